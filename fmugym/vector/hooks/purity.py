"""Hooks that may do more than compute: an additional call of one would change something."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from copy import deepcopy
from inspect import getattr_static
from types import BuiltinFunctionType, FunctionType, MappingProxyType, ModuleType
from typing import Any, Final

import gymnasium
import numpy as np

from fmugym.env import FMUEnv
from fmugym.task.step import ORDER
from fmugym.vector.contents import differs
from fmugym.vector.hooks.program import UntraceableError
from fmugym.vector.hooks.tables import is_foreign, names_in, places_of, unwrapped

__all__ = ["names_in_hooks", "unchanged_globals"]

_LEAVES: Final = (bool, int, float, complex, str, bytes, type(None), range, np.generic)

_OURS: Final = ("fmugym", "gymnasium", "logging")
"""Packages whose objects hooks only read."""

_ACTING: Final = frozenset(
    {"print", "open", "input", "exec", "eval", "setattr", "random", "breakpoint", "set_trace"}
)
"""Names of functions that act on something, and of modules that draw numbers."""

_MODULES: Final = frozenset(
    {"random", "time", "datetime", "os", "io", "sys", "shutil", "pathlib", "secrets", "warnings"}
    | {"socket", "subprocess", "threading", "asyncio", "queue", "logging", "pickle", "json", "csv"}
)
"""Modules of Python whose functions act on something, or return something new each time."""


def _is_ours(value: Any) -> bool:
    """Whether a value is an object that hooks only read."""
    if isinstance(value, gymnasium.Env):
        return False
    module = getattr(value, "__module__", None) or type(value).__module__
    return isinstance(module, str) and module.partition(".")[0] in _OURS


def _is_plain(value: Any) -> bool:
    """Whether it is a number or a text, or a container of them."""
    if isinstance(value, _LEAVES):
        return True
    if type(value) is dict:
        return all(map(_is_plain, value)) and all(map(_is_plain, value.values()))
    return type(value) in (list, tuple, set, frozenset) and all(map(_is_plain, value))


@contextmanager
def unchanged_globals(env: FMUEnv) -> Iterator[None]:
    """Refuse hooks that refer to what they could change, except for attributes.

    Numbers, texts, arrays, and lists and dicts of them may be global variables, or variables of
    a surrounding function. If hooks change one, they are refused, and the change is undone.

    Raises:
        UntraceableError: With the name.
    """
    reached = _reached(env)
    for function in reached:
        _require_plain_attributes(env, function)
    kept = [
        (place, name, place[name], deepcopy(place[name]))
        for function in reached
        for place, name in _checked_places(function)
    ]
    changed: list[str] = []
    try:
        yield
    finally:
        changed += _undo(kept)
    if changed:
        raise UntraceableError(f"it changes {changed[0] or 'a variable'} outside of self")


def _undo(kept: list[tuple[Any, str, Any, Any]]) -> list[str]:
    """Undo the changes of values outside of an environment; return their names."""
    changed = [one for one in kept if one[0][one[1]] is not one[2] or differs(one[3], one[2])]
    for place, name, value, copy in changed:
        _restore(value, copy)
        place[name] = value
    return [name for _, name, *_ in changed]


def _restore(value: Any, copy: Any) -> None:
    """Give a list, a dict, a set or an array the contents of its copy."""
    if isinstance(value, np.ndarray):
        value[...] = copy
    elif isinstance(value, list):
        value[:] = copy
    elif isinstance(value, dict | set):
        value.clear()
        value.update(copy)


def names_in_hooks(env: FMUEnv) -> set[str]:
    """The names of the attributes and globals to which hooks refer."""
    return {name for function in _reached(env) for name in names_in(function.__code__)}


def _reached(env: FMUEnv) -> list[FunctionType]:
    """The functions of hooks, and those that they call by name or by an attribute."""
    waiting = [getattr_static(env, name, None) for name in (*ORDER, "_goal_reward")]
    found: dict[int, FunctionType] = {}
    while waiting:
        function = unwrapped(waiting.pop())
        known = not isinstance(function, FunctionType) or id(function) in found
        if known or is_foreign(function.__module__ or ""):
            continue
        found[id(function)] = function
        waiting += [place[name] for place, name in places_of(function)]
        names = [name for name in names_in(function.__code__) if not name.startswith("__")]
        waiting += [getattr_static(env, name, None) for name in names]
        if "super" in names:
            waiting += [vars(cls).get(name) for cls in type(env).__mro__ for name in names]
    return list(found.values())


def _checked_places(function: FunctionType) -> Iterator[tuple[Any, str]]:
    """The places of plain values that a function refers to."""
    acting = _ACTING.intersection(names_in(function.__code__))
    if acting:
        raise UntraceableError(
            f"{function.__name__} uses {min(acting)}, which does not only compute"
        )
    for place, name in places_of(function):
        value = place[name]
        if isinstance(value, ModuleType):
            _require_computing(function, value)
        elif _is_plain(value) or type(value) is np.ndarray:
            yield place, name
        elif not _is_constant(value):
            raise UntraceableError(
                f"{function.__name__} refers to {name or 'a variable'}, a {type(value).__name__} "
                "that it could change"
            )


def _require_plain_attributes(env: FMUEnv, function: FunctionType) -> None:
    """Refuse functions that refer to objects among the attributes, which they could change."""
    for name in set(names_in(function.__code__)):
        value = getattr_static(env, name, None)
        is_harmless = _is_plain(value) or isinstance(value, np.ndarray) or _is_ours(value)
        if not is_harmless and not isinstance(value, _CODE) and not hasattr(value, "__get__"):
            raise UntraceableError(
                f"{function.__name__} refers to {name}, a {type(value).__name__} "
                "that it could change"
            )


_CODE: Final = (FunctionType, classmethod, staticmethod, property, type, MappingProxyType)
"""Types of attributes that hooks cannot change: code, and the parameters."""


def _require_computing(function: FunctionType, module: ModuleType) -> None:
    if module.__name__.partition(".")[0] in _MODULES:
        raise UntraceableError(f"{function.__name__} uses the module {module.__name__}")


def _is_constant(value: Any) -> bool:
    is_code = isinstance(value, type | FunctionType | BuiltinFunctionType)
    return (
        is_code
        or _is_ours(value)
        or type(value).__module__.partition(".")[0]
        in (
            "numpy",
            "typing",
            "functools",
        )
    )
