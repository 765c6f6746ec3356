"""Keys of configs, task files and systems: kinds, checks and descriptions, declared once.

Kinds and tables are data. ``checked_entry`` and ``with_paths`` read them, and so does
``docs/_site/keys.py``, which writes the tables of the documents and the JSON Schema for editors.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Mapping, Sequence, Sized
from dataclasses import dataclass, field, fields
from functools import partial
from typing import Any, Final, NamedTuple, TypeAlias

from fmugym.checks import (
    check_count,
    check_flag,
    check_mapping,
    check_number,
    check_option,
    check_text,
)
from fmugym.errors import ConfigError, shown, unknown_name

__all__ = [
    "COUNT",
    "FLAG",
    "LARGE_COUNT",
    "NUMBER",
    "POSITIVE",
    "REQUIRED",
    "TEXT",
    "AnyKind",
    "Either",
    "Entries",
    "Key",
    "Kind",
    "Listed",
    "Mistake",
    "Table",
    "check_fields",
    "checked_entry",
    "found_mistakes",
    "key",
    "option",
    "or_none",
    "table_of_fields",
    "with_paths",
]

_Keys = tuple[str, ...]

REQUIRED: Final = object()
"""The default of a key that must be given."""


@dataclass(frozen=True)
class Kind:
    """A single value.

    Attributes:
        check: Takes the name and the value, returns it as the package uses it, or raises
            ``ConfigError``.
        schema: What it is, as JSON Schema; a title is for the documents, too.
        holds: ``"path"`` if it is relative to the file that holds it, ``"libraries"`` if it is or
            lists such paths and names that the loader of the system finds; "" for anything else.
    """

    check: Callable[[str, Any], Any]
    schema: Mapping[str, Any] = field(default_factory=dict)
    holds: str = ""


@dataclass(frozen=True)
class Listed:
    """A list of values of one kind.

    Attributes:
        kind: Kind of the values.
        or_one: Whether a single value stands for a list of one.
        most: How many there may be; None for any number.
    """

    kind: AnyKind
    or_one: bool = False
    most: int | None = None


@dataclass(frozen=True)
class Entries:
    """A table of values of one kind under names of the user's choice.

    Attributes:
        kind: Kind of the values.
        most: How many there may be; None for any number.
    """

    kind: AnyKind
    most: int | None = None


@dataclass(frozen=True)
class Either:
    """A table, or else another value."""

    table: Entries | Table
    other: AnyKind


@dataclass(frozen=True)
class Table:
    """A table whose keys are known.

    Attributes:
        keys: By name.
        what: Name of a key of it, for errors.
        short: The key whose value may stand for the table; "" for none.
        one_of: Exactly one of these must be given.
        elsewhere: Names that are no keys of it, and what to do instead.
        make: Makes an object of the values by their keys; None to leave them in a dict.
    """

    keys: Mapping[str, Key]
    what: str = "key"
    short: str = ""
    one_of: Sequence[str] = ()
    elsewhere: Mapping[str, str] = field(default_factory=dict)
    make: type | None = None


AnyKind: TypeAlias = Kind | Listed | Entries | Either | Table


class Key(NamedTuple):
    """A key of a table.

    Attributes:
        kind: Kind of its value.
        text: Meaning, in Markdown.
        default: Its value where it is not given; ``REQUIRED`` if it must be given.
        shown: The default in words, for the documents, if the value does not tell it.
    """

    kind: AnyKind
    text: str
    default: Any = None
    shown: str = ""


class Mistake(NamedTuple):
    """Mistake in a value.

    Attributes:
        keys: The keys that lead to it.
        text: Expected and given value.
        is_unknown: Whether there is no such key.
    """

    keys: _Keys
    text: str
    is_unknown: bool = False


def checked_entry(kind: AnyKind, value: Any) -> Any:
    """Check a value in Python.

    Returns:
        The value as the package uses it. Keys that are not given have their defaults.

    Raises:
        ConfigError: If it is wrong; the text names all mistakes.
    """
    result, mistakes = found_mistakes(kind, value)
    if mistakes:
        raise ConfigError("; ".join(one.text for one in mistakes))
    return result


def found_mistakes(kind: AnyKind, value: Any) -> tuple[Any, list[Mistake]]:
    """Check a value, and find everything that is wrong with it.

    Args:
        kind: Kind of the value.
        value: As the user gave it.

    Returns:
        The value as in ``checked_entry``, as far as it is right, and the mistakes. A key of a table
        whose value is wrong is not in it.
    """
    reading = _Reading([])
    return reading.read(kind, (), value), reading.mistakes


class _Reading(NamedTuple):
    """Reads values, and notes mistakes."""

    mistakes: list[Mistake]

    def read(self, kind: AnyKind, keys: _Keys, value: Any) -> Any:
        """The value as the package uses it; None if it is wrong."""
        match kind:
            case Kind():
                try:
                    return kind.check(keys[-1], value)
                except ConfigError as error:
                    return self._note(keys, str(error))
            case Either():
                return self.read(kind.table if _is_table(value) else kind.other, keys, value)
            case Listed() if isinstance(value, list | tuple):
                if kind.most is not None and len(value) > kind.most:
                    return self._too_many(keys, kind.most, value)
                return [self.read(kind.kind, keys, one) for one in value]
            case Listed(or_one=True):
                return [self.read(kind.kind, keys, value)]
            case Listed():
                return self._note(keys, f"{keys[-1]} must be a list, got {shown(value)}")
            case Entries():
                items = self._items(keys, value)
                if items and kind.most is not None and len(items) > kind.most:
                    return self._too_many(keys, kind.most, items)
                return items and {
                    name: self.read(kind.kind, (*keys, name), one) for name, one in items.items()
                }
        return self._table(kind, keys, value)

    def _note(self, keys: _Keys, text: object, is_unknown: bool = False) -> None:
        self.mistakes.append(Mistake(keys, str(text), is_unknown))

    def _too_many(self, keys: _Keys, most: int, given: Sized) -> None:
        self._note(keys, f"{keys[-1]} has at most {most} names, got {len(given)}")

    def _items(self, keys: _Keys, value: Any) -> dict[str, Any] | None:
        what = keys[-1] if keys else "a task"
        try:
            return check_mapping(what, value)
        except ConfigError:
            return self._note(
                keys, f"{what} must be a table with names as keys (a dict), got {shown(value)}"
            )

    def _table(self, table: Table, keys: _Keys, value: Any) -> Any:
        if table.make is not None and isinstance(value, table.make):
            return value
        before = len(self.mistakes)
        is_short = bool(table.short) and not _is_table(value)
        items = {table.short: value} if is_short else self._items(keys, value)
        if items is None:
            return None
        given = {
            name: self._value(table, name, keys if is_short else (*keys, name), one)
            for name, one in items.items()
        }
        if given.keys() <= table.keys.keys():  # or else the missing key may be misspelt
            self._require(table, keys, given)
        defaults = {
            n: one.default
            for n, one in table.keys.items()
            if one.default is not None and one.default is not REQUIRED
        }
        if table.make is not None and len(self.mistakes) == before:
            return table.make(**given)
        right = {n: one for n, one in given.items() if one is not None or items[n] is None}
        return defaults | right

    def _value(self, table: Table, name: str, keys: _Keys, value: Any) -> Any:
        if name in table.keys:
            one = table.keys[name]
            is_unset = value is None and one.default is None
            return None if is_unset else self.read(one.kind, keys, value)
        if name in table.elsewhere:
            return self._note(keys, f"{name!r} is no {table.what}{table.elsewhere[name]}", True)
        return self._note(keys, unknown_name(table.what, name, table.keys), True)

    def _require(self, table: Table, keys: _Keys, given: Mapping[str, Any]) -> None:
        for name, one in table.keys.items():
            if one.default is REQUIRED and name not in given:
                self._note(keys, f"the {table.what} {name!r} is missing")
        if table.one_of and len(given.keys() & set(table.one_of)) != 1:
            self._note(keys, f"give one of {', '.join(table.one_of)}")
        for least, most in (("min", "max"), ("low", "high")):
            low, high = given.get(least), given.get(most)
            if low is not None and high is not None and not low < high:
                self._note(keys, f"{least} must be below {most}, got {low:g} and {high:g}")


def _is_table(value: Any) -> bool:
    """Whether a value is a table of keys; a distribution is one value."""
    return isinstance(value, Mapping) and "distribution" not in value


def with_paths(kind: AnyKind, value: Any, path_of: Callable[[str], str]) -> Any:
    """Return a value as the user gave it, with other paths.

    Args:
        kind: Kind of the value.
        value: The value.
        path_of: Takes a path, and returns the new one.
    """
    match kind, value:
        case Kind(holds="libraries") | Listed(), list() | tuple():
            inner = kind.kind if isinstance(kind, Listed) else kind
            return [with_paths(inner, one, path_of) for one in value]
        case Listed(or_one=True), str():
            return with_paths(kind.kind, value, path_of)
        case Kind(holds="libraries"), str() if os.path.dirname(value):
            path = path_of(value)
            return path if os.path.dirname(path) else f"./{path}"
        case Kind(holds="path"), str():
            return path_of(value)
        case Either(), _:
            return with_paths(kind.table if _is_table(value) else kind.other, value, path_of)
        case Entries(), Mapping():
            return {name: with_paths(kind.kind, one, path_of) for name, one in value.items()}
        case Table(), Mapping():
            kinds = {name: one.kind for name, one in kind.keys.items()}
            return {n: with_paths(kinds.get(n, TEXT), one, path_of) for n, one in value.items()}
        case Table(), _ if kind.short:
            return with_paths(kind.keys[kind.short].kind, value, path_of)
    return value


def key(kind: AnyKind, text: str, default: Any = REQUIRED, shown: str = "") -> Any:
    """Declare a field of a dataclass that is a key, too; see ``Key``."""
    declared = {"key": Key(kind, text, default, shown)}
    if default is REQUIRED:
        return field(metadata=declared)
    if default == {}:
        return field(default_factory=dict, metadata=declared)
    return field(default=default, metadata=declared)


def table_of_fields(cls: Any, **options: Any) -> Table:
    """Make the table of the keys of a dataclass.

    Args:
        cls: The class.
        options: Options of the ``Table``.
    """
    return Table({one.name: one.metadata["key"] for one in fields(cls)}, **options)


def check_fields(made: Any) -> None:
    """Check the fields of a frozen dataclass that are keys, and give them the package's types.

    Raises:
        ConfigError: For values that are wrong; it names all of them.
    """
    for name, value in checked_entry(table_of_fields(type(made)), vars(made)).items():
        object.__setattr__(made, name, value)


def option(*known: str) -> Kind:
    """Make the kind of a choice among some texts."""
    return Kind(partial(check_option, known=known), {"enum": list(known)})


def or_none(kind: Kind) -> Kind:
    """A value of a kind, or None."""
    return Kind(lambda what, value: None if value is None else kind.check(what, value), kind.schema)


TEXT: Final = Kind(check_text, {"type": "string"})
FLAG: Final = Kind(check_flag, {"type": "boolean"})
COUNT: Final = Kind(check_count, {"type": "integer", "minimum": 1})
LARGE_COUNT: Final = Kind(partial(check_count, largest=sys.maxsize), COUNT.schema)
NUMBER: Final = Kind(check_number, {"type": "number"})
POSITIVE: Final = Kind(
    partial(check_number, positive=True), {"type": "number", "exclusiveMinimum": 0}
)
