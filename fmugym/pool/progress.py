"""Progress messages about calls of an FMU that may take minutes."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Final

__all__ = ["progress"]

_EVERY: Final = 10.0
"""Seconds between two messages."""


@contextmanager
def progress(log: logging.Logger, call: str) -> Iterator[None]:
    """Log the duration of a call in this context every ten seconds, at INFO.

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
