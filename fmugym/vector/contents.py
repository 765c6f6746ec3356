"""The contents of the objects that an environment holds, to find and undo what hooks change."""

from __future__ import annotations

import math
import random
import sys
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import PurePath
from types import (
    BuiltinMethodType,
    CellType,
    FunctionType,
    MappingProxyType,
    MethodType,
    ModuleType,
    SimpleNamespace,
)
from typing import Any, Final, NamedTuple

import gymnasium
import numpy as np
from gymnasium import spaces

from fmugym.env import FMUEnv
from fmugym.vector.hooks.tables import functions_of, places_of

__all__ = ["OURS", "Changes", "Contents", "borrowed", "differs"]

_NOT_COMPARED: Final = "inside"
"""The attribute that the caller of hooks and the pool change."""

_LARGEST_OUTSIDE: Final = 2000
"""Global variables with more elements are taken for data, which no hook changes."""

OURS: Final = ("fmugym", "gymnasium", "logging")
"""Packages whose objects hooks only read."""


class _Kind(NamedTuple):
    """A kind of object that can change in place.

    Attributes:
        parts: The objects in the contents.
        copy: Copies the contents, but not the objects in them.
        restore: Writes such a copy back to the object.
    """

    parts: Callable[[Any], Iterable[Any]]
    copy: Callable[[Any], Any] = lambda value: value
    restore: Callable[[Any, Any], Any] = lambda value, contents: None


class _Kept(NamedTuple):
    attribute: str
    value: Any
    kind: _Kind
    contents: Any


class Changes(NamedTuple):
    """The names of what hooks have changed, one of each kind, or None.

    Attributes:
        inside: An attribute that was set, or whose value has changed in place.
        outside: A global variable that was set, or whose value has changed in place.
        added: A list or dict outside to which something was only added: a record or a cache, maybe.
    """

    inside: str | None
    outside: str | None
    added: str | None


class Contents:
    """The contents of all objects that the attributes of an environment lead to.

    Lists, dicts, arrays, random generators, instances of classes and variables of closures are
    followed to any depth. What extension types hold is not seen.

    Args:
        env: The environment.
        outside: Whether to keep the global variables to which its methods refer, too.
    """

    def __init__(self, env: FMUEnv, outside: bool = False) -> None:
        self._attributes = vars(env)
        self._before = dict(self._attributes)
        self._kept: list[_Kept] = []
        seen = {id(env)}
        for name, value in self._before.items():
            if name != _NOT_COMPARED:
                self._keep(name, value, seen)
        places = _places_outside(env) if outside else ()
        self._outside = [(place, name, place[name]) for place, name in places]
        self._first_outside = len(self._kept)
        for _, name, value in self._outside:
            largest = self._first_outside + _LARGEST_OUTSIDE
            self._keep(name or type(value).__name__, value, seen, largest)

    def _keep(self, attribute: str, value: Any, seen: set[int], largest: float = math.inf) -> None:
        waiting = [value]
        while waiting:
            value = waiting.pop()
            if id(value) in seen:
                continue
            seen.add(id(value))
            with suppress(Exception):  # users' objects may fail in any way
                kind = _kind_of(value)
                if kind is None or _size_of(value) + len(self._kept) > largest:
                    continue
                contents = kind.copy(value)
                self._kept.append(_Kept(attribute, value, kind, contents))
                waiting.extend(kind.parts(contents))

    def changes(self) -> Changes:
        """What has changed until now."""
        kept = list(filter(_has_changed, self._kept[self._first_outside :]))
        changed = [one.attribute for one in kept if not _was_added_to(one)]
        added = [one.attribute for one in kept if _was_added_to(one)]
        for place, name, value in self._outside:
            if differs(value, place[name]):
                changed.append(name or type(value).__name__)
        first, first_added = (next(iter(names), None) for names in (changed, added))
        return Changes(self._changed_inside(), first, first_added)

    def _changed_inside(self) -> str | None:
        before, now, in_place = self._before, self._attributes, self.changed_in_place()
        names = (name for name in (*now, *before) if name != _NOT_COMPARED)
        for name in names:
            if name in in_place or name not in before or name not in now:
                return name
            if differs(before[name], now[name]):
                return name
        return None

    def changed_in_place(self) -> set[str]:
        """The names of the attributes whose values have changed in place."""
        kept = self._kept[: self._first_outside]
        return {one.attribute for one in kept if _has_changed(one)}

    def restore(self) -> None:
        """Undo all changes."""
        for one in filter(_has_changed, self._kept):
            with suppress(Exception):  # as above
                one.kind.restore(one.value, one.contents)
        for place, name, value in self._outside:
            if place[name] is not value:
                place[name] = value
        _restore_dict(self._attributes, self._before)


def _places_outside(env: FMUEnv) -> Iterator[tuple[dict[str, Any], str]]:
    """Where the methods of a class find values outside of it: globals, and in closures.

    Instances of classes of other packages are left out: they may lead anywhere.
    """
    seen: set[tuple[int, str]] = set()
    for cls in type(env).__mro__:
        yield {cls.__name__: cls}, cls.__name__
    for function in functions_of(env):
        yield {function.__name__: function}, function.__name__
        own = (function.__module__ or "").partition(".")[0]
        for place, name in places_of(function):
            known = id(place), name
            if known not in seen and _is_followed(place[name], own):
                seen.add(known)
                yield place, name


def _is_followed(value: Any, own: str) -> bool:
    if isinstance(value, (ModuleType, gymnasium.Env)):
        return False
    is_known = isinstance(value, (*_KINDS, type, bool, int, float, np.generic))
    return is_known or type(value).__module__.partition(".")[0] == own


def _size_of(value: Any) -> int:
    if isinstance(value, np.ndarray):
        return value.size
    return len(value) if isinstance(value, (list, dict, set, tuple, deque)) else 1


def _was_added_to(kept: _Kept) -> bool:
    """Whether a container has all that it had, and more."""
    value, before = kept.value, kept.contents
    if isinstance(value, dict):
        return all(name in value and not differs(before[name], value[name]) for name in before)
    if isinstance(value, (list, deque)):
        return not differs(before, list(value)[: len(before)])
    return False


@contextmanager
def borrowed(env: FMUEnv, outside: bool = False) -> Iterator[Contents]:
    """Use an environment for calls of its hooks; afterwards it and its objects are as before.

    Args:
        env: The environment.
        outside: Whether this is to hold for global variables, too.
    """
    with env.inside.standing_in:
        before, env.inside.in_hooks = env.inside.in_hooks, True
        contents = Contents(env, outside)
        try:
            yield contents
        finally:
            contents.restore()
            env.inside.in_hooks = before


def _has_changed(kept: _Kept) -> bool:
    try:
        return differs(kept.contents, kept.kind.copy(kept.value))
    except Exception:  # users' objects may fail in any way
        return False


def _restore_dict(target: dict[str, Any], contents: Mapping[str, Any]) -> None:
    if list(target) != list(contents):  # an interrupt must not find the attributes gone
        dict.clear(target)
    dict.update(target, contents)


def _restore_list(target: Any, contents: Any) -> None:
    target[:] = contents


def _restore_by_methods(target: Any, contents: Any) -> None:
    target.clear()
    (target.extend if isinstance(target, deque) else target.update)(contents)


def _restore_array(target: Any, contents: Any) -> None:
    target[...] = contents


def _parts_of_array(contents: Any) -> list[Any]:
    return contents.ravel().tolist() if contents.dtype == object else []


def _slots_of(value: Any) -> dict[str, Any]:
    names = [n for cls in type(value).__mro__ for n in _names(getattr(cls, "__slots__", ()))]
    return {n: getattr(value, n) for n in names if n != "__dict__" and hasattr(value, n)}


def _names(slots: Any) -> list[str]:
    return [slots] if isinstance(slots, str) else list(slots)


def _attributes_of(value: Any) -> dict[str, Any]:
    return _slots_of(value) | getattr(value, "__dict__", {})


def _restore_attributes(target: Any, contents: Mapping[str, Any]) -> None:
    for name in _attributes_of(target).keys() - contents.keys():
        object.__delattr__(target, name)
    for name, value in contents.items():
        object.__setattr__(target, name, value)


def _held_by_function(function: Any) -> tuple[Any, ...]:
    kept = function.__closure__ or (), function.__defaults__ or (), function.__kwdefaults__ or {}
    return *kept, dict(vars(function))


def _parts_of_function(contents: tuple[Any, ...]) -> list[Any]:
    closure, defaults, of_keywords, attributes = contents
    return [*closure, *defaults, of_keywords, *attributes.values()]


def _restore_function(function: Any, contents: tuple[Any, ...]) -> None:
    _restore_dict(vars(function), contents[-1])


def _data_of_class(cls: Any) -> dict[str, Any]:
    """The attributes of a class that are no code."""
    return {
        name: value
        for name, value in vars(cls).items()
        if not name.startswith("__") and not callable(value) and not hasattr(value, "__get__")
    }


def _restore_class(cls: Any, contents: Mapping[str, Any]) -> None:
    for name in _data_of_class(cls).keys() - contents.keys():
        type.__delattr__(cls, name)
    for name, value in contents.items():
        if vars(cls).get(name) is not value:
            type.__setattr__(cls, name, value)


def _nothing(_: Any) -> tuple[()]:
    return ()


_KINDS: Final[Mapping[type, _Kind]] = {
    dict: _Kind(dict.values, dict, _restore_dict),
    list: _Kind(iter, list, _restore_list),
    bytearray: _Kind(_nothing, bytes, _restore_list),
    set: _Kind(iter, set, _restore_by_methods),
    deque: _Kind(iter, list, _restore_by_methods),
    tuple: _Kind(iter),
    frozenset: _Kind(iter),
    MappingProxyType: _Kind(lambda proxy: proxy.values()),
    np.ndarray: _Kind(_parts_of_array, np.copy, _restore_array),
    np.random.Generator: _Kind(lambda generator: [generator.bit_generator]),
    np.random.BitGenerator: _Kind(
        _nothing, lambda bits: bits.state, lambda bits, state: setattr(bits, "state", state)
    ),
    SimpleNamespace: _Kind(dict.values, _attributes_of, _restore_attributes),
    random.Random: _Kind(_nothing, random.Random.getstate, random.Random.setstate),
    CellType: _Kind(
        iter,
        lambda cell: [cell.cell_contents],
        lambda cell, contents: setattr(cell, "cell_contents", contents[0]),
    ),
    FunctionType: _Kind(_parts_of_function, _held_by_function, _restore_function),
    BuiltinMethodType: _Kind(lambda method: [method.__self__]),
    MethodType: _Kind(lambda method: [method.__self__]),
    partial: _Kind(lambda made: [made.func, made.args, made.keywords]),
}
_CLASS: Final = _Kind(dict.values, _data_of_class, _restore_class)
_INSTANCE: Final = _Kind(dict.values, _attributes_of, _restore_attributes)
_PLAIN: Final = (
    *(bool, int, float, complex, str, bytes, type(None), np.generic),
    *(ModuleType, PurePath),
)


def _is_of_a_package(cls: type) -> bool:
    """Whether a class is Python's, numpy's or ours."""
    package = cls.__module__.partition(".")[0]
    is_ours = package in OURS and not cls.__module__.startswith("fmugym.envs")
    return is_ours or package == "numpy" or package in sys.stdlib_module_names - {"__main__"}


def _kind_of(value: Any) -> _Kind | None:
    """How to keep the contents of an object; None if it has none that hooks could change."""
    cls = type(value)
    if isinstance(value, type):
        return None if _is_of_a_package(value) else _CLASS
    if issubclass(cls, _PLAIN):
        return None
    if cls.__module__.partition(".")[0] in OURS or issubclass(cls, (gymnasium.Env, spaces.Space)):
        return None
    for base in cls.__mro__:
        if base in _KINDS:
            return _KINDS[base]
    return _INSTANCE if hasattr(value, "__dict__") or hasattr(cls, "__slots__") else None


def differs(before: Any, after: Any) -> bool:
    """Whether a value has changed, if values of its type can be compared; NaNs are equal."""
    if before is after:
        return False
    if type(before) is not type(after):
        return True
    try:
        return _differ(before, after)
    except Exception:  # users' values may raise anything when compared
        return False


def _differ(before: Any, after: Any) -> bool:
    if isinstance(before, np.random.Generator):
        return bool(before.bit_generator.state != after.bit_generator.state)
    if isinstance(before, np.ndarray):
        return not np.array_equal(before, after, equal_nan=before.dtype.kind in "fc")
    if isinstance(before, list | tuple):
        return len(before) != len(after) or any(map(differs, before, after))
    if isinstance(before, dict):
        return before.keys() != after.keys() or any(differs(before[k], after[k]) for k in before)
    if isinstance(before, set | bytes):
        return bool(before != after)
    if isinstance(before, bool | int | float | complex | str | np.generic):
        return bool(before != after) and not bool(before != before and after != after)
    return _kind_of(before) is _INSTANCE and differs(_attributes_of(before), _attributes_of(after))
