"""What a system says of itself, in the form in which an FMU says it."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from itertools import count
from typing import Final

from fmugym.archive.description import Capabilities, ModelDescription, Unit, Variable
from fmugym.errors import ConfigError, unknown_name
from fmugym.systems.plan import Connector, End, SystemPlan

__all__ = ["PartVariable", "SystemDescription", "describe_system"]


_NO_PLAN: Final = SystemPlan("", ())
"""Dataclasses want a default here, for there are others before."""


@dataclass(frozen=True, eq=False)
class PartVariable:
    """A variable of a component behind a variable of the system.

    Attributes:
        part: The index of the component.
        variable: As its FMU describes it.
        gain, offset: See ``fmugym.systems.plan.End``.
    """

    part: int
    variable: Variable
    gain: float = 1.0
    offset: float = 0.0


@dataclass(frozen=True)
class SystemDescription(ModelDescription):
    """The description of a system.

    Variables are called ``component.variable``, and connectors have names of their own. The value
    reference of a variable is its index in ``ends``. All capabilities are those that all
    components have.

    Attributes:
        plan: The system.
        parts: The descriptions of the components.
        ends: What stands behind each variable; one, except for connectors with several ends.
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
        step_size=_step_size(plan, parts),
        fixed_internal_step_size=None,
        capabilities=_capabilities(plan, parts),
        variables=variables,
        state_derivatives={},
        findings=plan.findings,
        error_categories=tuple(sorted({c for part in parts for c in part.error_categories})),
        units=_units(parts),
        plan=plan,
        parts=tuple(parts),
        ends=ends,
    )


def _step_size(plan: SystemPlan, parts: Sequence[ModelDescription]) -> float | None:
    """The plan's; or else the smallest that fits the default of a component."""
    if plan.step_size is not None:
        return plan.step_size
    pairs = zip(plan.components, parts, strict=True)
    steps = [part.step_size * one.steps for one, part in pairs if part.step_size is not None]
    return min(steps, default=None)


def _capabilities(plan: SystemPlan, parts: Sequence[ModelDescription]) -> Capabilities:
    """What all components can; a restriction of one restricts the system."""
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
        can_interpolate_inputs=False,
    )


def _units(parts: Iterable[ModelDescription]) -> dict[str, Unit]:
    """All units; where two components disagree on a name, the first one wins."""
    units: dict[str, Unit] = {}
    for part in parts:
        units = {**part.units, **units}
    return units


def _variables(
    plan: SystemPlan, parts: Sequence[ModelDescription]
) -> tuple[dict[str, Variable], tuple[tuple[PartVariable, ...], ...]]:
    numbers = count()
    driven = _driven(plan)
    variables: dict[str, Variable] = {}
    ends: list[tuple[PartVariable, ...]] = []
    for index, (component, part) in enumerate(zip(plan.components, parts, strict=True)):
        for own in _scalars(part, component.starts):
            is_driven = (component.name, own.name) in driven
            variable = _renamed(own, f"{component.name}.{own.name}", next(numbers), is_driven)
            variables[variable.name] = variable
            ends.append((PartVariable(index, own),))
    for connector in plan.connectors:
        if connector.name in variables:
            raise ConfigError(f"{connector.name!r} is the name of two variables of {plan.name}")
        behind = tuple(_behind(plan, parts, end) for end in connector.ends)
        variables[connector.name] = _connector_variable(connector, behind[0], next(numbers))
        ends.append(behind)
    return variables, tuple(ends)


def _driven(plan: SystemPlan) -> set[tuple[str, str]]:
    """What a link or a connector of the system sets: it cannot be set by another name."""
    driven = {(link.target, link.input) for link in plan.links}
    for connector in plan.connectors:
        if connector.causality != "output":
            driven |= {(end.component, end.variable) for end in connector.ends}
    return driven


def _scalars(
    part: ModelDescription, starts: Sequence[tuple[str, float | str]]
) -> Iterator[Variable]:
    """Arrays, binary values and clocks cannot be variables of a system."""
    values = dict(starts)
    for variable in part.variables.values():
        if variable.numeric or (variable.kind == "string" and not variable.shape):
            yield _started(variable, values)


def _started(variable: Variable, values: Mapping[str, float | str]) -> Variable:
    """The variable with the start value that the system gives it, as the XML would have it."""
    if variable.name not in values:
        return variable
    value = values[variable.name]
    if variable.kind == "boolean":
        return replace(variable, start="true" if value else "false")
    is_whole = variable.kind in {"integer", "enumeration"}
    return replace(variable, start=str(int(value)) if is_whole else str(value))


def _renamed(own: Variable, name: str, reference: int, is_driven: bool) -> Variable:
    """What something else drives cannot be set from outside."""
    variable = replace(own, name=name, value_reference=reference)
    return replace(variable, causality="local", initial=None) if is_driven else variable


def _behind(plan: SystemPlan, parts: Sequence[ModelDescription], end: End) -> PartVariable:
    names = [component.name for component in plan.components]
    if end.component not in names:
        raise unknown_name(f"component of {plan.name}", end.component, names)
    part = names.index(end.component)
    starts = dict(plan.components[part].starts)
    variable = _started(parts[part].variable(end.variable), starts)
    return PartVariable(part, variable, end.gain, end.offset)


def _connector_variable(connector: Connector, first: PartVariable, reference: int) -> Variable:
    """Describe a connector as the variable behind its first end, in its own unit."""
    own = first.variable
    if connector.causality == "output":
        limits = [first.gain * x + first.offset for x in (own.minimum, own.maximum)]
    else:
        limits = [(x - first.offset) / first.gain for x in (own.minimum, own.maximum)]
    return replace(
        own,
        name=connector.name,
        value_reference=reference,
        causality=connector.causality,
        unit=own.unit if connector.unit is None else connector.unit,
        minimum=min(limits),
        maximum=max(limits),
        start=_start(connector, first),
        nominal=_nominal(connector, first),
        description=connector.description or own.description,
    )


def _start(connector: Connector, first: PartVariable) -> str | None:
    own = first.variable
    if own.start is None or not own.numeric or (first.gain, first.offset) == (1.0, 0.0):
        return own.start
    number = own.start_number
    if connector.causality == "output":
        return repr(first.gain * number + first.offset)
    return repr((number - first.offset) / first.gain)


def _nominal(connector: Connector, first: PartVariable) -> float | None:
    nominal = first.variable.nominal
    if nominal is None:
        return None
    factor = abs(first.gain)
    return nominal * factor if connector.causality == "output" else nominal / factor
