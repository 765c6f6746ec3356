"""What is told of calls of an FMU that may take minutes."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Final

__all__ = ["INITIALIZATION", "STEP", "announce", "hears_calls", "listen", "progress"]

INITIALIZATION: Final = "initialization"
STEP: Final = "a step"

_EVERY: Final = 10.0
"""Seconds between two messages."""

_listeners: list[Callable[[str], None]] = []


def listen(listener: Callable[[str], None]) -> None:
    """Let a function hear of every call of this process that may take long, before it begins."""
    _listeners.append(listener)


def hears_calls() -> bool:
    """Whether anyone listens to ``announce``."""
    return bool(_listeners)


def announce(call: str) -> None:
    """Tell the listeners which call begins."""
    for listener in _listeners:
        listener(call)


@contextmanager
def progress(log: logging.Logger, call: str) -> Iterator[None]:
    """Log every ten seconds, at INFO, how long a call in this context has taken.

    Args:
        log: The logger.
        call: What takes so long: the FMU and the call.
    """
    if not log.isEnabledFor(logging.INFO):
        yield
        return
    over = threading.Event()
    thread = threading.Thread(target=_tell, args=[log, call, over], daemon=True)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()


def _tell(log: logging.Logger, call: str, over: threading.Event) -> None:
    start = time.monotonic()
    while not over.wait(_EVERY):
        log.info("%s has taken %.0f s so far", call, time.monotonic() - start)
