"""A coroutine in a thread of its own."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Awaitable, Callable
from contextlib import suppress
from typing import Final

from fmugym.signals import ordinary

__all__ = ["Background"]

_JOIN_SECONDS: Final = 0.1
"""How long to wait for the effect of a cancellation, in seconds."""


class Background:
    """Runs a coroutine in a thread until it ends, or is stopped.

    Args:
        make: Makes the coroutine.
        name: Of the thread.

    Attributes:
        error: What the coroutine has raised, or None.
    """

    def __init__(self, make: Callable[[], Awaitable[None]], name: str) -> None:
        self.error: Exception | None = None
        self._make, self._is_ready = make, threading.Event()
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()
        self._is_ready.wait()

    @property
    def is_over(self) -> bool:
        """Whether the coroutine has ended."""
        return not self._thread.is_alive()

    def _run(self) -> None:
        with suppress(asyncio.CancelledError):
            asyncio.run(self._main())

    async def _main(self) -> None:
        self._loop, self._task = asyncio.get_running_loop(), asyncio.current_task()
        self._is_ready.set()
        try:
            await self._make()
        except ordinary(Exception) as error:
            self.error = error

    def _cancel(self) -> None:
        if self._task is not None:
            self._task.cancel()

    def join(self, seconds: float) -> None:
        """Wait for its end, for some time."""
        self._thread.join(seconds)

    def stop(self) -> None:
        """Cancel the coroutine, and wait for its end.

        Libraries lose cancellations: ``asyncio.wait_for`` does so until Python 3.12.
        """
        while not self.is_over:
            with suppress(RuntimeError):  # the loop is closed
                self._loop.call_soon_threadsafe(self._cancel)
            self._thread.join(_JOIN_SECONDS)
