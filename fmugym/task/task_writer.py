"""Writing tasks as TOML."""

from __future__ import annotations

import datetime
import tomllib
from collections.abc import Mapping, MutableMapping
from pathlib import Path
from typing import Any, Final

from fmugym.errors import ConfigError, shown
from fmugym.files import write_whole

__all__ = ["as_toml", "revised", "write_new"]

_Keys = tuple[str, ...]

_INLINE: Final = ("fmu", "clock", "warm_up")
"""Tables that describe one value; they are written in one line."""

_TABLES: Final = (("plant", "tags"), ("plant", "data"))
"""Tables within others that have a heading of their own."""


def write_new(path: Path, text: str) -> None:
    """Write a text to a new file; nothing stays of one that cannot be completed.

    Raises:
        FileExistsError: If the file exists.
    """
    with path.open("x", encoding="utf-8", newline="\n"):
        pass
    try:
        write_whole(path, text.encode())
    except BaseException:
        path.unlink(missing_ok=True)
        raise


def as_toml(document: Mapping[str, Any]) -> str:
    """Write a document as TOML: single values first, then one table for each of its tables.

    Args:
        document: Dicts, lists, texts, numbers, Booleans, dates and times.

    Raises:
        ConfigError: If it holds another object; the text names it.
    """
    import tomlkit

    written = tomlkit.document()
    for key in sorted(document, key=lambda key: _has_heading(document[key], (key,))):
        written.add(key, _new(document[key], (key,)))
    return str(tomlkit.dumps(written))


def _table(items: Mapping[str, Any], keys: _Keys) -> Any:
    """Write a table with a heading; inner tables with headings come last."""
    import tomlkit

    table, last = tomlkit.table(), {}
    for name, value in items.items():
        if (*keys, name) in _TABLES:
            last[name] = _table(value, (*keys, name))
        else:
            table.add(name, _item(value, (*keys, name)))
    for name, one in last.items():
        table.add(name, one)
    return table


def revised(text: str, document: Mapping[str, Any]) -> str | None:
    """Change the values of a TOML text, and keep its comments and its form.

    Args:
        text: The text of a file.
        document: The values that it should have.

    Returns:
        The new text; None if it cannot be changed so that it has these values.

    Raises:
        ConfigError: As ``as_toml``.
    """
    import tomlkit
    from tomlkit.exceptions import TOMLKitError

    try:
        written = tomlkit.parse(text)
        _revise(written, document, ())
        changed = tomlkit.dumps(written)
        return changed if _same(tomllib.loads(changed), document) else None
    except (TOMLKitError, KeyError, ValueError):
        return None


def _revise(table: MutableMapping[str, Any], wanted: Mapping[str, Any], keys: _Keys) -> None:
    for key in [key for key in table if key not in wanted]:
        del table[key]
    for key, value in wanted.items():
        present = table.get(key)
        if isinstance(present, MutableMapping) and isinstance(value, Mapping):
            _revise(present, value, (*keys, key))
        elif key not in table or not _same(present, value):
            table[key] = _new(value, (*keys, key))


def _new(value: Any, keys: _Keys) -> Any:
    return _table(value, keys) if _has_heading(value, keys) else _item(value, keys)


def _has_heading(value: Any, keys: _Keys) -> bool:
    """Whether a value is a table with a heading."""
    return isinstance(value, Mapping) and len(keys) == 1 and keys[0] not in _INLINE


def _same(first: Any, second: Any) -> bool:
    """Whether two values are equal, and of the same kind."""
    if isinstance(first, Mapping) and isinstance(second, Mapping):
        return first.keys() == second.keys() and all(_same(first[k], second[k]) for k in first)
    if isinstance(first, list) and isinstance(second, list):
        return len(first) == len(second) and all(map(_same, first, second))
    return bool(isinstance(first, bool) == isinstance(second, bool) and first == second)


def _item(value: Any, keys: _Keys) -> Any:
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
