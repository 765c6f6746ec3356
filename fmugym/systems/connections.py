"""Connections as a user writes them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

from fmugym.checks import KnownArguments, check_flag, check_number, check_text
from fmugym.errors import ConfigError, shown

__all__ = ["Connection"]

_ARROW: Final = "->"


@dataclass(frozen=True)
class Connection(KnownArguments):
    """A connection of an ``FMUSystem``: ``target = gain * source + offset``.

    The value is converted from the unit of the source to that of the target, then ``gain`` and
    ``offset`` apply to the converted value. Both may be the name of a component, a dot and the
    name of its variable. A name without a component is one of the system itself: as a source it
    is an input or parameter of the system, as a target an output.

    Attributes:
        source: Where the value comes from.
        target: Where it goes.
        gain, offset: 1 and 0 leave the value as it is.
        convert_units: Whether the value is converted between units.

    Raises:
        ConfigError: If a value does not fit.
        ArgumentError: If there is no argument of this name; that is a ``TypeError``, too.
    """

    source: str
    target: str
    gain: float = 1.0
    offset: float = 0.0
    convert_units: bool = True

    def __post_init__(self) -> None:
        for end in ("source", "target"):
            object.__setattr__(self, end, _name(end, getattr(self, end)))
        for number in ("gain", "offset"):
            value = check_number(f"{number} of {self}", getattr(self, number))
            object.__setattr__(self, number, value)
        if not self.gain:
            raise ConfigError(f"gain of {self} must not be 0")
        flag = check_flag(f"convert_units of {self}", self.convert_units)
        object.__setattr__(self, "convert_units", flag)

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


def _name(end: str, value: Any) -> str:
    name = check_text(f"the {end} of a connection", value).strip()
    if not name:
        raise ConfigError(f"the {end} of a connection is empty")
    return name
