"""N environments whose hooks run for one environment after another."""

from __future__ import annotations

import copy
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from itertools import repeat
from types import MappingProxyType
from typing import Any

import numpy as np
import numpy.typing as npt
from gymnasium.vector.utils import iterate

from fmugym.env import IN_POOL, FMUEnv
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
from fmugym.vector.stacking import ArrayStack, make_stack

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
        space, shared = envs[0].observation_space, pool.observations
        self._stack = stack = make_stack(space, len(envs))
        is_default = self._together and all(env._pool_observes for env in envs)
        fits = shared.dtype == space.dtype and shared.shape[1:] == space.shape
        observes = is_default and fits
        self._observed_by_pool = stack if isinstance(stack, ArrayStack) and observes else None
        self._observed = None if self._observed_by_pool is None else IN_POOL

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
            observation, infos[index] = self._reset(index, seed, options)
            self._stack.put(index, observation)
        self.note_starts(mask)
        return self._stack.copied(), gathered(infos, len(self._envs))

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
        told = self._told() if self._together else repeat((0, ()))
        if self._observed_by_pool is not None:
            self._observed_by_pool.put_all(self._pool.observations)
        each = zip(self._envs, items, told, strict=False)
        for index, (env, action, (status, outputs)) in enumerate(each):
            if idle[index]:
                observation, info = self._reset(index, None, {})
                reward, ended, cut_off = 0.0, False, False
            else:
                result = self._stepped(index, env, action, status, outputs)
                observation, reward, ended, cut_off, info = result
            if observation is not IN_POOL:
                self._stack.put(index, observation)
            rewards.append(reward)
            terminated.append(ended)
            truncated.append(cut_off or env.step_count >= self._limit)
            if info:
                infos[index] = info
        ends = np.array(terminated, np.bool_), np.array(truncated, np.bool_)
        self.note_ends(*ends)
        gained = np.array(rewards, np.float64)
        return StepResult(self._stack.copied(), gained, *ends, gathered(infos, len(items)))

    def _told(self) -> Iterator[tuple[int, tuple[float, ...]]]:
        """What the pool tells each environment after a step: the status and the outputs.

        One call for all takes less time than one for each, and less memory is touched.
        """
        outputs = map(tuple, self._pool.outputs.T.tolist())
        return zip(self._pool.statuses.tolist(), outputs, strict=True)

    def _reset(
        self, index: int, seed: int | None, options: Mapping[str, Any]
    ) -> tuple[Any, dict[str, Any]]:
        env = self._envs[index]
        is_first = not env._was_reset
        try:
            result = env.reset(seed=seed, options=dict(options))
            self.has_moved = True
            if is_first:  # a reset prepares the hooks
                _share_constants(self._envs[0], env)
            return result
        except FMUGymError as error:
            raise _located(error, index) from error

    def _stepped(
        self, index: int, env: FMUEnv, action: Any, status: int, outputs: tuple[float, ...]
    ) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        try:
            if not self._together:
                return env.step(action)
            env.step_count += 1
            result = env._conclude(self._columns[index], status, outputs, self._observed)
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
        taken, inputs = [], []
        try:
            for index, env in enumerate(self._envs):
                if not idle[index]:
                    env._in_hooks = True
                    if not self._checks_all:
                        env._require_usable(actions[index])
                    taken.append((env, env._take_usable(actions[index])))
                    inputs.append(env.inputs)
        except BaseException as error:
            for env, before in taken:
                env._give_up(before)
            if isinstance(error, FMUGymError):
                raise _located(error, index) from error
            raise
        if inputs:
            self._pool.inputs[:, ... if resetting is None else ~resetting] = np.transpose(inputs)
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
            self._stack.put(index, self._envs[index]._observation_and_info()[0])
        return self._stack.copied()


def _located(error: FMUGymError, index: int) -> FMUGymError:
    return type(error)(f"environment {index}: {error}")


def _share_constants(first: FMUEnv, env: FMUEnv) -> None:
    """Let an environment use the same objects as the first one, where they are equal.

    The objects of a thousand environments do not fit into the processor's caches.
    """
    env._is_finite, env._input_writer = first._is_finite, first._input_writer
    env.out.share_names(first.out)
    if env._own == first._own:
        env._own, env._observe, env._elements = first._own, first._observe, first._elements
