"""Entries of a task: values, numbers and distributions that know their places in the file.

Mistakes of a task are collected and reported together.
"""

from __future__ import annotations

import math
import re
import tomllib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, Final, NamedTuple

from fmugym.checks import check_mapping, check_number, number_of
from fmugym.environment.distributions import as_distribution, is_distribution
from fmugym.errors import ConfigError, ConsequenceError, TaskError, nearest_name, printable, shown
from fmugym.expressions.language import CONSTANTS, Expression
from fmugym.pool.pool_spec import whole_number_of_steps

__all__ = [
    "Entry",
    "Mistakes",
    "Source",
    "constant_of",
    "finite",
    "nearest_steps",
    "number",
    "number_or_distribution",
    "steps_in",
]

_Keys = tuple[str, ...]

_MOST: Final = 100
"""Mistakes that one error tells, at most."""


class Mistakes:
    """Mistakes of a task, by the keys of the wrong values.

    What only follows from a mistake is none: whatever needs a value that could not be read raises
    ``ConsequenceError``, which is not noted.

    Attributes:
        hidden: Names of components and connections of a system that have mistakes.
    """

    def __init__(self) -> None:
        self._found: dict[str, tuple[_Keys, tuple[int, int]]] = {}
        self._unknown: set[_Keys] = set()
        self._consequences: dict[_Keys, str] = {}
        self.hidden: set[str] = set()

    def note(
        self, text: str, keys: _Keys, place: tuple[int, int], is_unknown: bool = False
    ) -> None:
        """Note a mistake.

        Args:
            text: Description of the mistake and its place.
            keys: The keys of the value.
            place: The number of its file, and the line; mistakes are told in this order.
            is_unknown: Whether there is no key of this name.
        """
        if len(self._found) < _MOST:
            self._found.setdefault(text, (keys, place))
        if len(self._found) == _MOST:  # to look for more of them may take minutes
            self.require_none()
        if is_unknown:
            self._unknown.add(keys)

    def note_consequence(self, text: str, keys: _Keys) -> None:
        """Note that a value under these keys cannot be had because of another mistake."""
        self._consequences.setdefault(keys, text)

    @property
    def unknown_sections(self) -> list[str]:
        """The keys of the task that do not exist."""
        return [keys[0] for keys in self._unknown if len(keys) == 1]

    def explain(self, keys: _Keys) -> bool:
        """Whether a noted mistake may be the reason for a missing value under these keys.

        It is in the value, in the table that should have it, or in the name of a key of the table.
        """
        table = keys[:-1]
        found = {*self._consequences, *(one for one, _ in self._found.values())}
        return any(one[: len(keys)] == keys or one == table for one in found) or any(
            one[:-1] == table for one in self._unknown
        )

    def require_none(self) -> None:
        """Raise one error for all mistakes.

        Raises:
            TaskError: If there are any.
        """
        told = sorted(self._found, key=lambda text: self._found[text][1])
        if len(told) == _MOST:
            told.append(f"these are the first {_MOST} mistakes; there may be more")
        if told or self._consequences:
            raise TaskError("\n".join(told or self._consequences.values()))


_KEY: Final = r"""(?:[A-Za-z0-9_-]+|"[^"\n]*"|'[^'\n]*')"""
_KEYS: Final = rf"{_KEY}(?:\s*\.\s*{_KEY})*"
_HEADER: Final = re.compile(rf"\s*\[\[?\s*({_KEYS})\s*\]")
_ASSIGNMENT: Final = re.compile(rf"\s*({_KEYS})\s*=")


class Source(NamedTuple):
    """Source of a task's values: a file, or a dict of the caller.

    Attributes:
        path: The file; None for a dict.
        folder: Base of relative paths.
        text: The text of the file.
        document: Its values.
    """

    path: Path | None
    folder: Path
    text: str
    document: Mapping[str, Any]

    def has(self, keys: Sequence[str]) -> bool:
        """Whether there is a value under these keys."""
        value: Any = self.document
        for key in keys:
            if not isinstance(value, Mapping) or key not in value:
                return False
            value = value[key]
        return True

    def place(self, keys: Sequence[str], element: str = "") -> str:
        """Find the place of a value, or of an element of a list, as far as it is known."""
        if self.path is None:
            return ".".join(keys)
        line = self.line(keys, element)
        parts = [self.path.name, f"line {line}" if line else "", ".".join(keys)]
        return ", ".join(filter(None, parts))

    def line(self, keys: Sequence[str], element: str = "") -> int:
        """The first line that leads furthest along the keys; 0 if none does."""
        wholes, parts = _lines(self.text)
        own = tuple(keys)
        beginnings = (wholes.get(own[:length], 0) for length in range(len(own), 0, -1))
        first = parts.get(own) or next(filter(None, beginnings), 0)
        lines = enumerate(self.text.splitlines()[first - 1 :], first) if first and element else ()
        quoted = f'"{element}"', f"'{element}'"
        return next((number for number, line in lines if any(q in line for q in quoted)), first)


_Lines = dict[tuple[str, ...], int]


@lru_cache(maxsize=32)
def _lines(text: str) -> tuple[_Lines, _Lines]:
    """Find the first line of each key, and the first line of each table and its parents."""
    wholes, parts = _Lines(), _Lines()
    for number, path in _paths(text):
        wholes.setdefault(path, number)
        for length in range(1, len(path) + 1):
            parts.setdefault(path[:length], number)
    return wholes, parts


def _paths(text: str) -> Iterator[tuple[int, tuple[str, ...]]]:
    """The keys that each line of a TOML file sets, with the number of the line."""
    table: tuple[str, ...] = ()
    for number, line in enumerate(text.splitlines(), 1):
        header, assignment = _HEADER.match(line), _ASSIGNMENT.match(line)
        if header:
            table = _split(header[1])
            yield number, table
        elif assignment:
            yield number, table + _split(assignment[1])


def _split(dotted: str) -> tuple[str, ...]:
    keys, value = [], tomllib.loads(f"{dotted} = 0")
    while isinstance(value, dict):
        (key, value) = next(iter(value.items()))
        keys.append(key)
    return tuple(keys)


@dataclass(frozen=True)
class Entry:
    """A value of a task, and its place in the file.

    Attributes:
        value: The value.
        keys: The keys that lead to it.
        sources: The files that the task is made of; the first that has the value counts.
        mistakes: Mistakes that are known of the task.
        element: The text of an element of a list, which tells its line.
    """

    value: Any
    keys: tuple[str, ...]
    sources: tuple[Source, ...]
    mistakes: Mistakes = field(default_factory=Mistakes, compare=False)
    element: str = ""

    @property
    def name(self) -> str:
        """The last of its keys."""
        return self.keys[-1]

    @property
    def source(self) -> Source:
        """The file that gives the value, or that should give it."""
        for length in range(len(self.keys), 0, -1):
            for source in self.sources:
                if source.has(self.keys[:length]):
                    return source
        return self.sources[0]

    def error(self, text: object) -> TaskError:
        """Make an error that names the place of this value."""
        place = self.source.place(self.keys, self.element)
        return TaskError(printable(f"{place}: {text}" if place else text))

    def lack(self, text: str, *keys: str) -> TaskError:
        """Make an error for values that are missing in this table, unless a mistake explains it.

        Args:
            text: Description of the missing thing.
            keys: Their keys; none for this value itself.
        """
        places = [(*self.keys, key) for key in keys] or [self.keys]
        is_known = any(map(self.mistakes.explain, places))
        return ConsequenceError(text) if is_known else self.error(text)

    def note(self, error: object, is_unknown: bool = False) -> None:
        """Note a mistake in this value; see ``Mistakes.note``."""
        source = self.source
        place = self.sources.index(source), source.line(self.keys, self.element)
        self.mistakes.note(str(error), self.keys, place, is_unknown)

    @contextmanager
    def placing(self) -> Iterator[None]:
        """Add the place of this value to errors of a ``with`` block."""
        try:
            yield
        except TaskError:
            raise
        except ConfigError as error:
            raise self.error(error) from error

    @contextmanager
    def noting(self) -> Iterator[None]:
        """Note errors about this value, instead of raising them."""
        try:
            with self.placing():
                yield
        except ConsequenceError as error:
            self.mistakes.note_consequence(str(self.error(error)), self.keys)
        except TaskError as error:
            self.note(error)

    def child(self, key: str) -> Entry:
        """The value under a key of this table; None if it is missing."""
        items = self.value if isinstance(self.value, Mapping) else {}
        return Entry(items.get(key), (*self.keys, key), self.sources, self.mistakes)

    def items(self) -> dict[str, Entry]:
        """The values of this table by key; none if it is not given, and none that are wrong."""
        return {key: self.child(key) for key, one in (self.value or {}).items() if one is not None}

    def required(self, key: str) -> Entry:
        """The value under a key that must be there.

        Raises:
            ConfigError: If it is missing.
        """
        entry = self.child(key)
        if entry.value is None:
            raise self.lack(f"the key {key!r} is missing", key)
        return entry

    def elements(self) -> list[Entry]:
        """The elements of a list; none if it is not given."""
        return [
            replace(self, value=one, element=one if isinstance(one, str) else "")
            for one in self.value or ()
            if one is not None
        ]

    def path(self) -> Path:
        """The value as a path; a relative one is relative to the folder of its file."""
        path = Path(self.value).expanduser()
        return path if path.is_absolute() else self.source.folder / path


def nearest_steps(length: float, step: float) -> int:
    """The number of steps that is nearest to a duration.

    Raises:
        ConsequenceError: If the step is not a number, because the task has a mistake there.
    """
    _require_known(step)
    return round(length / step)


def _require_known(step: float) -> None:
    if math.isnan(step):
        raise ConsequenceError("the time step is not known")


def steps_in(entry: Entry, length: float, step: float, most: float = math.inf) -> int:
    """The number of steps in a duration.

    Args:
        entry: Entry of the task.
        length: The duration in seconds.
        step: The length of a step in seconds.
        most: There may be at most so many.

    Raises:
        ConfigError: If it is no positive multiple of the step, or there are more.
    """
    _require_known(step)
    count = whole_number_of_steps(length, step) if step > 0 else None
    if not count:
        raise entry.error(
            f"expected a positive multiple of the step of {step:g} s, got {length:g} s"
        )
    if count > most:
        raise entry.error(f"{length:g} s are {count} steps of {step:g} s, at most {most}")
    return count


def number(what: str, value: Any) -> float:
    """A number of a task: a number, or a text with an expression of constants, such as ``pi / 2``.

    Raises:
        ConfigError: If it is neither.
    """
    if isinstance(value, str):
        return constant_of(what, value)
    return number_of(what, value, may_be_boolean=True)


def constant_of(what: str, text: str) -> float:
    """The value of an expression of constants.

    Raises:
        ConfigError: If it is none.
    """
    expression = Expression.parse(text)
    if expression.names <= CONSTANTS.keys():
        return expression.constant()
    near = nearest_name(text, [*CONSTANTS])
    hint = "" if near is None else f"; did you mean {near!r}?"
    raise ConfigError(
        f"{what} must be a number, or an expression of constants such as '24 * pi / 180', got "
        f"{shown(text)}{hint}"
    )


def finite(what: str, value: Any) -> float:
    """A finite number of a task, as ``number``."""
    return check_number(what, number(what, value), may_be_boolean=True)


def number_or_distribution(
    what: str,
    value: Any,
    read: Callable[[str, Any], Any] = finite,
    *,
    draws_texts: bool = False,
) -> Any:
    """A number, or a distribution, whose numbers may be texts with expressions of constants.

    Args:
        what: Its name, for the error.
        value: As the user gave it.
        read: Reads what is no distribution.
        draws_texts: Whether texts among the values of a choice stand for themselves.

    Raises:
        ConfigError: If it is neither.
    """
    if is_distribution(value):
        return value
    if not isinstance(value, Mapping):
        return read(what, value)
    items = check_mapping(what, value)
    for name, given in items.items():
        if isinstance(given, list | tuple) and not (draws_texts and name == "values"):
            items[name] = [number(name, one) if isinstance(one, str) else one for one in given]
        elif name not in {"distribution", "values", "probabilities"}:
            items[name] = number(name, given)
    return as_distribution(what, items)
