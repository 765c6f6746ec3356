"""Threads that call functions on request, and do something else while there is no request."""

from __future__ import annotations

import contextlib
import queue
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from typing import Any, Final, NamedTuple

from fmugym.pool.rig.clocks import Clock, speed_of

__all__ = ["Here", "Idle", "Worker", "ask_all"]

_LEAST_WAIT: Final = 0.1
"""The least time between two looks at the clock, as a share of ``hold_after``."""


_Order = tuple["Future[Any]", Callable[..., Any], Any]
"""The future of the result, the function, and its argument."""

_Orders = queue.SimpleQueue[_Order | None]


class Idle(NamedTuple):
    """Work while there is no request.

    Attributes:
        action: Called whenever ``hold_after`` has passed without a request; it must not raise.
        hold_after: In s of the clock's time.
    """

    action: Callable[[], None]
    hold_after: float


class Here:
    """Calls functions in the caller's thread."""

    def ask(self, function: Callable[..., Any], argument: Any) -> Future[Any]:
        """Call a function; the future is done when this method returns."""
        future: Future[Any] = Future()
        future.set_result(function(argument))
        return future

    def end(self, timeout: float) -> None:
        """Do nothing: there is no thread."""


class Worker:
    """Calls functions in a thread of its own, one after another.

    The thread does not keep the interpreter from ending.

    Args:
        name: The name of the thread.
        clock: The clock that the functions use, or None.
        idle: What to do while there is no request, or None.

    Attributes:
        thread: The thread.
    """

    def __init__(self, name: str, clock: Clock | None = None, idle: Idle | None = None) -> None:
        self._orders: _Orders = queue.SimpleQueue()
        arguments = (self._orders, clock, idle)
        self.thread = threading.Thread(target=_work, args=arguments, name=name, daemon=True)
        self.thread.start()

    def ask(self, function: Callable[..., Any], argument: Any) -> Future[Any]:
        """Let the thread call a function after all earlier ones.

        If the thread itself asks, as a finalizer in it may, the function is called at once.
        """
        if threading.current_thread() is self.thread:
            return Here().ask(function, argument)
        future: Future[Any] = Future()
        self._orders.put((future, function, argument))
        return future

    def end(self, timeout: float) -> None:
        """Let the thread end after all earlier requests; wait at most ``timeout`` s for it."""
        self._orders.put(None)
        if threading.current_thread() is not self.thread:
            self.thread.join(timeout)


def _work(orders: _Orders, clock: Clock | None, idle: Idle | None) -> None:
    me, leave = threading.current_thread(), getattr(clock, "leave", _nobody_waits)
    while (order := _next(orders, clock, idle)) is not None:
        future, function, argument = order
        try:
            result = function(argument)
        except BaseException as error:
            leave(me)
            future.set_exception(error)
        else:
            leave(me)
            future.set_result(result)
        del order, future, function, argument  # so that the wait keeps none of them alive


def _nobody_waits(thread: threading.Thread) -> None:
    """Stands in for ``ManualClock.leave`` of other clocks."""


def _next(orders: _Orders, clock: Clock | None, idle: Idle | None) -> _Order | None:
    if idle is None or clock is None:
        return orders.get()
    speed = speed_of(clock)
    since, rest = clock.time(), idle.hold_after
    while True:
        try:
            return orders.get(timeout=max(rest, _LEAST_WAIT * idle.hold_after) / speed)
        except queue.Empty:
            now = clock.time()
        rest = since + idle.hold_after - now
        if rest <= 0.0:
            since, rest = now, idle.hold_after
            idle.action()


def ask_all(
    calls: Sequence[tuple[Here | Worker, Callable[..., Any], Any]],
    clock: Clock | None,
    timeout: float | None = None,
) -> list[Any]:
    """Let several workers call functions at the same time, and wait for all of them.

    Meanwhile, a clock that is moved by hand waits for their threads instead of the caller's.

    Args:
        calls: For each worker: the worker, the function, and its argument.
        clock: The clock that the functions use, or None.
        timeout: How long to wait for one of them, in s of real time; None for ever.

    Returns:
        The results of the functions, in the order of ``calls``.

    Raises:
        TimeoutError: If a function takes longer.
    """
    threads = [worker.thread for worker, *_ in calls if isinstance(worker, Worker)]
    handed_over = getattr(clock, "handed_over", None) if threads else None
    with contextlib.nullcontext() if handed_over is None else handed_over(threads):
        futures = [worker.ask(function, argument) for worker, function, argument in calls]
        return [future.result(timeout) for future in futures]
