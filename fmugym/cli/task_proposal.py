"""Proposal of a task file for an FMU, made from its model description.

The names and texts come from a foreign file. They enter the TOML only as quoted texts, as numbers
and in comments of one line.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final

from fmugym.cli.class_skeleton import (
    END_OF_EXPERIMENT,
    Skeleton,
    given_start,
    guessed_bounds,
    needs_bounds,
    old_libraries,
    remark,
)
from fmugym.cli.overview import typed_start
from fmugym.control.controller_table import is_table, table_in
from fmugym.errors import ConfigError, plain
from fmugym.fmi.fmu import FMU
from fmugym.fmi.systems.system_description import SystemDescription
from fmugym.fmi.variable import Variable
from fmugym.task.declarations import is_reserved
from fmugym.task.likely_units import likely_units

__all__ = ["Proposal", "preload_line"]

_HEAD: Final = """\
# A task for the FMU {file}. Complete the lines with TODO, then try
#   fmugym validate FILE                (mistakes, and their cures)
#   fmugym simulate FILE                (an episode)
#   fmugym train FILE --output agent    (an agent)
# Every key is described in docs/task-file.md.
fmu = {path}
time_step = {step}  # s{note}
episode_length = {length}  # s{note_of_length}
reward = "-abs({goal} - {setpoint})"  # TODO: a guess: {goal} follows {setpoint}
# terminated = "abs({goal}) > 10"  # TODO: does the task have an end?
"""

_MOST_RESULTS: Final = 30
"""Locals that are listed, at most."""

_TEMPERATURES: Final = frozenset({"K", "degC", "degF"})
_UNITS_OF_RESULTS: Final = _TEMPERATURES | {"W", "kW", "MW", "J", "kJ", "Wh", "kWh"}
"""Units of temperatures, powers and energies, which rewards and agents often need."""

_DEGREES: Final = 5.0
"""A set point of a temperature is this near to its start; zero of its unit means nothing."""

_ROOM: Final = {"K": 293.15, "degC": 20.0, "degF": 68.0}
"""Set points of a temperature without a start value, by unit."""

_GOAL: Final = re.compile(
    r"level|height|position|angle|speed|veloc|omega|rpm|pressure"
    r"|(^|\.)[hwx] \[|\[(m|rad|deg|m/s|rad/s)\]",
    re.IGNORECASE,
)
"""Pattern of variables that are often controlled, in names, descriptions and units."""

_OUTSIDE: Final = re.compile(
    r"\b(t ?(out|amb|ext)|amb|ambient|out(door|side)s?|weather|sol|solar|sun|irradi\w+|wind"
    r"|disturbances?|occupan\w+|people|internal gains?|load torque|tau load)\b",
    re.IGNORECASE,
)
"""Names and descriptions of inputs that no agent acts on."""


class Proposal:
    """Proposed task file for an FMU, with notes on its guesses.

    Args:
        fmu: The FMU; nothing of it is executed.
        folder: The folder of the file, from which the path of the FMU is relative; None for an
            absolute path.

    Raises:
        ConfigError: If the FMU has nothing to observe or to act on.
    """

    def __init__(self, fmu: FMU, folder: Path | None = None) -> None:
        self._guessed = likely_units(fmu.description)
        self._fmu, self._folder = fmu.with_units(self._guessed), folder
        self._skeleton = Skeleton(self._fmu)
        if not self._actions:
            raise ConfigError(
                f"{fmu.path.name} has no numeric input or tunable parameter that an agent could "
                f"act on{self._why_none()}"
            )

    @cached_property
    def _actions(self) -> list[Variable]:
        """The inputs that an agent may act on, or tunable parameters if there are none.

        Of a system, these are the parameters that are connectors of its own, if there are any.
        """
        variables = self._fmu.description.variables.values()
        tunable = [v for v in variables if v.numeric and v.settable_in_step]
        own = [variable for variable in tunable if variable.name in self._connectors]
        inputs = self._skeleton.inputs
        return [v for v in inputs if not _is_outside(v)] or inputs or own or tunable[:1]

    @cached_property
    def _connectors(self) -> set[str]:
        """The names of a system's own connectors; an FMU has none."""
        description = self._fmu.description
        if not isinstance(description, SystemDescription):
            return set()
        return {one.name for one in description.plan.connectors}

    def _why_none(self) -> str:
        """Advice for an FMU without an input to act on."""
        fixed = [v.name for v in self._skeleton.parameters if v.numeric]
        if not isinstance(self._fmu.description, SystemDescription):
            return ""
        cure = "; give the system a connector of the kind 'input'"
        if not fixed:
            return cure
        return f"{cure}. Its parameters, such as {fixed[0]!r}, are fixed within an episode"

    @cached_property
    def _others(self) -> list[Variable]:
        """The inputs that look like weather, loads or people."""
        return [v for v in self._skeleton.inputs if v not in self._actions]

    @cached_property
    def _goal(self) -> Variable:
        """The output that is probably to be controlled."""
        return min(self._skeleton.outputs, key=_unlikeliness)

    @cached_property
    def _setpoint(self) -> str:
        """The name of its set point."""
        taken = {*self._fmu.description.variables, *self._aliases.values()}
        return _free_alias(f"{self._aliases[self._goal.name]}_set", taken)

    @cached_property
    def _aliases(self) -> dict[str, str]:
        """An alias for each variable by its name in the FMU."""
        aliases: dict[str, str] = {}
        for variable in [*self._actions, *self._skeleton.outputs]:
            if variable.name not in aliases:
                aliases[variable.name] = _free_alias(variable.name, set(aliases.values()))
        return aliases

    def notes(self) -> Iterator[str]:
        """Decisions for the user, before the task is useful."""
        yield f"reward and set point are guesses: {self._goal.name!r} follows {self._setpoint!r}"
        for variable in self._others:
            yield f"input {variable.name!r} looks like a disturbance: no action writes it"
        for variable in filter(needs_bounds, self._actions):
            yield (
                f"the FMU gives no limits of {variable.causality} {variable.name!r}: those in the "
                "file are a guess"
            )
        used = dict.fromkeys(map(_scalar_or_array, [*self._actions, *self._skeleton.outputs]))
        for name in (one for one in used if one in self._guessed):
            yield (
                f"the FMU gives no unit of {name!r}, which looks like {self._guessed[name]}: check "
                "'fmu_unit'"
            )
        if not self._skeleton.has_step_size:
            yield "the FMU gives no step size that fits its default experiment; check 'time_step'"
        if not self._skeleton.has_duration:
            yield "the FMU does not say how long it takes: 'episode_length' is a guess"
        if self._skeleton.left_out:
            yield f"{self._skeleton.left_out} parameters are left out; 'fmugym info -v' lists them"
        for obstacle in self._fmu.obstacles:
            yield f"the FMU does not run on this machine: {obstacle}"

    def text(self, controllers: Mapping[str, str] = MappingProxyType({})) -> str:
        """The TOML file; only comments have letters beyond ASCII.

        Args:
            controllers: Guesses by name: texts as the command line takes them.
        """
        skeleton = self._skeleton
        head = _HEAD.format(
            file=plain(self._fmu.path.name),
            path=_quoted(self._path()),
            step=repr(skeleton.time_step),
            note="" if skeleton.has_step_size else "; TODO: the FMU gives none that fits",
            length=repr(self._length()),
            note_of_length="" if skeleton.has_duration else "; TODO: a guess",
            goal=self._aliases[self._goal.name],
            setpoint=self._setpoint,
        )
        return "\n".join(
            [
                *(head, *self._variables(), *self._results(), "", *self._setpoints(), ""),
                *(*self._agent(), "", *_controllers(controllers), ""),
                *(*self._parameters(), *self._config(), *self._foreign(), ""),
            ]
        )

    def _path(self) -> str:
        path = self._fmu.path
        if self._folder is not None and path.is_relative_to(self._folder.absolute()):
            return path.relative_to(self._folder.absolute()).as_posix()
        return path.as_posix()

    def _length(self) -> float:
        return float(f"{self._skeleton.episode_steps * self._skeleton.time_step:.12g}")

    def _variables(self) -> Iterator[str]:
        yield "[variables]"
        for variable in self._actions:
            yield self._action(variable)
        for variable in self._skeleton.outputs:
            parts = self._parts(variable, self._aliases[variable.name])
            if parts:
                yield f"{self._aliases[variable.name]} = {_table(parts)}{self._remark(variable)}"

    def _parts(self, variable: Variable, alias: str) -> list[str]:
        """Keys of any variable: its name in the FMU, and its unit there."""
        unit = self._guessed.get(_scalar_or_array(variable))
        name = [f"name = {_quoted(variable.name)}"] if alias != variable.name else []
        return name if unit is None else [*name, f"fmu_unit = {_quoted(unit)}"]

    def _remark(self, variable: Variable) -> str:
        is_guessed = _scalar_or_array(variable) in self._guessed
        return "  # TODO: the unit is a guess" if is_guessed else remark(variable)

    def _results(self) -> Iterator[str]:
        """Locals as comments: for many an exporter, the interesting variables are no outputs."""
        outputs = self._skeleton.outputs
        found = [v for v in self._fmu.description.variables.values() if _is_result(v)]
        found = [variable for variable in found if variable not in outputs]
        if found:
            yield "# These locals are no outputs of the FMU, but a reward or an agent may use them:"
        taken = {self._setpoint, *self._aliases.values()}
        for variable in found[:_MOST_RESULTS]:
            taken.add(alias := _free_alias(variable.name, taken))
            parts = self._parts(variable, alias) or [f"name = {_quoted(variable.name)}"]
            yield f"# {alias} = {_table(parts)}{self._remark(variable)}"
        if len(found) > _MOST_RESULTS:
            yield f"# {len(found) - _MOST_RESULTS} more are listed by: fmugym info --all"

    def _action(self, variable: Variable) -> str:
        parts = self._parts(variable, self._aliases[variable.name])
        if needs_bounds(variable):
            low, high = guessed_bounds(variable)
            parts.append(f"min = {low!r}, max = {high!r}")
        todo = "  # TODO: the limits are a guess" if needs_bounds(variable) else ""
        note = todo or self._remark(variable)
        return f"{self._aliases[variable.name]} = {_table(parts)}{note}"

    def _agent(self) -> Iterator[str]:
        yield "[agent]"
        others = [
            f"    # {_quoted(v.name)} looks like a disturbance: [data]?" for v in self._others
        ]
        yield from self._listing("actions", self._actions, others)
        seen = f'    "{self._setpoint}",  # the set point of {self._aliases[self._goal.name]}'
        yield from self._listing("observations", self._skeleton.outputs, [seen])

    def _listing(self, key: str, variables: list[Variable], more: list[str]) -> Iterator[str]:
        yield f"{key} = ["
        for variable in variables:
            yield f'    "{self._aliases[variable.name]}",{remark(variable)}'
        yield from [*more, "]"]

    def _setpoints(self) -> Iterator[str]:
        low, high = _ends_of_setpoint(self._goal)
        drawn = f'{{ distribution = "uniform", low = {low:.12g}, high = {high:.12g} }}'
        yield "[setpoints]"
        yield f"{self._setpoint} = {drawn}  # TODO: a guess; a number is constant"

    def _parameters(self) -> Iterator[str]:
        """Parameters as comments: a task need not set any."""
        yield "[parameters]"
        yield "# Each of these may be set, or drawn anew in each episode, for example:"
        yield '# name = { distribution = "uniform", low = 0.9, high = 1.1 }'
        for variable in self._skeleton.parameters:
            yield f"# {_key(variable.name)} = {_as_toml(given_start(variable))}{remark(variable)}"
        if self._skeleton.left_out:
            yield f"# {self._skeleton.left_out} more are listed by: fmugym info -v"

    def _config(self) -> Iterator[str]:
        if self._skeleton.stop_time is not None:
            yield "\n[config]"
            yield f"stop_time = {self._skeleton.stop_time!r}  # s, {END_OF_EXPERIMENT}"

    def _foreign(self) -> Iterator[str]:
        """The old libraries that the FMU lacks; a comment until they are built."""
        names = old_libraries(self._fmu)
        if not names:
            return
        are_there = all(((self._folder or Path()) / name).exists() for name in names)
        yield "\n[foreign]"
        yield f"# The FMU needs this: fmugym info --repair {plain(self._fmu.path.name)} builds it"
        yield ("" if are_there else "# ") + preload_line([f"./{name}" for name in names])


def preload_line(paths: Sequence[str]) -> str:
    """The line that names libraries, for the table ``[foreign]`` of a task file."""
    return f"preload = [{', '.join(map(_quoted, paths))}]"


def _controllers(guesses: Mapping[str, str]) -> Iterator[str]:
    yield "[controllers]"
    if guesses:
        yield "# Guesses from step responses of the actions; the least coupled loops come first."
    for guess, text in guesses.items():
        name = guess.lower().replace(" ", "_")
        if not is_table(text):
            yield f"{name} = {_quoted(text)}"
            continue
        yield f"[controllers.{name}]"
        yield from (f"{_key(action)} = {_quoted(one)}" for action, one in table_in(text).items())


def _scalar_or_array(variable: Variable) -> str:
    """The name of a scalar, or of the array of an element, which has the unit."""
    return variable.name if variable.array is None else variable.array.name


def _table(parts: Sequence[str]) -> str:
    """An inline table of TOML."""
    return f"{{ {', '.join(parts)} }}" if parts else "{}"


def _is_result(variable: Variable) -> bool:
    """Whether a local looks like something that a model is made to compute."""
    is_local = variable.causality == "local" and variable.variability == "continuous"
    return is_local and variable.numeric and variable.unit in _UNITS_OF_RESULTS


def _words(variable: Variable) -> str:
    """The name, the unit and the description of a variable."""
    return f"{variable.name.replace('_', ' ')} [{variable.unit or ''}] {variable.description}"


def _is_outside(variable: Variable) -> bool:
    """Whether an input looks like weather, a load or people."""
    return _OUTSIDE.search(_words(variable)) is not None


def _unlikeliness(variable: Variable) -> tuple[bool, ...]:
    """Reasons against an output as the controlled variable, the strongest first."""
    return (
        variable.kind != "real",
        variable.unit not in _TEMPERATURES,
        _is_outside(variable),
        _GOAL.search(_words(variable)) is None,
    )


def _ends_of_setpoint(variable: Variable) -> tuple[float, float]:
    """Values near the start of a temperature, or in the middle of the range of another output."""
    start = typed_start(variable) or variable.nominal or _ROOM.get(variable.unit or "")
    if variable.unit in _TEMPERATURES and isinstance(start, int | float):
        return start - _DEGREES, start + _DEGREES
    low, high = guessed_bounds(variable)
    return (3 * low + high) / 4, (low + 3 * high) / 4


def _free_alias(name: str, taken: set[str]) -> str:
    """A name of letters, digits and _ that is not taken."""
    alias = re.sub(r"\W+", "_", name, flags=re.ASCII).strip("_") or "variable"
    alias = f"v_{alias}" if alias[0].isdigit() or is_reserved(alias) else alias
    free, number = alias, 2
    while free in taken:
        free, number = f"{alias}_{number}", number + 1
    return free


def _key(name: str) -> str:
    """A key of TOML."""
    return name if re.fullmatch(r"[A-Za-z0-9_-]+", name) else _quoted(name)


def _quoted(text: str) -> str:
    """Quote a text as a basic string of TOML, in ASCII; its escapes are those of JSON."""
    parts = re.split(r"([\ud800-\udfff\U00010000-\U0010ffff\x7f])", text)
    escaped = "".join(
        f"\\U{ord(part):08x}" if index % 2 else json.dumps(part)[1:-1]
        for index, part in enumerate(parts)
    )
    return f'"{escaped}"'


def _as_toml(value: Any) -> str:
    """A start value in TOML, which writes numbers and Booleans as JSON does."""
    return _quoted(value) if isinstance(value, str) else json.dumps(value)
