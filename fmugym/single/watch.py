"""The attributes that programs depend on: which ones hooks read, and whether they have changed."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from copy import deepcopy
from types import MethodType
from typing import Any, NamedTuple

import numpy as np

from fmugym.env import FMUEnv
from fmugym.single.purity import is_ours, is_plain
from fmugym.task.readings import READINGS
from fmugym.vector.hooks.program import UntraceableError

__all__ = ["Watched", "noting_reads", "watched_in"]


class Watched(NamedTuple):
    """An attribute that hooks read.

    Attributes:
        name: Its name.
        value: The object that it was.
        copy: The bytes of an array, or a copy of a list or dict; None for what cannot change.
    """

    name: str
    value: Any
    copy: Any

    @property
    def is_method(self) -> bool:
        """Whether it is a method; the pool must not hold it, since it leads to the environment."""
        return isinstance(self.value, MethodType)

    def is_in(self, attributes: Mapping[str, Any]) -> bool:
        """Whether the attribute is still the same object, with the same contents."""
        if attributes.get(self.name, self) is not self.value:
            return False
        if isinstance(self.value, np.ndarray):
            return bool(self.value.tobytes() == self.copy)
        return self.copy is None or bool(self.value == self.copy)


@contextmanager
def noting_reads(env: FMUEnv) -> Iterator[set[str]]:
    """Note the names of all attributes of an environment that are read.

    Meanwhile the environment is an instance of a class derived from its own.
    """
    names: set[str] = set()
    cls: Any = type(env)

    def get(self: Any, name: str) -> Any:
        names.add(name)
        return cls.__getattribute__(self, name)

    plain: Any = FMUEnv.__init_subclass__
    if cls.__init_subclass__.__func__ is not plain.__func__:
        raise UntraceableError("the class has an __init_subclass__ of its own")
    env.__class__ = type(cls)(cls.__name__, (cls,), {"__slots__": (), "__getattribute__": get})
    try:
        yield names
    finally:
        env.__class__ = cls


def watched_in(attributes: Mapping[str, Any], names: set[str]) -> tuple[Watched, ...]:
    """Find out how changes of attributes can be noticed.

    Args:
        attributes: Those of the environment.
        names: The ones that hooks read, and others that are not in it.

    Raises:
        UntraceableError: If changes of one could not be noticed.
    """
    read = sorted(names & attributes.keys() - set(READINGS))
    return tuple(_watched(name, attributes[name]) for name in read if not is_ours(attributes[name]))


def _watched(name: str, value: Any) -> Watched:
    if type(value) is np.ndarray and value.dtype.kind in "biufc" and value.flags.c_contiguous:
        return Watched(name, value, value.tobytes())
    if isinstance(value, MethodType) and isinstance(value.__self__, FMUEnv):
        return Watched(name, value, None)
    if not is_plain(value):
        raise UntraceableError(
            f"it reads self.{name}, and changes inside of a {type(value).__name__} are not noticed"
        )
    return Watched(name, value, deepcopy(value) if _can_change(value) else None)


def _can_change(value: Any) -> bool:
    return type(value) in (list, dict) or (type(value) is tuple and any(map(_can_change, value)))
