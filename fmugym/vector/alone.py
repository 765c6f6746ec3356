"""A vector environment is for one thread at a time."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial, wraps
from threading import RLock
from typing import Any, Concatenate, ParamSpec, TypeVar

from fmugym.errors import SimulationError

__all__ = ["Turn", "alone", "in_use"]

P = ParamSpec("P")
R = TypeVar("R")
S = TypeVar("S", bound=Any)


class Turn:
    """Belongs to the thread that is in a method; the same thread may enter another one.

    Attributes:
        begin: Takes the turn and returns True, or False if another thread has it.
        wait: Takes the turn, after waiting for another thread.
        end: Gives it back.
    """

    def __init__(self) -> None:
        lock = RLock()
        self.begin: Callable[[], bool] = partial(lock.acquire, False)
        self.wait, self.end = lock.acquire, lock.release


def in_use(env: Any, method: str) -> SimulationError:
    """The error of a method that another thread has called at the wrong time."""
    return SimulationError(
        f"{method} was called while another thread is in a method of this {type(env).__name__}; an "
        "environment is for one thread at a time"
    )


def alone(method: Callable[Concatenate[S, P], R]) -> Callable[Concatenate[S, P], R]:
    """Refuse a call of a method of a vector environment that another thread uses."""

    @wraps(method)
    def guarded(self: S, /, *args: P.args, **kwargs: P.kwargs) -> R:
        turn = self._turn
        if not turn.begin():
            raise in_use(self, method.__name__)
        try:
            return method(self, *args, **kwargs)
        finally:
            turn.end()

    return guarded
