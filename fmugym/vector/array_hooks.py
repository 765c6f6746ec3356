"""Task of hooks that are called once a step, on the arrays of N environments."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from traceback import walk_tb
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from fmugym.env import FMUEnv
from fmugym.errors import ConfigError, SimulationError
from fmugym.pool.base import FloatArray, MaskArray, Played
from fmugym.task.episode import environments_last
from fmugym.task.hooks import Hooks
from fmugym.task.step import ORDER, call_hooks
from fmugym.vector.array_faults import settle_faults
from fmugym.vector.expressions import Expressions
from fmugym.vector.hooks import hook_results
from fmugym.vector.hooks.array_calls import infos_of_hooks, write_inputs_of_hooks
from fmugym.vector.hooks.task_programs import TaskPrograms
from fmugym.vector.tasks import StepResult, failed_in

__all__ = ["ArrayHooks"]

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

    def _step(self, actions: Any, restart: bool) -> StepResult:
        """See ``Expressions._step``; hooks tell which episodes end, so that none restarts."""
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
            started = starts[0]
            self._tell_starts(infos, *starts)
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
                observed = hook_results.observations(observed, env.observation_space, self._n)
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
            "fmugym.testing.check_hooks shows what is wrong"
        ) from error

    # The form of what hooks return.

    flag_type: type | None = None
    reward_type: type | None = None

    def flags(self, hook: str, value: Any) -> MaskArray:
        """See ``Form.flags``; nothing is done where the FMU has not stepped."""
        found = hook_results.flags(hook, value, self._n)
        if self._busy is not None and hook == "_is_done":
            found &= self._busy
        return found

    def rewards(self, value: Any) -> FloatArray:
        """See ``Form.rewards``."""
        return hook_results.rewards(value, self._n)

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
        array = hook_results.variable(name, value, self._n)
        if array.dtype == np.float64:
            return array
        dtype = hook_results.type_of_variable(self.env.episode_start, name, array.dtype)
        return array.astype(dtype, copy=False)

    def _holds(self, value: npt.NDArray[Any]) -> bool:
        return any(value is row for row in self.episodes.arrays.variables.values())
