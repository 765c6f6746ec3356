"""Model structure of an FMU: direct feed-through from inputs to outputs, by the XML."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Final

from fmugym.archive.description import ModelDescription

__all__ = ["Feedthrough", "read_feedthrough"]


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
