"""Messages of FMUs that FMPy calls, on their way to Python's ``logging``.

The logger of FMI 1.0 and 2.0 has a variable number of arguments, which ctypes cannot make. FMPy has
a native proxy that formats the text, but it knows one receiver per process. So there is one for all
instances, which lives as long as the process and knows them by their names.
"""

from __future__ import annotations

import ctypes
import itertools
import logging
from collections import deque
from typing import Any, Final
from weakref import WeakValueDictionary

import fmpy
from fmpy.fmi1 import fmi1CallbackFunctions
from fmpy.fmi2 import fmi2CallbackFunctions
from fmpy.logging import addLoggerProxy

from fmugym.fmi.words import Message, quoted
from fmugym.pool.reports import as_log_record

__all__ = ["Messages", "fmi1_callbacks", "fmi2_callbacks"]

_ids = itertools.count(1)
_by_name: WeakValueDictionary[bytes, Messages] = WeakValueDictionary()


class Messages:
    """The messages of one instance.

    A message is only noted while the FMU runs: no exception could pass through it.

    Args:
        model: The model's name, the first part of the instance name.
        log: Gets the messages.

    Attributes:
        name: An instance name that is unique in the process.
    """

    def __init__(self, model: str, log: logging.Logger) -> None:
        self.name = f"{model}_{next(_ids)}"
        self._log = log
        self._noted: deque[tuple[int, bytes, bytes]] = deque()
        self._recent: deque[Message] = deque(maxlen=10)
        _by_name[self.name.encode()] = self

    @property
    def wants_all(self) -> bool:
        """Whether the FMU is asked to log more than errors."""
        return self._log.isEnabledFor(logging.INFO)

    def note(self, _: Any, status: int, category: bytes, text: bytes) -> None:
        """Take a message; the callback of FMI 3.0."""
        self._noted.append((status, category or b"", text or b""))

    def pass_on(self) -> None:
        """Log the noted messages, each at the level of its status."""
        while self._noted:
            status, category, text = self._noted.popleft()
            line = _readable(text)
            self._recent.append((status, line))
            level, told = as_log_record(self.name, status, _readable(category), line)
            self._log.log(level, "%s", told)

    def forget(self) -> None:
        """Forget the messages of the episode before; they would not explain a failure."""
        self._recent.clear()

    def said(self) -> str:
        """The recent messages, to end an error's text."""
        self.pass_on()
        return quoted(tuple(self._recent))


def _readable(text: bytes) -> str:
    return text.decode(errors="replace").rstrip()


def _receive(instance: Any, name: bytes, status: int, category: bytes, text: bytes) -> None:
    messages = _by_name.get(name)
    if messages is not None:
        messages.note(instance, status, category, text)


def _callbacks(structure: Any) -> Any:
    """Fill a structure; the members used here are the same in FMI 1.0 and 2.0."""
    types = dict(structure._fields_)
    callbacks = structure()
    callbacks.logger = types["logger"](_receive)
    callbacks.allocateMemory = ctypes.cast(fmpy.calloc, types["allocateMemory"])
    callbacks.freeMemory = ctypes.cast(fmpy.free, types["freeMemory"])
    addLoggerProxy(ctypes.byref(callbacks))
    return callbacks


fmi1_callbacks: Final = _callbacks(fmi1CallbackFunctions)
fmi2_callbacks: Final = _callbacks(fmi2CallbackFunctions)
