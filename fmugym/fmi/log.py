"""Messages of FMUs, on their way to Python's ``logging``.

In FMI 1.0 and 2.0 the FMU gets a C function with a variable number of arguments, which ctypes
cannot make. FMPy has a native proxy that formats the text. The proxy knows one target per process,
and a call after that target is gone ends the process. So this module has one set of callbacks that
lives as long as the process. They find the receiver by the unique name of the instance. In FMI 3.0,
they find it by its environment pointer.
"""

from __future__ import annotations

import ctypes
import itertools
import logging
import sys
import threading
from collections import deque
from collections.abc import Callable
from types import FunctionType, TracebackType
from typing import Any, Final, ParamSpec, cast

import fmpy
from fmpy.fmi1 import fmi1CallbackFunctions
from fmpy.fmi2 import fmi2CallbackFunctions
from fmpy.fmi3 import fmi3LogMessageCallback
from fmpy.logging import addLoggerProxy

from fmugym.errors import printable
from fmugym.fmi.status import Status
from fmugym.fmi.words import Message, quoted

__all__ = [
    "Hearing",
    "MessageLog",
    "catching",
    "fmi1_callbacks",
    "fmi2_callbacks",
    "fmi3_log_message",
    "fmu_calls",
]

P = ParamSpec("P")

logger = logging.getLogger(__name__)

_LEVELS = (logging.INFO, logging.WARNING, logging.WARNING, logging.ERROR, logging.CRITICAL)
_receivers: dict[int, MessageLog] = {}
_ids = itertools.count(1)
_calling: list[int] = []
"""The threads that are inside ``fmu_calls``."""

_caught: deque[tuple[int, BaseException]] = deque()
"""What callbacks have raised, with the thread."""


_IDLE_LIMIT: Final = 1000
"""Messages that nobody wants, until the FMU is asked to log less."""

_MOST_HEARD: Final = 4
"""How many instances of a library may log all; it may take long to make them, and fail often."""


class Hearing:
    """What the instances of a library are asked to log if the log has no room for everything.

    Attributes:
        deaf: Whether they are not asked for errors: one has refused, or has logged too much.
    """

    def __init__(self) -> None:
        self.deaf = False
        self._heard = 0

    def may_hear_all(self) -> bool:
        """Whether one more instance may log everything."""
        self._heard += 1
        return self._heard <= _MOST_HEARD


class MessageLog:
    """The receiver of one instance's messages.

    Args:
        model: The model's name, the first part of the instance name.
        target: The logger for the messages.

    Attributes:
        environment: A number that is unique in the process.
        instance_name: A name that is unique in the process.
        recent: The last messages, for errors.
        idle: How many messages nobody wanted: those with the status OK, if only errors were asked
            for.
        muted: Whether messages are dropped.
    """

    muted = False

    def __init__(self, model: str, target: logging.Logger) -> None:
        self.environment = next(_ids)
        self.instance_name = f"{model}_{self.environment}"
        self.recent: deque[Message] = deque(maxlen=10)
        self.idle = 0
        self._target = target
        _receivers[self.environment] = self

    @property
    def wants_debug(self) -> bool:
        """Whether the FMU is asked to log more than errors."""
        return self._target.isEnabledFor(logging.INFO)

    def receive(self, status: int, category: str, message: str) -> None:
        """Pass a message on, at the level of its status."""
        if self.muted:
            return
        self.recent.append((status, message))
        if status == Status.OK and not self.wants_debug:
            self.idle += 1
            return
        level = _LEVELS[status] if 0 <= status < len(_LEVELS) else logging.INFO
        self._target.log(level, "%s: [%s] %s", self.instance_name, category, message)

    @property
    def is_too_long(self) -> bool:
        """Whether the FMU has logged too much that nobody wants."""
        return self.idle > _IDLE_LIMIT

    def said(self) -> str:
        """The recent messages, to end an error's text."""
        return quoted(tuple(self.recent))

    def close(self) -> None:
        """Stop receiving; later messages go to this module's logger."""
        _receivers.pop(self.environment, None)


class _Calls:
    """Surrounds calls of FMUs, and raises afterwards what receivers of messages have raised.

    No exception can pass through an FMU, so the callbacks catch all. Often it is that of a signal
    handler, such as Ctrl-C. Python may run the handler even before the first line of a callback.
    ctypes then gives the exception to ``sys.unraisablehook``, which usually prints and drops it.
    So this class replaces that hook in the main thread, the only one with signal handlers.
    """

    def __init__(self) -> None:
        self._hook = sys.unraisablehook

    def __enter__(self) -> None:
        _calling.append(threading.get_ident())
        if _is_main() and sys.unraisablehook is not _keep_lost:
            self._hook = sys.unraisablehook
            sys.unraisablehook = _keep_lost

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        if _is_main() and sys.unraisablehook is _keep_lost:
            sys.unraisablehook = self._hook
        _calling.remove(threading.get_ident())
        if _caught:
            _raise_caught()

    def pass_on(self, unraisable: sys.UnraisableHookArgs) -> None:
        """Call the hook that was there before."""
        self._hook(unraisable)


fmu_calls: Final = _Calls()


def _is_main() -> bool:
    return threading.get_ident() == threading.main_thread().ident


def _raise_caught() -> None:
    """Raise the first exception of this thread, or of one that an FMU has started."""
    this = threading.get_ident()
    mine = [pair for pair in tuple(_caught) if pair[0] == this or pair[0] not in _calling]
    for pair in mine:
        _caught.remove(pair)
    if mine:
        raise mine[0][1]


def _keep_lost(unraisable: sys.UnraisableHookArgs, /) -> None:
    """Keep what came out of a callback; anything else is for the hook that was there before."""
    traceback, error = unraisable.exc_traceback, unraisable.exc_value
    is_ours = traceback is not None and traceback.tb_frame.f_code is _CALLBACK_CODE
    if is_ours and error is not None:
        _caught.append((threading.get_ident(), error))
    else:
        fmu_calls.pass_on(unraisable)


def catching(function: Callable[P, None]) -> Callable[P, None]:
    """Make a callback of a function: it keeps what the function raises for ``fmu_calls``."""

    def called(*args: P.args, **kwargs: P.kwargs) -> None:
        try:
            function(*args, **kwargs)
        except BaseException as error:
            _caught.append((threading.get_ident(), error))

    return called


_CALLBACK_CODE: Final = cast(FunctionType, catching(print)).__code__
"""That of every callback; its frame is the first where an exception comes before its lines."""


def _deliver(environment: int | None, status: int, category: bytes, message: bytes) -> None:
    category_text = printable((category or b"").decode(errors="replace"))
    text = printable((message or b"").decode(errors="replace").rstrip())
    receiver = _receivers.get(environment or 0)
    if receiver is not None:
        receiver.receive(status, category_text, text)
    else:
        logger.info("[%s] %s", category_text, text)


def _by_name(_: Any, name: bytes, status: int, category: bytes, message: bytes) -> None:
    suffix = (name or b"").decode(errors="replace").rpartition("_")[2]
    _deliver(int(suffix) if suffix.isdecimal() else None, status, category, message)


def _make_callbacks(structure: Any) -> Any:
    """Fill a callback structure. The members used here are the same in FMI 1.0 and 2.0."""
    types = dict(structure._fields_)
    callbacks = structure()
    callbacks.logger = types["logger"](catching(_by_name))
    callbacks.allocateMemory = ctypes.cast(fmpy.calloc, types["allocateMemory"])
    callbacks.freeMemory = ctypes.cast(fmpy.free, types["freeMemory"])
    addLoggerProxy(ctypes.byref(callbacks))
    return callbacks


fmi1_callbacks = _make_callbacks(fmi1CallbackFunctions)
fmi2_callbacks = _make_callbacks(fmi2CallbackFunctions)
fmi3_log_message = fmi3LogMessageCallback(catching(_deliver))
