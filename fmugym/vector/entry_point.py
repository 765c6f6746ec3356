"""The vector entry points that Gymnasium's registry calls."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

from gymnasium.envs.registration import load_env_creator
from gymnasium.vector import AutoresetMode

from fmugym.vector.arguments import POOL_OPTIONS
from fmugym.vector.env import FMUVectorEnv

__all__ = ["vectorized"]


class VectorEntryPoint:
    """Makes vector environments of one class; see ``vectorized``.

    It pickles if the class does.
    """

    def __init__(self, env_class: Callable[..., Any] | str) -> None:
        self._env_class = env_class

    def __call__(
        self,
        num_envs: int = 1,
        max_episode_steps: int | None = None,
        autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
        hooks: str = "auto",
        backend: Any = "auto",
        **kwargs: Any,
    ) -> FMUVectorEnv:
        """Make a vector environment; see ``FMUVectorEnv``."""
        pool_options = {name: kwargs.pop(name) for name in POOL_OPTIONS if name in kwargs}
        env_class = self._env_class
        creator: Any = load_env_creator(env_class) if isinstance(env_class, str) else env_class
        if not isinstance(backend, str):  # it names no pool: the class knows what to do with it
            kwargs["backend"], backend = backend, "auto"
        return FMUVectorEnv(
            partial(creator, **kwargs),
            num_envs,
            max_episode_steps=max_episode_steps,
            autoreset_mode=autoreset_mode,
            hooks=hooks,
            backend=backend,
            **pool_options,
        )


def vectorized(env_class: Callable[..., Any] | str) -> Callable[..., FMUVectorEnv]:
    """Make the vector entry point of a class.

    Args:
        env_class: The class, or ``"module:Class"``.

    Returns:
        A function that makes a ``FMUVectorEnv``. It takes the arguments of ``FMUVectorEnv`` except
        ``make_env``, and passes all others to the class.
    """
    return VectorEntryPoint(env_class)
