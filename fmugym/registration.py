"""Registration of environments with Gymnasium."""

from __future__ import annotations

import sys
from collections.abc import Callable
from contextlib import suppress
from typing import Any, cast

import gymnasium

from fmugym.checks import check_text
from fmugym.environment.vector import vectorized
from fmugym.environment.vector.entry_points import vector_entry_point
from fmugym.errors import ConfigError, shown

__all__ = ["register", "register_bundled"]

_BUNDLED: dict[str, dict[str, Any]] = {
    "CartPole": {"max_episode_steps": 500, "reward_threshold": 475.0},
    "Pendulum": {"max_episode_steps": 200},
    "ModelicaCartPole": {"max_episode_steps": 200},
    "CloudPendulum": {"max_episode_steps": 500},
    "House": {},  # its task says how long an episode is
}
"""Specs of the environments of ``fmugym.envs``, by name."""


def register(
    env_id: str,
    env: Callable[..., gymnasium.Env[Any, Any]] | str,
    max_episode_steps: int | None = None,
    **spec: Any,
) -> None:
    """Register an environment for ``gymnasium.make`` and, natively, ``gymnasium.make_vec``.

    The spec names the class by its module. It can therefore be pickled and written as JSON
    (``env.spec.to_json()``), and another program makes the same environment of it:
    ``gymnasium.make(EnvSpec.from_json(text))``. That program has to find the class:

    * A class of an importable module is always found.
    * A class of a script or notebook is in the module ``__main__``. Only programs whose own main
      module has the class find it, such as the processes that the script starts.
    * A class that is defined within a function, and a lambda, are registered as objects. They work
      in this program only, and Gymnasium refuses to write their specs.

    Args:
        env_id: ``[namespace/]Name-vN``, for example ``"me/Boiler-v0"``.
        env: The class, or ``"module:Class"``.
        max_episode_steps: Steps after which ``make``'s time limit truncates an episode.
        spec: More fields of Gymnasium's ``EnvSpec``, for example ``reward_threshold``.

    Raises:
        ConfigError: If the id is malformed, or ``env`` is neither a class nor ``"module:Class"``.
    """
    env_id, entry_point = check_text("env_id", env_id), _entry_point(env)
    is_named = isinstance(entry_point, str)
    default = vector_entry_point(entry_point) if is_named else vectorized(entry_point)
    try:
        gymnasium.register(
            env_id,
            entry_point=cast(Any, entry_point),
            vector_entry_point=spec.pop("vector_entry_point", None) or cast(Any, default),
            max_episode_steps=max_episode_steps,
            **spec,
        )
    except gymnasium.error.Error as error:
        raise ConfigError(f"{shown(env_id)} cannot be registered: {error}") from None


def register_bundled() -> None:
    """Register the environments that come with the package, without importing them."""
    for name, spec in _BUNDLED.items():
        register(f"fmugym/{name}-v0", f"fmugym.envs:{name}Env", **spec)
    register("fmugym/FMU-v0", "fmugym.task:load")


def _entry_point(env: Any) -> Any:
    """Text ``"module:Class"`` if it leads to the class, the class itself otherwise."""
    if isinstance(env, str):
        module, _, name = env.partition(":")
        if not module or not name.isidentifier():
            raise ConfigError(f"expected 'module:Class', got {shown(env)}")
        return env
    if not callable(env):
        raise ConfigError(f"expected a class or 'module:Class', got {shown(env)}")
    with suppress(Exception):  # a callable object of the caller's that has no such names
        module, name = env.__module__, env.__qualname__
        if getattr(sys.modules[module], name) is env:
            return f"{module}:{name}"
    return env
