"""Tables of controllers as a text, and names in them.

The text is an inline table of TOML: ``{ u = "pid of=T setpoint=21 kp=0.5", v = 0 }``.
"""

from __future__ import annotations

import json
import re
import tomllib
from collections.abc import Mapping
from typing import Any, Final

from fmugym.checks import Spellings, check_mapping
from fmugym.errors import ConfigError, shown, unknown_name

__all__ = [
    "acting_text",
    "controller_in",
    "is_table",
    "named_controllers",
    "parts_of",
    "resolved",
    "table_in",
    "text_of",
    "with_controller",
]

_BARE: Final = re.compile(r"[A-Za-z0-9_-]+")
_KEYS: Final = ("controller", "min", "max")
"""The keys of a signal."""


def is_table(given: Any) -> bool:
    """Whether a text, or a dict, is a table of controllers."""
    return isinstance(given, Mapping) or (isinstance(given, str) and given.lstrip()[:1] == "{")


def table_in(given: Any) -> dict[str, Any]:
    """The entries of a table.

    Args:
        given: A dict, or a text.

    Raises:
        ConfigError: If it is no table, or a signal in it lacks a key or has another one.
    """
    if isinstance(given, str):
        try:
            given = tomllib.loads(f"table = {given.strip()}")["table"]
        except tomllib.TOMLDecodeError as error:
            raise ConfigError(
                f'expected a table such as {{ u = "pid of=T setpoint=21 kp=0.5", v = 0 }}, got '
                f"{shown(given)}: {error}"
            ) from None
    entries = check_mapping("a table of controllers", given)
    for name, entry in entries.items():
        if isinstance(entry, Mapping):
            _require_signal(name, entry)
    if not entries:
        raise ConfigError("a table of controllers needs an entry for each action")
    return entries


def _require_signal(name: str, entry: Mapping[str, Any]) -> None:
    for key in entry:
        if key not in _KEYS:
            raise unknown_name(f"key of {name}", key, _KEYS)
    for key in _KEYS:
        if key not in entry:
            raise ConfigError(f"{name}: the key {key!r} is missing")


def controller_in(entry: Any) -> Any:
    """Controller of an entry for an action or a signal."""
    return entry["controller"] if isinstance(entry, Mapping) else entry


def with_controller(entry: Any, controller: Any) -> Any:
    """The entry with another controller."""
    return {**entry, "controller": controller} if isinstance(entry, Mapping) else controller


def text_of(given: Mapping[str, Any]) -> str:
    """The text of a table, in one line."""
    entries = (f"{_key(name)} = {_value(one)}" for name, one in given.items())
    return f"{{ {', '.join(entries)} }}"


def _key(name: str) -> str:
    return name if _BARE.fullmatch(name) else json.dumps(name)


def _value(value: Any) -> str:
    return text_of(value) if isinstance(value, Mapping) else json.dumps(value)


def named_controllers(given: Mapping[str, Any]) -> dict[str, Any]:
    """The controllers of a task file by name: texts and numbers; a table is a text.

    Args:
        given: What stands there, in which tables may name others.

    Raises:
        ConfigError: If a name in a table is no controller of one number.
    """
    return {name: resolved(one, given) for name, one in given.items()}


def parts_of(given: Mapping[str, Any]) -> set[Any]:
    """Values that stand in tables, names of other controllers among them.

    Args:
        given: As for ``named_controllers``.
    """
    tables = [table_in(one) for one in given.values() if is_table(one)]
    return {controller_in(entry) for table in tables for entry in table.values()}


def resolved(given: Any, known: Mapping[str, Any]) -> Any:
    """A controller without names: a text or a number; a table is a text.

    Args:
        given: A text, a number or a table.
        known: Controllers by name.

    Raises:
        ConfigError: If a name in a table is no controller of one number.
    """
    if not is_table(given):
        return given
    entries = table_in(given)
    return text_of(
        {
            name: with_controller(entry, _named(name, controller_in(entry), known))
            for name, entry in entries.items()
        }
    )


def acting_text(given: Any) -> str:
    """The text of a controller; a number is a schedule that has one action."""
    return given if isinstance(given, str) else f"schedule 00:00={given}"


def _named(name: str, given: Any, known: Mapping[str, Any]) -> Any:
    """Resolve an entry of a table that names another controller."""
    own = Spellings("controller of the task", known).find(given)
    if own is None and known and isinstance(given, str) and given.isidentifier():
        raise ConfigError(f"{name}: {unknown_name('controller of the task', given, known)}")
    if own is not None and is_table(known[own]):
        raise ConfigError(f"{name}: {own!r} is a table; an entry is a controller of one number")
    return given if own is None else known[own]
