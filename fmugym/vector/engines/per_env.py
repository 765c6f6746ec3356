"""N environments whose hooks run for one environment after another."""

from __future__ import annotations

import copy
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from itertools import compress
from math import isfinite
from operator import not_
from types import MappingProxyType
from typing import Any, cast

import numpy as np
import numpy.typing as npt
from gymnasium.vector.utils import iterate

from fmugym.env import FMUEnv
from fmugym.errors import ConfigError, FMUGymError, shown
from fmugym.pool.base import FloatArray, MaskArray, Pool
from fmugym.pool.bundle import IndexArray
from fmugym.signals import ordinary
from fmugym.task.actions import blame, require_usable
from fmugym.task.construction import plan_of, prepare_hooks
from fmugym.task.judging import (
    IN_POOL,
    Result,
    fault_of_hooks,
    first_observation,
    info_of,
    judged,
)
from fmugym.task.pictures import note_for_picture
from fmugym.task.saving import columns_of, place_columns
from fmugym.task.snapshot import Columns, stacked
from fmugym.task.step import conclude
from fmugym.vector.actions import checked_actions, is_array_space
from fmugym.vector.calls import attribute
from fmugym.vector.codec import gathered
from fmugym.vector.column import PoolColumn
from fmugym.vector.engines.base import Engine, StepResult
from fmugym.vector.engines.outcomes import Outcomes, Unconverted
from fmugym.vector.engines.taken import Taken, in_time
from fmugym.vector.stacking import PoolStack, Stack, make_stack

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

    way = "per_env"

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
            env.inside.use(column)
            prepare_hooks(env)  # its constructor may have set some as attributes
        self._together = not any(env.inside.own.step for env in envs)
        self._checks_all = self._together and is_array_space(envs[0].action_space)
        self._limit = max_episode_steps or sys.maxsize
        self._action_space = action_space
        self._stack = stack = self._make_stack()
        self._observed = IN_POOL if isinstance(stack, PoolStack) else None
        self._take = stack.take
        self._form = Unconverted()
        self._acts_directly: bool | None = None

    def _make_stack(self) -> Stack | PoolStack:
        space, shared = self._envs[0].observation_space, self._pool.observations
        is_default = self._together and all(env.inside.pool_observes for env in self._envs)
        fits = shared.dtype == space.dtype and shared.shape[1:] == space.shape
        return PoolStack(shared) if is_default and fits else make_stack(space, len(self._envs))

    def _are_direct(self) -> bool:
        """Whether the actions are the inputs of all, so that no hook has to be asked for them."""
        if self._acts_directly is None:
            self._acts_directly = self._checks_all and all(
                env.inside.action_values is None and "_get_inputs" not in vars(env)
                for env in self._envs
            )
        return self._acts_directly and type(self._envs[0])._get_inputs is FMUEnv._get_inputs

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
        self._acts_directly = None  # a method may replace a hook
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
            env.inside.interface = env.inside.interface.with_parameter(name, values, index)
            env.inside.plan = plan_of(env)

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
        self._acts_directly = None  # a reset may have replaced hooks
        self.note_starts(mask)
        return self._stack.joined(), gathered(infos, len(self._envs))

    def step(self, actions: Any, resetting: MaskArray | None) -> StepResult:
        """See ``Engine.step``."""
        self.has_moved = False
        items = self._actions(actions)
        idle = [False] * len(items) if resetting is None else resetting.tolist()
        try:
            running = [*compress(range(len(idle)), map(not_, idle))]
            taken = self._step_pool(items, running, resetting) if self._together else None
            self.has_moved = True
            return self._results(items, idle, running, taken)
        except BaseException:
            for env in self._envs:
                env.inside.in_hooks = False
                if self.has_moved:  # its FMU has stepped without a result
                    env.inside.ended = True
            raise

    def _results(
        self, items: Sequence[Any], idle: Sequence[bool], running: list[int], taken: Taken | None
    ) -> StepResult:
        outcomes = Outcomes(len(self._envs))
        if isinstance(self._stack, PoolStack):
            self._stack.refresh()
        for index in compress(range(len(idle)), idle):
            observation, info = self._reset(index, None, {})
            self._note(outcomes, index, (observation, 0.0, False, False, info))
        if taken is None:
            self._step_each(outcomes, items, running)
        else:
            self._conclude(outcomes, taken)
        rewards, terminated, truncated = outcomes.arrays()
        self.note_ends(terminated, truncated)
        infos = gathered(outcomes.sorted_infos(), len(self._envs))
        return StepResult(self._stack.joined(), rewards, terminated, truncated, infos)

    def _step_each(self, outcomes: Outcomes, items: Sequence[Any], running: list[int]) -> None:
        """Call the steps of environments that have their own."""
        for index in running:
            try:
                result = self._envs[index].step(items[index])
            except FMUGymError as error:
                raise _located(error, index) from error
            self._note(outcomes, index, result)

    def _note(self, outcomes: Outcomes, index: int, result: Result) -> None:
        """Note the result of a step of one environment, whose numbers are checked."""
        observation, reward, ended, cut_off, info = result
        if observation is not IN_POOL:
            self._stack.put(index, observation)
        outcomes.note(index, reward, ended, cut_off, info)
        if self._envs[index].step_count >= self._limit:
            outcomes.truncated[index] = True

    def _conclude(self, outcomes: Outcomes, taken: Taken) -> None:
        """Ask the hooks of the environments whose FMUs have stepped for the results.

        Most numbers are checked when all are there, which takes much less time.
        """
        status_of, outputs = self._pool.statuses.tolist(), self._pool.outputs
        envs, indices, actions = self._envs, taken.indices, taken.actions
        told = in_time(outputs if taken.skipped is None else outputs[:, ~taken.skipped])
        index = 0
        try:
            for index, inputs, values in zip(indices, in_time(taken.rows.T), told, strict=True):
                env = envs[index]
                read = env.inside.readings
                if actions is not None:
                    env.inside.in_hooks = True
                    read.previous_action, read.previous_state = read.action, read.state
                    read.action = actions[index]
                read.inputs = inputs
                read.step_count += 1
                if status_of[index] or env.render_mode is not None:
                    self._conclude_fully(outcomes, index, status_of[index], values)
                else:
                    self._judge(outcomes, index, env, values)
                env.inside.in_hooks = False
            for index in outcomes.faulty(self._stack.finite()):
                self._fault(outcomes, index)
        except FMUGymError as error:
            raise _located(error, index) from error

    def _judge(
        self, outcomes: Outcomes, index: int, env: FMUEnv, values: tuple[float, ...]
    ) -> None:
        """Do what ``judged`` does, but leave numbers unchecked where no info follows."""
        read = env.inside.readings
        outcomes.values[index] = read.values
        if env.inside.own.update:
            outcomes.variables[index] = read.variables.copy()
        read.values = values
        read.state = values if env.inside.no_monitors else values[: env.inside.output_count]
        observed = self._observed
        if observed is None and env.inside.pool_observes:
            observed = env.inside.observation_row.copy()
        steps = read.step_count
        observation, reward, ended, cut_off = conclude(
            env, self._form, False, steps >= env.inside.step_limit, observed
        )
        if env.inside.has_info and _are_finite(env, reward, observation):
            outcomes.infos[index] = info_of(env)
        if observation is not IN_POOL and not self._take(index, observation):
            if env.inside.is_finite(observation):
                self._stack.put(index, observation)
            else:
                outcomes.misfits[index] = observation
        outcomes.rewards[index] = reward
        if ended or cut_off:
            env.inside.ended = True
            outcomes.terminated[index], outcomes.truncated[index] = ended, cut_off
        if steps >= self._limit:
            outcomes.truncated[index] = True

    def _conclude_fully(
        self, outcomes: Outcomes, index: int, status: int, values: tuple[float, ...]
    ) -> None:
        """Let an environment conclude alone: it has pictures, or its FMU a status."""
        env = self._envs[index]
        result = judged(env, status, values, self._observed)
        self._note(outcomes, index, result)
        env.inside.in_hooks = False
        if env.render_mode is not None:
            note_for_picture(env, result[1])

    def _fault(self, outcomes: Outcomes, index: int) -> None:
        """End an episode because of a number that is not finite."""
        env, reward = self._envs[index], float(outcomes.rewards[index])
        observation = outcomes.misfits.get(index)
        if observation is None:
            observation = self._stack.row(index)
        before = outcomes.values[index], outcomes.variables[index]
        env.inside.in_hooks = True
        self._note(outcomes, index, fault_of_hooks(env, reward, observation, before))
        env.inside.in_hooks = False

    def _reset(
        self, index: int, seed: int | None, options: Mapping[str, Any]
    ) -> tuple[Any, dict[str, Any]]:
        env = self._envs[index]
        is_first = not env.inside.was_reset
        try:
            result = env.reset(seed=seed, options=dict(options))
            self.has_moved = True
            if is_first:  # a reset prepares the hooks
                _share_constants(self._envs[0], env)
            return result
        except FMUGymError as error:
            raise _located(error, index) from error

    def _step_pool(
        self, actions: Sequence[Any], running: list[int], resetting: MaskArray | None
    ) -> Taken:
        """Step the FMUs whose episodes go on, after checking that all their actions are valid."""
        rows = self._direct_inputs(actions, running) if self._are_direct() else None
        taken = None if rows is None else Taken(running, resetting, rows, actions)
        if taken is None:
            taken = Taken(running, resetting, self._take_actions(actions, running), None)
        self._pool.inputs[:, ... if resetting is None else ~resetting] = taken.rows.T
        self._pool.step(None, resetting, self._pool.observations)
        return taken

    def _direct_inputs(self, actions: Sequence[Any], running: list[int]) -> FloatArray | None:
        """Inputs that are the actions, shape (M, k); None if the environments must be asked.

        The environments learn of their actions when they conclude.
        """
        return self._envs[0].inside.input_writer.of_actions(np.asarray(actions)[running])

    def _take_actions(self, actions: Sequence[Any], running: list[int]) -> FloatArray:
        """Ask environments for their inputs, shape (M, k)."""
        writer, parts, index = self._envs[0].inside.input_writer, [], 0
        befores: list[tuple[Any, Any, Any, Any]] = []
        try:
            for index in running:
                env, action = self._envs[index], actions[index]
                env.inside.in_hooks = True
                if not self._checks_all:
                    require_usable(env, action)
                read = env.inside.readings
                state, before = read.state, read.action
                befores.append((before, read.previous_action, read.previous_state, read.inputs))
                read.previous_action, read.previous_state, read.action = before, state, action
                parts.append(writer.packed(env._get_inputs(), action))
            rows = writer.unpacked(parts)
            finite = np.isfinite(rows)
            if not finite.all():
                place = int(finite.all(axis=1).argmin())
                index = running[place]
                writer.checked(rows[place], actions[index])
            return rows
        except BaseException as error:
            for place, taken in zip(running, befores, strict=False):
                self._envs[place].inside.readings.take_back(taken)
            blaming = blame(self._envs[index], actions[index], error) or error
            if isinstance(blaming, FMUGymError):
                raise _located(blaming, index) from error
            raise

    def _actions(self, actions: Any) -> Sequence[Any]:
        """Copy the action of each environment, because hooks keep it."""
        space = self._envs[0].action_space
        if self._checks_all:
            return cast(Sequence[Any], checked_actions(space, len(self._envs), actions))
        try:
            items = list(iterate(self._action_space, copy.deepcopy(actions)))
        except ordinary(Exception):  # users' actions may raise anything
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
            self._stack.put(index, first_observation(self._envs[index])[0])
        return self._stack.joined()


def _are_finite(env: FMUEnv, reward: Any, observation: Any) -> bool:
    """Whether the numbers of a step are finite, so that no fault follows."""
    if observation is IN_POOL:
        observation = env.inside.observation_row
    return isfinite(reward) and env.inside.is_finite(observation)


def _located(error: FMUGymError, index: int) -> FMUGymError:
    return type(error)(f"environment {index}: {error}")


def _share_constants(first: FMUEnv, env: FMUEnv) -> None:
    """Let an environment use the same objects as the first one, where they are equal.

    The objects of a thousand environments do not fit into the processor's caches.
    """
    env.inside.is_finite, env.inside.input_writer = (
        first.inside.is_finite,
        first.inside.input_writer,
    )
    env.out.share_names(first.out)
    if env.inside.own == first.inside.own:
        env.inside.own, env.inside.observe, env.inside.elements = (
            first.inside.own,
            first.inside.observe,
            first.inside.elements,
        )
