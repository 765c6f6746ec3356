"""Vector environments for libraries of reinforcement learning."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from importlib import import_module
from typing import Any

import gymnasium
from gymnasium.envs.registration import load_env_creator
from gymnasium.vector import AutoresetMode

from fmugym.environment.env import FMUEnv
from fmugym.environment.vector.entry_points import vectorized
from fmugym.environment.vector.vector_env import FMUVectorEnv
from fmugym.errors import ConfigError, shown

__all__ = ["make_vector_env", "require_vector_env"]


def make_vector_env(
    env: str | Callable[..., FMUEnv], num_envs: int, kwargs: Mapping[str, Any]
) -> Any:
    """Make a vector environment of an id or of a class.

    Args:
        env: A registered id, or a class; ids bring their ``max_episode_steps``.
        num_envs: N.
        kwargs: Arguments of ``FMUVectorEnv`` and of the environment.

    Raises:
        ConfigError: If the environment is unknown or not one of fmugym, or an argument does not
            fit.
    """
    if isinstance(env, str):
        return _registered(env, num_envs, kwargs)
    if callable(env):
        return vectorized(env)(num_envs, **kwargs)
    raise ConfigError(f"env must be a registered id or a class, got {shown(env)}")


def require_vector_env(env: Any, mode: AutoresetMode) -> FMUVectorEnv:
    """Return a vector environment with the autoreset mode that a library expects.

    Raises:
        ConfigError: If it is something else, or has another mode.
    """
    if not isinstance(env, FMUVectorEnv):
        raise ConfigError(f"expected a FMUVectorEnv, got {type(env).__name__}")
    if env.autoreset_mode is not mode:
        raise ConfigError(
            f"the autoreset mode is {env.autoreset_mode.name}, expected {mode.name}: make the "
            f"FMUVectorEnv with autoreset_mode={mode.name.lower()!r}"
        )
    return env


def _registered(env_id: str, num_envs: int, kwargs: Mapping[str, Any]) -> Any:
    module, _, name = env_id.rpartition(":")
    try:
        if module:
            import_module(module)
        creator: Any = gymnasium.spec(name).entry_point
    except (ImportError, ValueError, gymnasium.error.Error) as error:
        raise ConfigError(f"there is no environment {env_id!r}: {error}") from None
    creator = load_env_creator(creator) if isinstance(creator, str) else creator
    if isinstance(creator, type) and not issubclass(creator, FMUEnv):
        raise ConfigError(
            f"{name} is not an environment of fmugym; make it by the functions of the library"
        )
    return gymnasium.make_vec(name, num_envs=num_envs, **kwargs)
