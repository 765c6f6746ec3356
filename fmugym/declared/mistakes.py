"""Mistakes of a task, which are collected and reported together."""

from __future__ import annotations

from typing import Final

from fmugym.errors import TaskError

__all__ = ["Mistakes"]

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
