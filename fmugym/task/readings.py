"""What hooks read: numbers for one environment, arrays for N, or symbols in their place."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any, Final

from fmugym.task.values import EpisodeVariables, NamedValues

if TYPE_CHECKING:
    from fmugym.task.hooks import Hooks

__all__ = ["LATE", "READINGS", "LateReading", "Readings", "make_late", "reading"]


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
    out: NamedValues
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


class LateReading:
    """A reading that the environment does not keep while the pool does whole steps.

    As an attribute of the class, it is only found if the environment itself has no attribute of
    its name. It then makes the value from what the pool keeps.
    """

    def __init__(self, name: str) -> None:
        self._name = name

    def __get__(self, env: Any, owner: type | None = None) -> Any:
        if env is None:
            return self
        if env._play is None:
            raise AttributeError(
                f"{type(env).__name__!r} object has no attribute {self._name!r}", name=self._name
            )
        return env._player.read(env, self._name)


LATE: Final = (
    *("_values", "state", "previous_state", "inputs", "action", "previous_action"),
    *("step_count", "done"),
)
"""The readings that only the pool keeps between compiled steps.

So it does with ``variables`` if hooks use any.
"""


def make_late(cls: type[Any]) -> None:
    """Give a class the readings that the pool keeps, which it then has for good.

    Without them, reading an attribute of an environment is faster, so that only processes with
    compiled steps of single environments need them.
    """
    for name in (*LATE, "variables"):
        if name not in vars(cls):
            setattr(cls, name, LateReading(name))
