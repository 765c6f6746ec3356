"""Registration of environments with Gymnasium."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, cast

import gymnasium

from fmugym.vector import vectorized

__all__ = ["register"]


def register(
    env_id: str,
    env: Callable[..., gymnasium.Env[Any, Any]] | str,
    max_episode_steps: int | None = None,
    **spec: Any,
) -> None:
    """Register an environment for ``gymnasium.make`` and, natively, ``gymnasium.make_vec``.

    Args:
        env_id: ``[namespace/]Name-vN``, for example ``"me/Boiler-v0"``.
        env: The class, or ``"module:Class"``.
        max_episode_steps: Steps after which ``make``'s time limit truncates an episode.
        spec: More fields of Gymnasium's ``EnvSpec``, for example ``reward_threshold``.
    """
    gymnasium.register(
        env_id,
        entry_point=cast(Any, env),
        vector_entry_point=cast(Any, spec.pop("vector_entry_point", None) or vectorized(env)),
        max_episode_steps=max_episode_steps,
        **spec,
    )
