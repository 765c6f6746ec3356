"""Entries of a task: values that know their places in the file."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, Final, NamedTuple

from fmugym.declared.mistakes import Mistakes
from fmugym.errors import ConfigError, ConsequenceError, TaskError, printable

__all__ = ["Entry", "Source"]

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
