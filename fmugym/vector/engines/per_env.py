"""N environments whose hooks run for one environment after another."""

from __future__ import annotations

import copy
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from types import MappingProxyType
from typing import Any

import numpy as np
import numpy.typing as npt
from gymnasium import spaces
from gymnasium.vector.utils import concatenate, create_empty_array, iterate

from fmugym.env import FMUEnv
from fmugym.errors import ConfigError, FMUGymError, shown
from fmugym.pool.base import FloatArray, MaskArray, Pool
from fmugym.pool.bundle import IndexArray
from fmugym.task.saving import columns_of, place_columns
from fmugym.task.snapshot import Columns, stacked
from fmugym.vector.actions import checked_actions, is_array_space
from fmugym.vector.calls import attribute
from fmugym.vector.codec import gathered
from fmugym.vector.column import PoolColumn
from fmugym.vector.engines.base import Engine, StepResult

__all__ = ["PerEnvEngine"]


class PerEnvEngine(Engine):
    """Calls the hooks of N environments, each on a column of one pool.

    The FMUs still step together on all threads, unless the class has its own ``step``.

    Args:
        envs: The environments.
        pool: Their pool of N instances.
        max_episode_steps: Truncates episodes, in addition to the config's own limit.
        action_space: The space of the actions of all environments.
    """

    def __init__(
        self,
        envs: Sequence[FMUEnv],
        pool: Pool,
        max_episode_steps: int | None,
        action_space: Any,
    ) -> None:
        super().__init__(len(envs))
        self._envs, self._pool = envs, pool
        self._columns = [PoolColumn(pool, index) for index in range(len(envs))]
        for env, column in zip(envs, self._columns, strict=True):
            env._use(column)
            env._prepare_hooks()  # its constructor may have set some as attributes
        self._together = not any(env._own.step for env in envs)
        self._checks_all = self._together and is_array_space(envs[0].action_space)
        self._limit = max_episode_steps or sys.maxsize
        self._action_space = action_space
        self._space = envs[0].observation_space
        self._observations: list[Any] = [None] * len(envs)
        shared = pool.observations
        is_default = shared.dtype == self._space.dtype and shared.shape[1:] == self._space.shape
        self._observes = is_default and all(env._pool_observes for env in envs)
        self._shared: tuple[npt.NDArray[np.float32], list[Any]] = shared.copy(), [None] * len(envs)

    def close(self) -> None:
        """See ``Engine.close``."""
        for env in self._envs:
            env.close()

    def seed_of(self, index: int) -> int | None:
        """See ``Engine.seed_of``."""
        return self._envs[index].np_random_seed

    @contextmanager
    def single(self, index: int) -> Iterator[FMUEnv]:
        """See ``Engine.single``."""
        yield self._envs[index]

    def read(self, name: str, index: int) -> Any:
        """See ``Engine.read``."""
        return attribute(self._envs[index], name)

    def call(
        self,
        name: str,
        indices: Sequence[int],
        arguments: Sequence[Any],
        keywords: Mapping[str, Any],
    ) -> list[Any]:
        """See ``Engine.call``."""
        values = [attribute(self._envs[index], name) for index in indices]
        return [v(*arguments, **keywords) if callable(v) else v for v in values]

    def evaluate(
        self, function: Callable[[Any], Sequence[Any]], actions: Any, indices: IndexArray
    ) -> FloatArray:
        """See ``Engine.evaluate``; the environments know their actions."""
        return np.array([function(self._envs[index]) for index in indices], np.float64).T

    def set_attribute(self, name: str, values: Mapping[int, Any]) -> None:
        """See ``Engine.set_attribute``; the values may be of any type."""
        for index, value in values.items():
            setattr(self._envs[index], name, value)

    def set_parameter(self, name: str, values: npt.NDArray[Any]) -> None:
        """See ``Engine.set_parameter``."""
        for index, env in enumerate(self._envs):
            env._interface = env._interface.with_parameter(name, values, index)
            env._plan = env._plan_episode({})

    def reset(
        self, mask: MaskArray, seeds: Sequence[int | None] | None, options: Mapping[str, Any]
    ) -> tuple[Any, dict[str, Any]]:
        """See ``Engine.reset``."""
        infos: dict[int, dict[str, Any]] = {}
        self.has_moved = False
        for index in np.flatnonzero(mask).tolist():
            seed = None if seeds is None else seeds[index]
            self._observations[index], infos[index] = self._reset(index, seed, options)
        self.note_starts(mask)
        return self._stacked(), gathered(infos, len(self._envs))

    def step(self, actions: Any, resetting: MaskArray | None) -> StepResult:
        """See ``Engine.step``."""
        self.has_moved = False
        items = self._actions(actions)
        idle = [False] * len(items) if resetting is None else resetting.tolist()
        try:
            if self._together:
                self._step_pool(items, idle, resetting)
            self.has_moved = True
            return self._results(items, idle)
        except BaseException:
            for env in self._envs:
                env._in_hooks = False
                env._ended = env._ended or self.has_moved  # its FMU has stepped without a result
            raise

    def _results(self, items: Sequence[Any], idle: Sequence[bool]) -> StepResult:
        infos: dict[int, dict[str, Any]] = {}
        rewards, terminated, truncated = [], [], []
        steps = self._told() if self._together else items
        for index, (env, action) in enumerate(zip(self._envs, items, strict=True)):
            if idle[index]:
                observation, info = self._reset(index, None, {})
                reward, ended, cut_off = 0.0, False, False
            else:
                result = self._stepped(index, env, action, steps[index])
                observation, reward, ended, cut_off, info = result
            self._observations[index] = observation
            rewards.append(reward)
            terminated.append(ended)
            truncated.append(cut_off or env.step_count >= self._limit)
            if info:
                infos[index] = info
        ends = np.array(terminated, np.bool_), np.array(truncated, np.bool_)
        self.note_ends(*ends)
        told = gathered(infos, len(items))
        return StepResult(self._stacked(), np.array(rewards, np.float64), *ends, told)

    def _told(self) -> list[tuple[Any, ...]]:
        """What the pool tells each environment after a step: status, outputs and observation.

        A single call for all takes less time than one for each, and less memory is touched.
        """
        pool = self._pool
        count = len(self._envs)
        shared = pool.observations.copy()
        rows: list[Any] = list(shared) if self._observes else [None] * count
        self._shared = shared, rows
        outputs = map(tuple, pool.outputs.T.tolist())
        return list(zip(pool.statuses.tolist(), outputs, rows, strict=True))

    def _reset(
        self, index: int, seed: int | None, options: Mapping[str, Any]
    ) -> tuple[Any, dict[str, Any]]:
        try:
            result = self._envs[index].reset(seed=seed, options=dict(options))
            self.has_moved = True
            return result
        except FMUGymError as error:
            raise _located(error, index) from error

    def _stepped(
        self, index: int, env: FMUEnv, action: Any, told: tuple[Any, ...]
    ) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        try:
            if not self._together:
                return env.step(action)
            env.step_count += 1
            result = env._conclude(self._columns[index], *told)
        except FMUGymError as error:
            raise _located(error, index) from error
        env._in_hooks = False
        if env.render_mode is not None:
            env._note_for_picture(result[1])
        return result

    def _step_pool(
        self, actions: Sequence[Any], idle: Sequence[bool], resetting: MaskArray | None
    ) -> None:
        """Step the FMUs whose episodes go on, after checking that all their actions are valid."""
        taken = []
        try:
            for index, env in enumerate(self._envs):
                if not idle[index]:
                    taken.append((env, env.previous_action, env.previous_state, env.inputs))
                    env._in_hooks = True
                    take = env._take_usable if self._checks_all else env._take_action
                    take(actions[index])
        except BaseException as error:
            for env, previous_action, previous_state, inputs in taken[:-1]:  # the last has done it
                env.action, env.inputs = env.previous_action, inputs
                env.previous_action, env.previous_state = previous_action, previous_state
            if isinstance(error, FMUGymError):
                raise _located(error, index) from error
            raise
        self._pool.step(None, resetting, self._pool.observations)

    def _actions(self, actions: Any) -> Sequence[Any]:
        """Copy the action of each environment, because hooks keep it."""
        space = self._envs[0].action_space
        if self._checks_all:
            return list(checked_actions(space, len(self._envs), actions))
        try:
            items = list(iterate(self._action_space, copy.deepcopy(actions)))
        except Exception:  # users' actions may raise anything
            raise ConfigError(
                f"the actions do not make one of {space} for each environment: {shown(actions)}"
            ) from None
        if len(items) != len(self._envs):
            raise ConfigError(f"there are {len(items)} actions, expected {len(self._envs)}")
        return items

    def columns(self, indices: IndexArray) -> Columns:
        """See ``Engine.columns``."""
        parts = [columns_of(self._envs[index]) for index in indices.tolist()]
        return stacked(parts) | {"ended": self.ended[indices]}

    def place(self, columns: Columns, sources: IndexArray, indices: IndexArray) -> None:
        """See ``Engine.place``."""
        for source, index in zip(sources.tolist(), indices.tolist(), strict=True):
            place_columns(self._envs[index], columns, source)
            self.ended[index] = columns["ended"][source]
        self.any_ended = bool(self.ended.any())

    def show_parameters(self, values: Mapping[str, FloatArray]) -> None:
        """See ``Engine.show_parameters``."""
        for index, env in enumerate(self._envs):
            own = {name: float(numbers[index]) for name, numbers in values.items()}
            env.parameters = MappingProxyType({**env.parameters, **own})

    def observe(self, indices: IndexArray) -> Any:
        """See ``Engine.observe``."""
        for index in indices.tolist():
            self._observations[index] = self._envs[index]._observation_and_info()[0]
        return self._stacked()

    def _with_others(self) -> npt.NDArray[np.float32] | None:
        """The pool's observations, with those of resets and faults; None if hooks make them."""
        shared, rows = self._shared
        for index, observation in enumerate(self._observations):
            if observation is not rows[index]:
                fits = type(observation) is np.ndarray and observation.dtype == shared.dtype
                if not self._observes or not fits or observation.shape != shared.shape[1:]:
                    return None
                shared[index] = observation
        return shared if self._observes else None

    def _stacked(self) -> Any:
        shared = self._with_others()
        if shared is not None:
            return shared.copy()
        empty: Any = create_empty_array(self._space, n=len(self._envs), fn=np.zeros)
        try:
            if isinstance(self._space, spaces.Box) and self._space.dtype.kind == "f":
                stacked = np.array(self._observations, empty.dtype)  # a fifth of the time
                if stacked.shape == empty.shape:
                    return stacked
            return concatenate(self._space, self._observations, empty)
        except Exception:  # users' observations may raise anything
            raise ConfigError(
                f"_get_observation returned {shown(self._observations[0])}, which is no element of "
                f"{self._space}"
            ) from None


def _located(error: FMUGymError, index: int) -> FMUGymError:
    return type(error)(f"environment {index}: {error}")
