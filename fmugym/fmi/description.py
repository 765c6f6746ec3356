"""Model description of an FMU, in one form for the three FMI versions, and its model structure.

``fmugym.fmi.description_reader`` makes these types from an FMU's XML. The model structure tells the
direct feed-through from inputs to outputs.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Final

import fmpy
import numpy as np

from fmugym.checks import Spellings, integer_of
from fmugym.errors import ConfigError, shown, unknown_name
from fmugym.fmi.variable import Variable

__all__ = [
    "BASE_UNITS",
    "INTERFACES",
    "Capabilities",
    "Feedthrough",
    "ModelDescription",
    "ModelExchange",
    "Unit",
    "read_feedthrough",
]

BASE_UNITS: Final = ("kg", "m", "s", "A", "K", "mol", "cd", "rad")
"""SI base units of which the dimension of a unit has exponents."""

INTERFACES = ("co_simulation", "model_exchange")
"""The interfaces by which an FMU may be run, the preferred one first."""


_LARGEST_SIZE: Final = 2**31 - 1

_ELEMENT: Final = re.compile(r"(.+)\[(\d{1,9}(?:, ?\d{1,9})*)\]")
"""Pattern of the name of an element: the array's name, and indices."""


def _whole(value: Any) -> int | None:
    """Return a whole number as an int, also if it is a float."""
    return int(value) if isinstance(value, float) and value.is_integer() else integer_of(value)


def _place(array: Variable, index: str) -> int | None:
    """The place of an element in row-major order; None if the array has no such element."""
    numbers = [int(number) - 1 for number in index.split(",")]
    try:
        return int(np.ravel_multi_index(numbers, array.shape))
    except ValueError:
        return None


@dataclass(frozen=True)
class Capabilities:
    """The capability flags of an interface, by their FMI 3.0 names in Python's spelling."""

    can_handle_variable_communication_step_size: bool = False
    can_get_and_set_fmu_state: bool = False
    can_serialize_fmu_state: bool = False
    provides_directional_derivatives: bool = False
    can_be_instantiated_only_once_per_process: bool = False
    needs_execution_tool: bool = False
    provides_adjoint_derivatives: bool = False

    @property
    def provides_derivatives(self) -> bool:
        """Whether the FMU differentiates itself, in one way or the other."""
        return self.provides_directional_derivatives or self.provides_adjoint_derivatives


@dataclass(frozen=True)
class ModelExchange:
    """Facts about an FMU's equations that a solver needs.

    Attributes:
        number_of_states: Continuous states.
        number_of_event_indicators: An indicator that changes its sign is an event.
        needs_completed_integrator_step: Whether the FMU wants to know of each complete step.
        derivatives, indicators: The names of the variables that hold the derivatives of the states,
            and of those that hold event indicators; empty where the XML gives only their numbers.
        state_references, derivative_references: The value references of the states and their
            derivatives in the order of the states; empty if the XML does not tell them.
    """

    number_of_states: int
    number_of_event_indicators: int
    needs_completed_integrator_step: bool
    state_references: tuple[int, ...] = ()
    derivative_references: tuple[int, ...] = ()
    derivatives: tuple[str, ...] = ()
    indicators: tuple[str, ...] = ()

    def resized(self, variables: Mapping[str, Variable]) -> ModelExchange:
        """The same for arrays of other sizes."""
        return replace(
            self,
            number_of_states=sum(variables[name].size for name in self.derivatives),
            number_of_event_indicators=sum(variables[name].size for name in self.indicators),
        )


@dataclass(frozen=True)
class Unit:
    """A unit that the model description defines.

    Attributes:
        dimension: The exponents of ``BASE_UNITS``; None where the FMU does not give them, as in
            FMI 1.0.
        factor, offset: A value in this unit times ``factor``, plus ``offset``, is the value in the
            SI unit of this dimension.
        display_units: Factor and offset by name: a value in this unit times the factor, plus the
            offset, is the value in the display unit.
    """

    dimension: tuple[int, ...] | None = None
    factor: float = 1.0
    offset: float = 0.0
    display_units: Mapping[str, tuple[float, float]] = field(default_factory=dict, hash=False)


@dataclass(frozen=True)
class ModelDescription:
    """The part of a model description that an environment needs.

    Attributes:
        model_identifier, capabilities: Identifier and capabilities of the interface in use.
        interfaces: The interface types that the FMU offers.
        interface: The one in use, one of ``INTERFACES``.
        model_exchange: Facts for a solver; None in co-simulation.
        start_time, stop_time, step_size, fixed_internal_step_size: In seconds; None where the FMU
            gives no usable value.
        tolerance: Tolerance of the default experiment; None where the FMU gives no usable value.
        variables: The variables by name, in the order of the XML, but for the ``namesakes``.
        namesakes: The variables of each name that is not unique, which cannot be used.
        derivatives: For each continuous state that the FMU declares, a scalar or an array, the name
            of its derivative.
        findings: Rules of the standard that the file breaks, as texts.
        error_categories: The declared log categories of errors and warnings.
        units: The units that the XML defines, by name.
        has_event_mode: Whether the FMU offers event mode in co-simulation.
        structure: The structural parameters that get other values than in the XML, and the values.
    """

    fmi_version: str
    model_name: str
    model_identifier: str
    instantiation_token: str
    interfaces: tuple[str, ...]
    description: str
    generation_tool: str
    start_time: float
    stop_time: float | None
    tolerance: float | None
    step_size: float | None
    fixed_internal_step_size: float | None
    capabilities: Capabilities
    variables: Mapping[str, Variable]
    derivatives: Mapping[str, str]
    findings: tuple[str, ...]
    error_categories: tuple[str, ...] = ()
    units: Mapping[str, Unit] = field(default_factory=dict)
    interface: str = "co_simulation"
    model_exchange: ModelExchange | None = None
    has_event_mode: bool = False
    structure: tuple[tuple[Variable, int], ...] = ()
    namesakes: Mapping[str, tuple[Variable, ...]] = field(default_factory=dict)

    @cached_property
    def fmi_major_version(self) -> int:
        """1, 2 or 3."""
        return int(self.fmi_version.split(".")[0])

    @cached_property
    def everything(self) -> tuple[Variable, ...]:
        """All variables, also those whose names are not unique."""
        others = (variable for several in self.namesakes.values() for variable in several)
        return (*self.variables.values(), *others)

    @cached_property
    def state_derivatives(self) -> Mapping[str, str]:
        """For each continuous state, a scalar or an element, the name of its derivative.

        Raises:
            ConfigError: If an array of states has too many elements to name each.
        """
        pairs = ((self.variables[x], self.variables[d]) for x, d in self.derivatives.items())
        return {
            own.name: rate.name
            for state, derivative in pairs
            if state.shape == derivative.shape
            for own, rate in zip(state.elements, derivative.elements, strict=True)
        }

    @cached_property
    def strings(self) -> frozenset[str]:
        """The names of the variables that are Strings."""
        return frozenset(v.name for v in self.variables.values() if v.kind == "string")

    @cached_property
    def uses_event_mode(self) -> bool:
        """Whether the pool handles events between the FMU's steps, in co-simulation of FMI 3.0.

        It does so where only this gives them their time: where the FMU has clocks or discrete
        inputs. Other FMUs handle their events within their steps.
        """
        needed = any(
            variable.ticking or (variable.causality, variable.variability) == ("input", "discrete")
            for variable in self.everything
        )
        return self.has_event_mode and needed

    @cached_property
    def clocks(self) -> tuple[Variable, ...]:
        """Clocks that tick; none if neither the pool nor model exchange has events."""
        if not self.uses_event_mode and self.model_exchange is None:
            return ()
        return tuple(v for v in self.everything if v.ticking and not v.shape)

    @property
    def clocked_inputs(self) -> tuple[Variable, ...]:
        """Inputs that may be set only at a tick of one of their clocks."""
        known = {clock.value_reference for clock in self.clocks}
        inputs = (v for v in self.everything if v.causality == "input" and v.clocks)
        return tuple(v for v in inputs if known.issuperset(v.clocks))

    def what_drives(self, variable: Variable) -> str | None:
        """In a system: the output or the name of the system that sets a variable; or None."""
        return None

    @cached_property
    def arrays_beside_clocked(self) -> tuple[Variable, ...]:
        """Arrays without clocks that steps set, if other inputs have clocks."""
        if not self.clocked_inputs:
            return ()
        clocked = {variable.name for variable in self.clocked_inputs}
        arrays = (v for v in self.variables.values() if v.shape and v.settable_in_step)
        return tuple(v for v in arrays if v.name not in clocked)

    @property
    def has_reset(self) -> bool:
        """Whether the FMI version has a function for resets: FMI 1.0 has none in model exchange."""
        return self.fmi_major_version > 1 or self.model_exchange is None

    @property
    def components(self) -> tuple[ModelDescription, ...]:
        """The descriptions of the FMUs of a system; an FMU has none."""
        return ()

    @property
    def platform(self) -> str:
        """The folder under ``binaries/`` for this machine; FMI 3.0 has other names for them."""
        return str(fmpy.platform_tuple if self.fmi_major_version == 3 else fmpy.platform)

    def variable(self, name: str) -> Variable:
        """Look a variable, or an element of an array as ``y[2]`` or ``y[1,3]``, up by its name.

        Raises:
            ConfigError: If there is no such variable, with the nearest name; or if there are
                several.
        """
        try:
            return self.variables[name]
        except Exception:  # a KeyError; or something that is no key at all
            known = list(self.variables)
        spelt = self._spelt(name)
        if spelt is not None:
            return self.variables[spelt]
        array, index = self._array_and_index(name)
        if array is None:
            raise unknown_name(f"variable of {self.model_name}", name, known)
        place = _place(array, index)
        if place is None:
            raise ConfigError(
                f"{name!r} is no element of {array.name!r}, an array of shape {array.shape}; its "
                f"indices begin with 1"
            )
        return array.elements[place]

    def require_unique(self, name: Any) -> None:
        """Require that only one variable has a name.

        Raises:
            ConfigError: If it is.
        """
        several = self.namesakes.get(name) if isinstance(name, str) else None
        if several is not None:
            listing = ", ".join(f"{v.causality} (reference {v.value_reference})" for v in several)
            raise ConfigError(
                f"{name!r} is the name of {len(several)} variables of {self.model_name}: "
                f"{listing}; expected a name that is unique"
            )

    def _spelt(self, name: Any) -> str | None:
        """The name of a variable as the FMU has it; None if there is none.

        Raises:
            ConfigError: If there are several.
        """
        spelt = self._spellings.find(name)
        self.require_unique(spelt)
        return spelt

    def _array_and_index(self, name: Any) -> tuple[Variable | None, str]:
        """Take the name of an element apart; no array if it is not the name of one."""
        match = _ELEMENT.fullmatch(name) if isinstance(name, str) else None
        spelt = None if match is None else self._spelt(match[1])
        array = None if spelt is None else self.variables[spelt]
        return (array, match[2]) if array and match and array.shape else (None, "")

    def resized(self, sizes: Mapping[str, int]) -> ModelDescription:
        """The same FMU with other values of structural parameters, and with arrays of these sizes.

        Args:
            sizes: Values of structural parameters by name.

        Raises:
            ConfigError: If there is no such structural parameter, or it cannot have the value.
        """
        given = {self.variable(name).name: size for name, size in sizes.items()}
        chosen = {name: self._checked_size(name, size) for name, size in given.items()}
        variables = {name: v.resized(chosen) for name, v in self.variables.items()}
        solved = self.model_exchange
        for name in () if solved is None else (*solved.derivatives, *solved.indicators):
            self.require_unique(name)
        return replace(
            self,
            variables=variables,
            structure=tuple((variables[name], size) for name, size in chosen.items()),
            model_exchange=None if solved is None else solved.resized(variables),
        )

    def with_units(self, units: Mapping[str, str]) -> ModelDescription:
        """The same FMU with other units of its variables.

        Args:
            units: Units by the names of scalars and arrays.

        Raises:
            ConfigError: If there is no such variable.
        """
        changed = {name: replace(self.variable(name), unit=unit) for name, unit in units.items()}
        return replace(self, variables={**self.variables, **changed})

    def _checked_size(self, name: str, size: Any) -> int:
        variable, number = self.variable(name), _whole(size)
        if variable.causality != "structuralParameter" or variable.type != "UInt64":
            raise ConfigError(
                f"{name!r} is no structural parameter of type UInt64: it is a "
                f"{variable.causality} of type {variable.type}"
            )
        low, high = max(0, variable.minimum), min(_LARGEST_SIZE, variable.maximum)
        if number is None or not low <= number <= high:
            raise ConfigError(
                f"{name!r} is a structural parameter: expected an integer from {low:g} to "
                f"{high:g}, got {shown(size)}"
            )
        return number

    def find(self, name: str) -> Variable | None:
        """Return a variable as ``variable`` does, but None for an unknown name.

        Raises:
            ConfigError: If there are several.
        """
        spelt = self._spelt(name)
        if spelt is not None:
            return self.variables[spelt]
        try:
            return self.variable(name)
        except ConfigError:
            return None

    def scalars(self, name: str) -> tuple[Variable, ...]:
        """Look up the scalars that a name stands for.

        The name of an array stands for its elements in row-major order. FMI 1.0 and 2.0 have no
        arrays: there ``y`` stands for the variables ``y[1]``, ``y[2]``, ... unless a variable has
        this name.

        Raises:
            ConfigError: If there is no such variable, the name is not unique, or an array has too
                many elements.
        """
        if isinstance(name, str) and self._spelt(name) is None:
            spelt = Spellings("array", self._named_arrays).find(name)
            if spelt is not None:
                for variable in self._named_arrays[spelt]:
                    self.require_unique(variable.name)
                return self._named_arrays[spelt]
        return self.variable(name).elements

    @cached_property
    def _spellings(self) -> Spellings:
        names = {**self.variables, **self.namesakes}
        return Spellings(f"variable of {self.model_name}", names)

    @cached_property
    def _named_arrays(self) -> Mapping[str, tuple[Variable, ...]]:
        """The scalars that are elements of an array by their names only, by the array's name."""
        found: dict[str, list[tuple[tuple[int, ...], Variable]]] = {}
        for variable in self.everything:
            match = _ELEMENT.fullmatch(variable.name)
            if match is not None and not variable.shape:
                index = tuple(int(number) for number in match[2].split(","))
                found.setdefault(match[1], []).append((index, variable))
        return {
            name: tuple(variable for _, variable in sorted(elements, key=lambda e: e[0]))
            for name, elements in found.items()
        }


@dataclass(frozen=True)
class Feedthrough:
    """The inputs that act on each output without a step in between.

    Attributes:
        in_step: By output, the inputs on which it depends between two steps.
        at_start: By output, the inputs on which it depends in the initialization.
        known: Whether the FMU tells all of it. An output of which it tells nothing depends on all
            inputs.
    """

    in_step: Mapping[str, frozenset[str]]
    at_start: Mapping[str, frozenset[str]]
    known: bool


def read_feedthrough(root: Any, description: ModelDescription) -> Feedthrough:
    """Read the direct feed-through of an FMU.

    FMI 2.0 and 3.0 tell it in ``ModelStructure`` (FMI 2.0.5, section 2.2.8; FMI 3.0.2, section
    2.4.8), FMI 1.0 by the element ``DirectDependency`` of an output. What is absent means a
    dependence on all inputs.

    Args:
        root: The root of the XML.
        description: Variables that have been read.
    """
    inputs = frozenset(_named(description, "input"))
    outputs = list(_named(description, "output"))
    if description.fmi_major_version == 1:
        told = dict(_of_fmi1(root))
        at_start: dict[str, list[str] | None] = dict.fromkeys(outputs)
    else:
        names = _names_of_references(root, description)
        told = dict(_told(root, names, _STEP_PLACES))
        at_start = dict(_told(root, names, _START_PLACES))
    known = all(told.get(name) is not None for name in outputs)
    return Feedthrough(
        _completed(outputs, told, inputs), _completed(outputs, at_start, inputs), known
    )


_STEP_PLACES: Final = ("ModelStructure/Outputs/Unknown", "ModelStructure/Output")
_START_PLACES: Final = (
    *("ModelStructure/InitialUnknowns/Unknown", "ModelStructure/InitialUnknown"),
)


def _named(description: ModelDescription, causality: str) -> Iterator[str]:
    return (name for name, v in description.variables.items() if v.causality == causality)


def _completed(
    outputs: Iterable[str], told: Mapping[str, list[str] | None], inputs: frozenset[str]
) -> dict[str, frozenset[str]]:
    """Dependencies on inputs alone; an output without an entry depends on all of them."""
    found = ((name, told.get(name)) for name in outputs)
    return {name: inputs if on is None else inputs.intersection(on) for name, on in found}


def _of_fmi1(root: Any) -> Iterator[tuple[str, list[str] | None]]:
    for element in root.iterfind("ModelVariables/ScalarVariable"):
        direct = element.find("DirectDependency")
        names = None if direct is None else [one.text or "" for one in direct.iterfind("Name")]
        yield element.get("name", ""), names


def _names_of_references(root: Any, description: ModelDescription) -> dict[str, str]:
    """The names of variables by their numbers in FMI 2.0, by value references in FMI 3.0."""
    elements = root.iterfind("ModelVariables/*")
    if description.fmi_major_version == 2:
        return {str(place): e.get("name", "") for place, e in enumerate(elements, 1)}
    return {e.get("valueReference", ""): e.get("name", "") for e in elements}


def _told(
    root: Any, names: Mapping[str, str], places: tuple[str, ...]
) -> Iterator[tuple[str, list[str] | None]]:
    for place in places:
        for element in root.iterfind(place):
            own = element.get("index") or element.get("valueReference") or ""
            listed = element.get("dependencies")
            on = None if listed is None else [names.get(one, "") for one in listed.split()]
            yield names.get(own, ""), on
