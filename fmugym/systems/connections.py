"""Connections as a user writes them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

from fmugym.checks import KnownArguments, check_number, check_text
from fmugym.errors import ConfigError, shown
from fmugym.keys import FLAG, NUMBER, TEXT, Either, Kind, check_fields, key, table_of_fields

__all__ = ["CONNECTION", "Connection"]

_ARROW: Final = "->"


def _name(end: str, value: Any) -> str:
    name = check_text(f"the {end} of a connection", value).strip()
    if not name:
        raise ConfigError(f"the {end} of a connection is empty")
    return name


def _gain(what: str, value: Any) -> float:
    gain = check_number(what, value)
    if not gain:
        raise ConfigError(f"{what} must not be 0")
    return gain


@dataclass(frozen=True)
class Connection(KnownArguments):
    """A connection of an ``FMUSystem``: ``target = gain * source + offset``.

    The value is converted from the unit of the source to that of the target, then ``gain`` and
    ``offset`` apply to the converted value. Both may be the name of a component, a dot and the
    name of its variable. A name without a component is one of the system itself: as a source it
    is an input or parameter of the system, as a target an output. The keys are those of a
    connection in a task file, see ``docs/systems.md``.

    Raises:
        ConfigError: If a value does not fit.
        ArgumentError: If there is no argument of this name; that is a ``TypeError``, too.
    """

    source: str = key(Kind(_name, TEXT.schema), "Where the value comes from.")
    target: str = key(Kind(_name, TEXT.schema), "Where it goes.")
    gain: float = key(Kind(_gain, NUMBER.schema), "Factor of the value.", 1.0)
    offset: float = key(NUMBER, "This is added.", 0.0)
    convert_units: bool = key(FLAG, "Whether the value is converted between units.", True)

    def __post_init__(self) -> None:
        check_fields(self)

    def __str__(self) -> str:
        return f"{self.source} {_ARROW} {self.target}"

    @classmethod
    def of(cls, value: Any) -> Connection:
        """Make a connection of ``"source -> target"`` or a pair of names.

        Raises:
            ConfigError: If it is none.
        """
        if isinstance(value, Connection):
            return value
        parts = value.split(_ARROW) if isinstance(value, str) else value
        if isinstance(parts, list | tuple) and len(parts) == 2:
            return cls(*parts)
        raise ConfigError(
            f"a connection must be 'source -> target', a pair of names or a Connection, "
            f"got {shown(value)}"
        )


CONNECTION: Final = Either(
    table_of_fields(Connection, make=Connection),
    Kind(lambda _, value: Connection.of(value), {"title": '"source -> target"', **TEXT.schema}),
)
"""A connection as a text or pair of names, a table or an object."""
