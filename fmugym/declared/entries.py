"""The values of a task, each of which knows where it stands in its file."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, NamedTuple, TypeVar

from fmugym.errors import ConfigError, TaskError, printable

__all__ = ["Entry", "Source", "gathered"]

_Part = TypeVar("_Part")
_Read = TypeVar("_Read")

_KEY: Final = r"""(?:[A-Za-z0-9_-]+|"[^"\n]*"|'[^'\n]*')"""
_KEYS: Final = rf"{_KEY}(?:\s*\.\s*{_KEY})*"
_HEADER: Final = re.compile(rf"\s*\[\[?\s*({_KEYS})\s*\]")
_ASSIGNMENT: Final = re.compile(rf"\s*({_KEYS})\s*=")


class Source(NamedTuple):
    """A file, or a dict of the caller, that gives values of a task.

    Attributes:
        path: The file; None for a dict.
        folder: Where relative paths start.
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

    def place(self, keys: Sequence[str]) -> str:
        """Say where a value stands, as far as that is known."""
        if self.path is None:
            return ".".join(keys)
        line = self._line(keys)
        parts = [self.path.name, f"line {line}" if line else "", ".".join(keys)]
        return ", ".join(filter(None, parts))

    def _line(self, keys: Sequence[str]) -> int | None:
        """The first line that leads furthest along the keys."""
        found: tuple[int, int | None] = (0, None)
        for number, path in _paths(self.text):
            shared = min(len(path), len(keys))
            if shared > found[0] and list(path[:shared]) == list(keys[:shared]):
                found = shared, number
        return found[1]


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
    """A value of a task, and where it stands.

    Attributes:
        value: The value.
        keys: The keys that lead to it.
        sources: The files that the task is made of; the first that has the value counts.
    """

    value: Any
    keys: tuple[str, ...]
    sources: tuple[Source, ...]

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
        """Make an error that says where this value stands."""
        place = self.source.place(self.keys)
        return TaskError(printable(f"{place}: {text}" if place else text))

    @contextmanager
    def placing(self) -> Iterator[None]:
        """Let errors about this value say where it stands."""
        try:
            yield
        except TaskError:
            raise
        except ConfigError as error:
            raise self.error(error) from error

    def child(self, key: str) -> Entry:
        """The value under a key of this table; None if it is missing."""
        items = self.value if isinstance(self.value, Mapping) else {}
        return Entry(items.get(key), (*self.keys, key), self.sources)

    def items(self) -> dict[str, Entry]:
        """The values of this table by key; none if it is not given."""
        return {key: self.child(key) for key in self.value or ()}

    def required(self, key: str) -> Entry:
        """The value under a key that must be there.

        Raises:
            ConfigError: If it is missing.
        """
        entry = self.child(key)
        if entry.value is None:
            raise self.error(f"the key {key!r} is missing")
        return entry

    def elements(self) -> list[Entry]:
        """The elements of a list, as entries with the place of the list."""
        return [Entry(value, self.keys, self.sources) for value in self.value]

    def path(self) -> Path:
        """The value as a path; a relative one is relative to the folder of its file."""
        path = Path(self.value).expanduser()
        return path if path.is_absolute() else self.source.folder / path


def gathered(read: Callable[[_Part], _Read], parts: Iterable[_Part]) -> list[_Read]:
    """Read parts one after the other, and raise one error for all that have mistakes.

    Raises:
        TaskError: If there are any.
    """
    found, errors = list[_Read](), list[str]()
    for part in parts:
        try:
            found.append(read(part))
        except TaskError as error:
            errors.append(str(error))
    if errors:
        raise TaskError("\n".join(dict.fromkeys(errors)))
    return found
