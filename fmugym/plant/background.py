"""A coroutine in a thread of its own."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable, Coroutine
from contextlib import suppress
from typing import Any, Final

__all__ = ["BackgroundLoop"]

_JOIN_SECONDS: Final = 0.1
"""Time to wait for the effect of a cancellation, in seconds."""


class BackgroundLoop:
    """Runs a coroutine in a thread until it ends, or is stopped.

    Args:
        make: Makes the coroutine.
        name: Name of the thread.

    Attributes:
        error: Exception of the coroutine, or None.
    """

    def __init__(self, make: Callable[[], Coroutine[Any, Any, None]], name: str) -> None:
        self.error: BaseException | None = None
        self._loop = asyncio.new_event_loop()
        self._task = self._loop.create_task(make())
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        with asyncio.Runner(loop_factory=lambda: self._loop) as runner:
            runner.run(asyncio.wait([self._task]))
            self.error = None if self._task.cancelled() else self._task.exception()

    def join(self, seconds: float) -> bool:
        """Wait for its end, for some time; tells whether it has come."""
        self._thread.join(seconds)
        return not self._thread.is_alive()

    def stop(self) -> None:
        """Cancel the coroutine, and wait for its end.

        Libraries lose cancellations: ``asyncio.wait_for`` does so until Python 3.12.
        """
        while not self.join(0.0):
            with suppress(RuntimeError):  # the loop is closed
                self._loop.call_soon_threadsafe(self._task.cancel)
            self.join(_JOIN_SECONDS)
