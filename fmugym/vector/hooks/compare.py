"""The comparison of programs with the hooks that they were made of."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from fmugym.env import FMUEnv
from fmugym.errors import ConfigError
from fmugym.expressions.graph import TOLERANCES
from fmugym.expressions.program import (
    DifferenceError,
    UntraceableError,
    evaluate,
    writes_variable,
)
from fmugym.task import spaces as fmu_spaces
from fmugym.task.readings import Readings, reading
from fmugym.vector.contents import borrowed
from fmugym.vector.hooks import hook_results
from fmugym.vector.hooks.memory import Memory
from fmugym.vector.hooks.task_programs import TaskPrograms
from fmugym.vector.views import some

__all__ = ["require_same"]


def require_same(env: FMUEnv, batch: Readings, task: TaskPrograms) -> None:
    """Run programs in C and hooks on arrays, and compare all results.

    They must be equal to the last bit: NaNs are equal, zeros of different sign are not. Where hooks
    use functions of the C library or multiply matrices, floats may differ by the tolerance of the
    task, times the largest of all results. Booleans and integers may not: a flag that hangs on
    such a last bit is no program's.

    Args:
        env: The environment with the hooks.
        batch: What the hooks read: arrays of M environments, which are not changed.
        task: The programs.

    Raises:
        DifferenceError: If a result differs.
        UntraceableError: If another hook than ``_update`` writes a variable.
    """
    own = some(batch)
    with np.errstate(all="ignore"), borrowed(env, outside=True), reading(env, own):
        comparison = _Comparison(env, task)
        comparison.compare_inputs()
        comparison.compare_judgement()


class _Comparison:
    def __init__(self, env: FMUEnv, task: TaskPrograms) -> None:
        self._env, self._task = env, task
        self._count = len(env.step_count)
        rows: Any = [*task.inputs.rows, *task.judgement.rows]
        attributes = {name: getattr(env, name) for kind, name, *_ in rows if kind == "attribute"}
        parameters = {name: env.parameters[name] for kind, name, *_ in rows if kind == "parameter"}
        self._played = some(env.inside.readings)
        ended = np.zeros(self._count, np.bool_)
        self._memory = memory = Memory(env, self._played, ended, _contiguous(attributes))
        memory.parameters = _contiguous(parameters, np.float64)
        memory.hold(task)
        self._before = memory.before
        env.variables.update({name: row.copy() for name, row in self._before.items()})

    def compare_inputs(self) -> None:
        """Compare the inputs, and keep them for the hooks that follow."""
        env, memory = self._env, self._memory
        before, env.previous_state = env.previous_state, env.state.copy()
        evaluate(self._task.inputs, memory.find, memory.actions)
        expected = np.array(env.inputs)
        hook_results.write_inputs(env._get_inputs(), expected)
        self._require_unwritten(self._before)
        for index in range(self._count):
            expected[:, index] = self._typed(expected[:, index])
        for row, wanted in zip(self._played.inputs, expected, strict=True):
            if "_get_inputs" not in self._task.left:
                self._require_equal("_get_inputs", row, wanted)
        env.inputs, env.previous_state = expected, before
        self._played.inputs[...] = expected

    def _typed(self, values: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        result = values.copy()
        for index, variable in enumerate(self._env.inside.interface.inputs):
            one = values[index : index + 1]
            try:
                result[index] = fmu_spaces.to_input_types([variable], one)[0]
            except ConfigError:
                result[index] = np.nan
        return result

    def compare_judgement(self) -> None:
        """Compare what follows the step of the FMU."""
        env, count = self._env, self._count
        seen = tuple(np.zeros((count, *a.shape), a.dtype) for a in self._task.seen)
        judged = evaluate(self._task.judgement, self._memory.find, self._memory.actions, seen)
        if env.inside.own.update:
            env._update()
            for name in self._task.updated:
                kept = hook_results.variable(name, env.variables[name], count)
                env.variables[name] = kept.astype(self._task.variables[name])
        env.done = hook_results.flags("_is_done", env._is_done(), count)
        self._require_equal("_is_done", judged[0], env.done)
        if "_is_truncated" not in self._task.left:
            truncated = hook_results.flags("_is_truncated", env._is_truncated(), count)
            self._require_equal("_is_truncated", judged[1], truncated)
        if "_reward_policy" not in self._task.left:
            rewards = hook_results.rewards(env._reward_policy(), count)
            self._require_equal("_reward_policy", judged[2], rewards)
        self._compare_seen(seen)
        self._compare_variables()

    def _compare_variables(self) -> None:
        """Compare them when all hooks were called: only ``_update`` may write them."""
        updated = self._task.updated
        self._require_unwritten(name for name in self._before if name not in updated)
        for name in updated:
            stored = self._memory.variables[name].reshape(-1, self._count)
            for row, wanted in zip(stored, self._rows(name), strict=True):
                self._require_equal("_update", row, wanted)

    def _require_unwritten(self, names: Iterable[str]) -> None:
        for name in names:
            if not _equal(self._before[name].reshape(-1, self._count), self._rows(name)):
                raise UntraceableError(writes_variable(name))

    def _rows(self, name: str) -> npt.NDArray[Any]:
        """The present values of an episode variable, a row for each element."""
        value = hook_results.variable(name, self._env.variables[name], self._count)
        return np.broadcast_to(value, self._before[name].shape).reshape(-1, self._count)

    def _compare_seen(self, seen: tuple[npt.NDArray[Any], ...]) -> None:
        env, tree = self._env, dict[str, Any]()
        for kind in dict.fromkeys(array.path[0] for array in self._task.seen):
            value = getattr(env, f"_get_{kind}")()
            if kind == "observation":
                value = hook_results.observations(value, env.observation_space, self._count)
            else:
                value = hook_results.info_arrays(value, np.ones(self._count, np.bool_))
            tree[kind] = value
        for array, description in zip(seen, self._task.seen, strict=True):
            expected: Any = tree
            for name in description.path:
                expected = expected[name]
            hook = f"_get_{description.path[0]}"
            self._require_equal(hook, array, expected)
            if array.dtype != expected.dtype:
                raise UntraceableError(f"the program of {hook} gives another type")

    def _require_equal(
        self, hook: str, value: npt.NDArray[Any], expected: npt.NDArray[Any]
    ) -> None:
        tolerance = self._task.tolerance
        if not _equal(value, expected) and not _nearly_equal(value, expected, tolerance):
            raise DifferenceError(hook)


def _contiguous(rows: Mapping[str, Any], dtype: Any = None) -> dict[str, npt.NDArray[Any]]:
    return {name: np.ascontiguousarray(row, dtype) for name, row in rows.items()}


def _equal(value: npt.NDArray[Any], expected: npt.NDArray[Any]) -> bool:
    """Whether arrays are equal, the signs of zeros too."""
    is_float = value.dtype.kind == "f"
    same = bool(np.array_equal(value, expected, equal_nan=is_float))
    if same and is_float:
        numbers = ~np.isnan(value)
        same = np.array_equal(np.signbit(value)[numbers], np.signbit(expected)[numbers])
    return same


def _nearly_equal(value: npt.NDArray[Any], expected: npt.NDArray[Any], tolerance: float) -> bool:
    """Whether floats differ by a part of the largest one: sums may cancel."""
    if value.dtype.kind != "f" or tolerance == 0.0:
        return False
    part = max(tolerance, TOLERANCES[value.dtype.itemsize])
    largest = float(np.max(np.abs(expected[np.isfinite(expected)]), initial=0.0))
    return bool(np.allclose(value, expected, rtol=part, atol=part * largest, equal_nan=True))
