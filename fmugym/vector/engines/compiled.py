"""N environments whose hooks run as programs inside the native pool's step."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt

from fmugym.env import FMUEnv
from fmugym.pool.base import FloatArray, MaskArray
from fmugym.pool.extension import require_refusal
from fmugym.signals import ordinary
from fmugym.task import spaces as fmu_spaces
from fmugym.task.readings import Readings
from fmugym.vector.actions import checked_actions
from fmugym.vector.engines.base import StepResult
from fmugym.vector.engines.batch import BatchEngine
from fmugym.vector.engines.layout import Layout
from fmugym.vector.engines.memory import Memory
from fmugym.vector.engines.programs import compile_hooks
from fmugym.vector.hooks import results
from fmugym.vector.hooks.trace import TracedTask
from fmugym.vector.infos import drawn_info, not_finite, restricted
from fmugym.vector.streams import given_draws

__all__ = ["CompiledEngine"]

logger = logging.getLogger(__name__)

_BOOL = np.dtype(np.bool_)

_REFUSALS = (TypeError, ValueError, BufferError)
"""What the pool raises if it does not take the arguments of a step."""


class CompiledEngine(BatchEngine):
    """A ``BatchEngine`` in which the native pool does whole steps, hooks included.

    ``BatchEngine`` does resets and steps, on the same arrays, in two cases: while parameters of a
    running episode are overridden or were set since it began, and if the hooks can no longer be
    compiled after an attribute was set.

    Args:
        env: The prototype, made with a native pool of N instances.
        num_envs: N.
        max_episode_steps: Truncates episodes, in addition to the config's own limit.
        task: From ``find_programs``.
    """

    def __init__(
        self, env: FMUEnv, num_envs: int, max_episode_steps: int | None, task: TracedTask
    ) -> None:
        super().__init__(env, num_envs, max_episode_steps)
        self._memory = Memory(env, env.inside.readings, self.ended, self._columns)
        self._prepare(task)

    def _prepare(self, task: TracedTask | None) -> None:
        """Give the pool everything it needs for a step, if there are programs."""
        plan, streams = self.env.inside.plan, self._streams
        self._task = task
        self._prepared = self._resets_at_once = self._is_whole = False
        if task is None:
            return
        self._left = task.left
        self._drawn_shape = len(plan.draws), self._n
        draws = streams.native_draws(plan)
        self._draws_ahead = draws is None
        in_pass = not self._draws_ahead and self.env.inside.warm_ups is None
        in_pass = in_pass and self._pool.plays_alone
        self._starts_in_pass = in_pass and task.left.keys() <= {"_get_inputs"}
        self._resets_apart = self._pool.is_attended or self.env.inside.warm_ups is not None
        self._resets_apart = self._resets_apart or not self._pool.plays_alone
        memory = self._memory
        memory.parameters = self._parameters
        memory.hold(task)
        layout = Layout(task, self.env, self._n)
        self._new_arrays, self._divided = layout.new_arrays, layout.divided
        self._is_whole = not task.left
        self._resets_at_once = not (self._resets_apart or self._draws_ahead)
        flags, real = ((self._n,), _BOOL), np.dtype(np.float64)
        arrays = *layout.shapes, ((self._n,), real), flags, flags, flags, (self._drawn_shape, real)
        tell = partial(drawn_info, plan)
        self._play = self._pool.prepare_play(
            plan.model_variables,
            memory.programs(task),
            memory.action_group(),
            self._start_values,
            (given_draws(plan) if draws is None else draws, streams.states),
            (self.env.step_count, self.ended, self._limit),
            memory.surroundings(task, (StepResult, *layout.form, arrays, tell)),
        )
        self._play_with_resets = self._pool.watched(self._play)
        if not self._resets_apart:
            self._start = self._pool.start_of_play()
            self._reset_by = self._pool.reset_of_play()
        self._prepared = True
        self._not_drawn = np.empty(self._drawn_shape)

    def set_parameter(self, name: str, values: npt.NDArray[Any]) -> None:
        """See ``Engine.set_parameter``."""
        super().set_parameter(name, values)
        self._prepare(self._task)

    def _assign(self, attributes: Mapping[str, tuple[Any, bool]]) -> None:
        """Compile the hooks anew, because the programs contain the old values of the attributes."""
        super()._assign(attributes)
        task: TracedTask | None = None
        try:
            task = compile_hooks(self.env, [Readings.of(self.env)], self._columns)
        except ordinary(Exception) as reason:  # as in find_programs
            logger.info("the hooks cannot be compiled any more: %s", reason)
        finally:
            self._prepare(task)

    def reset(
        self, mask: MaskArray, seeds: Sequence[int | None] | None, options: Mapping[str, Any]
    ) -> tuple[Any, dict[str, Any]]:
        """See ``Engine.reset``."""
        if options or not self._prepared or self._any_foreign or self._resets_apart:
            return super().reset(mask, seeds, options)
        self.has_moved = False
        if seeds is not None:
            self._streams.seed(seeds, np.flatnonzero(mask))
        self._streams.require_seeds()
        seen = self._new_arrays()
        drawn = self._draw_ahead(mask) if self._draws_ahead else np.empty(self._drawn_shape)
        self.has_moved = True
        troubled, self.any_ended = self._start(mask, seen, drawn)
        infos = drawn_info(self.env.inside.plan, drawn, mask)
        if self._divided is not None:
            seen, told = self._divided(seen)
            infos = restricted(told, mask) | infos
        return self._started(seen, infos, mask, troubled)

    def reset_by(self, options: Any) -> tuple[Any, dict[str, Any]] | None:
        """See ``Engine.reset_by``."""
        if not self._resets_at_once or self._any_foreign:
            return None
        try:
            done = self._reset_by(options)
        except BaseException:
            self.has_moved = True
            raise
        if done is None:
            return None
        result, troubled, self.any_ended = done
        if self._is_whole and not troubled:
            return result
        return self._started(*result, result[1]["_drawn"], troubled)

    def _started(
        self, observations: Any, infos: dict[str, Any], mask: MaskArray, troubled: int
    ) -> tuple[Any, dict[str, Any]]:
        """Call the hooks that are not compiled after a reset, and refuse impossible starts."""
        if troubled:
            self._require_started(np.flatnonzero(mask), self._pool.statuses)
        if self._left:
            observations, infos = self._seen_by_hooks_left(observations, infos, mask)
        if troubled or self._left:
            self._require_finite_start(observations, mask)
        return observations, infos

    def _draw_ahead(self, mask: MaskArray) -> FloatArray:
        """Make the array of drawn values; those that only Python can draw are in it."""
        drawn = np.empty(self._drawn_shape)
        if self._draws_ahead:
            drawn[:, mask] = self._streams.draw(self.env.inside.plan, np.flatnonzero(mask))
        return drawn

    def call(
        self,
        name: str,
        indices: Sequence[int],
        arguments: Sequence[Any],
        keywords: Mapping[str, Any],
    ) -> list[Any]:
        """See ``Engine.call``."""
        returned = super().call(name, indices, arguments, keywords)
        if self._prepared:
            self._memory.take_over()
        return returned

    def step(self, actions: Any, resetting: MaskArray | None) -> StepResult:
        """See ``Engine.step``."""
        if resetting is not None or not self._is_whole or self._any_foreign:
            return self._step_in_parts(actions, resetting)
        result: StepResult
        starts = self.starts_at_ends and self._starts_in_pass
        play = self._play_with_resets if starts else self._play
        self.has_moved = True  # unless the call refuses its arguments
        try:
            result, troubled, self.any_ended, started = play(
                actions, None if starts else self._not_drawn
            )
        except _REFUSALS as error:
            return self.step(self._converted(actions, error), None)
        if troubled:
            return self._completed(result, troubled, None, started)
        return result

    def _step_in_parts(self, actions: Any, resetting: MaskArray | None) -> StepResult:
        """Do a step for which one call of the pool may not be all."""
        warms_up = resetting is not None and self.env.inside.warm_ups is not None
        if self._any_foreign or not self._prepared or warms_up:
            return self._step_on_arrays(actions, resetting)
        if self._left or (resetting is not None and self._draws_ahead):
            actions = self._checked_ahead(actions, resetting)
        result: StepResult
        starts = resetting is None and self.starts_at_ends and self._starts_in_pass
        drawn = self._not_drawn if resetting is None else self._draw_ahead(resetting)
        play = self._play_with_resets if starts or resetting is not None else self._play
        self.has_moved = True  # unless the call refuses its arguments
        try:
            result, troubled, self.any_ended, started = play(actions, None if starts else drawn)
        except _REFUSALS as error:
            return self.step(self._converted(actions, error), resetting)
        if resetting is not None:
            result.infos.update(drawn_info(self.env.inside.plan, drawn, resetting))
        if troubled or self._left:
            return self._completed(result, troubled, resetting, started)
        return result

    def _checked_ahead(self, actions: Any, resetting: MaskArray | None) -> npt.NDArray[Any]:
        """Check actions before Python draws or calls a hook: a refused step changes nothing."""
        self.has_moved = False
        checked = self._flat(actions)
        if "_get_inputs" in self._left:
            self._call_get_inputs(checked, resetting)
        return checked

    def _converted(self, actions: Any, error: Exception) -> npt.NDArray[Any]:
        """The actions in the form that the pool takes, if it has refused another one."""
        require_refusal(error)
        self.has_moved = False
        converted = self._flat(actions)
        if converted is actions:
            raise error
        return converted

    def roll_out(self, actions: npt.NDArray[Any]) -> tuple[Any, ...] | None:
        """See ``Engine.roll_out``."""
        if not self._prepared or self._left or not self._pool.rolls_out:
            return None
        horizon = len(actions)
        shape = horizon, self._n
        judged = np.empty(shape), np.empty(shape, _BOOL), np.empty(shape, _BOOL)
        seen = self._arrays_of_steps(horizon)
        self.has_moved = True
        arrays = tuple(seen.values()) if isinstance(seen, dict) else seen
        troubled = self._pool.roll_out(
            np.ascontiguousarray(actions), arrays, *judged, np.zeros(self._drawn_shape)
        )
        if troubled:
            return None
        return seen if self._divided is None else self._divided(seen)[0], *judged

    def _arrays_of_steps(self, horizon: int) -> Any:
        """Make the arrays of many steps, with a first axis for the steps."""
        arrays = self._new_arrays()
        if isinstance(arrays, tuple):
            return tuple(_for_steps(array, horizon) for array in arrays)
        if isinstance(arrays, dict):
            return {name: _for_steps(array, horizon) for name, array in arrays.items()}
        return _for_steps(arrays, horizon)

    def _completed(
        self,
        result: StepResult,
        troubled: int,
        resetting: MaskArray | None,
        started: MaskArray | None,
    ) -> StepResult:
        """Call the hooks that are not compiled, and handle faults."""
        if self._left:
            result = self._with_hooks_left(result, resetting)
        seen = result.rewards, result.observations
        if troubled or any(not_finite(values) is not None for values in seen):
            self._mend(result, resetting if started is None else started)
        return result

    def _call_get_inputs(self, actions: npt.NDArray[Any], resetting: MaskArray | None) -> None:
        """Call this hook on arrays, before the pool takes over the actions."""
        env = self.env
        before = env.action, env.previous_action, env.previous_state
        env.previous_action, env.action = env.action, np.moveaxis(actions, 0, -1)
        env.previous_state, env.inside.in_hooks = env.state.copy(), True
        try:
            self._write_inputs(env._get_inputs(), resetting)
        finally:
            env.inside.in_hooks = False
            env.action, env.previous_action, env.previous_state = before

    def _with_hooks_left(self, result: StepResult, resetting: MaskArray | None) -> StepResult:
        """Call the hooks that are not compiled, in their order."""
        env, left, n = self.env, self._left, self._n
        observations, infos = result.observations, result.infos
        env.inside.in_hooks = True
        idle = slice(0) if resetting is None else resetting
        try:
            if "_is_truncated" in left:
                flags = results.flags("_is_truncated", env._is_truncated(), n)
                flags[idle] = False
                np.logical_or(result.truncated, flags, out=result.truncated)
                self.note_ends(result.terminated, result.truncated)
            if "_reward_policy" in left:
                result.rewards[:] = results.rewards(env._reward_policy(), n)
                result.rewards[idle] = 0.0
            if "_get_observation" in left:
                observations = self._observe()
            if "_get_info" in left:
                infos = self._infos(np.ones(n, np.bool_)) | infos
        finally:
            env.inside.in_hooks = False
        return result._replace(observations=observations, infos=infos)

    def _seen_by_hooks_left(
        self, observations: Any, infos: dict[str, Any], starting: MaskArray
    ) -> tuple[Any, dict[str, Any]]:
        """What the hooks that are not compiled observe where episodes have started."""
        env, left = self.env, self._left
        env.inside.in_hooks = True
        try:
            if "_get_observation" in left:
                observations = self._observe()
            if "_get_info" in left:
                infos = self._infos(starting) | infos
        finally:
            env.inside.in_hooks = False
        return observations, infos

    def _flat(self, actions: Any) -> npt.NDArray[Any]:
        """The actions as the pool takes them, environments first.

        Raises:
            ConfigError: If they do not fit.
        """
        space: Any = self.env.action_space
        with np.errstate(over="ignore"):  # the action becomes infinite, and so does an input
            array = checked_actions(space, self._n, actions).astype(space.dtype, copy=False)
        return np.require(array, requirements=["C", "A"])

    def _step_on_arrays(self, actions: Any, resetting: MaskArray | None) -> StepResult:
        self._longest = self._limit  # steps of the pool are not counted there
        try:
            result = super().step(actions, resetting)
        except BaseException:
            if self._prepared:
                self._memory.show()  # a reset follows if the FMUs have stepped
            raise
        if self._prepared:
            self._memory.take_over()
        return result

    def _mend(self, result: StepResult, starting: MaskArray | None) -> None:
        """Handle failures and numbers that are not finite: rare, so numpy is fast enough.

        Args:
            result: Of the step; it is corrected.
            starting: Which environments have started an episode in this step.
        """
        env, statuses = self.env, self._pool.statuses
        if starting is not None:
            self._require_started(np.flatnonzero(starting), statuses)
            self._require_finite_start(result.observations, starting)
        self._require_possible_inputs(starting)
        self._outputs_before, self._variables_before = self._memory.kept, self._memory.before
        env.inside.in_hooks = True
        try:
            self._handle_faults(result, statuses, True, not_finite(result.observations))
        finally:
            env.inside.in_hooks = False
        self.note_ends(result.terminated, result.truncated)
        if starting is not None:
            self.note_starts(starting)

    def _require_possible_inputs(self, resetting: MaskArray | None) -> None:
        """Refuse inputs that are not finite, which they also are outside of their type's range."""
        inputs = self._pool.inputs
        if not self.env.inside.input_writer.all_real and not np.isfinite(inputs).all():
            wanted = np.array(inputs)
            results.write_inputs(self.env._get_inputs(), wanted)
            for index in self._stepping(resetting):
                fmu_spaces.to_input_types(self.env.inside.interface.inputs, wanted[:, index])
        self._require_finite_inputs(resetting)


def _for_steps(array: npt.NDArray[Any], horizon: int) -> npt.NDArray[Any]:
    return np.empty((horizon, *array.shape), array.dtype)
