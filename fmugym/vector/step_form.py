"""Description of a compiled step for a pool: programs, the arrays that they use, and results."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from fmugym.env import FMUEnv
from fmugym.expressions.program import LETTERS, TYPES, Row
from fmugym.expressions.quantities import PREVIOUS
from fmugym.pool.base import FloatArray, Play
from fmugym.pool.play_form import ArrayElement, RowStart
from fmugym.task.episode_start import Draw
from fmugym.vector.episode_arrays import EpisodeArrays, element_row
from fmugym.vector.hooks.task_programs import TaskPrograms

__all__ = ["prepare_step"]

_FLOAT_CHECKS = {np.dtype(np.float64): 2, np.dtype(np.float32): 3}
"""The numbers of ``ActionCheck`` in ``native/play.h``: what refuses a NaN."""

_RESULTS: Final = {
    kind: TYPES.index(letter)
    for kind, letter in zip(("reward", "terminated", "truncated"), "d??", strict=True)
}
"""The types of the rows of results, in the order of their arrays after those of observations."""

_KEPT_BY_THE_POOL: Final = frozenset({"previous_state", "previous_action"})
"""The quantities before the step that the pool keeps by itself, from ``kept`` and ``actions``."""


def prepare_step(
    env: FMUEnv,
    arrays: EpisodeArrays,
    task: TaskPrograms,
    starts: FloatArray,
    draws: tuple[Any, Sequence[Draw], npt.NDArray[np.uint64]],
    results: tuple[bool, tuple[Any, ...]],
) -> Play:
    """Give the pool of an environment everything it needs for steps.

    Args:
        env: An environment, for what all have in common.
        arrays: Those of the episodes.
        task: The programs; their variables are held.
        starts: The values of each parameter, a row each.
        draws: What draws values natively, what it draws, and the streams.
        results: Whether the pool returns numbers of one environment, and the shapes and types of
            the arrays of observations and infos.
    """
    native, drawn, streams = draws
    count = len(arrays.ended)
    are_of_one, seen = results
    flags, real = ((count,), arrays.done.dtype), np.dtype(np.float64)
    others = ((count,), real), flags, flags, flags, ((len(drawn), count), real)

    def find(row: Row) -> Any:
        kind = row[0]
        if kind == "seen":
            place: Any = row[1:]
            return ArrayElement(*place)
        if kind in _RESULTS:
            return ArrayElement(len(seen) + [*_RESULTS].index(kind), 0, 1, _RESULTS[kind])
        return arrays.find(row)

    return env._instance.pool.prepare_play(
        env.episode_start.model_variables,
        [one.with_rows(find) for one in (task.inputs, task.conclusion, task.observation)],
        _actions(env, arrays),
        starts,
        (native, streams),
        arrays.ended,
        _surroundings(env, arrays, task, starts, drawn)
        | {"seen": len(seen), "results": (are_of_one, (*seen, *others))},
    )


def _actions(env: FMUEnv, arrays: EpisodeArrays) -> dict[str, Any]:
    """Description of actions for the pool."""
    dtype = arrays.actions[0].dtype
    space: Any = env.action_space
    is_discrete = isinstance(space, spaces.Discrete)
    check = 1 if is_discrete else _FLOAT_CHECKS.get(dtype, 0)
    low, high = (int(space.start), int(space.start + space.n - 1)) if is_discrete else (0, 0)
    flat = [actions.reshape(-1) for actions in arrays.actions]
    return {
        "shape": arrays.actions[0].shape[1:],
        "letter": LETTERS.get(dtype, dtype.char),
        "size": dtype.itemsize,
        "check": check,
        "lowest": low,
        "highest": high,
        "current": flat[0],
        "previous": flat[1],
        "none": np.array(env._conversions.no_action, dtype).reshape(-1),
    }


def _surroundings(
    env: FMUEnv,
    arrays: EpisodeArrays,
    task: TaskPrograms,
    start_values: FloatArray,
    drawn: Sequence[Draw],
) -> dict[str, Any]:
    """Description of what else surrounds a step; see ``NativePool.prepare_play``.

    Args:
        env: The environment.
        arrays: Those of the episodes.
        task: The programs.
        start_values: The values of each parameter, a row each.
        drawn: What the pool draws.
    """
    count = len(arrays.ended)
    pairs = ((row, arrays.before[name]) for name, row in arrays.variables.items())
    flat = [(row.reshape(-1, count), before.reshape(-1, count)) for row, before in pairs]
    return {
        "kept": arrays.kept,
        "reads_kept": task.conclusion.loads("kept"),
        "before_inputs": tuple(_previous(arrays)),
        "before_conclusion": tuple(pair for rows in flat for pair in zip(*rows, strict=True)),
        "starts": tuple(_starts(env, arrays, start_values, drawn)),
    }


def _previous(arrays: EpisodeArrays) -> Iterator[tuple[FloatArray, FloatArray]]:
    """Rows of values, and of the same before the step, which the pool does not keep by itself."""
    read = arrays.quantities
    for name, now in PREVIOUS.items():
        if name not in _KEPT_BY_THE_POOL:
            for index in range(getattr(read, name).size // len(arrays.ended)):
                yield (
                    element_row(getattr(read, now), index),
                    element_row(getattr(read, name), index),
                )


def _starts(
    env: FMUEnv, arrays: EpisodeArrays, start_values: FloatArray, drawn: Sequence[Draw]
) -> Iterator[tuple[npt.NDArray[Any], RowStart]]:
    """Rows, and what they hold at the start of an episode, in the order in which they are set."""
    draws, read = env.episode_start, arrays.quantities
    names, held = draws.parameter_names, arrays.variables
    yield arrays.done, b"\0"
    yield read.step_count, b"\0"
    for row, (name, start) in zip(read.inputs, env.interface.start_inputs, strict=True):
        is_parameter = name in names
        yield row, start_values[names.index(name)] if is_parameter else np.float64(start).tobytes()
    for name, start in draws.constant_variables.items():
        if name in held:
            elements = np.broadcast_to(start, held[name].shape[:-1]).reshape(-1)
            rows = held[name].reshape(-1, len(arrays.ended))
            for row, value in zip(rows, elements, strict=True):
                yield row, np.array(value, row.dtype).tobytes()
    for number, draw in enumerate(drawn):
        if draw.name in held:
            yield held[draw.name].reshape(-1, len(arrays.ended))[draw.element or 0], number
    for now, before in _previous(arrays):
        yield before, now
    yield from zip(arrays.kept, read.outputs, strict=True)
