"""Conversion of FMPy's model description, and of XML elements that FMPy does not read."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from itertools import repeat
from operator import attrgetter
from types import MappingProxyType
from typing import Any, Final

from fmpy.validation import validate_model_description

from fmugym.errors import FMULoadError, reason
from fmugym.fmi.description import (
    BASE_UNITS,
    INTERFACES,
    Capabilities,
    ModelDescription,
    ModelExchange,
    Unit,
)
from fmugym.fmi.variable import CLOCK_KINDS, MOST_FRACTIONS, UNKNOWN, Interval, Variable

__all__ = ["convert"]

_EXPERIMENT: Final = ("startTime", "stopTime", "tolerance", "stepSize")
_POSITIVE: Final = {"tolerance", "stepSize", "fixedInternalStepSize"}
_IDENTIFIER: Final = re.compile(r"[^/\\:]{1,200}")
_OF_ERRORS: Final = re.compile("error|fatal|discard|warning", re.IGNORECASE)
_MOST_CATEGORIES: Final = 32
_MOST_EQUATIONS: Final = 1_000_000
_REFERENCES: Final = range(2**32)
_ITEMS: Final = range(-(2**63), 2**63)

_SHARED: Final = attrgetter(
    "type",
    "causality",
    "variability",
    "initial",
    "unit",
    "declaredType",
    "min",
    "max",
    "nominal",
    "shape",
)
"""Attributes of FMPy's variables that are the same for many."""

_NOTHING_MORE: Final[Mapping[str, str]] = MappingProxyType({})
"""Stands for an XML element that FMPy reads entirely."""

_OPPOSITES: Final = {"Real", "Integer", "Boolean"}
"""The types of FMI 1.0 whose values can be negated."""

_WORDS: Final = {"co_simulation": "co-simulation", "model_exchange": "model exchange"}
_ELEMENTS: Final = {"co_simulation": "CoSimulation", "model_exchange": "ModelExchange"}


def convert(source: Any, root: Any, interface: str | None = None) -> ModelDescription:
    """Convert FMPy's model description to a ``ModelDescription``.

    Args:
        source: Model description as FMPy reads it.
        root: The root of the XML.
        interface: One of ``INTERFACES``; None for the first of them that the FMU offers.

    Raises:
        FMULoadError: If the FMU does not have the interface, or has a value that cannot be used.
        Exception: FMPy's objects may lack anything in a malformed file.
    """
    interface, offer = _choose(source, interface)
    experiment = source.defaultExperiment
    capabilities = _capabilities(source, root, interface, offer)
    pairs = list(_with_elements(source, root))
    variables = _variables(pairs)
    namesakes = _namesakes(variables)
    return ModelDescription(
        fmi_version=source.fmiVersion,
        model_name=source.modelName or "",
        model_identifier=_identifier(source, offer.modelIdentifier),
        instantiation_token=source.guid or "",
        interfaces=tuple(_interfaces(source)),
        description=source.description or "",
        generation_tool=source.generationTool or "",
        start_time=_time(experiment, "startTime") or 0.0,
        stop_time=_time(experiment, "stopTime"),
        tolerance=_time(experiment, "tolerance"),
        step_size=_time(experiment, "stepSize"),
        fixed_internal_step_size=_time(offer, "fixedInternalStepSize"),
        capabilities=capabilities,
        variables={v.name: v for v in variables if v.name not in namesakes},
        namesakes=namesakes,
        derivatives=_derivatives(source, namesakes),
        findings=_findings(source) + _of_aliases(source, pairs),
        error_categories=_error_categories(root),
        units=_units(root),
        interface=interface,
        has_event_mode=interface == "co_simulation" and offer.hasEventMode,
        model_exchange=None if interface == "co_simulation" else _model_exchange(source, offer),
    )


def _choose(source: Any, interface: str | None) -> tuple[str, Any]:
    """The interface to use, and FMPy's object for it."""
    offers = _interfaces(source)
    wanted = INTERFACES if interface is None else [interface]
    for name in wanted:
        if _WORDS[name] in offers:
            return name, offers[_WORDS[name]]
    words, there = " or ".join(_WORDS[name] for name in wanted), ", ".join(offers) or "none"
    raise FMULoadError(f"{source.modelName} has no interface for {words}; it offers: {there}")


def _with_elements(source: Any, root: Any) -> Iterator[tuple[Any, Any]]:
    """Pair FMPy's variables with their XML elements; an alias of FMI 3.0 has its variable's.

    Names may come twice.
    """
    found = root.xpath("ModelVariables[1]/*[@name]")
    if not found:
        yield from zip(source.modelVariables, repeat(_NOTHING_MORE))
        return
    own = [variable for variable in source.modelVariables if variable.alias is None]
    elements = dict(zip(own, found, strict=True))
    for variable in source.modelVariables:
        element = elements[variable.alias or variable]
        if variable.type.startswith("UInt"):  # of which FMPy leaves out the limits
            variable.min, variable.max = element.get("min"), element.get("max")
        yield variable, element


def _namesakes(variables: Sequence[Variable]) -> dict[str, tuple[Variable, ...]]:
    """The variables of each name that is not unique."""
    if len({variable.name for variable in variables}) == len(variables):  # as in most FMUs
        return {}
    found: dict[str, list[Variable]] = {}
    for variable in variables:
        found.setdefault(variable.name, []).append(variable)
    return {name: tuple(several) for name, several in found.items() if len(several) > 1}


def _model_exchange(source: Any, offer: Any) -> ModelExchange:
    derivatives = [unknown.variable for unknown in source.derivatives]
    states = [variable.derivative for variable in derivatives]
    scalar = all(state and not state.shape for state in states)
    return ModelExchange(
        _count(source, "numberOfContinuousStates"),
        _count(source, "numberOfEventIndicators"),
        offer.needsCompletedIntegratorStep or source.fmiVersion == "1.0",
        tuple(int(state.valueReference) for state in states) if scalar else (),
        tuple(int(variable.valueReference) for variable in derivatives) if scalar else (),
        tuple(variable.name for variable in derivatives),
        tuple(unknown.variable.name for unknown in source.eventIndicators or ()),
    )


def _count(source: Any, attribute: str) -> int:
    count = int(getattr(source, attribute))
    if not 0 <= count <= _MOST_EQUATIONS:
        raise FMULoadError(f"{attribute} is {count}, expected 0 to {_MOST_EQUATIONS}")
    return count


def _units(root: Any) -> dict[str, Unit]:
    """Read the unit definitions; unusable ones are left out."""
    units: dict[str, Unit] = {}
    for element in root.findall("UnitDefinitions/*"):
        name = element.get("unit" if element.tag == "BaseUnit" else "name")
        with suppress(ValueError):
            units[name or ""] = _unit(element)
    return units


def _unit(element: Any) -> Unit:
    base = element.find("BaseUnit")
    displays = {
        display.get("displayUnit") or display.get("name") or "": _display_unit(display)
        for display in element.findall("DisplayUnit") + element.findall("DisplayUnitDefinition")
        if not _is_set(display, "inverse")  # one over the value: not linear
    }
    if base is None:
        return Unit(display_units=displays)
    dimension = tuple(int(base.get(name, "0")) for name in BASE_UNITS)
    return Unit(dimension, *_linear(base, "factor"), displays)


def _display_unit(element: Any) -> tuple[float, float]:
    """Factor and offset; FMI 1.0 calls the factor a gain."""
    return _linear(element, "gain" if element.tag == "DisplayUnitDefinition" else "factor")


def _linear(element: Any, factor: str) -> tuple[float, float]:
    numbers = float(element.get(factor, "1")), float(element.get("offset", "0"))
    if not all(map(math.isfinite, numbers)) or numbers[0] == 0:
        raise ValueError(f"{numbers} is no conversion")
    return numbers


def _error_categories(root: Any) -> tuple[str, ...]:
    """Read the log categories whose names or descriptions tell of errors; FMI 1.0 has none."""
    categories = root.findall("LogCategories/Category")
    chosen = [
        category.get("name", "")
        for category in categories
        if _OF_ERRORS.search(f"{category.get('name')} {category.get('description')}")
    ]
    return tuple(name for name in chosen if name)[:_MOST_CATEGORIES]


def _derivatives(source: Any, namesakes: Collection[str]) -> dict[str, str]:
    """Read the derivatives of ModelStructure that name their states.

    Where one of the two names is not unique, nobody can use the other one.
    """
    derivatives = [unknown.variable for unknown in source.derivatives]
    named = {d.derivative.name: d.name for d in derivatives if d.derivative}
    return {x: d for x, d in named.items() if x not in namesakes and d not in namesakes}


def _interfaces(source: Any) -> dict[str, Any]:
    """FMPy's objects for the interfaces that the FMU offers, by their names."""
    offered = {
        "co-simulation": source.coSimulation,
        "model exchange": source.modelExchange,
        "scheduled execution": source.scheduledExecution,
    }
    return {name: offer for name, offer in offered.items() if offer is not None}


def _identifier(source: Any, name: str | None) -> str:
    """The model identifier becomes a file name: a path here would load any library.

    The functions of FMI 1.0 begin with it, so that it must be a C identifier there.
    """
    file_name = name is not None and name.isprintable() and _IDENTIFIER.fullmatch(name)
    if name is None or not file_name or name in {".", ".."}:
        raise FMULoadError(f"the modelIdentifier is {name!r}, expected the name of a file")
    if source.fmiVersion == "1.0" and not re.fullmatch(r"[A-Za-z_]\w*", name, re.ASCII):
        raise FMULoadError(
            f"the modelIdentifier is {name!r}, expected a C identifier: the names of the functions "
            "of FMI 1.0 begin with it"
        )
    return name


def _time(source: Any, attribute: str) -> float | None:
    """Read a time or the tolerance; None if it is not given or cannot be used."""
    text = getattr(source, attribute, None)
    if text is None:
        return None
    value = float(text)
    usable = math.isfinite(value) and (value > 0 or attribute not in _POSITIVE)
    return value if usable else None


def _capabilities(source: Any, root: Any, interface: str, offer: Any) -> Capabilities:
    if source.fmiVersion == "1.0":
        return _fmi1_capabilities(root, interface)
    return Capabilities(
        interface == "model_exchange" or offer.canHandleVariableCommunicationStepSize,
        offer.canGetAndSetFMUstate,
        offer.canSerializeFMUstate,
        _provides(root, _ELEMENTS[interface], "Directional"),
        offer.canBeInstantiatedOnlyOncePerProcess,
        offer.needsExecutionTool,
        _provides(root, _ELEMENTS[interface], "Adjoint"),
    )


def _provides(root: Any, element: str, kind: str) -> bool:
    """Read a flag for derivatives. FMI 3.0 spells it in the plural, which FMPy does not read."""
    names = (f"provides{kind}Derivative", f"provides{kind}Derivatives")
    return any(_is_set(root.find(element), name) for name in names)


def _is_set(element: Any, flag: str) -> bool:
    return element.get(flag) in {"true", "1"}


def _fmi1_capabilities(root: Any, interface: str) -> Capabilities:
    """Read the flags of FMI 1.0, which FMPy leaves out. FMI 1.0 has no FMU state."""
    flags = root.find("Implementation/*/Capabilities")
    flags = {} if flags is None else flags.attrib
    return Capabilities(
        can_handle_variable_communication_step_size=interface == "model_exchange"
        or _is_set(flags, "canHandleVariableCommunicationStepSize"),
        can_be_instantiated_only_once_per_process=_is_set(
            flags, "canBeInstantiatedOnlyOncePerProcess"
        ),
        needs_execution_tool=root.find("Implementation/CoSimulation_Tool") is not None,
    )


def _variables(pairs: Iterable[tuple[Any, Any]]) -> list[Variable]:
    """Convert the variables; only one of a group that differs in ``OWN`` alone takes time."""
    templates: dict[Any, Variable] = {}
    variables = []
    for source, element in pairs:
        key = _what_is_shared(source, element)
        template = templates.get(key)
        if template is None:
            template = templates[key] = _template(source, element)
        own = (source.name, _reference(source), source.start, source.description or "")
        variables.append(template.sibling(*own))
    return variables


def _what_is_shared(source: Any, element: Any) -> tuple[Any, ...]:
    """All that ``_template`` reads, but for arrays and clocks, which have a template each."""
    more: tuple[Any, ...] = ()
    if element is not _NOTHING_MORE:
        more = (_is_relative(source, element), element.get("clocks"), element.get("alias"))
    special = source if source.dimensions or source.type == "Clock" else None
    return (_SHARED(source), source.start is None, special, more)


def _template(source: Any, element: Any) -> Variable:
    """A variable without a name, whose siblings are like FMPy's variable."""
    ticking = _ticking(source, element)
    return Variable(
        name="",
        type=source.type,
        value_reference=0,
        causality=source.causality,
        variability=source.variability,
        initial=_initial(source),
        unit=_inherited(source, "unit", str) or None,
        relative=_is_relative(source, element),
        minimum=_bound(source, "min", -math.inf),
        maximum=_bound(source, "max", math.inf),
        nominal=_nominal(source),
        items=_items(source),
        shape=_shape(source),
        dimensions=tuple(
            "" if d.start is not None else d.variable.name for d in source.dimensions or ()
        ),
        clocks=tuple(map(int, (element.get("clocks") or "").split())),
        ticking=ticking,
        interval=_clock_time(source, element, "interval") if ticking else UNKNOWN,
        shift=_shift(source, element, ticking) if ticking else UNKNOWN,
        by_fractions=bool(ticking) and _is_set(element, "supportsFraction"),
        negated=element.get("alias") == "negatedAlias" and source.type in _OPPOSITES,
    )


def _shape(source: Any) -> tuple[int, ...]:
    shape = tuple(source.shape or ())
    if any(length < 0 for length in shape):
        raise FMULoadError(f"the array {source.name!r} has the shape {shape}")
    return shape


def _ticking(source: Any, element: Any) -> str:
    if source.type != "Clock":
        return ""
    kind = element.get("intervalVariability")
    if kind not in CLOCK_KINDS:
        raise FMULoadError(
            f"the clock {source.name!r} has intervalVariability={kind!r}, expected one of "
            f"{', '.join(CLOCK_KINDS)}"
        )
    return str(kind)


def _shift(source: Any, element: Any, ticking: str) -> Interval:
    """Time before the first tick; the FMU alone knows it for a calculated clock."""
    shift = _clock_time(source, element, "shift")
    return Interval(0.0) if shift is UNKNOWN and ticking != "calculated" else shift


def _clock_time(source: Any, element: Any, name: str) -> Interval:
    """An interval or shift. A fraction is preferred to a decimal, because it is exact."""
    decimal, counter = element.get(f"{name}Decimal"), element.get(f"{name}Counter")
    if counter is not None and element.get("resolution") is not None:
        resolution = _fraction_part(source, "resolution", element.get("resolution"), 1)
        return Interval.of_fraction(
            _fraction_part(source, f"{name}Counter", counter, 0), resolution
        )
    return UNKNOWN if decimal is None else Interval(float(decimal))


def _fraction_part(source: Any, attribute: str, text: str, least: int) -> int:
    """Read a part of a fraction."""
    if not text.isdecimal() or not least <= int(text) <= MOST_FRACTIONS:
        raise FMULoadError(
            f"the clock {source.name!r} has {attribute}={text!r}, expected a whole number from "
            f"{least} to {MOST_FRACTIONS}"
        )
    return int(text)


def _reference(source: Any) -> int:
    reference = int(source.valueReference)
    if reference not in _REFERENCES:
        raise FMULoadError(
            f"variable {source.name!r} has the value reference {source.valueReference}, expected "
            f"0 to {_REFERENCES[-1]}"
        )
    return reference


def _initial(source: Any) -> str | None:
    """Read ``initial``. FMI 1.0 has none: there a start attribute means that it may be set."""
    if source.initial is None:
        return None if source.start is None else "exact"
    return str(source.initial)


def _inherited(source: Any, attribute: str, convert: Callable[[str], Any]) -> Any:
    """Take an attribute from the variable, or else from its declared type."""
    value = getattr(source, attribute)
    if value is None and source.declaredType is not None:
        value = getattr(source.declaredType, attribute)
    return None if value is None else convert(value)


def _is_relative(source: Any, element: Any) -> bool:
    """Whether a variable or its type is relative; FMPy does not find it at variables."""
    places = element if source.type == "Real" else (element,)  # below it before FMI 3.0
    for place in places:
        if place.get("relativeQuantity") is not None:
            return place.get("relativeQuantity") in {"true", "1"}
    return bool(getattr(source.declaredType, "relativeQuantity", False))


def _bound(source: Any, attribute: str, default: float) -> float:
    value = _inherited(source, attribute, float)
    return default if value is None or math.isnan(value) else float(value)


def _nominal(source: Any) -> float | None:
    value = _inherited(source, "nominal", float)
    return value if value is not None and math.isfinite(value) else None


def _items(source: Any) -> tuple[tuple[str, int], ...]:
    declared = source.declaredType
    items = () if declared is None else tuple((str(i.name), int(i.value)) for i in declared.items)
    for name, value in items:
        if value not in _ITEMS:
            raise FMULoadError(
                f"item {name!r} of the enumeration {declared.name!r} is {value}, expected an "
                "integer of 64 bits"
            )
    return items


def _findings(source: Any) -> tuple[str, ...]:
    experiment = _unused_times(source.defaultExperiment, _EXPERIMENT)
    internal = _unused_times(source.coSimulation, ("fixedInternalStepSize",))
    return experiment + internal + _broken_rules(source)


def _of_aliases(source: Any, pairs: Iterable[tuple[Any, Any]]) -> tuple[str, ...]:
    """The findings on aliases of FMI 1.0; later versions have no negated ones."""
    if source.fmiVersion != "1.0":
        return ()
    return tuple(
        f"{variable.name!r} is a negated alias of type {variable.type}, which has no negation: its "
        "value is taken as it is"
        for variable, element in pairs
        if element.get("alias") == "negatedAlias" and variable.type not in _OPPOSITES
    )


def _unused_times(source: Any, attributes: tuple[str, ...]) -> tuple[str, ...]:
    given = {name: getattr(source, name, None) for name in attributes}
    return tuple(
        f"{name} is {text}, which cannot be used"
        for name, text in given.items()
        if text is not None and _time(source, name) is None
    )


def _broken_rules(source: Any) -> tuple[str, ...]:
    try:
        return tuple(validate_model_description(source))
    except Exception as error:  # the validation itself stumbles over some invalid files
        return (f"the model description could not be validated: {reason(error)}",)
