"""Model description of a system, in the form of an FMU's."""

from __future__ import annotations

import re
from collections.abc import Callable, Container, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Final

from fmugym.errors import ConfigError
from fmugym.fmi.description import Capabilities, ModelDescription, Unit
from fmugym.fmi.systems.system_plan import Connector, End, SystemPlan
from fmugym.fmi.units import IDENTITY, Conversion
from fmugym.fmi.variable import MOST_ELEMENTS, Variable

__all__ = ["PartVariable", "SystemDescription", "describe_system"]


_NO_PLAN: Final = SystemPlan("", ())
"""A dataclass needs a default here, because fields before this one have some."""


@dataclass(frozen=True, eq=False)
class PartVariable:
    """Scalar or element of a component, which a variable of the system stands for.

    Attributes:
        part: The index of the component.
        variable: As its FMU describes it.
        gain, offset: See ``fmugym.fmi.systems.system_plan.End``.
        is_target: Whether the system's variable is the source of this one: an input or a parameter.
    """

    part: int
    variable: Variable
    gain: float = 1.0
    offset: float = 0.0
    is_target: bool = False

    @property
    def reading(self) -> tuple[float, float]:
        """Gain and offset from the value here to the value of the system's variable."""
        if self.is_target and self.gain:
            return 1.0 / self.gain, -self.offset / self.gain
        return self.gain, self.offset


@dataclass(frozen=True)
class SystemDescription(ModelDescription):
    """The description of a system.

    Variables are called ``component.variable``, and connectors have names of their own. The value
    reference of a scalar, or of an element of an array, is its index in ``ends``. All capabilities
    are those that all components have.

    Attributes:
        plan: The system.
        parts: The descriptions of the components.
        ends: Variables of components behind each scalar and each element; one, except for
            connectors with several ends.
    """

    plan: SystemPlan = _NO_PLAN
    parts: tuple[ModelDescription, ...] = ()
    ends: tuple[tuple[PartVariable, ...], ...] = ()

    @property
    def has_reset(self) -> bool:
        """Whether all components have a function for resets."""
        return all(part.has_reset for part in self.parts)

    @property
    def components(self) -> tuple[ModelDescription, ...]:
        """See ``ModelDescription.components``."""
        return self.parts

    def what_drives(self, variable: Variable) -> str | None:
        """See ``ModelDescription.what_drives``."""
        sources = {".".join(target): source for target, source in _sources(self.plan).items()}
        array = () if variable.array is None else (variable.array,)
        return next((sources[one.name] for one in (variable, *array) if one.name in sources), None)

    @cached_property
    def clocks(self) -> tuple[Variable, ...]:
        """The clocks of all components: outputs tell whether one ticked, and some inputs let it."""
        ticking = (v for v in self.variables.values() if v.ticking)
        ends = ((v, self.ends[v.value_reference][0]) for v in ticking)
        return tuple(v for v, end in ends if end.variable in self.parts[end.part].clocks)

    @property
    def clocked_inputs(self) -> tuple[Variable, ...]:
        """None: each component lets its own inputs wait for their clocks."""
        return ()

    def resized(self, sizes: Mapping[str, int]) -> ModelDescription:
        """Refuse sizes: the connections of the system fit the arrays as they are.

        Raises:
            ConfigError: If there are any.
        """
        for name in sizes:
            raise ConfigError(
                f"{name!r} is a structural parameter of a component: give it in the start_values "
                "of the component, since connections depend on the sizes of arrays"
            )
        return self


def describe_system(plan: SystemPlan, parts: Sequence[ModelDescription]) -> SystemDescription:
    """Describe a system.

    Args:
        plan: The system.
        parts: The descriptions of its components in their order.

    Raises:
        ConfigError: If a name of the plan is unknown to a component.
    """
    variables, ends = _variables(plan, parts)
    newest = max(parts, key=lambda part: part.fmi_major_version)
    return SystemDescription(
        fmi_version=newest.fmi_version,
        model_name=plan.name,
        model_identifier=re.sub(r"\W", "_", plan.name) or "system",
        instantiation_token="",
        interfaces=("co_simulation",),
        description=plan.description,
        generation_tool="fmugym",
        start_time=plan.start_time,
        stop_time=plan.stop_time,
        tolerance=plan.tolerance,
        step_size=plan.step_size,
        fixed_internal_step_size=None,
        capabilities=_capabilities(parts),
        variables=variables,
        namesakes=_namesakes(plan, parts),
        derivatives=_derivatives(plan, parts),
        findings=plan.findings,
        error_categories=tuple(sorted({c for part in parts for c in part.error_categories})),
        units=_units(plan, parts),
        plan=plan,
        parts=tuple(parts),
        ends=ends,
    )


def _namesakes(
    plan: SystemPlan, parts: Sequence[ModelDescription]
) -> dict[str, tuple[Variable, ...]]:
    return {
        f"{component.name}.{name}": several
        for component, part in zip(plan.components, parts, strict=True)
        for name, several in part.namesakes.items()
    }


def _derivatives(plan: SystemPlan, parts: Sequence[ModelDescription]) -> dict[str, str]:
    return {
        f"{component.name}.{state}": f"{component.name}.{derivative}"
        for component, part in zip(plan.components, parts, strict=True)
        for state, derivative in part.derivatives.items()
    }


def _capabilities(parts: Sequence[ModelDescription]) -> Capabilities:
    """Capabilities that all components have."""
    flags = [part.capabilities for part in parts]
    able = {
        field.name: all(getattr(one, field.name) for one in flags) for field in fields(Capabilities)
    }
    restrictions = ("can_be_instantiated_only_once_per_process", "needs_execution_tool")
    able |= {name: any(getattr(one, name) for one in flags) for name in restrictions}
    return replace(
        Capabilities(**able),
        provides_directional_derivatives=False,
        provides_adjoint_derivatives=False,
    )


def _units(plan: SystemPlan, parts: Iterable[ModelDescription]) -> dict[str, Unit]:
    """All units; if two components differ on a name, the first one counts."""
    units: dict[str, Unit] = {}
    for part in parts:
        for name, unit in part.units.items():
            units.setdefault(name, unit)
    return {**dict(plan.units), **units}


def _variables(
    plan: SystemPlan, parts: Sequence[ModelDescription]
) -> tuple[dict[str, Variable], tuple[tuple[PartVariable, ...], ...]]:
    numbers = {one.name: number for number, one in enumerate(plan.components)}
    driven = _driven(plan, parts, numbers)
    variables: dict[str, Variable] = {}
    ends: list[tuple[PartVariable, ...]] = []
    for index, (component, part) in enumerate(zip(plan.components, parts, strict=True)):
        for own in _usable(part, component.starts):
            name = f"{component.name}.{own.name}"
            variables[name] = _renamed(own, name, len(ends), driven[component.name])
            ends += [(PartVariable(index, element),) for element in own.elements]
    elements = {one.name for v in variables.values() if v.shape for one in v.elements}
    for connector in plan.connectors:
        is_source = connector.causality != "output"
        ends_in = [(numbers[end.component], end) for end in connector.ends]
        behind = [_behind(plan, parts, part, end, is_source) for part, end in ends_in]
        variable = _connector_variable(connector, behind[0], len(ends))
        names = {connector.name, *(one.name for one in variable.elements)}
        for name in names & (variables.keys() | elements):
            raise ConfigError(f"{name!r} is the name of two variables of {plan.name}")
        variables[connector.name] = variable
        elements |= names
        each = ([replace(end, variable=v) for v in end.variable.elements] for end in behind)
        ends += zip(*each, strict=True)
    return variables, tuple(ends)


def _sources(plan: SystemPlan) -> dict[tuple[str, str], str]:
    """The outputs and names of the system that set variables, by component and variable."""
    sources = {(one.target, one.input): f"{one.source}.{one.output}" for one in plan.links}
    for connector in plan.connectors:
        if connector.causality != "output":
            ends = ((end.component, end.variable) for end in connector.ends)
            sources |= dict.fromkeys(ends, connector.name)
    return sources


def _driven(
    plan: SystemPlan, parts: Sequence[ModelDescription], numbers: Mapping[str, int]
) -> dict[str, set[str]]:
    """Variables that links and connectors of the system set, so that other names may not set them.

    Returns:
        The names of scalars and elements by component.
    """
    driven: dict[str, set[str]] = {name: set() for name in numbers}
    for component, variable in _sources(plan):
        part = parts[numbers[component]]
        driven[component].update(one.name for one in part.variable(variable).elements)
    return driven


def _usable(
    part: ModelDescription, starts: Sequence[tuple[str, float | str]]
) -> Iterator[Variable]:
    """Binary values, arrays of Strings and arrays of clocks cannot be variables of a system."""
    values = dict(starts)
    for variable in part.variables.values():
        is_number = variable.is_number and not (variable.ticking and variable.shape)
        if (is_number and _is_good_array(variable)) or variable.is_text:
            yield _started(variable, values)


def _is_good_array(variable: Variable) -> bool:
    """Whether it is a scalar, or an array whose elements have names and start values."""
    if not variable.shape or not variable.settable_at_start:
        return variable.size <= MOST_ELEMENTS
    try:
        return bool(variable.start_numbers)
    except ConfigError:
        return False


def _started(variable: Variable, values: Mapping[str, float | str]) -> Variable:
    """The variable with the start value that the system gives it, as the XML would have it."""
    texts = [_start_text(one, values.get(one.name)) for one in variable.elements]
    if all(text is None for text in texts):
        return variable
    return replace(variable, start=texts[0] if variable.is_scalar else _joined(variable, texts))


def _start_text(variable: Variable, value: float | str | None) -> str | None:
    if value is None:
        return None
    if variable.kind == "boolean":
        return "true" if value else "false"
    is_whole = variable.kind in {"integer", "enumeration"}
    return str(int(value)) if is_whole else str(value)


def _joined(array: Variable, texts: Iterable[str | None]) -> str:
    """Start values of an array; elements without a text of their own keep theirs."""
    pairs = zip(array.elements, texts, strict=True)
    return " ".join(repr(one.start_number) if text is None else text for one, text in pairs)


def _renamed(own: Variable, name: str, reference: int, driven: Container[str]) -> Variable:
    """A variable under another name; a driven variable cannot be set from outside."""
    variable = replace(own, name=name, value_reference=reference)
    places = [place for place, one in enumerate(own.elements) if one.name in driven]
    if own.shape:
        variable = replace(variable, driven=frozenset(places))
    is_driven = len(places) == len(own.elements) > 0
    return replace(variable, causality="local", initial=None) if is_driven else variable


def _behind(
    plan: SystemPlan, parts: Sequence[ModelDescription], part: int, end: End, is_target: bool
) -> PartVariable:
    """The variable of a component behind an end, which may be an array here."""
    starts = dict(plan.components[part].starts)
    found = parts[part].variable(end.variable)
    array = found if found.array is None else found.array
    variable = _started(array, starts)
    if found.array is not None:
        variable = variable.elements[found.place]
    return PartVariable(part, variable, end.gain, end.offset, is_target)


def _connector_variable(connector: Connector, first: PartVariable, reference: int) -> Variable:
    """Describe a connector as the variable behind its first end, in its own unit."""
    own, change = first.variable, Conversion(first.gain, first.offset)
    convert = change if connector.causality == "output" else change.inverse
    limits = [convert(x) for x in (own.minimum, own.maximum)]
    return replace(
        own,
        name=connector.name,
        value_reference=reference,
        array=None,
        place=0,
        driven=frozenset() if own.shape else None,
        causality=connector.causality,
        unit=own.unit if connector.unit is None else connector.unit,
        minimum=min(limits),
        maximum=max(limits),
        start=own.start if change == IDENTITY else _converted_start(own, convert),
        nominal=None if own.nominal is None else own.nominal * abs(first.reading[0]),
    )


def _converted_start(own: Variable, convert: Callable[[float], float]) -> str | None:
    if own.start is None or not own.is_number:
        return own.start
    return " ".join(repr(convert(element.start_number)) for element in own.elements)
