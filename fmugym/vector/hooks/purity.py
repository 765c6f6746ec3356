"""Hooks that may do more than compute: an additional call of one would change something."""

from __future__ import annotations

from inspect import getattr_static
from types import BuiltinFunctionType, FunctionType, MappingProxyType, ModuleType
from typing import Any, Final

import gymnasium
import numpy as np

from fmugym.env import FMUEnv
from fmugym.expressions.program import UntraceableError
from fmugym.vector.contents import OURS
from fmugym.vector.hooks.tables import defaults_of, functions_of, names_in, places_of

__all__ = ["names_in_hooks", "require_pure", "unrepeatable"]

_LEAVES: Final = (bool, int, float, complex, str, bytes, type(None), range, np.generic)

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
    return isinstance(module, str) and module.partition(".")[0] in OURS


def _is_plain(value: Any) -> bool:
    """Whether it is a number or a text, or a container of them."""
    if isinstance(value, _LEAVES):
        return True
    if type(value) is dict:
        return all(map(_is_plain, value)) and all(map(_is_plain, value.values()))
    return type(value) in (list, tuple, set, frozenset) and all(map(_is_plain, value))


def unrepeatable(env: FMUEnv) -> str | None:
    """What hooks refer to that a call may change for good, in words; None if there is nothing.

    Python keeps default arguments for all calls and all environments. So hooks with some that can
    change are not called more often than a task asks for.
    """
    for function in functions_of(env):
        for name, value in defaults_of(function).items():
            if not _is_fixed(value):
                what = f"{name}, a {type(value).__name__} that it could change"
                return f"{function.__name__} has a default argument {what}"
    return None


def _is_fixed(value: Any) -> bool:
    """Whether no call can change a value, and functions are looked at by themselves."""
    if isinstance(value, tuple | frozenset):
        return all(map(_is_fixed, value))
    if isinstance(value, (*_LEAVES, FunctionType, ModuleType, type, np.dtype, np.ufunc)):
        return True
    if isinstance(value, BuiltinFunctionType):
        return value.__self__ is None or isinstance(value.__self__, ModuleType)
    return callable(value) and (getattr(value, "__module__", None) or "").startswith("numpy")


def require_pure(env: FMUEnv) -> None:
    """Refuse hooks that refer to what acts on something, or to objects that they could change.

    Numbers, texts, arrays, and lists and dicts of them may be global variables, or variables of a
    surrounding function; whether hooks change them shows when they are called.

    Raises:
        UntraceableError: With the name.
    """
    obstacle = unrepeatable(env)
    if obstacle is not None:
        raise UntraceableError(obstacle)
    for function in functions_of(env):
        names = set(names_in(function.__code__))
        if not _ACTING.isdisjoint(names):
            acting = min(_ACTING & names)
            raise UntraceableError(
                f"{function.__name__} uses {acting}, which does not only compute"
            )
        for name in names:
            value = getattr_static(env, name, None)
            is_code = isinstance(value, _CODE) or hasattr(value, "__get__")
            if not is_code and not isinstance(value, np.ndarray):
                _require(_is_plain(value) or _is_ours(value), function, name, value)
        for place, name in places_of(function):
            value = place[name]
            if isinstance(value, ModuleType):
                _require_computing(function, value)
            elif type(value) is not np.ndarray:
                is_harmless = _is_plain(value) or _is_constant(value)
                _require(is_harmless, function, name or "a variable", value)


def _require(is_harmless: bool, function: FunctionType, name: str, value: Any) -> None:
    if not is_harmless:
        raise UntraceableError(
            f"{function.__name__} refers to {name}, a {type(value).__name__} that it could change"
        )


def names_in_hooks(env: FMUEnv) -> set[str]:
    """The names of the attributes and globals to which hooks refer."""
    return {name for function in functions_of(env) for name in names_in(function.__code__)}


_CODE: Final = (FunctionType, classmethod, staticmethod, property, type, MappingProxyType)
"""Types of attributes that hooks cannot change: code, and the parameters."""


def _require_computing(function: FunctionType, module: ModuleType) -> None:
    if module.__name__.partition(".")[0] in _MODULES:
        raise UntraceableError(f"{function.__name__} uses the module {module.__name__}")


def _is_constant(value: Any) -> bool:
    is_code = isinstance(value, type | FunctionType | BuiltinFunctionType)
    package = type(value).__module__.partition(".")[0]
    return is_code or _is_ours(value) or package in ("numpy", "typing", "functools")
