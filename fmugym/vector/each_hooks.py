"""Task of hooks that are called for one environment after another."""

from __future__ import annotations

import copy
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, cast

import numpy as np
from gymnasium.vector.utils import batch_space, concatenate, create_empty_array, iterate

from fmugym.env import FMUEnv
from fmugym.errors import ConfigError, FMUGymError, shown
from fmugym.pool.base import FloatArray, MaskArray, Pool
from fmugym.pool.bundle import IndexArray
from fmugym.task.actions import take_action
from fmugym.task.conclusion import conclude, first_observation
from fmugym.task.construction import draws_of_reset
from fmugym.task.faults import Result
from fmugym.task.future import assumed, future_of
from fmugym.task.pictures import note_for_picture
from fmugym.vector.action_arrays import checked_actions, is_array_space
from fmugym.vector.info_arrays import gathered, mapped
from fmugym.vector.separate_episodes import SeparateEpisodes
from fmugym.vector.tasks import StepResult, VectorTask

__all__ = ["EachHooks"]


class EachHooks(VectorTask):
    """Task whose hooks are called one by one. The FMUs still step together on all threads.

    Args:
        envs: The environments.
        pool: Their pool of N instances.
        max_episode_steps: Truncates episodes, in addition to the config's own limit.
    """

    way = "one by one"
    episodes: SeparateEpisodes

    def __init__(self, envs: Sequence[FMUEnv], pool: Pool, max_episode_steps: int | None) -> None:
        super().__init__(SeparateEpisodes(envs, pool))
        self._observed = pool.observations
        self._checks_all = is_array_space(envs[0].action_space)
        self._limit = max_episode_steps or sys.maxsize
        self._action_space = batch_space(envs[0].action_space, len(envs))
        self._observations: list[Any] = [None] * len(envs)

    # Episodes

    def reset(
        self,
        mask: MaskArray,
        seeds: Sequence[int | None] | None = None,
        options: Mapping[str, Any] = {},
    ) -> tuple[Any, dict[str, Any]]:
        """See ``VectorTask.reset``."""
        infos: dict[int, dict[str, Any]] = {}
        self.has_moved = False
        draws_of_reset(self.episodes.envs[0], options, "reset_mask")  # it refuses unknown options
        for index in np.flatnonzero(mask).tolist():
            seed = None if seeds is None else seeds[index]
            observation, infos[index] = self._reset(index, seed, options)
            self._observations[index] = _copied(observation)
        self.episodes.note_starts(mask)
        return self._joined(), gathered(infos, len(self.episodes.envs))

    def _reset(
        self, index: int, seed: int | None, options: Mapping[str, Any]
    ) -> tuple[Any, dict[str, Any]]:
        env = self.episodes.envs[index]
        is_first = not env._was_reset
        try:
            self.has_moved = True  # what can be refused was checked before
            result = env.reset(seed=seed, options=dict(options))
            if is_first:  # a reset prepares the hooks
                _share_constants(self.episodes.envs[0], env)
            return result
        except FMUGymError as error:
            raise _located(error, index) from error

    @contextmanager
    def assuming(
        self, tables: Mapping[str, FloatArray], offsets: FloatArray | None
    ) -> Iterator[None]:
        """See ``VectorTask.assuming``."""
        self.offsets = offsets
        try:
            with assumed(map(future_of, self.episodes.envs), tables):
                yield
        finally:
            self.offsets = None

    def observe(self, indices: IndexArray) -> Any:
        """See ``VectorTask.observe``."""
        for index in indices.tolist():
            self._observations[index] = _copied(first_observation(self.episodes.envs[index])[0])
        return self._joined()

    # Steps

    def step(
        self, actions: Any, *, restart: bool = False, resting: MaskArray | None = None
    ) -> StepResult:
        """See ``VectorTask.step``."""
        self.has_moved = False
        try:
            return super().step(actions, restart=restart, resting=resting)
        except BaseException:
            for env in self.episodes.envs:
                if self.has_moved:  # its FMU has stepped without a result
                    env._ended = True
            raise

    def _take_actions(self, actions: Any, idle: MaskArray | None) -> None:
        """See ``VectorTask._take_actions``; if an action cannot be used, none has taken any."""
        actions, idles = (
            self._actions(actions),
            np.zeros(len(self.episodes.envs)) if idle is None else idle,
        )
        running = np.flatnonzero(np.logical_not(idles)).tolist()
        befores: list[tuple[FMUEnv, Any]] = []
        given, index = self._pool.inputs.copy(), 0
        try:
            for index in running:
                env = self.episodes.envs[index]
                befores.append((env, take_action(env, actions[index])))
        except BaseException as error:
            for env, before in befores:
                env._episode.take_back(before)
            self._pool.inputs[...] = given
            if isinstance(error, FMUGymError):
                raise _located(error, index) from error
            raise

    def _actions(self, actions: Any) -> Sequence[Any]:
        """Copy the action of each environment, because hooks keep it."""
        space = self.episodes.envs[0].action_space
        if self._checks_all:
            return cast(Sequence[Any], checked_actions(space, len(self.episodes.envs), actions))
        try:
            items = list(iterate(self._action_space, copy.deepcopy(actions)))
        except Exception:  # users' actions may raise anything
            raise ConfigError(
                f"the actions do not make one of {space} for each environment: {shown(actions)}"
            ) from None
        if len(items) != len(self.episodes.envs):
            raise ConfigError(f"there are {len(items)} actions, expected {len(self.episodes.envs)}")
        return items

    def _add_offsets(self, idle: MaskArray | None = None) -> None:
        """See ``VectorTask._add_offsets``; the pool has made observations without them."""
        super()._add_offsets(idle)
        if self.offsets is not None:
            observed = self._pool.observations
            observed[:] = self._pool.outputs[: observed.shape[1]].T

    def _start(self, mask: MaskArray) -> dict[int, dict[str, Any]]:
        """See ``VectorTask._start``; returns the infos by the number of the environment."""
        infos = {}
        for index in np.flatnonzero(mask).tolist():
            observation, infos[index] = self._reset(index, None, {})
            self._observations[index] = _copied(observation)
        return infos

    def _conclude(self, taken: Any, idle: MaskArray | None, started: Any) -> StepResult:
        """See ``VectorTask._conclude``; the environments conclude the step one after another."""
        results: list[Result] = []
        statuses, columns = self._pool.statuses.tolist(), self._pool.outputs.T.tolist()
        idles, infos = [False] * len(columns) if idle is None else idle.tolist(), started or {}
        index = 0
        try:
            for index, (env, is_idle) in enumerate(zip(self.episodes.envs, idles, strict=True)):
                if is_idle:
                    observation = self._observations[index]
                    results.append((observation, 0.0, False, False, infos.get(index, {})))
                    continue
                result = _concluded(env, statuses[index], tuple(columns[index]))
                is_new = env._conversions.pool_observes
                self._observations[index] = result[0] if is_new else _copied(result[0])
                results.append(result)
        except FMUGymError as error:
            raise _located(error, index) from error
        return self._result(results, idle)

    def _result(self, results: Sequence[Result], idle: MaskArray | None) -> StepResult:
        _, rewards, terminated, cut_off, infos = zip(*results, strict=True)
        truncated = np.array(cut_off, np.bool_)
        counts = [env._episode.step_count for env in self.episodes.envs]
        truncated |= np.array(counts) >= self._limit
        truncated &= True if idle is None else ~idle
        ends = np.array(terminated, np.bool_)
        self.episodes.note_ends(ends, truncated)
        told = gathered({i: info for i, info in enumerate(infos) if info}, len(infos))
        return self._joined(), np.array(rewards, np.float64), ends, truncated, told

    def _joined(self) -> Any:
        """The observations of all in new arrays."""
        space, count = self.episodes.envs[0].observation_space, len(self.episodes.envs)
        try:
            if type(self._observations[0]) is np.ndarray:
                joined = np.array(self._observations)
                if joined.dtype == space.dtype and joined.shape[1:] == space.shape:
                    return joined  # a quarter of the instructions of what follows
            empty: Any = create_empty_array(space, n=count, fn=np.zeros)
            return concatenate(space, self._observations, empty)
        except Exception:  # users' observations may raise anything
            raise _misfit(space, self._observations) from None


def _concluded(env: FMUEnv, status: int, values: tuple[float, ...]) -> Result:
    """The result of a step that its FMU has done."""
    env._episode.step_count += 1
    result = conclude(env, status, values)
    if env.render_mode is not None:
        note_for_picture(env, result[1])
    return result


def _copied(observation: Any) -> Any:
    """Copy the arrays of an observation, whose memory may serve the next hook."""
    return mapped(lambda part: part.copy() if type(part) is np.ndarray else part, observation)


def _misfit(space: Any, observations: Sequence[Any]) -> ConfigError:
    """The error of the first observation that is no element of the space."""
    found = next((one for one in observations if not _fits(space, one)), observations[0])
    return ConfigError(f"_get_observation returned {shown(found)}, which is no element of {space}")


def _fits(space: Any, observation: Any) -> bool:
    try:
        empty: Any = create_empty_array(space, n=1, fn=np.zeros)
        concatenate(space, [observation], empty)
    except Exception:  # as above
        return False
    return True


def _located(error: FMUGymError, index: int) -> FMUGymError:
    return type(error)(f"environment {index}: {error}")


def _share_constants(first: FMUEnv, env: FMUEnv) -> None:
    """Let an environment use the same objects as the first one, where they are equal.

    The objects of a thousand environments do not fit into the processor's caches.
    """
    env._conversions.is_finite, env._conversions.input_writer = (
        first._conversions.is_finite,
        first._conversions.input_writer,
    )
    env.out.share_names(first.out)
    if env._own_hooks == first._own_hooks:
        env._own_hooks, env._conversions.observe, env._conversions.elements = (
            first._own_hooks,
            first._conversions.observe,
            first._conversions.elements,
        )
