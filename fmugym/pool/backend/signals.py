"""Signals that arrive while FMPy calls an FMU whose code is Python.

Python runs the handlers of signals between any two of its instructions on the main thread, also
between those of such an FMU. What a handler raises there, as for Ctrl-C, goes to the FMU, and is
lost.
"""

from __future__ import annotations

import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

__all__ = ["signals_held"]


@contextmanager
def signals_held() -> Iterator[None]:
    """Run the handlers of signals that arrive in a ``with`` block after it."""
    if threading.current_thread() is not threading.main_thread():
        yield  # other threads run no handlers
        return
    noted: list[signal.Signals] = []
    handlers: dict[signal.Signals, Callable[[int, Any], Any]] = {}
    try:
        for number in signal.valid_signals():
            handler = signal.getsignal(number)
            if callable(handler):
                handlers[number] = handler
                signal.signal(number, lambda number, _: noted.append(signal.Signals(number)))
        yield
    finally:
        _give_back(handlers)
        for number in noted:
            handlers[number](number, sys._getframe())


def _give_back(handlers: dict[signal.Signals, Callable[[int, Any], Any]]) -> None:
    """Set all handlers again, although one that is back already may raise meanwhile."""
    left = dict(handlers)
    try:
        for number, handler in handlers.items():
            signal.signal(number, handler)
            del left[number]
    finally:
        if left:
            _give_back(left)
