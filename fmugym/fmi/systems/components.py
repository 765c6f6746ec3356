"""Components and connections of a system, as a user gives them.

Components are checked against their FMUs.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

from fmugym.checks import (
    KnownArguments,
    check_flag,
    check_number,
    check_path,
    check_text,
    parts_of_array,
)
from fmugym.errors import ConfigError, FMULoadError, shown, unknown_name
from fmugym.fmi.description import INTERFACES, Feedthrough
from fmugym.fmi.fmu import FMU
from fmugym.fmi.systems import system_plan
from fmugym.fmi.variable import Variable, checked_value, unknown_rest
from fmugym.keys import (
    COUNT,
    FLAG,
    NUMBER,
    TEXT,
    Either,
    Entries,
    Kind,
    check_fields,
    key,
    option,
    table_of_fields,
)

__all__ = ["CONNECTION", "Component", "Connection", "OpenComponent"]

_ARROW: Final = "->"


def _name(end: str, value: Any) -> str:
    name = check_text(f"the {end} of a connection", value).strip()
    if not name:
        raise ConfigError(f"the {end} of a connection is empty")
    return name


def _gain(what: str, value: Any) -> float:
    gain = check_number(what, value)
    if not gain:
        raise ConfigError(f"{what} must not be 0")
    return gain


@dataclass(frozen=True)
class Connection(KnownArguments):
    """A connection of an ``FMUSystem``: ``target = gain * source + offset``.

    The value is converted from the unit of the source to that of the target, then ``gain`` and
    ``offset`` apply to the converted value. Both may be the name of a component, a dot and the
    name of its variable. A name without a component is one of the system itself: as a source it
    is an input or parameter of the system, as a target an output. The keys are those of a
    connection in a task file, see ``docs/systems.md``.

    Raises:
        ConfigError: If a value does not fit.
        ArgumentError: If there is no argument of this name; that is a ``TypeError``, too.
    """

    source: str = key(Kind(_name, TEXT.schema), "Where the value comes from.")
    target: str = key(Kind(_name, TEXT.schema), "Where it goes.")
    gain: float = key(Kind(_gain, NUMBER.schema), "Factor of the value.", 1.0)
    offset: float = key(NUMBER, "This is added.", 0.0)
    convert_units: bool = key(FLAG, "Whether the value is converted between units.", True)

    def __post_init__(self) -> None:
        check_fields(self)

    def __str__(self) -> str:
        return f"{self.source} {_ARROW} {self.target}"

    @classmethod
    def of(cls, value: Any) -> Connection:
        """Make a connection of ``"source -> target"`` or a pair of names.

        Raises:
            ConfigError: If it is none.
        """
        if isinstance(value, Connection):
            return value
        parts = value.split(_ARROW) if isinstance(value, str) else value
        if isinstance(parts, list | tuple) and len(parts) == 2:
            return cls(*parts)
        raise ConfigError(
            f"a connection must be 'source -> target', a pair of names or a Connection, "
            f"got {shown(value)}"
        )


CONNECTION: Final = Either(
    table_of_fields(Connection, make=Connection),
    Kind(lambda _, value: Connection.of(value), {"title": '"source -> target"', **TEXT.schema}),
)
"""A connection as a text or pair of names, a table or an object."""

_NO_NAME = set('/\\:*?"<>|')


def _fmu(what: str, value: Any) -> Any:
    if not isinstance(value, FMU):
        check_path("the path of an FMU", value)
    return value


def _no_feedthrough(what: str, value: Any) -> bool:
    if check_flag(what, value):
        raise ConfigError(f"{what} of a component must be False or None, got True")
    return False


@dataclass(frozen=True)
class Component(KnownArguments):
    """One FMU of an ``FMUSystem``.

    Its keys are those of a component in a task file, see ``docs/systems.md``. The values of an
    environment, such as ``model_parameters``, win over ``start_values``. ``isolation`` of an
    environment wins over ``isolate``.

    Raises:
        ConfigError: If a value does not fit.
        ArgumentError: If there is no argument of this name; that is a ``TypeError``, too.
    """

    fmu: FMU | str | os.PathLike[str] = key(
        Kind(_fmu, {"title": "path"}, "path"),
        "Path of the FMU, or in Python an `FMU`, whose limits and libraries are used.",
    )
    start_values: Mapping[str, Any] = key(
        Entries(Kind(lambda _, value: value)),
        "Parameters and start values by the names of the FMU's variables, in their units: numbers, "
        "texts, for arrays nested lists, a flat list or one value for all elements; structural "
        "parameters, too. `model_parameters` of an environment win.",
        {},
    )
    interface: str | None = key(
        option(*INTERFACES), "How the FMU is run.", None, "co-simulation if there is one"
    )
    steps: int = key(COUNT, "Communication steps of the component in one of the system.", 1)
    feedthrough: bool | None = key(
        Kind(_no_feedthrough, {"const": False}),
        "`false`: [no output depends on an input](systems.md#order) without a step in between.",
        None,
        "as the FMU tells",
    )
    isolate: bool = key(
        FLAG,
        "Whether the whole system runs in [worker processes](systems.md#in-worker-processes) "
        "because of this component, so that a crash ends single episodes only.",
        False,
    )

    def __post_init__(self) -> None:
        check_fields(self)


class OpenComponent:
    """A component whose FMU has been read.

    Args:
        name: Its name in the system.
        given: Values that the user gave.

    Attributes:
        name, given: As given.
        fmu: The FMU. Nothing of it is executed or extracted.
        starts: The start values as numbers and texts, by the names of scalars and elements.
        sizes: The values of structural parameters.

    Raises:
        ConfigError: If the name or a start value does not fit.
        FMULoadError: If the FMU cannot be read.
    """

    def __init__(self, name: str, given: Component) -> None:
        if not name or not name.isprintable() or _NO_NAME & set(name) or name != name.strip():
            raise ConfigError(f"a component cannot be named {shown(name)}")
        self.name, self.given = name, given
        try:
            self.fmu = _opened(given)
        except FMULoadError as error:
            raise type(error)(f"component {name!r}: {error}") from None
        self.sizes = dict(self.fmu.sizes)
        found: dict[str, float | str] = {}
        # what is given for an element counts more than what is given for its array
        for one, value in sorted(given.start_values.items(), key=lambda item: item[0][-1:] == "]"):
            if one not in self.sizes:
                found.update(self._starts(one, value))
        self.starts = tuple(found.items())
        self._require_rest()

    def _starts(self, name: str, value: Any) -> Iterator[tuple[str, float | str]]:
        variable = self.variable(name)
        if not variable.settable_at_start:
            raise ConfigError(
                f"{self.name}.{name} cannot be set: it is a {variable.variability} "
                f"{variable.causality} with initial={variable.initial!r}"
            )
        if not variable.shape:
            yield name, _start(f"{self.name}.{name}", variable, value)
            return
        parts = parts_of_array(f"{self.name}.{name}", variable.shape, value)
        for element, part in zip(variable.elements, parts, strict=True):
            yield element.name, _start(f"{self.name}.{element.name}", element, part)

    def _require_rest(self) -> None:
        """FMI sets whole arrays, and the FMU does not tell the start values of a new size."""
        found = unknown_rest([self.variable(name) for name, _ in self.starts])
        if found is not None:
            missing, array = found
            raise ConfigError(
                f"there is no value of {missing.name!r} of the component {self.name!r}: "
                f"{array.name!r} has a size of its own, {array.shape}; give all elements"
            )

    def variable(self, name: str) -> Variable:
        """Find a variable, or an element of an array, by its name in the component.

        Raises:
            ConfigError: If there is none; the text suggests the nearest name.
        """
        description = self.fmu.description
        found = description.find(name)
        if found is not None:
            return found
        if name.endswith("]"):
            description.variable(name)  # which says what is wrong with the index of an element
        raise unknown_name(f"variable of the component {self.name!r}", name, description.variables)

    @property
    def feedthrough(self) -> Feedthrough:
        """Direct feed-through: the inputs that act at once on each output."""
        told = self.fmu.feedthrough
        if self.given.feedthrough is None:
            return told
        nothing: dict[str, frozenset[str]] = dict.fromkeys(told.in_step, frozenset())
        return Feedthrough(nothing, nothing, known=True)

    def planned(self) -> system_plan.ComponentPlan:
        """The component as the master executes it."""
        limits, preload = self.fmu.limits, self.fmu.preload
        return system_plan.ComponentPlan(
            self.name,
            self.fmu.path,
            self.fmu.interface,
            self.given.steps,
            self.starts,
            limits,
            preload,
            tuple(self.sizes.items()),
            self.given.isolate,
        )


def _start(name: str, variable: Variable, value: Any) -> float | str:
    """Convert a start value for a variable, which is called by another name in errors."""
    if variable.kind == "string" and isinstance(value, str):
        return str.__str__(value)
    if not variable.numeric:
        raise ConfigError(f"{name} is of type {variable.type} and cannot be {shown(value)}")
    return checked_value(replace(variable, name=name), value)


def _opened(given: Component) -> FMU:
    """Open the FMU with the interface and the sizes of arrays that the component wants."""
    if isinstance(given.fmu, FMU):
        fmu = given.fmu
    else:
        fmu = FMU(check_path("the path of an FMU", given.fmu), interface=given.interface)
    variables = fmu.description.variables
    known = {n: v for n, v in given.start_values.items() if n in variables}
    sizes = {n: v for n, v in known.items() if variables[n].is_structural}
    fits = given.interface in (None, fmu.description.interface)
    if fits and sizes.items() <= fmu.sizes.items():
        return fmu
    return FMU(
        Path(fmu.path),
        limits=fmu.limits,
        preload=fmu.preload,
        probe_timeout=fmu.probe_timeout,
        interface=fmu.interface if given.interface is None else given.interface,
        sizes={**fmu.sizes, **sizes},
    )
