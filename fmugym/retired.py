"""What earlier versions took: it warns for one release, and is unknown after that."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Collection, Mapping
from types import FrameType
from typing import Final, TypeVar

__all__ = ["RETIRED", "grouped", "warn_of_gone", "without_retired"]

_Value = TypeVar("_Value")

RETIRED: Final = {
    "error_tolerance": "give 'step_size', or 'substeps' of the environment, to make steps smaller",
    "input_interpolation": "inputs hold their values within a step; take a shorter 'time_step'",
    "keep_initial_states": "leave it out; each instance keeps its own state after initialization",
    "max_initializations_per_second": "leave it out; 'max_instances' and 'licence_wait' stay",
    "min_step_size": "leave it out, as 'error_tolerance'",
    "rehearsals": "leave it out; the trial alone finds how episodes begin, or give 'reset_method'",
}
"""Keys of configs and task files and arguments of systems that are gone, and what to do now."""


def without_retired(given: Mapping[str, _Value]) -> dict[str, _Value]:
    """Leave out what is gone, with a ``FutureWarning`` for each that says what to do."""
    for key in given:
        if key in RETIRED:
            warn_of_gone(f"{key!r} is gone and does nothing: {RETIRED[key]}")
    return {key: value for key, value in given.items() if key not in RETIRED}


_OURS: Final = frozenset({"fmugym", "functools", "gymnasium"})


def warn_of_gone(text: str) -> None:
    """Warn of something that is gone; the warning shows the user's line."""
    frame: FrameType = sys._getframe(1)
    while frame.f_back is not None and _package_of(frame) in _OURS:
        frame = frame.f_back
    place = frame.f_code.co_filename, frame.f_lineno
    shown = frame.f_globals.setdefault("__warningregistry__", {})
    warnings.warn_explicit(text, FutureWarning, *place, registry=shown)


def _package_of(frame: FrameType) -> str:
    name: str = frame.f_globals.get("__name__", "")
    return name.partition(".")[0]


def grouped(
    given: Mapping[str, _Value], names: Collection[str], where: str
) -> tuple[dict[str, _Value], dict[str, _Value]]:
    """Separate keys that have moved, with a ``FutureWarning`` for each.

    Args:
        given: What the user gave.
        names: The keys that have moved.
        where: Where they stand now.

    Returns:
        The other keys, and these.
    """
    moved = {key: value for key, value in given.items() if key in names}
    for key in moved:
        warn_of_gone(f"{key!r} now stands in {where}")
    return {key: value for key, value in given.items() if key not in moved}, moved
