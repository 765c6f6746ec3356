"""Environments made by a user's function for the columns of one pool."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict
from typing import Any

from fmugym.environment.construction import require_construction
from fmugym.environment.env import FMUEnv
from fmugym.environment.pool_opening import deferred_pools, env_numbers, open_env_pool
from fmugym.errors import ConfigError
from fmugym.fmi.fmu import FMU
from fmugym.pool import PoolSpec

__all__ = ["EnvMaker", "make_with_pool"]


def make_with_pool(make_env: Callable[[], Any], num_instances: int = 1, **options: Any) -> FMUEnv:
    """Make an environment with a pool of other options than its constructor takes.

    Args:
        make_env: A function without arguments that returns a new environment.
        num_instances: N.
        options: See ``open_env_pool``.

    Raises:
        ConfigError: If an argument does not fit.
        FMULoadError: If the FMU cannot be used on this machine.
    """
    env = EnvMaker(make_env).make()
    require_construction(env)
    env._use(open_env_pool(env, num_instances, **options))
    return env


class EnvMaker:
    """Makes environments that have no pool yet; they share the FMUs that they open.

    Args:
        make_env: A function without arguments that returns a new environment.
    """

    def __init__(self, make_env: Callable[[], Any]) -> None:
        self._make_env = make_env
        self._fmus: dict[Any, FMU] = {}

    def make(self) -> FMUEnv:
        """Make one environment.

        Raises:
            ConfigError: If the function returns something else, or an environment that was there
                before. An environment that was made in vain is closed.
        """
        first = next(env_numbers)
        with deferred_pools(self._fmus):
            env = self._make_env()
        if not isinstance(env, FMUEnv):
            with suppress(Exception):  # it is the user's
                env.close()
            raise ConfigError(
                f"make_env must return an unwrapped environment of fmugym, got {type(env).__name__}"
            )
        if env._number < first:
            raise ConfigError(
                "make_env must make a new environment in each call, but it returned a "
                f"{type(env).__name__} that was there before; let it call the class"
            )
        env._close_pool()  # of a constructor that has used it, or in another thread
        return env

    def make_like(self, prototype: FMUEnv, index: int) -> FMUEnv:
        """Make one more environment for the pool of a prototype.

        Raises:
            ConfigError: As ``make``; or if the new one does not fit the pool or the spaces.
        """
        env = self.make()
        for what, differs in _differences(prototype, env).items():
            if differs:
                env.close()
                raise ConfigError(
                    f"make_env must make environments that differ in values only, but environment "
                    f"{index} has another {what} than environment 0"
                )
        return env


def _differences(first: FMUEnv, second: FMUEnv) -> dict[str, bool]:
    return {
        "class": type(first) is not type(second),
        "FMU": first.fmu.path != second.fmu.path,
        "interface to the FMU": not _are_equal(first.pool_spec, second.pool_spec),
        "action space": first.action_space != second.action_space,
        "observation space": first.observation_space != second.observation_space,
    }


def _are_equal(first: PoolSpec, second: PoolSpec) -> bool:
    """Compare by content; variables of FMUs that were opened apart are different objects."""
    return first == second or asdict(first) == asdict(second)
