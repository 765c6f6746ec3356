"""Ways of calling hooks that a class does not choose itself: to compare them with each other."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

from fmugym.environment.env import FMUEnv
from fmugym.environment.hooks import ORDER, Hooks

__all__ = ["ARRAYS", "EACH", "EXPRESSIONS", "in_python", "in_way"]

ARRAYS, EACH, EXPRESSIONS = "arrays", "one by one", "expressions"


def in_way(way: str | None, make: Callable[..., FMUEnv]) -> Callable[..., FMUEnv]:
    """A function like another one, whose hooks are called in a way; None for that of the class."""
    return functools.partial(_made, way, make)


def _made(way: str | None, make: Callable[..., FMUEnv], *given: Any, **options: Any) -> FMUEnv:
    env = make(*given, **options)
    assert way != EXPRESSIONS or env.formulas is not None
    if way not in (None, EXPRESSIONS):
        env.__class__ = _declared(type(env), way == ARRAYS)
    return env


@functools.cache
def _declared(cls: type[FMUEnv], vectorized: bool) -> type[FMUEnv]:
    """A subclass whose hooks call those of the class, and say in which way they work."""
    hooks = (*ORDER, "_goal_reward")
    owners = {name: next(one for one in cls.__mro__ if name in vars(one)) for name in hooks}
    own = [name for name, owner in owners.items() if owner is not Hooks] or ["_is_done"]

    def calling(name: str) -> Callable[..., Any]:
        return lambda self, *given: getattr(super(made, self), name)(*given)

    body = {name: calling(name) for name in own} | {"vectorized": vectorized}
    made = type(cls.__name__, (cls,), body | {"__module__": cls.__module__})
    return made


def in_python(env: FMUEnv) -> FMUEnv:
    """Evaluate the expressions of an environment in Python; for the time before its first reset."""
    env.formulas = None
    return env
