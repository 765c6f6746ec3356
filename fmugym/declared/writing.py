"""Writing tasks as TOML."""

from __future__ import annotations

import datetime
from collections.abc import Mapping
from typing import Any, Final

from fmugym.errors import ConfigError, shown

__all__ = ["as_toml"]

_INLINE: Final = ("fmu", "clock", "warm_up")
"""Tables that describe one value; they are written in one line."""


def as_toml(document: Mapping[str, Any]) -> str:
    """Write a document as TOML: single values first, then one table for each of its tables.

    Args:
        document: Dicts, lists, texts, numbers, Booleans, dates and times.

    Raises:
        ConfigError: If it holds another object; the text names it.
    """
    import tomlkit

    written = tomlkit.document()
    tables = {k: v for k, v in document.items() if isinstance(v, Mapping) and k not in _INLINE}
    for key, value in document.items():
        if key not in tables:
            written.add(key, _item(value, (key,)))
    for key, items in tables.items():
        table = tomlkit.table()
        for name, value in items.items():
            table.add(name, _item(value, (key, name)))
        written.add(key, table)
    return str(tomlkit.dumps(written))


def _item(value: Any, keys: tuple[str, ...]) -> Any:
    import tomlkit

    if isinstance(value, Mapping):
        table = tomlkit.inline_table()
        for key, item in value.items():
            table.add(key, _item(item, (*keys, key)))
        return table
    if isinstance(value, list | tuple):
        array = tomlkit.array()
        array.extend([_item(item, keys) for item in value])
        return array
    if isinstance(value, str | bool | int | float | datetime.date | datetime.time):
        return tomlkit.item(value)
    raise ConfigError(f"{'.'.join(keys)} cannot be written to a file: it is {shown(value)}")
