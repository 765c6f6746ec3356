"""Spelling of names: characters that only look the same are replaced by the declared ones."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any, Final

from fmugym.archive.description import ModelDescription
from fmugym.checks import Spellings, normal_form
from fmugym.declared.entries import Entry
from fmugym.declared.format import SETPOINT
from fmugym.errors import ConfigError
from fmugym.expressions.language import Expression
from fmugym.keys import Table

__all__ = ["as_declared"]

_DECLARING: Final = ("variables", "memory", "expressions", "data", "setpoints")
_TERMS: Final = ("reward", "costs", "kpis")

_NAMES: Final = (
    *(("agent", name) for name in ("actions", "observations")),
    *(("agent", name, "of") for name in ("forecast", "history")),
    ("setpoints", "*", "of"),
    ("data", "*", "input"),
)
"""The places of names; ``*`` stands for any key. Lists are looked through."""


NameOf = Callable[[str], str]


def as_declared(root: Entry, description: ModelDescription) -> tuple[Entry, NameOf]:
    """A task in which each name stands as it is declared, or else as the FMU has it.

    Args:
        root: The table of all keys.
        description: Description of the FMU.

    Returns:
        The table, and the function that brings names into this form.
    """
    values = root.value or {}
    names = list(_declared_in(values))
    spellings = Spellings("name of the task", dict.fromkeys(names))

    def name_of(name: str) -> str:
        if name in description.variables:
            return name
        try:
            own, in_fmu = spellings.find(name), description.find(name)
        except ConfigError:  # it may be several, which is told where it is used
            return name
        if own is not None:
            return own
        return normal_form(name) if in_fmu is None else in_fmu.name

    return replace(root, value=_renamed(values, (), name_of)), name_of


def _declared_in(values: Mapping[str, Any]) -> Any:
    """Names that a task declares, with the names that set points add."""
    for section in (*_DECLARING, *_TERMS):
        given = values.get(section)
        yield from given if isinstance(given, Mapping) else ()
    points = values.get("setpoints")
    tables = (key.kind.keys for key in SETPOINT.keys.values() if isinstance(key.kind, Table))
    suffixes = {"error", *(key for table in tables for key in table)}
    for name in points if isinstance(points, Mapping) else ():
        yield from (f"{name}_{suffix}" for suffix in suffixes)


def _renamed(value: Any, keys: tuple[str, ...], name_of: Callable[[str], str]) -> Any:
    if isinstance(value, Expression):
        return value.renamed(name_of)
    if isinstance(value, list):
        return [_renamed(one, keys, name_of) for one in value]
    if isinstance(value, Mapping) and "distribution" not in value:
        return {key: _renamed(one, (*keys, key), name_of) for key, one in value.items()}
    if isinstance(value, str) and any(_fits(keys, place) for place in _NAMES):
        return name_of(value)
    return value


def _fits(keys: tuple[str, ...], place: tuple[str, ...]) -> bool:
    pairs = zip(keys, place, strict=False)
    return len(keys) == len(place) and all(wanted in ("*", key) for key, wanted in pairs)
