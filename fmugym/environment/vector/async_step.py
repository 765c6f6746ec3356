"""Steps of a vector environment in the background, while the caller computes."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor, wait
from typing import Any

from gymnasium.error import AlreadyPendingCallError, NoAsyncCallError

from fmugym.errors import SimulationError

__all__ = ["Background", "NoStepError", "PendingStepError", "StepTimeoutError"]


class PendingStepError(SimulationError, AlreadyPendingCallError):
    """A method was called between ``step_async`` and ``step_wait``.

    Callers of Gymnasium's ``AsyncVectorEnv`` expect an ``AlreadyPendingCallError``.
    """

    def __init__(self, text: str) -> None:
        AlreadyPendingCallError.__init__(self, text, "step")


class NoStepError(SimulationError, NoAsyncCallError):
    """``step_wait`` was called without ``step_async``.

    Callers of Gymnasium's ``AsyncVectorEnv`` expect a ``NoAsyncCallError``.
    """

    def __init__(self, text: str) -> None:
        NoAsyncCallError.__init__(self, text, "step")


class StepTimeoutError(SimulationError, TimeoutError):
    """A step has not ended in time. It goes on, and ``step_wait`` may be called again."""


class Background:
    """Makes one call at a time in a thread of its own.

    The thread starts with the first call and ends with this object. At the end of the process,
    Python waits for a call that is under way. A fork does not have the thread; there, no call is
    under way, and the next one starts another thread.

    Attributes:
        is_pending: Whether a call has begun and its result has not been fetched.
    """

    def __init__(self) -> None:
        self.is_pending = False
        self._future: Future[Any] | None = None
        self._threads: ThreadPoolExecutor | None = None
        self._process = 0

    def begin(self, function: Callable[..., Any], *arguments: Any) -> None:
        """Begin a call.

        The new thread gets the interpreter first. So the pool is at work before this returns.
        """
        began = threading.Lock()
        began.acquire()
        self.is_pending = True
        self._future = self._executor().submit(_call, began, function, arguments)
        began.acquire()

    def _executor(self) -> ThreadPoolExecutor:
        if self._threads is None or self._process != os.getpid():
            self._threads = ThreadPoolExecutor(1, "fmugym-step")
            self._process = os.getpid()
        return self._threads

    def finish(self, timeout: float | None) -> Any:
        """Wait for the end of the call.

        Returns:
            What the call returned.

        Raises:
            NoStepError: If no call is under way.
            StepTimeoutError: If it does not end in time.
            BaseException: What the call raised.
        """
        if self._process != os.getpid():  # the step was that of the parent process
            self._future, self.is_pending = None, False
        future = self._future
        if future is None:
            raise NoStepError("step_wait was called without step_async")
        if not wait([future], timeout).done:
            raise StepTimeoutError(f"the step has not ended after {timeout} s")
        self._future, self.is_pending = None, False
        return future.result()

    def stop(self) -> None:
        """Wait for a call that is under way, forget its result, and end the thread."""
        if self._process == os.getpid() and self._threads is not None:
            self._threads.shutdown()
        self._threads = self._future = None
        self.is_pending = False


def _call(began: threading.Lock, function: Callable[..., Any], arguments: tuple[Any, ...]) -> Any:
    began.release()
    return function(*arguments)
