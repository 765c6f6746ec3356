"""The probe: are a class's hooks the same on arrays as one environment at a time?

``if abs(x) > 2.4`` raises on arrays, but ``np.any`` and ``norm`` without an axis answer silently
for all environments at once. So every hook is evaluated on some distinct states in both ways.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from gymnasium import spaces

from fmugym.adapters import Status
from fmugym.env import FMUEnv
from fmugym.vector.views import batched, column, light_copy

__all__ = ["find_difference", "sample_states"]

_HOOKS = (
    "_get_inputs",
    "_update",
    "_is_done",
    "_is_truncated",
    "_reward_policy",
    "_get_observation",
    "_get_info",
)
_STATES = 6
"""Distinct states that the FMU is brought to; each is also tried at other magnitudes."""

_TOLERANCE = 1e-7
"""numpy's loops over arrays may differ from its scalars in the last bit of a float32."""

_SCALES = (1.0, -0.3, 10.0)


def find_difference(env: FMUEnv) -> str | None:
    """Look for a reason to call an environment's hooks one by one.

    Args:
        env: A prototype whose pool nobody has used yet.

    Returns:
        What differs, with the name of the hook, or None if the hooks work on arrays.
    """
    cls = type(env)
    for method in ("step", "reset"):
        if getattr(cls, method) is not getattr(FMUEnv, method):
            return f"{method} is overridden"
    if not _is_array_space(env.action_space):
        return f"actions of {env.action_space} do not make one array"
    batch = sample_states(env)
    with np.errstate(all="ignore"):
        for name in _HOOKS:
            difference = _compare(name, batch)
            if difference is not None:
                return f"{name} {difference}"
    return None


def _is_array_space(space: spaces.Space[Any]) -> bool:
    kinds = (spaces.Box, spaces.Discrete, spaces.MultiBinary, spaces.MultiDiscrete)
    return isinstance(space, kinds)


def sample_states(env: FMUEnv) -> FMUEnv:
    """A batch of states that the FMU takes under random actions, and of scaled ones."""
    rng = np.random.default_rng(0)
    count = _STATES * len(_SCALES)
    batch = light_copy(env)
    batched(batch, count)
    rows: dict[str, list[Any]] = {}
    for index in range(count):
        _take_sample(env, batch, index, rng, rows)
    for name, values in rows.items():
        if name in batch.variables:
            batch.variables[name] = np.array(values)
    batch.parameters = {n: np.array(v) for n, v in rows.items() if n not in batch.variables}
    batch._in_hooks = True
    return batch


def _take_sample(
    env: FMUEnv, batch: FMUEnv, index: int, rng: np.random.Generator, rows: dict[str, list[Any]]
) -> None:
    pool = env._open_pool("the probe")
    mask = np.zeros(pool.num_instances, np.bool_)
    mask[0] = True
    plan = env._plan
    episode = plan.draw(rng)
    scale = _SCALES[index % len(_SCALES)]
    pool.reset(plan.model_variables, np.repeat(episode.start_values, len(mask), axis=1), mask)
    batch.previous_state[:, index] = scale * pool.outputs[: env._output_count, 0]
    pool.inputs[:, 0] = 0.1 * rng.uniform(size=len(pool.inputs))
    for _ in range(index // len(_SCALES)):
        if pool.statuses[0] <= Status.WARNING:
            pool.step(None, ~mask)
    batch._values[:, index] = scale * pool.outputs[:, 0]
    batch.inputs[:, index] = pool.inputs[:, 0]
    batch.step_count[index] = 1 + index
    batch.done[index] = bool(rng.integers(2))
    for actions in (batch.action, batch.previous_action):
        actions[..., index] = _sample(env.action_space, rng)
    for name, value in {**episode.parameters, **episode.variables}.items():
        rows.setdefault(name, []).append(value)


def _sample(space: spaces.Space[Any], rng: np.random.Generator) -> Any:
    """Sample without touching the space's own generator."""
    own, space._np_random = space._np_random, rng
    try:
        return space.sample()
    finally:
        space._np_random = own


def _compare(name: str, batch: FMUEnv) -> str | None:
    """Say how a hook's results on arrays differ from those one by one, or None."""
    count = len(batch.step_count)
    singles = [column(batch, index) for index in range(count)]
    for single in singles:
        single._in_hooks = True
    one_by_one = [_call(single, name) for single in singles]
    errors = [result for result in one_by_one if isinstance(result, Exception)]
    if errors and not isinstance(errors[0], ArithmeticError | ValueError):
        return None  # it fails in every way of calling it: that is for the first step to tell
    together = _call(batch, name)
    if isinstance(together, Exception):
        return f"fails on arrays ({type(together).__name__}: {together})"
    for index, expected in enumerate(one_by_one):
        if not isinstance(expected, Exception) and not _same(expected, together, index, count):
            return "gives other values on arrays than one environment at a time"
    return None


def _call(env: FMUEnv, name: str) -> Any:
    try:
        result = getattr(env, name)()
    except Exception as error:
        return error
    return dict(env.variables) if name == "_update" else result


def _same(expected: Any, together: Any, index: int, count: int) -> bool:
    """Whether one environment's part of a result on arrays is what it gets alone."""
    if isinstance(expected, Mapping):
        if not isinstance(together, Mapping) or expected.keys() != together.keys():
            return False
        return all(_same(expected[k], together[k], index, count) for k in expected)
    if isinstance(expected, list | tuple) and isinstance(together, list | tuple):
        return len(expected) == len(together) and all(
            _same(a, b, index, count) for a, b in zip(expected, together, strict=True)
        )
    alone, batch = np.asarray(expected), np.asarray(together)
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
