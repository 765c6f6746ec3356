"""Signals held back while an FMU works whose code is Python.

Python runs the handlers of signals between any two of its instructions on the main thread, also
between those of such an FMU. What a handler raises there, as for Ctrl-C, goes to the FMU, and is
lost: the FMU tells that it has failed.
"""

from __future__ import annotations

import _signal  # type: ignore[import-not-found]  # typeshed leaves it out
import functools
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, Final, ParamSpec, TypeVar

__all__ = ["signals_held", "undisturbed"]

_SIGNALS: Final = tuple(map(int, signal.valid_signals()))

_handler_of: Final[Callable[[int], Any]] = _signal.getsignal
"""As ``signal.getsignal``, which makes an enumeration of each and takes 20 times as long."""

P = ParamSpec("P")
R = TypeVar("R")


@contextmanager
def signals_held() -> Iterator[None]:
    """Run the handlers of signals that arrive in a ``with`` block after it."""
    if threading.current_thread() is not threading.main_thread():
        yield  # other threads run no handlers
        return
    noted: list[int] = []
    handlers: dict[int, Callable[[int, Any], Any]] = {}
    try:
        for number in _SIGNALS:
            handler = _handler_of(number)
            if callable(handler):
                handlers[number] = handler
                signal.signal(number, lambda number, _: noted.append(number))
        yield
    finally:
        _give_back(handlers)
        for number in noted:
            handlers[number](number, sys._getframe())


def _give_back(handlers: dict[int, Callable[[int, Any], Any]]) -> None:
    """Set all handlers again, although one that is back already may raise meanwhile."""
    left = dict(handlers)
    try:
        for number, handler in handlers.items():
            signal.signal(number, handler)
            del left[number]
    finally:
        if left:
            _give_back(left)


def undisturbed(function: Callable[P, R]) -> Callable[P, R]:
    """Hold signals during the calls of a function."""

    @functools.wraps(function)
    def call(*arguments: P.args, **named: P.kwargs) -> R:
        with signals_held():
            return function(*arguments, **named)

    return call
