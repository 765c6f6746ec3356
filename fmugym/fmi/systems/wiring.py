"""Wiring of a system: connections resolved to variables, gains and offsets, with their mistakes.

The order and the plan of a wired system follow from its components and connections.
"""

from __future__ import annotations

import inspect
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Final, Never, TypeAlias

from fmugym.checks import Spellings, normal_form
from fmugym.errors import ConfigError, unknown_argument, unknown_name
from fmugym.fmi.description import Unit
from fmugym.fmi.systems.components import CONNECTION, Component, Connection, OpenComponent
from fmugym.fmi.systems.system_plan import (
    MASTERS,
    Connector,
    End,
    Link,
    Loop,
    SystemOrder,
    SystemPlan,
    order_of,
)
from fmugym.fmi.units import IDENTITY, Conversion, conversion_of_link
from fmugym.fmi.variable import MOST_ELEMENTS, Variable
from fmugym.keys import (
    COUNT,
    NUMBER,
    POSITIVE,
    REQUIRED,
    TEXT,
    Entries,
    Key,
    Listed,
    Table,
    checked_entry,
    option,
    table_of_fields,
)

__all__ = ["SYSTEM", "Port", "WiredSystem", "Wiring"]

_DefinedUnit: TypeAlias = tuple[str | None, Mapping[str, Unit]]
"""A unit, and the definitions of units by which it is meant."""

_SOURCES = ("output", "local", "calculatedParameter")


@dataclass(frozen=True)
class Port:
    """A variable of a component: a scalar, an element of an array, or a whole array."""

    component: OpenComponent
    variable: Variable

    @property
    def name(self) -> str:
        """Its name in the system."""
        return f"{self.component.name}.{self.variable.name}"

    @property
    def kind(self) -> str:
        """Kind of the variable, with items of enumerations as integers."""
        kind = self.variable.kind
        return "integer" if kind == "enumeration" else kind

    @property
    def elements(self) -> Iterator[Port]:
        """Scalars of an array, or the variable itself."""
        return (Port(self.component, element) for element in self.variable.elements)

    @property
    def is_text(self) -> bool:
        """Whether it is a String that a component can be started with."""
        return self.variable.is_text and self.variable.settable_at_start


@dataclass
class Wiring:
    """The connections of a system.

    Args:
        components: The components by name.
        connections: The connections as given.
        units: Units of the system's own inputs, outputs and parameters; without one, they have
            that of the variable behind them.
        own_names: The names of the system itself that contain a dot, at least.
        definitions: Units of ``units``, and of FMUs that do not define them themselves.

    Attributes:
        links: Links between components.
        connectors: The names of the system itself.

    Raises:
        ConfigError: If a connection does not fit.
    """

    components: Mapping[str, OpenComponent]
    connections: Iterable[Connection]
    units: Mapping[str, str]
    own_names: frozenset[str]
    definitions: Mapping[str, Unit]
    links: list[Link] = field(default_factory=list)
    connectors: list[Connector] = field(default_factory=list)
    _driven: dict[str, Connection] = field(default_factory=dict)
    _ends: dict[str, list[End]] = field(default_factory=dict)
    _causalities: dict[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._spellings = Spellings("component", self.components)
        self._spelt = {normal_form(name): name for name in self.own_names}
        for connection in self.connections:
            self._add(connection)
        self._check_units()
        self.connectors = [self._connector(name, ends) for name, ends in self._ends.items()]

    def _connector(self, name: str, ends: list[End]) -> Connector:
        """A name of the system; its unit is given only if it differs from the variable's."""
        unit, first = self.units.get(name), self._first(ends)
        if first is not None and unit == first.variable.unit:
            unit = None
        return Connector(name, tuple(ends), self._causalities[name], unit)

    def _add(self, connection: Connection) -> None:
        source, target = self.port(connection.source), self.port(connection.target)
        if source is None:
            connection = replace(connection, source=self._own_name(connection.source))
        if target is None:
            connection = replace(connection, target=self._own_name(connection.target))
        if source is None and target is None:
            raise ConfigError(
                f"{connection}: one of the two must be a variable of a component; components are: "
                f"{', '.join(self.components)}"
            )
        if target is not None:
            self._drive(target, connection)
        if source is None and target is not None:
            self._add_input(connection, target)
        elif source is not None:
            _require_source(source, connection)
            if target is None:
                self._add_output(connection, source)
            else:
                self.links.append(self._link(connection, source, target))

    def _own_name(self, name: str) -> str:
        """A name of the system as it was spelt first; its letters may only look other."""
        return name if name in self.own_names else self._spelt.setdefault(normal_form(name), name)

    def port(self, name: str) -> Port | None:
        """Find the variable that a name stands for; None for a name of the system itself.

        Raises:
            ConfigError: If there is no such component or variable; the text suggests the nearest.
        """
        dots = [place for place, letter in enumerate(name) if letter == "."]
        for dot in reversed(dots):
            own = self._spellings.find(name[:dot])
            if own is not None:
                component = self.components[own]
                return Port(component, component.variable(name[dot + 1 :]))
        if dots and self._own_name(name) not in self.own_names:
            raise unknown_name("component", name[: dots[0]], self.components)
        return None

    def _link(self, connection: Connection, source: Port, target: Port) -> Link:
        _check_kinds(connection, source, target)
        end = _end(connection, target, self._unit(source), self._unit(target))
        ends = source.component.name, source.variable.name, end.component, end.variable
        return Link(*ends, end.gain, end.offset)

    def _unit(self, port: Port) -> _DefinedUnit:
        """Unit of a variable; its FMU's definition of the name counts."""
        units = port.component.fmu.description.units
        return port.variable.unit, {**self.definitions, **units}

    def _drive(self, target: Port, connection: Connection) -> None:
        """Note the source of an input, which may be only one."""
        variable = target.variable
        from_system = self.port(connection.source) is None
        if not (from_system and target.is_text):
            _require_number(connection, target)
        for element in target.elements:
            other = self._driven.setdefault(element.name, connection)
            if other is not connection:
                raise ConfigError(
                    f"{element.name} has two sources: {other.source}, {connection.source}"
                )
        is_parameter = variable.causality == "parameter" and variable.settable_at_start
        if variable.causality != "input" and not (from_system and is_parameter):
            raise ConfigError(
                f"{connection}: {target.name} is a {variable.variability} {variable.causality}; "
                "a connection must end at an input"
            )

    def _add_input(self, connection: Connection, target: Port) -> None:
        name = connection.source
        is_input = target.variable.causality == "input"
        causality = "input" if is_input else "parameter"
        self._claim(name, causality, connection)
        ends = self._ends.setdefault(name, [])
        first = self._first(ends)
        end = _end(connection, target, self._own_unit(name, first or target), self._unit(target))
        if first is None:
            _check_gain(connection, target)
        else:
            _check_kinds(connection, first, target)
        ends.append(end)

    def _first(self, ends: list[End]) -> Port | None:
        if not ends:
            return None
        component = self.components[ends[0].component]
        return Port(component, component.variable(ends[0].variable))

    def _own_unit(self, name: str, port: Port) -> _DefinedUnit:
        """Unit of a name of the system, by default of a variable behind it."""
        unit, known = self._unit(port)
        if name not in self.units:
            return unit, known
        return self.units[name], {**known, **self.definitions}

    def _add_output(self, connection: Connection, source: Port) -> None:
        name = connection.target
        if name in self._ends:
            known = self._driven.get(name)
            others = f"{known.source}, {connection.source}" if known else connection.source
            raise ConfigError(f"the output {name!r} of the system has two sources: {others}")
        self._driven[name] = connection
        self._claim(name, "output", connection)
        _require_number(connection, source)
        end = _end(connection, source, self._unit(source), self._own_unit(name, source))
        _check_gain(connection, source)
        self._ends[name] = [end]

    def _claim(self, name: str, causality: str, connection: Connection) -> None:
        """Let a name of the system mean one thing."""
        if self._spellings.find(name) is not None:
            raise ConfigError(f"{connection}: {name!r} is a component; which of its variables?")
        known = self._causalities.setdefault(name, causality)
        if known != causality:
            raise ConfigError(
                f"{connection}: {name!r} is both {known} and {causality} of the system"
            )

    def _check_units(self) -> None:
        for name in self.units:
            if name not in self._ends:
                raise unknown_name(
                    "input, output or parameter of the system in 'units'", name, self._ends
                )

    def open_inputs(self) -> Iterator[Port]:
        """The inputs of components that nothing drives; they are inputs of the system."""
        for component in self.components.values():
            for variable in component.fmu.description.variables.values():
                ticks_itself = variable.ticking and not variable.settable_in_step
                if variable.causality == "input" and not ticks_itself:
                    yield from self._open_parts(Port(component, variable))

    def _open_parts(self, port: Port) -> Iterator[Port]:
        """An input that nothing drives, or its elements that nothing drives."""
        if not self._has_driven(port):
            yield port
        elif port.variable.shape:
            yield from (one for one in port.elements if one.name not in self._driven)

    def _has_driven(self, port: Port) -> bool:
        if port.variable.size > MOST_ELEMENTS:  # connections name no elements of such an array
            return False
        return any(element.name in self._driven for element in port.elements)


def _require_source(source: Port, connection: Connection) -> None:
    if source.variable.causality not in _SOURCES:
        variable = source.variable
        raise ConfigError(
            f"{connection}: {source.name} is a {variable.variability} {variable.causality}; a "
            "connection must begin at an output"
        )


def _end(connection: Connection, port: Port, own: _DefinedUnit, other: _DefinedUnit) -> End:
    """A variable, with the gain and offset of the units and of the connection."""
    conversion = IDENTITY
    if connection.convert_units:
        try:
            conversion = conversion_of_link(*own, *other)
        except ConfigError as error:
            raise ConfigError(
                f"{connection}: {error}; give it a gain and convert_units=False"
            ) from None
    conversion = conversion.of_differences(port.variable.relative)
    change = Conversion(connection.gain, connection.offset).after(conversion)
    return End(port.component.name, port.variable.name, change.factor, change.offset)


def _check_kinds(connection: Connection, source: Port, target: Port) -> None:
    """Refuse a connection that loses information: only integers may become reals."""
    if not (source.is_text and target.is_text):
        _require_number(connection, source)
    shapes = source.variable.shape, target.variable.shape
    if shapes[0] != shapes[1]:
        raise ConfigError(
            f"{connection}: {_shaped(source)}, and {_shaped(target)}; only equal shapes can be "
            "connected. An element has a name of its own: 'component.array[1]'"
        )
    kinds = source.kind, target.kind
    if kinds[0] != kinds[1] and kinds != ("integer", "real"):
        raise ConfigError(
            f"{connection}: {source.name} is of type {source.variable.type} and {target.name} of "
            f"type {target.variable.type}; only equal kinds can be connected, and Integer with Real"
        )
    _check_gain(connection, target)


def _check_gain(connection: Connection, target: Port) -> None:
    plain = connection.gain == 1 and connection.offset == 0
    if target.kind != "real" and not plain:
        raise ConfigError(
            f"{connection}: gain and offset are for reals; {target.name} is of type "
            f"{target.variable.type}"
        )


def _shaped(port: Port) -> str:
    shape = port.variable.shape
    return f"{port.name} is an array of shape {shape}" if shape else f"{port.name} is a scalar"


def _require_number(connection: Connection, port: Port) -> None:
    """Refuse a variable that no connection can carry.

    Raises:
        ConfigError: If the variable is neither a number nor a Boolean, nor an array of them.
    """
    variable = port.variable
    if variable.is_number and not variable.ticking:
        return
    if variable.ticking:
        text = "a clock. Each component lets its own clocks tick; connect a variable of the clock"
    else:
        text = f"of type {variable.type}{_REASONS.get(variable.type, '')}"
    raise ConfigError(f"{connection}: {port.name} is {text}")


_REASONS: Final = {
    "String": ". Connections carry numbers and Booleans. A String parameter gets its text from "
    "start_values of the component, or from a name of the system",
    "Binary": ". Connections carry numbers and Booleans",
}

_LOOPS: Final = ("newton", "refuse")
"""Treatments of algebraic loops."""


SYSTEM: Final = Table(
    {
        "components": Key(
            Entries(table_of_fields(Component, make=Component, short="fmu")),
            "By name: the path of an FMU, or a [component](systems.md#connect-fmus).",
            REQUIRED,
        ),
        "connections": Key(
            Listed(CONNECTION),
            'Texts `"source -> target"`, or [tables](systems.md#connect-fmus).',
            (),
        ),
        "units": Key(
            Entries(TEXT), "Units of the system's own inputs, outputs and parameters by name.", {}
        ),
        "name": Key(TEXT, "Of the system.", "system"),
        "description": Key(TEXT, "A description for readers.", ""),
        "step_size": Key(
            POSITIVE,
            "Default communication step size.",
            None,
            "the smallest of a component",
        ),
        "start_time": Key(NUMBER, "Of the default experiment, in seconds.", 0.0),
        "stop_time": Key(NUMBER, "Of the default experiment, in seconds."),
        "master": Key(
            option(*MASTERS),
            "How values are exchanged; see [How systems run](systems.md#how-a-step-runs).",
            MASTERS[0],
        ),
        "loops": Key(
            option(*_LOOPS),
            "How [algebraic loops](systems.md#algebraic-loops) are solved, or that they are "
            "refused.",
            _LOOPS[0],
        ),
        "loop_tolerance": Key(
            POSITIVE,
            "A loop is solved when no value changes by more; relative, and absolute below 1.",
            Loop.tolerance,
        ),
        "loop_iterations": Key(COUNT, "After so many, the step fails.", Loop.max_iterations),
        "tolerance": Key(POSITIVE, "For the solvers of the components.", None, "the FMUs'"),
    }
)
"""The keys of a system."""

_TIMES: Final = ("step_size", "start_time", "stop_time", "tolerance")


class WiredSystem:
    """A system with all its names resolved.

    See ``fmugym.FMUSystem`` for the arguments, the attributes and the errors.
    """

    def __init__(
        self,
        components: Mapping[str, Any],
        connections: Sequence[Any] = (),
        *,
        name: str = "system",
        units: Mapping[str, str] | None = None,
        master: str = MASTERS[0],
        loops: str = _LOOPS[0],
        loop_tolerance: float = Loop.tolerance,
        loop_iterations: int = Loop.max_iterations,
        step_size: float | None = None,
        start_time: float = 0.0,
        stop_time: float | None = None,
        tolerance: float | None = None,
        description: str = "",
        own_names: Sequence[str] = (),
        unit_definitions: Mapping[str, Unit] | None = None,
        findings: Sequence[str] = (),
        file: Path | None = None,
        **unknown: Never,
    ) -> None:
        for argument in unknown:
            raise unknown_argument(type(self).__name__, argument, _ARGUMENTS)
        told = {
            "components": components,
            "connections": connections,
            "name": name,
            "units": units or {},
            "description": description,
            "master": master,
            "loops": loops,
            "loop_tolerance": loop_tolerance,
            "loop_iterations": loop_iterations,
            "step_size": step_size,
            "start_time": start_time,
            "stop_time": stop_time,
            "tolerance": tolerance,
        }
        self._given = given = checked_entry(SYSTEM, told)
        if not given["components"]:
            raise ConfigError("a system needs at least one component")
        self.name, self.description = given["name"], given["description"]
        self.units, self.master, self.loops = given["units"], given["master"], given["loops"]
        self.loop = Loop(given["loop_tolerance"], given["loop_iterations"])
        self.times = {name: given[name] for name in _TIMES}
        self._given_findings, self.file = tuple(findings), file
        self.connections = tuple(given["connections"])
        made = given["components"].items()
        self.components = {one: OpenComponent(one, component) for one, component in made}
        self.own_names = tuple(own_names)
        self.unit_definitions = dict(unit_definitions or {})
        self._wiring = Wiring(
            self.components,
            self.connections,
            self.units,
            frozenset(self.own_names) | self.units.keys(),
            self.unit_definitions,
        )
        self.links, self.connectors = tuple(self._wiring.links), tuple(self._wiring.connectors)
        self.units = {one.name: one.unit for one in self.connectors if one.unit is not None}
        if self.loops == "refuse" and self.order.loops:
            raise ConfigError(
                f"the system has an algebraic loop: {_told_loop(self.order.loops[0])}"
            )

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.name!r}: {', '.join(self.components)})"

    @cached_property
    def order(self) -> SystemOrder:
        """The order of steps and of the initialization, and the algebraic loops."""
        told = {name: one.feedthrough for name, one in self.components.items()}
        parts = {name: one.fmu.description for name, one in self.components.items()}
        old = {name for name, part in parts.items() if part.fmi_major_version == 1}
        unable = {n for n, part in parts.items() if not part.capabilities.can_get_and_set_fmu_state}
        if self.master == "jacobi":  # which repeats no steps
            unable = set()
        return order_of(list(told), self.links, told, self.loop, unable, old)

    def port(self, name: str) -> Port | None:
        """Find the variable that a name stands for; None for a name of the system itself.

        Raises:
            ConfigError: If there is no such component or variable.
        """
        return self._wiring.port(name)

    @property
    def open_inputs(self) -> tuple[Port, ...]:
        """The inputs of components that nothing drives."""
        return tuple(self._wiring.open_inputs())

    @cached_property
    def findings(self) -> tuple[str, ...]:
        """Doubtful facts about the system and its FMUs, as texts."""
        untold = [
            f"{name} does not tell its direct feed-through; each output is taken to depend on all "
            "inputs"
            for name, one in self.components.items()
            if not one.feedthrough.known
        ]
        of_fmus = [
            f"{name}: {finding}"
            for name, one in self.components.items()
            for finding in one.fmu.findings
        ]
        return (*self._given_findings, *_findings_of(self.order), *untold, *of_fmus)

    @cached_property
    def plan(self) -> SystemPlan:
        """Execution plan of the master."""
        times = dict(self.times)
        if times["step_size"] is None:
            times["step_size"] = self._smallest_step()
        return SystemPlan(
            self.name,
            tuple(one.planned() for one in self.components.values()),
            self.links,
            self.order.groups,
            self.order.initialization,
            self.master,
            self.connectors,
            description=self.description,
            findings=self.findings,
            file=self.file,
            units=tuple(self.unit_definitions.items()),
            **times,
        )

    def _smallest_step(self) -> float | None:
        """The smallest default step size of the components, as a step of the system."""
        steps = [
            size * one.given.steps
            for one in self.components.values()
            if (size := one.fmu.description.step_size) is not None
        ]
        return min(steps, default=None)


_ARGUMENTS: Final = tuple(
    name
    for name in inspect.signature(WiredSystem.__init__).parameters
    if name not in ("self", "unknown")
)


def _findings_of(order: SystemOrder) -> Iterator[str]:
    for loop in order.loops:
        yield f"algebraic loop: {_told_loop(loop)}"
    for name in order.unsolved:
        yield f"{name} cannot save its FMU state, so that its algebraic loop is not solved in steps"
    for name in order.unsolved_at_start:
        yield (
            f"{name} is an FMU of FMI 1.0, which has no Initialization Mode: in its algebraic loop "
            "it begins with the start values of its inputs"
        )
    for link in order.late:
        yield (
            f"{link.target} steps before {link.source}, so that {link.target}.{link.input} gets "
            "the value of the step before"
        )


def _told_loop(loop: Sequence[Link]) -> str:
    """Links of a loop one after the other, as far as each begins at the end of another."""
    rest = list(loop)
    chain = [rest.pop(0)]
    while rest:
        following = next((k for k in rest if k.source == chain[-1].target), rest[0])
        rest.remove(following)
        chain.append(following)
    return ", ".join(f"{k.source}.{k.output} -> {k.target}.{k.input}" for k in chain)
