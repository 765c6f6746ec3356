"""Skeleton of an environment class for an FMU, made from its model description.

The names and texts come from a foreign file. They enter the program only as literals and in
comments of one line, so that none of them can become code.
"""

from __future__ import annotations

import math
import os
import re
import textwrap
from collections.abc import Iterator, Sequence
from contextlib import suppress
from functools import cached_property
from pathlib import Path
from typing import Any, Final

import numpy as np

from fmugym.cli.overview import typed_start
from fmugym.errors import ConfigError, FMULoadError, plain
from fmugym.fmi.fmu import FMU
from fmugym.fmi.fortran_libraries import replaceable
from fmugym.fmi.systems.system_description import SystemDescription
from fmugym.fmi.variable import Variable

__all__ = [
    "END_OF_EXPERIMENT",
    "Skeleton",
    "given_start",
    "guessed_bounds",
    "needs_bounds",
    "old_libraries",
    "remark",
    "rounded_down",
]

_MOST_PARAMETERS: Final = 40
"""More parameters than this are left out; ``fmugym info`` lists them."""

_DEFAULT_STEP: Final = 0.01
"""Step size in seconds for an FMU without a default experiment."""

_MOST_ELEMENTS: Final = 100
"""Larger arrays are left out."""

_MOST_LOCALS: Final = 8
"""Most locals that stand for the outputs of an FMU without any."""

_EPISODE_STEPS: Final = 500
"""Approximate number of steps in a default experiment without a usable step size."""

_MOST_STEPS: Final = 100_000
"""More steps than this are no episode."""

_SOLVER: Final = re.compile(
    r"""(^|\.)_                 # as in JModelica's _cs_solver
    |(^|[._])(
        solver|jacobian|newton|cvode|ida|nle|sundials
        |(rel|abs|r|a)_?tol(erance)?|(max|min|initial)_?step(_?size)?|log_?level
    )($|[._\d])""",
    re.VERBOSE | re.IGNORECASE,
)
"""Names of parameters that set up the exporter's solver rather than the model."""

END_OF_EXPERIMENT: Final = "of the FMU's default experiment; an episode ends there"
_NO_STEP_SIZE: Final = "TODO: the FMU gives none that fits"

_PROGRAM: Final = '''\
"""An environment for the FMU {file}. Complete the lines with TODO.

Running this file checks the environment.
"""

from __future__ import annotations

import logging
from typing import Any

{import_}import fmugym
from fmugym.environment.env_checker import check_fmu_env, check_hooks

FMU_PATH = {path}  # a relative path is relative to this file


class {name}(fmugym.{base}):
    """TODO: what is there to learn?"""

    vectorized = True  # the hooks work on arrays, environments last; check_hooks looks after that

    def __init__(self, log_level: int = logging.WARNING) -> None:
        config = {{
{config}
        }}
        super().__init__(FMU_PATH, config, log_level)
{hooks}
    def _is_done(self) -> Any:
        """Whether the task has ended, by success or by failure."""
        # TODO: for example  return abs(self.out[{first_output}]) > 1.0
        return False

    def _reward_policy(self) -> Any:
        """The reward of this step."""
        # TODO: by default positive_reward, and negative_reward in the step that ends the task
        return super()._reward_policy()


if __name__ == "__main__":
    env = {name}()
    check_fmu_env(env)
    env.close()
    check_hooks({name})
    print("{name} keeps the contract of an environment.")
'''

_IMPORT_WITHOUT_INPUT: Final = "from gymnasium import spaces\n\n"

_HOOKS_WITHOUT_INPUT: Final = '''
    def _get_action_space(self) -> spaces.Space[Any]:
        """The FMU has no numeric input, so the only action is to wait."""
        return spaces.Discrete(1)  # TODO: or name a tunable parameter as an input

    def _get_inputs(self) -> Any:
        return ()
'''


class Skeleton:
    """Python file for an FMU, with notes on its guesses.

    Args:
        fmu: The FMU; nothing of it is executed.
        folder: The folder of the file, from which paths are relative; None for absolute ones.

    Raises:
        ConfigError: If the FMU has no numeric variable to observe.
    """

    def __init__(self, fmu: FMU, folder: Path | None = None) -> None:
        self._fmu, self._folder = fmu, folder
        self._description = fmu.description
        if not self.outputs:
            raise ConfigError(
                f"{fmu.path.name} has no Real, Integer, Boolean or Enumeration to observe"
            )

    @cached_property
    def inputs(self) -> list[Variable]:
        """The numeric inputs."""
        return _scalars(self._of("input"))

    @cached_property
    def outputs(self) -> list[Variable]:
        """The numeric outputs, or some locals if there are none."""
        return _scalars(self._of("output")) or _scalars(self._of("local"))[:_MOST_LOCALS]

    @cached_property
    def parameters(self) -> list[Variable]:
        """The parameters of the model that can be set and have a start value.

        At most ``_MOST_PARAMETERS``. Those of the exporter's solver are left out.
        """
        usable = (v for v in self._of("parameter") if v.settable_at_start and literal(v))
        return [v for v in usable if not _SOLVER.search(v.name)][:_MOST_PARAMETERS]

    @property
    def left_out(self) -> int:
        """Number of parameters of the FMU that are not among ``parameters``."""
        return len(self._of("parameter")) - len(self.parameters)

    def _of(self, causality: str) -> list[Variable]:
        """The variables that an environment may use in this role; not all clocks are."""
        clocks, everything = self._description.clocks, self._description.variables.values()
        return [
            v
            for v in everything
            if v.causality == causality
            and (not v.ticking or (v in clocks and (causality != "input" or v.settable_in_step)))
        ]

    @property
    def class_name(self) -> str:
        """A name for the class, made of the last part of the model's name."""
        words = re.findall(r"[A-Za-z0-9]+", self._description.model_name.split(".")[-1])
        name = "".join(word[0].upper() + word[1:] for word in words)
        return ("Model" if not name or name[0].isdigit() else "") + name + "Env"

    def notes(self) -> Iterator[str]:
        """Decisions for the user, before the file is useful."""
        for variable in filter(needs_bounds, self.inputs):
            yield f"the FMU gives no limits of input {variable.name!r}; set them in 'bounds'"
        if not self.inputs:
            yield "the FMU has no numeric input"
        if not self._of("output"):
            yield "the FMU has no outputs; locals replace them"
        if not self.has_step_size:
            yield "the FMU gives no step size that fits its default experiment; set 'time_step'"
        for obstacle in self._fmu.obstacles:
            yield f"the FMU does not run on this machine: {obstacle}"

    @property
    def _base(self) -> str:
        """The name of the base class."""
        if isinstance(self._description, SystemDescription):
            return "FMUEnv"
        kind = "CS" if self._description.interface == "co_simulation" else "ME"
        return f"FMI{self._description.fmi_major_version}{kind}Env"

    def text(self) -> str:
        """The Python file, ASCII."""
        return _PROGRAM.format(
            file=re.sub(r'["\\]', "_", plain(self._fmu.path.name)),
            import_="" if self.inputs else _IMPORT_WITHOUT_INPUT,
            path=_quoted(self._path()),
            name=self.class_name,
            base=self._base,
            config=textwrap.indent("\n".join(self._config()), " " * 12),
            hooks="" if self.inputs else _HOOKS_WITHOUT_INPUT,
            first_output=_quoted(self.outputs[0].name),
        )

    def _config(self) -> Iterator[str]:
        yield from _listing("model_input_names", [_name_line(v) for v in self.inputs])
        yield from self._bounds()
        yield from _listing("model_output_names", [_name_line(v) for v in self.outputs])
        yield "# A value may be a distribution, drawn at each reset: fmugym.Uniform(low, high), ..."
        yield from _listing("model_parameters", list(self._parameter_lines()), "{}")
        yield from self._times()
        yield from self._preloaded()

    def _path(self) -> str:
        """The path of the FMU, relative to the folder of the file if that is known."""
        path = self._fmu.path
        if self._folder is not None:
            with suppress(ValueError):  # on another drive
                path = Path(os.path.relpath(path, self._folder.absolute()))
        return path.as_posix()

    def _preloaded(self) -> Iterator[str]:
        """The old libraries that the FMU lacks; a comment until they are built."""
        names = old_libraries(self._fmu)
        if names:
            are_there = all(((self._folder or Path()) / name).exists() for name in names)
            paths = ", ".join(_quoted(f"./{name}") for name in names)
            name = plain(self._fmu.path.name)
            yield f"# The FMU needs this: fmugym info --repair {name} builds it"
            yield ("" if are_there else "# ") + f'"foreign": {{"preload": [{paths}]}},'

    def _bounds(self) -> Iterator[str]:
        unbounded = [v for v in self.inputs if needs_bounds(v)]
        if unbounded:
            yield "# TODO: the FMU gives no limits of these; (low, high) is a guess."
            ends = [(_quoted(v.name), *guessed_bounds(v)) for v in unbounded]
            lines = [f"{name}: ({low!r}, {high!r}),  # TODO" for name, low, high in ends]
            yield from _listing("bounds", lines, "{}")

    def _parameter_lines(self) -> Iterator[str]:
        for variable in self.parameters:
            yield f"{_quoted(variable.name)}: {literal(variable)},{remark(variable)}"
        if self.left_out:
            yield f"# {self.left_out} more are listed by: fmugym info -v"

    def _times(self) -> Iterator[str]:
        note = "the default of the FMU" if self.has_step_size else _NO_STEP_SIZE
        yield f'"time_step": {self.time_step!r},  # s, {note}'
        yield f'"max_episode_steps": {self.episode_steps},'
        if self.stop_time is not None:
            yield f'"stop_time": {self.stop_time!r},  # s, {END_OF_EXPERIMENT}'

    @property
    def time_step(self) -> float:
        """The step size of the FMU in seconds, or a guess."""
        own = self._description.step_size
        return own if self.has_step_size and own is not None else self._guessed_step

    @property
    def episode_steps(self) -> int:
        """Number of steps in the default experiment, unless that is no episode."""
        return round(self._duration / self.time_step) if self.has_duration else 200

    @property
    def stop_time(self) -> float | None:
        """End of the FMU's default experiment; None for none, or one too early.

        Some FMUs do not start without one.
        """
        start, stop = self._description.start_time, self._description.stop_time
        length = self.episode_steps * self.time_step
        return stop if stop is not None and start + length <= stop * (1 + 1e-9) else None

    @property
    def _duration(self) -> float:
        """The seconds of the FMU's default experiment; 0 if it has none."""
        description = self._description
        seconds = 0.0 if description.stop_time is None else description.stop_time
        return max(seconds - description.start_time, 0.0) if seconds else 0.0

    @property
    def has_duration(self) -> bool:
        """Whether an episode takes as long as the FMU's default experiment."""
        return 1 <= self._duration / self.time_step <= _MOST_STEPS

    @property
    def has_step_size(self) -> bool:
        """Whether the FMU's own step size is not longer than its default experiment."""
        step = self._description.step_size
        return step is not None and (self._duration == 0.0 or step <= self._duration)

    @property
    def _guessed_step(self) -> float:
        """A round number of seconds, or a multiple of the FMU's internal step size."""
        internal = self._description.fixed_internal_step_size
        if not 0.0 < self._duration < math.inf:
            return internal or _DEFAULT_STEP
        if internal:
            return internal * max(1, round(self._duration / _EPISODE_STEPS / internal))
        return rounded_down(self._duration / _EPISODE_STEPS)


def old_libraries(fmu: FMU) -> tuple[str, ...]:
    """The libraries that an FMU lacks and for which replacements can be built."""
    if not isinstance(fmu.description, SystemDescription):
        with suppress(FMULoadError):  # the notes tell what is damaged
            return replaceable(fmu)
    return ()


def _listing(key: str, lines: list[str], brackets: str = "[]") -> Iterator[str]:
    if not lines:
        yield f'"{key}": {brackets},'
        return
    yield f'"{key}": {brackets[0]}'
    yield from (f"    {line}" for line in lines)
    yield f"{brackets[1]},"


def _name_line(variable: Variable) -> str:
    return f"{_quoted(variable.name)},{remark(variable)}"


def needs_bounds(variable: Variable) -> bool:
    """Whether the FMU leaves a limit of an input open, or its limits contradict each other."""
    low, high = variable.limits
    return variable.kind in {"real", "integer"} and not (math.isfinite(low) and math.isfinite(high))


def guessed_bounds(variable: Variable) -> tuple[float, float]:
    """The limits of an input; missing ones are guessed.

    A model often fails far away from its start value.
    """
    low, high = variable.limits
    down, up = _reach(variable)
    start = _start(variable)
    if not math.isfinite(low):
        low = min(start, high) - down
    if not math.isfinite(high):
        high = max(start, low) + up
    return low, high


def _start(variable: Variable) -> float:
    value = typed_start(variable)
    return float(value) if isinstance(value, int | float) else 0.0


def _reach(variable: Variable) -> tuple[float, float]:
    """Distances below and above its start value that an input without limits may move.

    A tenth of a start value, and at most the nominal value. Without both, nothing is known; a model
    then fails more often with negative values than with positive ones.
    """
    start, nominal = abs(_start(variable)), abs(variable.nominal or 0.0)
    sizes = [size for size in (start / 10, nominal) if size > 0.0]
    if not sizes:
        return 0.0, 1.0
    reach = min(sizes)
    return (max(1.0, round(reach)),) * 2 if variable.kind == "integer" else (reach, reach)


def rounded_down(value: float) -> float:
    """The next lower of 1, 2 or 5 times a power of ten; rounding errors do not count."""
    value *= 1.0 + 1e-9
    power = 10.0 ** math.floor(math.log10(value))
    digit = next(digit for digit in (5, 2, 1) if digit * power <= value or digit == 1)
    return float(f"{digit * power:.0e}")


def _scalars(variables: Sequence[Variable]) -> list[Variable]:
    """The numeric scalars, and the elements of numeric arrays that are not large."""
    usable = (v for v in variables if v.is_number and v.size <= _MOST_ELEMENTS)
    # something else drives elements of another causality
    return [one for v in usable for one in v.elements if one.causality == v.causality]


def literal(variable: Variable) -> str:
    """The start value as Python writes it; empty if the config takes none."""
    value = given_start(variable)
    return _quoted(value) if isinstance(value, str) else "" if value is None else repr(value)


def given_start(variable: Variable) -> Any:
    """The start value as the config takes it; None if the config takes none."""
    if variable.shape and variable.is_number and variable.start is not None:
        return _array_start(variable)
    value = typed_start(variable)
    if variable.kind == "string" and not variable.shape:
        return value
    if not variable.numeric or isinstance(value, str):
        return None  # a text is malformed or not finite here
    names = (name for name, number in variable.items if number == value)
    return next(names, None) if variable.items else value


def _array_start(variable: Variable) -> Any:
    """Nested lists of the start values; None if they are many, or are malformed."""
    with suppress(ConfigError):
        if 0 < variable.size <= _MOST_ELEMENTS:
            return np.reshape(variable.start_numbers, variable.shape).tolist()
    return None


def _quoted(text: str) -> str:
    """Quote a text as a literal in ASCII, in double quotes if they need no escape."""
    literal = ascii(text)
    return literal if '"' in literal else f'"{literal[1:-1]}"'


def remark(variable: Variable) -> str:
    """A comment with the unit and the description of a variable; empty if it has none."""
    unit = f"[{variable.unit}] " if variable.unit else ""
    text = textwrap.shorten(plain(unit + variable.description), 60, placeholder=" ...")
    return f"  # {text}" if text else ""
