"""What hooks read: numbers for one environment, arrays for N, or symbols in their place."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any, Final

from fmugym.task.values import EpisodeVariables

if TYPE_CHECKING:
    from fmugym.task.hooks import Hooks

__all__ = ["READINGS", "Readings", "reading"]


@dataclass(slots=True)
class Readings:
    """The values that hooks read from the attributes of their environment.

    Each value has one of three forms. In a single environment it is a number or a tuple of numbers.
    In a batch of N environments it is an array with the environments on its last axis. While hooks
    are traced it is a symbol.

    Attributes:
        values: The outputs and the monitored variables; the attribute ``_values``.
        out: The same values by name.
        state: The outputs only.
        previous_state, inputs, action, previous_action, step_count, done, after_end, parameters,
            variables: See ``FMUEnv``.
    """

    values: Any
    out: Mapping[str, Any]
    state: Any
    previous_state: Any
    inputs: Any
    action: Any
    previous_action: Any
    step_count: Any
    done: Any
    after_end: Any
    parameters: Mapping[str, Any]
    variables: EpisodeVariables

    @classmethod
    def of(cls, env: Hooks) -> Readings:
        """Return what the hooks of an environment read now; nothing is copied."""
        present = vars(env)
        return cls(*[present[name] for name in READINGS])

    def place_in(self, env: Hooks) -> None:
        """Let the hooks of an environment read these values from now on."""
        vars(env).update(zip(READINGS, (getattr(self, name) for name in _FIELDS), strict=True))


_FIELDS: Final = tuple(field.name for field in fields(Readings))

READINGS: Final = ("_values", *_FIELDS[1:])
"""The attributes of an environment that hold its readings, in the order of the fields."""


@contextmanager
def reading(env: Hooks, readings: Readings) -> Iterator[None]:
    """Let the hooks of an environment read other values inside of a ``with`` block.

    The environment stays the same object. So objects and functions that it holds, and that refer
    to it, read the same values as its hooks.
    """
    before = Readings.of(env)
    readings.place_in(env)
    try:
        yield
    finally:
        before.place_in(env)
