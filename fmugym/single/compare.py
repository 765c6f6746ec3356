"""The comparison of programs with the hooks that they were made of, on random states."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from math import prod
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from fmugym.env import FMUEnv
from fmugym.signals import ordinary
from fmugym.single.purity import unchanged_globals
from fmugym.single.trace import SingleTask, kind_of
from fmugym.task.readings import Readings, reading
from fmugym.task.step import conclude
from fmugym.task.values import EpisodeVariables
from fmugym.vector.contents import Contents, borrowed, differs
from fmugym.vector.hooks.check import sample_of
from fmugym.vector.hooks.program import Program, Row, UntraceableError, evaluate, writes_variable

__all__ = ["require_equal"]

_COUNT: Final = 48

_SCALES: Final = (0.1, 0.1, 1.0, 1.0, 10.0, 300.0)
"""How far the states are from the present one; the last ones may reach limits."""


def require_equal(env: FMUEnv, task: SingleTask) -> None:
    """Run programs and hooks on random states, and compare all results to the last bit.

    States in which a hook raises an exception, or the programs ask for Python, are left out. NaNs
    are equal. Hooks that are left to Python are called, too: they must change nothing.

    Args:
        env: The environment, in an episode; its FMU is not used.
        task: The programs.

    Raises:
        UntraceableError: If a result differs, the hooks raise in every state, or a hook that is
            left to Python changes something.
    """
    with np.errstate(all="ignore"), borrowed(env):
        comparison = _Comparison(env, task)
        vars(env).update(_stand_ins(task.left))
        compared = sum(map(comparison.compare, range(_COUNT)))
    if task.left:
        with np.errstate(all="ignore"), unchanged_globals(env), borrowed(env) as contents:
            comparison.require_pure(contents)
    if not compared:
        raise UntraceableError("the hooks raise an exception in all states that were tried")


def _stand_ins(left: Iterable[str]) -> dict[str, Callable[..., Any]]:
    """What stands in for hooks that are left to Python, while the others are compared."""
    nothing: dict[str, Callable[..., Any]] = {
        "_get_inputs": tuple,
        "_is_truncated": bool,
        "_reward_policy": float,
        "_get_observation": tuple,
    }
    found = {name: nothing[name] for name in left}
    return found | ({"_goal_reward": lambda *goals: 0.0} if "_reward_policy" in found else {})


class _Comparison:
    def __init__(self, env: FMUEnv, task: SingleTask) -> None:
        self._env, self._task = env, task
        rng = np.random.default_rng(0)
        scales = np.resize(_SCALES, _COUNT)
        width, now = len(env.out), np.array(env._values)[:, None]
        noise = rng.normal(size=(2 * width, _COUNT)) * scales
        self._kept, self._outputs = (now + (1 + abs(now)) * part for part in np.split(noise, 2))
        self._last_inputs = rng.normal(size=(len(env.inputs), _COUNT)) * scales
        self._makes_inputs = "_get_inputs" not in task.left
        self._wanted = self._last_inputs[:, ::-1].copy()
        self._inputs = self._last_inputs.copy()
        self._counts = rng.integers(0, 1000, _COUNT)
        actions = [sample_of(env.action_space, rng) for _ in range(2 * _COUNT)]
        self._actions = np.array(actions[:_COUNT]), np.array(actions[_COUNT:])
        self._before = {name: self._drawn(name, rng) for name in task.variables}
        self._after = {name: values.copy() for name, values in self._before.items()}
        self._outside: set[int] = set()
        self._run()

    def _drawn(self, name: str, rng: np.random.Generator) -> npt.NDArray[Any]:
        """A row for each element of an episode variable."""
        kind = self._task.variables[name]
        values = 3 * rng.normal(size=(prod(kind.shape or ()), _COUNT))
        values[:, ::3] = np.reshape(self._env.variables[name], (-1, 1))  # it may be an index
        return values > 0 if kind.dtype == np.bool_ else values.astype(kind.dtype)

    def _run(self) -> None:
        """Run the programs on all states at once."""
        task = self._task
        self._evaluate(task.inputs, self._find_before, ())
        self._inputs = self._wanted.copy()
        self._seen = tuple(np.zeros((_COUNT, *array.shape), array.dtype) for array in task.seen)
        self._counts = self._counts + 1
        self._judged = self._evaluate(task.judgement, self._find, self._seen)

    def _evaluate(
        self, program: Program, find: Callable[[Row], Any], seen: tuple[npt.NDArray[Any], ...]
    ) -> list[npt.NDArray[Any]]:
        """Run a program; note the states in which an index is outside of its table."""
        try:
            return evaluate(program, find, self._actions, seen)
        except IndexError:
            results = [self._evaluate_one(index, program, find, seen) for index in range(_COUNT)]
            return [np.concatenate(parts) for parts in zip(*results, strict=True)]

    def _evaluate_one(
        self,
        index: int,
        program: Program,
        find: Callable[[Row], Any],
        seen: tuple[npt.NDArray[Any], ...],
    ) -> list[npt.NDArray[Any]]:
        part = slice(index, index + 1)
        first, second = (actions[part] for actions in self._actions)
        parts = tuple(array[part] for array in seen)
        try:
            return evaluate(program, lambda row: find(row)[part], (first, second), parts)
        except IndexError:
            self._outside.add(index)
            return [np.zeros(1) for _ in program.results]

    def _find_before(self, row: Row) -> Any:
        """The values of a row before the step, when the inputs are made."""
        if row[0] == "output":
            index: Any = row[1]
            return self._kept[index]
        return self._find(row)

    def _find(self, row: Row) -> Any:
        kind, *rest = row
        index: Any = rest[-1] if rest else 0
        name: Any = rest[0] if rest else None
        match kind:
            case "output":
                return self._outputs[index]
            case "kept":
                return self._kept[index]
            case "input":
                return self._inputs[index]
            case "wanted":
                return self._wanted[index]
            case "parameter":
                return np.full(_COUNT, self._env.parameters[name])
            case "step_count":
                return self._counts
        rows = self._after if kind == "variable" else self._before
        return rows[name][index]

    def compare(self, index: int) -> bool:
        """Compare one state; return whether the hooks have given a result there."""
        env = self._env
        if index in self._outside:
            return False
        with reading(env, self._readings(index)):
            try:
                inputs = self._inputs_of(index)
            except ordinary(Exception):  # hooks may raise anything
                return False
            if _leaves_to_python(self._wanted[:, index], np.array(inputs)):
                return False
            _require("_get_inputs", self._wanted[:, index], np.array(inputs))
            self._place_after(index, inputs)
            try:
                observed = None if self._task.seen else ()  # the pool's, or that of a hook left
                result = conclude(env, env._form, False, False, observed)
            except ordinary(Exception):  # as above
                return False
            if _leaves_to_python(self._judged[-1][index], np.asarray(result[1])):
                return False
            self._compare_results(index, result)
        return True

    def _inputs_of(self, index: int) -> tuple[float, ...]:
        if not self._makes_inputs:
            return tuple(self._wanted[:, index].tolist())
        return self._env._input_writer.checked(self._env._get_inputs(), self._env.action)

    def require_pure(self, contents: Contents) -> None:
        """Call the hooks that are left to Python in some states, and look for what they change.

        Raises:
            UntraceableError: If they change an attribute or an episode variable.
        """
        for index in range(0, _COUNT, _COUNT // 8):
            with reading(self._env, self._readings(index)):
                before = dict(self._env.variables)
                contained = {name: np.copy(value) for name, value in before.items()}
                for name in self._task.left:
                    if name != "_get_inputs":
                        self._place_after(index, tuple(self._inputs[:, index].tolist()))
                    _call(self._env, name)
                    after = self._env.variables.items()
                    changed = {
                        n
                        for n, v in after
                        if v is not before[n] or differs(contained[n], np.copy(v))
                    }
                    _require_nothing_changed(name, min(changed, default=contents.changed()))

    def _readings(self, index: int) -> Readings:
        env = self._env
        values = tuple(self._kept[:, index].tolist())
        variables = EpisodeVariables(env.variables)
        for name, rows in self._before.items():
            variables[name] = self._value(name, rows[:, index])
        state = values[: env._output_count]
        action, before = (self._action(actions[index]) for actions in self._actions)
        present = Readings.of(env)
        return Readings(
            values=values,
            out=env.out,
            state=state,
            previous_state=state,
            inputs=tuple(self._last_inputs[:, index].tolist()),
            action=action,
            previous_action=before,
            step_count=int(self._counts[index]) - 1,
            done=False,
            after_end=False,
            parameters=present.parameters,
            variables=variables,
        )

    def _action(self, action: Any) -> Any:
        if self._task.action_type is int:
            return int(action)
        return action.copy()

    def _value(self, name: str, value: Any) -> Any:
        kind = self._task.variables[name]
        if kind.shape is not None:
            return value.reshape(kind.shape)
        return kind.python(value[0]) if kind.python else value[0]

    def _place_after(self, index: int, inputs: tuple[float, ...]) -> None:
        """Let the hooks read what they read after the FMU's step."""
        env = self._env
        env.inputs, env.previous_state = inputs, env.state
        env._values = tuple(self._outputs[:, index].tolist())
        env.state = env._values[: env._output_count]
        env.step_count += 1

    def _compare_results(self, index: int, result: tuple[Any, ...]) -> None:
        self._compare_variables(index)
        observation, reward, done, truncated = result
        expected = {"_is_done": done, "_is_truncated": truncated, "_reward_policy": reward}
        for (hook, value), row in zip(expected.items(), self._judged, strict=True):
            _require(hook, row[index], np.asarray(value, row.dtype))
        for array, description in zip(self._seen, self._task.seen, strict=True):
            *_, key = description.path
            part = observation[key] if isinstance(observation, Mapping) else observation
            _require("_get_observation", array[index], part)

    def _compare_variables(self, index: int) -> None:
        """Compare them when all hooks were called: only ``_update`` may write them."""
        for name, after in self._after.items():
            value = self._env.variables[name]
            if name not in self._task.updated:
                before = self._value(name, self._before[name][:, index])
                if type(value) is not type(before) or differs(before, value):
                    raise UntraceableError(writes_variable(name))
                continue
            if kind_of(value) != self._task.variables[name]:
                raise UntraceableError(f"_update gives {name!r} different types")
            _require("_update", after[:, index], np.asarray(value).reshape(-1))


def _leaves_to_python(values: Any, expected: Any) -> bool:
    """Whether a NaN asks Python to judge a step, where that finds a number."""
    return bool(np.any((values != values) & (expected == expected)))


def _require(hook: str, value: Any, expected: Any) -> None:
    if value.dtype == expected.dtype and value.shape == expected.shape:
        numbers = value == value
        same = np.array_equal(numbers, expected == expected)
        bits = value[numbers].tobytes() == expected[numbers].tobytes()
        if same and bits:
            return
    raise UntraceableError(f"the program gives other values than {hook}")


def _call(env: FMUEnv, hook: str) -> None:
    """Call a hook in a random state, in which it may fail."""
    try:
        getattr(env, hook)()
    except ordinary(Exception):  # hooks may raise anything
        return


def _require_nothing_changed(hook: str, changed: str | None) -> None:
    if changed is not None:
        raise UntraceableError(f"{hook} changes {changed!r}, and only some hooks are compiled")
