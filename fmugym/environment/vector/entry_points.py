"""Vector entry points: functions that make a vector environment of a class, also by name.

Gymnasium's specs need names in order to be written as text:

``"fmugym.environment.vector.entry_points:me.boilers.Boiler"`` is the vector entry point of the
class ``Boiler`` in the module ``me.boilers``.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any

from gymnasium.envs.registration import load_env_creator
from gymnasium.vector import AutoresetMode

from fmugym.errors import ArgumentError

if TYPE_CHECKING:
    from fmugym.environment.vector.vector_env import FMUVectorEnv

__all__ = ["vector_entry_point", "vectorized"]


def vector_entry_point(entry_point: str) -> str:
    """Return the vector entry point for the entry point ``"module:Class"`` of one environment."""
    return f"{__name__}:{entry_point.replace(':', '.')}"


def __getattr__(name: str) -> Callable[..., Any]:
    module, _, attribute = name.rpartition(".")
    if not module:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return vectorized(f"{module}:{attribute}")


def _make(
    env_class: Callable[..., Any] | str,
    /,
    num_envs: int = 1,
    max_episode_steps: int | None = None,
    autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
    backend: Any = "auto",
    **kwargs: Any,
) -> FMUVectorEnv:
    from fmugym.environment.vector.arguments import (  # registration shall be quick
        ARGUMENTS,
        POOL_OPTIONS,
    )
    from fmugym.environment.vector.vector_env import FMUVectorEnv

    pool_options = {name: kwargs.pop(name) for name in POOL_OPTIONS if name in kwargs}
    creator: Any = load_env_creator(env_class) if isinstance(env_class, str) else env_class
    if not isinstance(backend, str):  # it names no pool: the class knows what to do with it
        kwargs["backend"], backend = backend, "auto"
    try:
        return FMUVectorEnv(
            partial(creator, **kwargs),
            num_envs,
            max_episode_steps=max_episode_steps,
            autoreset_mode=autoreset_mode,
            backend=backend,
            **pool_options,
        )
    except ArgumentError as error:
        more = ", ".join(map(repr, (*ARGUMENTS[1:], *POOL_OPTIONS)))
        raise ArgumentError(f"{error}; a vector environment also takes {more}") from None


def vectorized(env_class: Callable[..., Any] | str) -> Callable[..., FMUVectorEnv]:
    """Make the vector entry point of a class.

    Args:
        env_class: The class, or ``"module:Class"``.

    Returns:
        A function that makes a ``FMUVectorEnv``. It takes the arguments of ``FMUVectorEnv`` except
        ``make_env``, and passes all others to the class. It pickles if the class does.
    """
    return partial(_make, env_class)
