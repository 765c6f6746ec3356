"""Tasks of hooks: called once a step on the arrays of N environments, or for one after another."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from traceback import walk_tb
from typing import Any, Final, cast

import numpy as np
import numpy.typing as npt
from gymnasium.vector.utils import batch_space, concatenate, create_empty_array, iterate

from fmugym.environment.actions import checked_actions, is_array_space, take_action
from fmugym.environment.construction import draws_of_reset
from fmugym.environment.env import FMUEnv
from fmugym.environment.episode import environments_last
from fmugym.environment.forecasts import assumed, future_of
from fmugym.environment.hooks import ORDER, Hooks, call_hooks
from fmugym.environment.pictures import note_for_picture
from fmugym.environment.step_result import Result, conclude, first_observation
from fmugym.environment.vector import array_results
from fmugym.environment.vector.array_faults import settle_faults
from fmugym.environment.vector.array_results import infos_of_hooks, write_inputs_of_hooks
from fmugym.environment.vector.episodes import SeparateEpisodes
from fmugym.environment.vector.expression_task import Expressions
from fmugym.environment.vector.infos import gathered, mapped
from fmugym.environment.vector.task_programs import TaskPrograms
from fmugym.environment.vector.tasks import StepResult, VectorTask, failed_in
from fmugym.errors import ConfigError, FMUGymError, SimulationError, shown
from fmugym.pool.pool import FloatArray, MaskArray, Played, Pool
from fmugym.pool.states import IndexArray

__all__ = ["ArrayHooks", "EachHooks"]

_ON_ARRAYS: Final = (*ORDER, "_goal_reward")
"""The hooks that are called on arrays."""


class ArrayHooks(Expressions):
    """Task of hooks on arrays, called before the step of the FMUs and after it.

    Args:
        env: See ``Expressions``.
        limit: The steps after which an episode is truncated.
    """

    way = "arrays"

    def __init__(self, env: FMUEnv, limit: int) -> None:
        self._idle: MaskArray | None = None
        self._busy: MaskArray | None = None
        self._all = np.ones(env._instance.pool.num_instances, np.bool_)
        inputs = len(env.interface.inputs)
        super().__init__(env, TaskPrograms.without_programs(env.variables, inputs, limit))

    def _prepare(self, programs: TaskPrograms) -> None:
        super()._prepare(programs)
        self._are_hooks_tried = False

    # Episodes

    def _first_by_pool(
        self, seen: Sequence[Any], mask: MaskArray, troubled: int
    ) -> tuple[Any, dict[str, Any]]:
        """See ``Expressions._first_by_pool``."""
        is_there = self.env._conversions.pool_observes
        return self._first(self._layout.parts(seen)[0] if is_there else None, mask)

    def _first(self, observations: Any, mask: MaskArray) -> tuple[Any, dict[str, Any]]:
        """See ``Expressions._first``."""
        try:
            return super()._first(observations, mask)
        except Exception as error:
            self._blame_arrays(error)
            raise

    # Steps

    def step(self, actions: Any, may_restart: bool = False) -> StepResult:
        """See ``Expressions.step``; hooks tell which episodes end, so that none restarts."""
        play: Any = self._play
        fresh = self.episodes.ended.copy() if self.episodes.any_ended else None
        is_native = play.step is not None and self.offsets is None
        if not is_native or not (fresh is None or self._pool_starts):
            return self._compose(actions, fresh, None)
        taken = self._checked(actions, fresh)
        self.has_moved = True
        step = play.step if fresh is None else play.start_and_step
        return self._completed(step(taken, False), fresh)

    def _checked(self, actions: Any, idle: MaskArray | None) -> npt.NDArray[Any]:
        """See ``Expressions._checked``; the hook makes the inputs.

        If the hook fails, nothing has changed.
        """
        taken = np.array(super()._checked(actions, idle))  # of which a hook may keep a part
        read = self.env._episode
        before, read.action = read.keep(), environments_last(taken)
        try:
            write_inputs_of_hooks(self.env, self.episodes.arrays.given, idle)
            self._keep_variables()
            return taken
        except Exception as error:
            self._blame_arrays(error)
            raise
        finally:
            read.take_back(before)  # the pool does the same with its arrays

    def _completed(self, played: Played, idle: MaskArray | None) -> StepResult:
        """See ``Expressions._completed``; the hooks that follow the FMUs' step are called."""
        env, conversions = self.env, self.env._conversions
        troubled, _, _, terminated, truncated, seen, starts = played
        infos: dict[str, Any] = {}
        started = idle
        if starts is not None:
            started, drawn, last = starts
            self._tell_starts(infos, started, drawn, last)
        self._idle = started
        if troubled:
            failed = failed_in(self._pool.statuses)
            self._idle = failed if started is None else failed | started
        self._busy = None if self._idle is None else ~self._idle
        made = seen[0] if conversions.pool_observes else None
        try:
            stopped = terminated if troubled else False
            observed, rewards, terminated, truncated = call_hooks(
                env, self, stopped, truncated, made
            )
            if made is None:
                observed = array_results.observations(observed, env.observation_space, self._n)
            if conversions.has_info:
                infos = infos_of_hooks(env, self._all) | infos
            self._keep_variables()
            self._are_hooks_tried = True
        except Exception as error:
            self._blame_arrays(error)
            raise
        if started is not None:  # a third of the time of assignments with a mask
            running = self._busy if self._idle is started else ~started
            terminated &= running
            truncated &= running
            np.copyto(rewards, 0.0, where=started)
        self.episodes.arrays.keep_done(terminated)
        self.episodes.note_ends(terminated, truncated)
        result = observed, rewards, terminated, truncated, infos
        settle_faults(self.episodes, result, troubled, started)
        return result

    def _blame_arrays(self, error: Exception) -> None:
        """Say which hook has not worked on arrays, until all have done so in a first step.

        Raises:
            ConfigError: If a hook has raised the error, or returned what cannot be used.
        """
        codes = [getattr(getattr(self.env, name), "__code__", None) for name in _ON_ARRAYS]
        frames = [frame.f_code for frame, _ in walk_tb(error.__traceback__)]
        named = zip(_ON_ARRAYS, codes, strict=True)
        hook = next((name for name, code in named if code in frames), None)
        if isinstance(error, ConfigError):
            hook = next((name for name in _ON_ARRAYS if str(error).startswith(f"{name} ")), None)
        if hook is None or self._are_hooks_tried or isinstance(error, SimulationError):
            return
        what = error if isinstance(error, ConfigError) else f"{type(error).__name__}: {error}"
        raise ConfigError(
            f"{hook} of {type(self.env).__name__}, whose hooks are said to be vectorized, does "
            f"not work on the arrays of {self._n} environments: {what}. "
            "fmugym.environment.env_checker.check_hooks shows what is wrong"
        ) from error

    # The form of what hooks return.

    flag_type: type | None = None
    reward_type: type | None = None

    def flags(self, hook: str, value: Any) -> MaskArray:
        """See ``Form.flags``; nothing is done where the FMU has not stepped."""
        found = array_results.flags(hook, value, self._n)
        if self._busy is not None and hook == "_is_done":
            found &= self._busy
        return found

    def rewards(self, value: Any) -> FloatArray:
        """See ``Form.rewards``."""
        return array_results.rewards(value, self._n)

    def update(self, env: Hooks) -> None:
        """Call the hook, but keep the variables of environments that did not step."""
        env._update()
        self._keep_variables()
        if self._idle is not None and self._idle.any():
            self.episodes.restore_variables(self._idle)

    def _keep_variables(self) -> None:
        """Copy assigned variables to the arrays that the pool keeps, or make others."""
        variables, held = self.env.variables, self.episodes.arrays.variables
        if not held:
            return
        assigned = [name for name, row in held.items() if variables[name] is not row]
        if not assigned:
            return
        others: dict[str, np.dtype[Any]] = {}
        values = [self._value_of(name, variables[name], len(assigned)) for name in assigned]
        for name, value in zip(assigned, values, strict=True):
            row = held[name]
            if value.dtype == row.dtype and value.shape == row.shape:
                np.copyto(row, value)
                dict.__setitem__(variables, name, row)  # it needs no check
            else:
                variables[name], others[name] = value, value.dtype
        if others:
            before = dict(self.episodes.arrays.before)
            self._prepare(replace(self._programs, variables={**self._programs.variables, **others}))
            self.episodes.arrays.take_back(before)

    def _value_of(self, name: str, value: Any, count: int) -> npt.NDArray[Any]:
        """A value of a variable in the type that it is kept in.

        If more than one are assigned, it is an array that the others do not write.
        """
        row = self.episodes.arrays.variables[name]
        if type(value) is np.ndarray and value.dtype == row.dtype and value.shape == row.shape:
            is_apart = count == 1 or (value.base is None and not self._holds(value))
            return value if is_apart else value.copy()
        array = array_results.variable(name, value, self._n)
        if array.dtype == np.float64:
            return array
        dtype = array_results.type_of_variable(self.env.episode_start, name, array.dtype)
        return array.astype(dtype, copy=False)

    def _holds(self, value: npt.NDArray[Any]) -> bool:
        return any(value is row for row in self.episodes.arrays.variables.values())


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

    def _compose(
        self, actions: Any, fresh: MaskArray | None, resting: MaskArray | None
    ) -> StepResult:
        """See ``VectorTask._compose``."""
        self.has_moved = False
        try:
            return super()._compose(actions, fresh, resting)
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
        """The action of each environment."""
        space = self.episodes.envs[0].action_space
        if self._checks_all:
            return cast(Sequence[Any], checked_actions(space, len(self.episodes.envs), actions))
        try:
            items = list(iterate(self._action_space, actions))
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
