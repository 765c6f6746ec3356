"""Chooses how the hooks of N environments are called: the engine of a vector environment."""

from __future__ import annotations

import logging

from gymnasium.vector.utils import batch_space

from fmugym.env import FMUEnv
from fmugym.errors import ConfigError
from fmugym.pool import Pool
from fmugym.pool.extension import require_engine
from fmugym.vector.engines.batch import BatchEngine
from fmugym.vector.engines.engine import Engine
from fmugym.vector.engines.per_env import PerEnvEngine
from fmugym.vector.engines.programs import find_programs
from fmugym.vector.hooks.check import CURE, find_difference
from fmugym.vector.hooks.formula_programs import formulas_of
from fmugym.vector.hooks.task_programs import TaskPrograms
from fmugym.vector.making import EnvMaker

__all__ = ["make_engine"]

logger = logging.getLogger(__name__)


def make_engine(
    maker: EnvMaker, prototype: FMUEnv, pool: Pool, hooks: str, max_episode_steps: int | None
) -> Engine:
    """Make the fastest engine that gives correct results, or the one that is asked for.

    Args:
        maker: Makes the other environments if hooks are called one environment at a time.
        prototype: The environment that was made already; it uses the pool.
        pool: The FMUs of all environments.
        hooks: The way of calling hooks, see ``FMUVectorEnv``.
        max_episode_steps: Truncates episodes.

    Raises:
        ConfigError: If the hooks cannot be called as asked for.
    """
    count = pool.num_instances
    if not _use_arrays(prototype, hooks):
        envs = _make_all(maker, prototype, count)
        return PerEnvEngine(
            envs, pool, max_episode_steps, batch_space(prototype.action_space, count)
        )
    if hooks == "array":
        task = TaskPrograms.without_programs(prototype)
    else:
        task = find_programs(prototype, required=hooks == "compiled")
    return BatchEngine(prototype, count, max_episode_steps, task)


def _make_all(maker: EnvMaker, prototype: FMUEnv, count: int) -> list[FMUEnv]:
    """Make the other environments; all but the prototype are closed if one cannot be made."""
    envs = [prototype]
    try:
        envs.extend(maker.make_like(prototype, index) for index in range(1, count))
    except BaseException:
        for env in envs[1:]:
            env.close()
        raise
    return envs


def _use_arrays(prototype: FMUEnv, hooks: str) -> bool:
    if hooks == "per_env":
        return False
    require_engine(f"a vector environment with hooks={hooks!r} instead of 'per_env'")
    difference = None if formulas_of(prototype) else find_difference(prototype)
    if difference is None:
        return True
    name = type(prototype).__name__
    text = f"{name}: {difference}, so its hooks cannot be called on arrays. {CURE}"
    if hooks != "auto":
        raise ConfigError(text)
    logger.warning("%s. Until then they are called one environment at a time: slower", text)
    return False
