"""Memory layout of a system: slots of inputs and outputs, and the routes between them.

``fmugym.pool.pool_form`` tells it to ``native/system/system_steps.c``.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable
from dataclasses import dataclass, field
from functools import cached_property
from typing import TypeAlias

from fmugym.fmi.description import ModelDescription
from fmugym.fmi.systems.system_description import PartVariable, SystemDescription
from fmugym.fmi.systems.system_plan import ComponentPlan, Evaluation, Group
from fmugym.fmi.variable import Variable

__all__ = ["PartLayout", "Route", "SystemLayout", "array_key"]


@dataclass
class PartLayout:
    """Inputs and outputs of one component that a step sets and gets.

    Attributes:
        component: Component of the plan.
        description: Model description of its FMU.
        inputs, outputs: Its scalars and elements of arrays, one for each slot. Arrays are there as
            a whole, because FMI sets them as a whole.
        first_input, first_output: The numbers of its first slots.
    """

    component: ComponentPlan
    description: ModelDescription
    inputs: list[Variable] = field(default_factory=list)
    outputs: list[Variable] = field(default_factory=list)
    first_input: int = 0
    first_output: int = 0

    @property
    def label(self) -> str:
        """Name in messages."""
        return f"component {self.component.name!r}"

    @property
    def has_mode(self) -> bool:
        """Whether its FMI version has an Initialization Mode."""
        return self.description.fmi_major_version > 1

    @cached_property
    def starts(self) -> tuple[tuple[Variable, float | str], ...]:
        """Start values that the plan sets before the initialization."""
        starts = self.component.starts
        return tuple((self.description.variable(name), value) for name, value in starts)

    def starts_of(self, variables: Iterable[Variable]) -> list[float]:
        """Start values of numeric scalars and elements of this component."""
        known = dict(self.component.starts)
        return [float(known.get(one.name, one.start_number)) for one in variables]


@dataclass(frozen=True)
class Route:
    """Carries values from slots of outputs to slots of inputs; see ``Link``.

    Attributes:
        source_part, target_part: Numbers of components.
        source, target: The first slots.
        count: How many slots follow each other: several for a whole array.
        gain, offset, link: Gain, offset and number of the link.
    """

    source_part: int
    source: int
    target_part: int
    target: int
    count: int
    gain: float
    offset: float
    link: int


class SystemLayout:
    """The slots and routes of a system.

    Args:
        description: Description of the system.
        inputs: The system's variables that each step sets.
        outputs: The system's variables that are read after each step.

    Attributes:
        description, plan: Description and plan of the system.
        parts: One for each component.
        routes: In the order of their targets.

    Raises:
        ConfigError: If a name of the plan is unknown, or a variable cannot be used in its role.
    """

    def __init__(
        self,
        description: SystemDescription,
        inputs: Iterable[Variable],
        outputs: Iterable[Variable],
    ) -> None:
        self.description, self.plan = description, description.plan
        pairs = zip(self.plan.components, description.parts, strict=True)
        self.parts = [PartLayout(component, part) for component, part in pairs]
        self._numbers = {part.component.name: i for i, part in enumerate(self.parts)}
        self._input_slots: _Slots = {}
        self._output_slots: _Slots = {}
        self._fill(inputs, outputs)
        self.routes = self._find_routes()

    def _fill(self, inputs: Iterable[Variable], outputs: Iterable[Variable]) -> None:
        ins = [self._end(link.target, link.input) for link in self.plan.links]
        ins += [(e.part, e.variable) for v in inputs for e in self.ends_of(v)]
        outs = [self._end(link.source, link.output) for link in self.plan.links]
        outs += [(e.part, e.variable) for v in outputs for e in self.ends_of(v)[:1]]
        own_inputs, own_outputs = _by_part(ins), _by_part(outs)
        for index, part in enumerate(self.parts):
            part.first_input, part.first_output = len(self._input_slots), len(self._output_slots)
            part.inputs = _filled(self._input_slots, index, own_inputs[index])
            part.outputs = _filled(self._output_slots, index, own_outputs[index])

    def _end(self, component: str, name: str) -> tuple[int, Variable]:
        part = self._numbers[component]
        return part, self.parts[part].description.variable(name)

    def _find_routes(self) -> tuple[Route, ...]:
        routes = []
        for number, link in enumerate(self.plan.links):
            source_part, output = self._end(link.source, link.output)
            target_part, variable = self._end(link.target, link.input)
            if not variable.elements:  # an array may have the size 0
                continue
            source = self._output_slots[source_part, *_key(output.elements[0])]
            target = self._input_slots[target_part, *_key(variable.elements[0])]
            ends = source_part, source, target_part, target, len(variable.elements)
            routes.append(Route(*ends, link.gain, link.offset, number))
        return tuple(sorted(routes, key=lambda route: route.target))

    def ends_of(self, variable: Variable) -> tuple[PartVariable, ...]:
        """Variables of components behind a variable of the system."""
        return self.description.ends[variable.value_reference]

    def input_slot(self, end: PartVariable) -> int:
        """The slot that is set for this variable; -1 if there is none."""
        return self._input_slots.get((end.part, *_key(end.variable)), -1)

    def output_slot(self, end: PartVariable) -> int:
        """The slot that this variable is read into; -1 if there is none."""
        return self._output_slots.get((end.part, *_key(end.variable)), -1)

    @cached_property
    def arrays(self) -> dict[tuple[int, int, str], tuple[int, Variable]]:
        """The arrays of all components behind variables of the system.

        Returns:
            By what ``array_key`` returns, the numbers of their components and the arrays.
        """
        ends = (end for group in self.description.ends for end in group)
        found = ((end, end.variable.array) for end in ends)
        return {array_key(end): (end.part, array) for end, array in found if array is not None}

    # Numbers in the place of names.

    @cached_property
    def _route_of_link(self) -> dict[int, int]:
        return {route.link: index for index, route in enumerate(self.routes)}

    def parts_of(self, group: Group) -> tuple[int, ...]:
        """The components of a group."""
        return tuple(self._numbers[name] for name in group.components)

    def inner_routes(self, group: Group) -> tuple[int, ...]:
        """The routes within a group."""
        inside, into = set(self.parts_of(group)), self._routes_by_target
        found = (index for part in inside for index in into.get(part, ()))
        return tuple(sorted(i for i in found if self.routes[i].source_part in inside))

    @cached_property
    def _routes_by_target(self) -> dict[int, list[int]]:
        found = defaultdict(list)
        for index, route in enumerate(self.routes):
            found[route.target_part].append(index)
        return found

    def routes_of(self, evaluation: Evaluation) -> tuple[int, ...]:
        """The routes of an evaluation."""
        known = self._route_of_link
        return tuple(known[link] for link in evaluation.links if link in known)

    def loop_label(self, numbers: Iterable[int]) -> str:
        """Name a loop through these components, for messages."""
        names = dict.fromkeys(repr(self.parts[i].component.name) for i in numbers)
        return f"the algebraic loop of {', '.join(names)}"


_Key: TypeAlias = tuple[int, str, int, bool]
_Slots: TypeAlias = dict[tuple[int, *_Key], int]


def _key(variable: Variable) -> _Key:
    """Identity of a value of an FMU; value references of FMI 1.0 and 2.0 need the type."""
    return variable.value_reference, variable.kind, variable.place, variable.negated


def array_key(end: PartVariable) -> tuple[int, int, str]:
    """Identity of the array of an element."""
    return end.part, end.variable.value_reference, end.variable.kind


def _by_part(pairs: Iterable[tuple[int, Variable]]) -> defaultdict[int, list[Variable]]:
    """The variables of each component."""
    found = defaultdict(list)
    for index, variable in pairs:
        found[index].append(variable)
    return found


def _filled(slots: _Slots, part: int, used: Iterable[Variable]) -> list[Variable]:
    """Give a slot to each value of a component that is used, and return these.

    They are scalars as they are, and all elements of arrays of which something is there.
    """
    wholes = (one if one.array is None else one.array for one in used)
    found = {_key(element): element for whole in wholes for element in whole.elements}
    for key in found:
        slots[part, *key] = len(slots)
    return list(found.values())
