"""The hook check: do hooks give the same on arrays as one environment at a time?

``if abs(x) > 2.4`` raises on arrays, but ``np.any`` and ``norm`` without an axis silently give one
answer for all environments. So the check evaluates every hook on some distinct states both ways.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from gymnasium import spaces

from fmugym.env import FMUEnv
from fmugym.fmi.status import WARNING_CODE
from fmugym.pool.base import FloatArray
from fmugym.task.readings import Readings, reading
from fmugym.task.step import ORDER
from fmugym.task.values import ParameterValues
from fmugym.vector.action_arrays import is_array_space
from fmugym.vector.contents import Contents, borrowed, differs
from fmugym.vector.hooks.purity import unrepeatable
from fmugym.vector.views import batched, column, some

__all__ = ["CURE", "find_difference", "sample_of", "sample_states", "states_around"]

CURE = (
    "Write hooks element-wise: & and | for 'and' and 'or', numpy.where for 'if', no reduction over "
    "all values"
)
"""The advice that follows a difference."""

_IDLE = ("_update", "_is_truncated", "_get_info")
"""Hooks that do nothing by default."""

_READ_ONLY = (
    "state",
    "previous_state",
    "inputs",
    "action",
    "previous_action",
    "step_count",
    "done",
)

_WRITING = ("_get_inputs", "_update")
"""Hooks that are not called for environments that start an episode, and may write variables."""

_OUTSIDE = "outside: "
"""Precedes the names of global variables among those of what hooks have changed."""

_EPISODES, _STEPS = 2, 3
"""How many states of the FMU are tried; each is tried at other magnitudes, too."""

_TOLERANCE = 1e-6
"""numpy's results on arrays may differ from those on scalars in the last bit of a float32."""

_SCALES = (1.0, -0.3, 10.0)
_WILD_SCALES = (300.0, -1e5)
"""Hooks may fail at these. They reach limits that the FMU's own states are far from."""


def find_difference(env: FMUEnv, states: Readings | None = None) -> str | None:
    """Look for a reason to call hooks one environment at a time.

    Args:
        env: A prototype.
        states: States in which hooks may fail; None for those that the FMU takes, if its pool has
            not been used yet, and others.

    Returns:
        The hook and how it differs on arrays, or None if all hooks work on arrays.
    """
    obstacle = _obstacle(env)
    if obstacle is not None:
        return obstacle
    hooks = [hook for hook in ORDER if hook not in _IDLE or hook in env.inside.own]
    with (
        np.errstate(all="ignore"),
        warnings.catch_warnings(),
        borrowed(env, outside=True) as contents,
    ):
        warnings.simplefilter("ignore")
        scales = _SCALES[:1], _SCALES[1:], _WILD_SCALES
        kinds = [sample_states(env, some) for some in scales] if states is None else [states]
        for name in hooks:
            for index, batch in enumerate(kinds):
                comparison = _Comparison(env, contents, batch, name)
                may_fail = states is not None or index > 0
                difference = comparison.run(is_natural=index == 0, may_fail=may_fail)
                if difference is not None:
                    return f"{name} {difference}"
    return None


def _obstacle(env: FMUEnv) -> str | None:
    """What keeps hooks from being called on arrays, whatever they compute."""
    for method, is_own in (("step", env.inside.own.step), ("reset", env.inside.own.reset)):
        if is_own:
            return f"{method} is overridden, which is for one environment only"
    if not is_array_space(env.action_space):
        return f"actions of {env.action_space} do not make one array"
    if not _makes_arrays(env.observation_space):
        return f"observations of {env.observation_space} do not make arrays"
    return unrepeatable(env)


def _makes_arrays(space: spaces.Space[Any]) -> bool:
    """Whether observations of N environments are an array, or a dict of arrays."""
    if isinstance(space, spaces.Dict):
        return all(map(_makes_arrays, space.values()))
    return is_array_space(space)


def sample_states(
    env: FMUEnv, scales: Sequence[float] = _SCALES, visited: Sequence[Visited] | None = None
) -> Readings:
    """Make a batch of states, each in several magnitudes.

    Args:
        env: A prototype.
        scales: The factors of the states, each with some noise.
        visited: The states; by default those that the first instance of its pool takes.

    Returns:
        What hooks read in these states.
    """
    rng = np.random.default_rng(0)
    visited = _visit_states(env, rng) if visited is None else visited
    tried = [(state, scale) for state in visited for scale in scales]
    batch = batched(env, len(tried))
    rows: dict[str, list[Any]] = {}
    for index, (state, scale) in enumerate(tried):
        _place_sample(env, batch, index, state, rng, rows)
        if scale != 1.0:
            batch.values[:, index] *= scale * rng.uniform(0.5, 1.5, size=len(batch.values))
            batch.previous_state[:, index] *= scale
    for name, values in rows.items():
        if name in batch.variables:
            batch.variables[name] = np.moveaxis(np.array(values), 0, -1)
    own = ((n, np.array(v)) for n, v in rows.items() if n not in batch.variables)
    batch.parameters = ParameterValues(own)
    return batch


Visited = tuple[FloatArray, FloatArray, FloatArray]
"""The outputs before a step, those after it, and the inputs."""


def _visit_states(env: FMUEnv, rng: np.random.Generator) -> list[Visited]:
    """Run short episodes with small inputs; a slow FMU would take long for more."""
    pool, draws = env.inside.pool, env.inside.draws
    if pool.is_real:
        zeros = np.zeros(len(pool.outputs)), np.zeros(len(pool.inputs))
        return _drawn_around(*zeros, [1.0] * _EPISODES * _STEPS, rng)  # nothing real must move
    mask = np.zeros(pool.num_instances, np.bool_)
    mask[0] = True
    visited: list[Visited] = []
    for _ in range(_EPISODES):
        start_values = draws.draw(rng).start_values
        pool.reset(draws.model_variables, np.repeat(start_values, len(mask), axis=1), mask)
        for _ in range(_STEPS):
            before = pool.outputs[:, 0].copy()
            pool.inputs[:, 0] = 0.1 * rng.uniform(size=len(pool.inputs))
            if pool.statuses[0] <= WARNING_CODE:
                pool.step(None, ~mask)
            visited.append((before, pool.outputs[:, 0].copy(), pool.inputs[:, 0].copy()))
    return visited


def states_around(env: FMUEnv, reaches: Sequence[float]) -> list[Visited]:
    """Draw states around the one that a single environment has now.

    Args:
        env: The environment.
        reaches: How far each is from there, relative to the magnitudes of the values.
    """
    now = env.inside.readings
    values, inputs = (np.array(part, np.float64) for part in (now.values, now.inputs))
    return _drawn_around(values, inputs, reaches, np.random.default_rng(0))


def _drawn_around(
    values: FloatArray, inputs: FloatArray, reaches: Sequence[float], rng: np.random.Generator
) -> list[Visited]:
    def moved(reach: float) -> Any:
        centres = values, values, inputs
        return tuple(c + reach * (1 + abs(c)) * rng.normal(size=len(c)) for c in centres)

    return [moved(reach) for reach in reaches]


def _place_sample(
    env: FMUEnv,
    batch: Readings,
    index: int,
    visited: Visited,
    rng: np.random.Generator,
    rows: dict[str, list[Any]],
) -> None:
    before, batch.values[:, index], batch.inputs[:, index] = visited
    batch.previous_state[:, index] = before[: env.inside.output_count]
    batch.step_count[index] = 1 + index
    batch.done[index] = bool(rng.integers(2))
    for actions in (batch.action, batch.previous_action):
        actions[..., index] = sample_of(env.action_space, rng)
    episode = env.inside.draws.draw(rng)
    for name, value in {**episode.parameters, **episode.variables}.items():
        rows.setdefault(name, []).append(value)


def sample_of(space: spaces.Space[Any], rng: np.random.Generator) -> Any:
    """Sample without touching the space's own generator."""
    own, space._np_random = space._np_random, rng
    try:
        return space.sample()
    finally:
        space._np_random = own


class _Comparison(NamedTuple):
    """Compares one hook on arrays with the same hook one environment at a time.

    Attributes:
        env: The prototype, whose hook is called.
        contents: What the prototype holds; each call is undone.
        batch: What hooks read.
        name: The hook.
    """

    env: FMUEnv
    contents: Contents
    batch: Readings
    name: str

    def run(self, is_natural: bool, may_fail: bool) -> str | None:
        """Say how the results differ, or None."""
        count = len(self.batch.step_count)
        calls = [self._call(column(self.batch, index)) for index in range(count)]
        changed = next((name for _, name in calls if name is not None), None)
        if changed == "variables":
            return "changes self.variables, which only _update may do"
        if changed is not None and changed.startswith(_OUTSIDE):
            return f"changes {changed.removeprefix(_OUTSIDE)}, which all environments share"
        if is_natural and changed is not None:
            return f"changes self.{changed}, which belongs in 'episode_variables'"
        failures = sum(type(result) is _Failure for result, _ in calls)
        if failures == count or (failures and may_fail):
            return None  # if it fails either way, the first step will tell
        together, changed = self._call(some(self.batch))
        if changed in {"state", "out"}:  # the same arrays
            return "changes the arrays in self.state and self.out in place"
        if changed in _READ_ONLY:
            return f"changes the arrays in self.{changed} in place"
        if type(together) is _Failure:
            return f"fails on arrays ({together.text})"
        for index, (expected, _) in enumerate(calls):
            if type(expected) is not _Failure and not _same(expected, together, index, count):
                return "gives other values on arrays than one environment at a time"
        return None

    def _call(self, readings: Readings) -> tuple[Any, str | None]:
        """Call the hook; return its result and the name of an attribute that it changes."""
        before = _read_only(readings, self.name)
        with reading(self.env, readings):
            result = _result_of(self.env, self.name)
            after = _read_only(Readings.of(self.env), self.name)
        changed = [name for name, row in before.items() if differs(row, after[name])]
        changes = self.contents.changes()
        if any(changes):
            self.contents.restore()
        attribute = changes.inside
        if attribute is None and changes.outside is not None:
            attribute = f"{_OUTSIDE}{changes.outside}"
        return result, changed[0] if changed else attribute


def _read_only(readings: Readings, hook: str) -> dict[str, Any]:
    """Copy the readings that a hook must not change, by the names of the attributes."""
    rows: dict[str, Any] = {name: np.copy(getattr(readings, name)) for name in _READ_ONLY}
    if hook not in _WRITING:
        variables = readings.variables.items()  # a hook may have written anything
        rows["variables"] = {n: v.copy() if type(v) is np.ndarray else v for n, v in variables}
    return rows | {"out": np.copy(readings.values)}


class _Failure(NamedTuple):
    """Stands for the result of a hook that has raised an exception."""

    text: str


def _result_of(env: FMUEnv, name: str) -> Any:
    try:
        result = getattr(env, name)()
    except Exception as error:
        return _Failure(f"{type(error).__name__}: {error}")
    return dict(env.variables) if name == "_update" else result


def _same(expected: Any, together: Any, index: int, count: int) -> bool:
    """Whether one environment's part of a result on arrays is its result alone; NaNs are equal."""
    try:
        return _equal(expected, together, index, count)
    except Exception:  # the results are the user's, and may be anything
        return False


def _equal(expected: Any, together: Any, index: int, count: int) -> bool:
    if isinstance(expected, Mapping):
        if not isinstance(together, Mapping) or expected.keys() != together.keys():
            return False
        return all(_same(expected[k], together[k], index, count) for k in expected)
    if isinstance(expected, list | tuple) and isinstance(together, list | tuple):
        return len(expected) == len(together) and all(
            _same(a, b, index, count) for a, b in zip(expected, together, strict=True)
        )
    alone, batch = np.asarray(expected), np.asarray(together)
    if isinstance(together, np.bool_) or (isinstance(together, np.ndarray) and batch.ndim == 0):
        return False  # numpy has reduced the array: this is no constant
    if batch.ndim == 0:  # a constant, the same for all
        part = batch[()]
    elif batch.shape[-1] != count:
        return False
    else:
        part = batch[..., index]
    if np.shape(part) != alone.shape and np.size(part) != alone.size:
        return False
    if alone.dtype.kind not in "biuf" or np.asarray(part).dtype.kind not in "biuf":
        return bool(np.array_equal(alone, part))
    same = np.isclose(np.ravel(alone), np.ravel(part), rtol=_TOLERANCE, atol=1e-9, equal_nan=True)
    return bool(np.all(same))
