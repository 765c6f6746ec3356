"""Signals that end the command line as Ctrl-C does.

By default SIGTERM (of ``kill``, ``timeout`` and batch systems) and SIGHUP (of a terminal that
closes) end a process at once, and its temporary folders remain. Ctrl-C waits for the FMU.
"""

from __future__ import annotations

import os
import signal
import socket
import sys
import threading
from types import FrameType
from typing import Final

__all__ = ["SignalledEnd", "end_as_after_ctrl_c", "exit_code"]

_NAMES: Final = ("SIGTERM", "SIGHUP")

_TIMEOUT: Final = 5.0
"""Seconds until the process is ended by force: its FMU may hang, and Python waits for the call."""

_begun: Final = threading.Event()
"""Set when Python has begun to end the program."""

_readers: Final[list[socket.socket]] = []
"""Stay open as long as the process: Python writes the numbers of signals to their other ends."""


class SignalledEnd(KeyboardInterrupt):
    """A signal asks the program to end.

    Attributes:
        number: Number of the signal.
    """

    def __init__(self, number: int) -> None:
        super().__init__(signal.Signals(number).name)
        self.number = number


def end_as_after_ctrl_c() -> None:
    """Let SIGTERM and SIGHUP raise ``SignalledEnd``, unless they are ignored or handled.

    To be called in the main thread. If Python has not begun to end ``_TIMEOUT`` after a signal, the
    process is killed. While an FMU of Python works, handlers wait; see
    ``fmugym.pool.held_signals``.
    """
    numbers = {
        number
        for number in (getattr(signal, name, None) for name in _NAMES)
        if number is not None and signal.getsignal(number) == signal.SIG_DFL
    }
    for number in numbers:
        signal.signal(number, _raise)
    if numbers:
        _watch(numbers)


def exit_code(error: KeyboardInterrupt) -> int:
    """The exit code that shells give to a process that a signal has ended: 130 after Ctrl-C."""
    return 128 + getattr(error, "number", signal.SIGINT)


def _raise(number: int, frame: FrameType | None) -> None:
    _begun.set()
    raise SignalledEnd(number)


def _watch(numbers: set[int]) -> None:
    """Watch for signals in a thread, which runs also while the main thread is in an FMU."""
    reader, writer = socket.socketpair()
    _readers.append(reader)
    writer.setblocking(False)
    signal.set_wakeup_fd(writer.detach(), warn_on_full_buffer=False)
    threading.Thread(target=_end_by_force, args=(reader, numbers), daemon=True).start()


def _end_by_force(reader: socket.socket, numbers: set[int]) -> None:
    """Wait for a signal, and end the process if Python does not begin to end it."""
    number = 0
    while number not in numbers:
        (number,) = reader.recv(1)
    if _begun.wait(_TIMEOUT):
        return
    if "fmugym.fmi.temporary" in sys.modules:
        sys.modules["fmugym.fmi.temporary"].remove_rest()
    os._exit(128 + number)
