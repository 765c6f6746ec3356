"""Exceptions of signal handlers, told apart from those of a user's objects."""

from __future__ import annotations

import inspect
import sys
from collections.abc import Iterator
from itertools import pairwise
from traceback import walk_stack, walk_tb
from types import FrameType
from typing import TypeVar

__all__ = ["Ignoring", "ordinary"]

E = TypeVar("E", bound=Exception)


def ordinary(*kinds: type[E]) -> tuple[type[E], ...]:
    """What an ``except`` clause may catch: nothing if a signal handler has raised the exception.

    ::

        try:
            array = np.asarray(value)
        except ordinary(Exception) as error:  # the user's own __array__ may raise anything
            raise ConfigError(...) from None

    Args:
        kinds: What to catch otherwise.

    Returns:
        The kinds; nothing if a handler has raised the present exception, or one that it was made
        of.
    """
    error = sys.exception()
    return () if error is not None and _is_of_handler(error) else kinds


class Ignoring:
    """As ``contextlib.suppress``, but lets through what a signal handler has raised.

    Args:
        kinds: What to ignore otherwise.
    """

    def __init__(self, *kinds: type[Exception]) -> None:
        self._kinds = kinds

    def __enter__(self) -> None:
        pass

    def __exit__(self, kind: object, error: BaseException | None, place: object) -> bool:
        return isinstance(error, self._kinds) and not _is_of_handler(error)


def _is_of_handler(error: BaseException) -> bool:
    left = [frame for origin in _origins(error) for frame, _ in walk_tb(origin.__traceback__)]
    return any(map(_is_handler, left))


def _origins(error: BaseException) -> Iterator[BaseException]:
    """An exception and those that it was made of, without those that callers are handling.

    Nor is it made of one that asks for an end, as Ctrl-C does: clean-ups have failed meanwhile.
    """
    stack = error.__traceback__ and walk_stack(error.__traceback__.tb_frame)
    callers = [frame for frame, _ in stack or ()][1:]
    origin: BaseException | None = error
    while isinstance(origin, Exception) and not (
        origin.__traceback__ and origin.__traceback__.tb_frame in callers
    ):
        yield origin
        origin = origin.__cause__ or origin.__context__


def _is_handler(frame: FrameType) -> bool:
    """Python calls a handler with the number of the signal and the frame that it interrupts.

    The types are asked for, as ``isinstance`` would call properties of a user's objects.
    """
    names, rest, _, values = inspect.getargvalues(frame)
    given = [values.get(name) for name in names] + list(values.get(rest, ()) if rest else ())
    return any(
        issubclass(type(number), int) and type(place) is FrameType and place is frame.f_back
        for number, place in pairwise(given)
    )
