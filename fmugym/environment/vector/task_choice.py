"""Choice of the task of N environments: expressions, hooks on arrays, or hooks one by one."""

from __future__ import annotations

import logging
import sys
from typing import Any, Final

from gymnasium import spaces

from fmugym.environment.actions import is_array_space
from fmugym.environment.env import FMUEnv
from fmugym.environment.hooks import ORDER, Hooks
from fmugym.environment.vector.env_maker import EnvMaker
from fmugym.environment.vector.expression_task import Expressions
from fmugym.environment.vector.hook_tasks import ArrayHooks, EachHooks
from fmugym.environment.vector.task_programs import TaskPrograms, compile_formulas, formulas_of
from fmugym.environment.vector.tasks import VectorTask
from fmugym.errors import ConfigError, warn_once
from fmugym.expressions.program import UncompilableError
from fmugym.pool import Pool
from fmugym.pool.c_extension import has_native_pool

__all__ = ["hook_of_one", "make_task", "no_arrays", "require_own_order"]

logger = logging.getLogger(__name__)

_MANY: Final = 16
"""From so many environments on, calling hooks one by one is worth a warning."""

_KEYS: Final = {
    "_get_inputs": "inputs",
    "_update": "memory",
    "_is_done": "terminated",
    "_is_truncated": "truncated",
    "_reward_policy": "reward",
    "_get_observation": "observations",
    "_get_info": "info",
}
"""The keys of the config whose expressions stand for hooks."""


def make_task(
    maker: EnvMaker, prototype: FMUEnv, pool: Pool, max_episode_steps: int | None
) -> VectorTask:
    """Make the task of N environments.

    Expressions run as programs. Hooks that are vectorized are called once a step, on arrays; all
    others once for each environment, with a warning if there are many of these.

    Args:
        maker: Makes the other environments if hooks are called one by one.
        prototype: The environment that was made already; it uses the pool.
        pool: The FMUs of all environments.
        max_episode_steps: Truncates episodes.
    """
    reason = _reason(prototype)
    if reason is None:
        limit = min(prototype.step_limit, max_episode_steps or sys.maxsize)
        programs = _programs(prototype, limit)
        if programs is None:
            return ArrayHooks(prototype, limit)
        return Expressions(prototype, programs)
    if pool.num_instances >= _MANY:
        warn_once(logger, f"the hooks of {type(prototype).__name__} are called {reason}")
    envs = _make_all(maker, prototype, pool.num_instances)
    return EachHooks(envs, pool, max_episode_steps)


def require_own_order(env: FMUEnv) -> None:
    """Refuse a class that overrides ``step`` or ``reset``.

    Raises:
        ConfigError: If it overrides ``step`` or ``reset``.
    """
    own, name = env._own_hooks, type(env).__name__
    if own.step or own.reset:
        method = "step" if own.step else "reset"
        raise ConfigError(
            f"{name} overrides {method}, which a FMUVectorEnv does not call; make a "
            f"gymnasium.vector.SyncVectorEnv([{name}] * N) instead"
        )


def _programs(env: FMUEnv, limit: int) -> TaskPrograms | None:
    """The programs of an environment whose hooks are expressions."""
    formulas = formulas_of(env)
    if formulas is None:
        return None
    try:
        return compile_formulas(env, formulas, limit)
    except UncompilableError as reason:
        text = f"the expressions of {type(env).__name__} cannot be compiled: {reason}"
        logger.info("%s. They are evaluated on arrays, which is slower", text)
        return None


def _reason(env: FMUEnv) -> str | None:
    """Why hooks are called one by one; None if they are not."""
    obstacle = no_arrays(env)
    if obstacle is not None:
        return f"one environment at a time, because {obstacle}"
    hook = None if formulas_of(env) else hook_of_one(type(env))
    if hook is not None:
        key = f"; or give an expression under {_KEYS[hook]!r}" if hook in _KEYS else ""
        return (
            f"one environment at a time, which is slow, because {hook} is not vectorized: let "
            f"fmugym.environment.env_checker.check_hooks find out whether they work on arrays, and "
            f"write vectorized = True in the class that has {hook}{key}"
        )
    if not has_native_pool():
        return "one environment at a time, because there is no C extension"
    return None


def hook_of_one(cls: type[FMUEnv]) -> str | None:
    """The first hook of a step that works on the numbers of one environment, as classes say.

    A default works on arrays. Any other hook does if the class body that has it says so.
    """
    for name in (*ORDER, "_goal_reward"):
        owner = next(one for one in cls.__mro__ if name in vars(one))
        is_default = getattr(cls, name) is getattr(Hooks, name)
        if not is_default and not vars(owner).get("vectorized", False):
            return name
    return None


def no_arrays(env: FMUEnv) -> str | None:
    """Obstacle to arrays of N environments, in words; None if there is none."""
    if not is_array_space(env.action_space):
        return f"actions of {env.action_space} do not make one array"
    if not _makes_arrays(env.observation_space):
        return f"observations of {env.observation_space} do not make arrays"
    return None


def _makes_arrays(space: spaces.Space[Any]) -> bool:
    """Whether observations of N environments are an array, or a dict of arrays."""
    if isinstance(space, spaces.Dict):
        return all(map(_makes_arrays, space.values()))
    return is_array_space(space)


def _make_all(maker: EnvMaker, prototype: FMUEnv, count: int) -> list[FMUEnv]:
    """Make the other environments; all but the prototype are closed if one cannot be made."""
    envs = [prototype]
    try:
        while len(envs) < count:
            envs.append(maker.make_like(prototype, len(envs)))
    except BaseException:
        for env in envs[1:]:
            env.close()
        raise
    return envs
