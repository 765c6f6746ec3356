"""Exceptions that come from signal handlers, which nobody may take for those of a user's hooks."""

from __future__ import annotations

import signal
from types import CodeType
from typing import Any

__all__ = ["is_of_signal_handler", "let_through"]


def is_of_signal_handler(error: BaseException | None) -> bool:
    """Whether a signal handler has raised an exception, or one that it was made of."""
    codes = {_code_of(signal.getsignal(number)) for number in signal.valid_signals()} - {None}
    while error is not None:
        place = error.__traceback__
        while place is not None:
            if place.tb_frame.f_code in codes:
                return True
            place = place.tb_next
        error = error.__cause__ or error.__context__
    return False


def let_through(error: BaseException) -> None:
    """Raise an exception again if a signal handler has raised it."""
    if is_of_signal_handler(error):
        raise error


def _code_of(handler: Any) -> CodeType | None:
    """The code of a function, a method or an object that can be called."""
    function = getattr(handler, "__func__", handler)
    if not hasattr(function, "__code__"):
        function = vars(type(handler)).get("__call__")
    code = getattr(function, "__code__", None)
    return code if isinstance(code, CodeType) else None
