"""An environment is for one thread at a time."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial, wraps
from threading import RLock
from typing import Any, Concatenate, ParamSpec, Protocol, TypeVar

from fmugym.errors import SimulationError
from fmugym.pool import has_native_pool

__all__ = ["Guard", "alone", "make_guard"]

P = ParamSpec("P")
R = TypeVar("R")
S = TypeVar("S", bound=Any)


class Guard(Protocol):
    """Lets one thread at a time call the methods of an environment; these may call each other.

    Whether an exception of a signal handler comes at any moment, the thread gives the guard back.
    ``with guard:`` waits for another thread.
    """

    def run(self, name: str, function: Callable[..., R], /, *args: Any) -> R:
        """Call a function.

        Args:
            name: The method of the environment that does so.
            function: The function.
            args: Its arguments.

        Raises:
            SimulationError: If another thread is in a method of this environment.
        """

    def __enter__(self) -> None: ...

    def __exit__(self, *reason: object) -> None: ...


class _PythonGuard:
    """A ``Guard`` where there is no C extension; an interrupt while it is taken may keep it."""

    def __init__(self) -> None:
        self._lock = RLock()

    def run(self, name: str, function: Callable[..., R], /, *args: Any) -> R:
        if not self._lock.acquire(blocking=False):
            raise SimulationError(
                f"{name} is not possible while another thread is in a method of this environment, "
                "which is for one thread at a time"
            )
        try:
            return function(*args)
        finally:
            self._lock.release()

    def __enter__(self) -> None:
        self._lock.acquire()

    def __exit__(self, *reason: object) -> None:
        self._lock.release()


def make_guard() -> Guard:
    """Make the guard of an environment."""
    if not has_native_pool():
        return _PythonGuard()
    from fmugym import _native

    return _native.Guard()


def alone(method: Callable[Concatenate[S, P], R]) -> Callable[Concatenate[S, P], R]:
    """Refuse a call of a method of an environment in whose methods another thread is."""
    name: str = method.__name__

    @wraps(method)
    def guarded(self: S, /, *args: P.args, **kwargs: P.kwargs) -> R:
        guard: Guard = self.inside.guard
        return guard.run(name, partial(method, self, *args, **kwargs))

    return guarded
