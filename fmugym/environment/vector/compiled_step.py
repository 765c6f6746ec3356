"""Compiled step: its programs, the arrays that it fills, and the step of a single environment.

The description for a pool has the programs, the arrays that they use, and the results. A layout
finds the observations and infos in these arrays. A single environment with expressions steps by
their programs, too, as in a batch of one.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from fmugym.environment.actions import as_element
from fmugym.environment.env import FMUEnv
from fmugym.environment.episode_start import Draw, no_draws
from fmugym.environment.saved_episode import READ
from fmugym.environment.step_result import Result, conclude
from fmugym.environment.vector.infos import masked
from fmugym.environment.vector.quantity_arrays import (
    EpisodeArrays,
    EpisodeColumn,
    batched,
    element_row,
)
from fmugym.environment.vector.task_programs import TaskPrograms, compile_formulas, formulas_of
from fmugym.expressions.program import TYPES, Row, UncompilableError
from fmugym.expressions.quantities import PREVIOUS
from fmugym.pool.c_extension import require_refusal
from fmugym.pool.play_form import ArrayElement, RowStart
from fmugym.pool.pool import FloatArray, MaskArray, Play

__all__ = ["ExpressionStep", "Layout", "LayoutOfOne", "expression_step_of", "prepare_step"]


class Layout:
    """The arrays that a program or the pool fills, and the observations and infos in them.

    Args:
        task: The programs.
        env: The environment.
        count: N.

    Attributes:
        shapes: The shape and type of each array.
        is_plain: Whether there is one array, the observations, and there are no infos.
    """

    def __init__(self, task: TaskPrograms, env: FMUEnv, count: int) -> None:
        paths = [array.path for array in task.seen]
        self.shapes = tuple(((count, *array.shape), array.dtype) for array in task.seen)
        if not task.seen and env._conversions.pool_observes:
            paths = [("observation",)]
            self.shapes = (((count, env.interface.output_count), np.dtype(np.float32)),)
        self.is_plain = paths == [("observation",)]
        observed, told = (
            [p[1:] for p in paths if p[0] == kind] for kind in ("observation", "info")
        )
        self._observations = _Tree(observed, 0)
        self._first_info = len(observed)
        self._infos = _Tree(told, len(observed))
        self._everywhere = np.ones(count, np.bool_)

    def parts(
        self, arrays: Sequence[npt.NDArray[Any]], mask: MaskArray | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """The observations and infos in some arrays of these shapes.

        Args:
            arrays: The arrays.
            mask: The environments of the infos, shape (N,); None for all.

        Returns:
            Observations, which are {} if no program makes any; and infos.
        """
        if self.is_plain:
            return arrays[0], {}
        if mask is None:
            return self._observations.filled(arrays), self._infos.filled(arrays, self._everywhere)
        told = [masked(mask, array) for array in arrays[self._first_info :]]
        observations = self._observations.filled(arrays)
        return observations, self._infos.filled([*arrays[: self._first_info], *told], mask)


class _Tree:
    """Dicts of arrays, or a single array, in a list of arrays.

    Args:
        paths: The names that lead to each array; () for a single one.
        first: The place of the first array in the list.
    """

    def __init__(self, paths: Sequence[tuple[str, ...]], first: int) -> None:
        self._single = first if list(paths) == [()] else None
        entries: dict[tuple[str, ...], dict[str, int | None]] = {(): {}}
        for place, path in enumerate(paths, first):
            for end in range(len(path)):
                own = entries.setdefault(path[:end], {})
                own.setdefault(path[end], None if end + 1 < len(path) else place)
        order = sorted(entries, key=len, reverse=True)  # a dict comes after those that it has
        numbers = {path: number for number, path in enumerate(order)}
        self._dicts = [
            [
                (name, f"_{name}", place, numbers.get((*path, name), 0))
                for name, place in entries[path].items()
            ]
            for path in order
        ]

    def filled(self, arrays: Sequence[Any], mask: MaskArray | None = None) -> Any:
        """The dicts of these arrays; with a mask, as infos have it, for each name."""
        if self._single is not None:
            return arrays[self._single]
        made: list[dict[str, Any]] = []
        for entries in self._dicts:
            values: dict[str, Any] = {}
            for name, name_of_mask, place, number in entries:
                values[name] = made[number] if place is None else arrays[place]
                if mask is not None:
                    values[name_of_mask] = mask.copy()
            made.append(values)
        return made[-1]


class LayoutOfOne(Layout):
    """The same of a single environment; a plain array has no axis for environments.

    Args:
        task, env: See ``Layout``.
    """

    def __init__(self, task: TaskPrograms, env: FMUEnv) -> None:
        super().__init__(task, env, 1)
        self.is_plain = self.is_plain and len(self.shapes[0][0]) > 1
        if self.is_plain:
            ((_, *shape), dtype) = self.shapes[0]
            self.shapes = ((tuple(shape), dtype),)

    def of_one(self, arrays: Sequence[npt.NDArray[Any]]) -> tuple[Any, dict[str, Any]]:
        """The observation and the info in some arrays of these shapes, if these are not plain."""
        values = [_first(array) for array in arrays]
        return self._observations.filled(values), self._infos.filled(values)


def _first(array: npt.NDArray[Any]) -> Any:
    """An array without its first axis of one; if it has no other, a number."""
    return array[0].copy() if array.ndim > 1 else array.item()


_FLOAT_CHECKS = {np.dtype(np.float64): 2, np.dtype(np.float32): 3}
"""The numbers of ``ActionCheck`` in ``native/pool/play.h``: what refuses a NaN."""

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
        | {
            "unstepped": tuple((find((kind, 0)), b"\0") for kind in (*_RESULTS, "done", "ended")),
            "seen": len(seen),
            "results": (are_of_one, tuple(np.empty(*one) for one in (*seen, *others))),
        },
    )


def _actions(env: FMUEnv, arrays: EpisodeArrays) -> dict[str, Any]:
    """Description of actions for the pool."""
    dtype = arrays.actions[0].dtype
    space: Any = env.action_space
    is_discrete = isinstance(space, spaces.Discrete)
    check = 1 if is_discrete else _FLOAT_CHECKS.get(dtype, 0)
    low, high = (int(space.start), int(space.start + space.n - 1)) if is_discrete else (0, 0)
    return {
        "size": dtype.itemsize,
        "check": check,
        "lowest": low,
        "highest": high,
        "current": arrays.actions[0],
        "previous": arrays.actions[1],
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


logger = logging.getLogger(__name__)

_REFUSALS: Final = (TypeError, ValueError, BufferError)
"""What the pool raises if it does not take an action."""


def expression_step_of(env: FMUEnv) -> ExpressionStep | None:
    """Compile the expressions of an environment, which then reads from arrays of one.

    Args:
        env: The environment, with a native pool of its own.

    Returns:
        None if they cannot be compiled, or if there is another hook.
    """
    formulas = formulas_of(env)
    if formulas is None:
        return None
    try:
        return ExpressionStep(env, compile_formulas(env, formulas, env.step_limit))
    except UncompilableError as reason:
        text = f"the expressions of {type(env).__name__} cannot be compiled: {reason}"
        logger.info("%s. They are evaluated in Python, which is slower", text)
        return None


class ExpressionStep:
    """The step of an environment whose hooks are expressions: a step of a pool of one.

    Args:
        env: The environment. It reads from the arrays of this step from now on.
        task: The programs of its expressions.
    """

    def __init__(self, env: FMUEnv, task: TaskPrograms) -> None:
        pool, draws = env._instance.pool, env.episode_start
        rows = batched(env, 1, pool)
        starts = draws.constants[:, None].copy()
        if task.inputs.loads("parameter") or task.conclusion.loads("parameter"):
            numbers = zip(draws.parameter_names, starts, strict=True)
            rows.parameters = {name: row for name, row in numbers if name not in draws.strings}
        self._arrays = arrays = EpisodeArrays(env, rows, np.zeros(1, np.bool_))
        arrays.hold(task.variables)
        self._layout = layout = LayoutOfOne(task, env)
        play = prepare_step(
            env,
            arrays,
            task,
            starts,
            (no_draws(), (), np.zeros((1, 6), np.uint64)),
            (True, layout.shapes),
        )
        self._play: Any = play.step
        self._updated = task.updated
        self._take_over(env, EpisodeColumn(rows, 0))

    def _take_over(self, env: FMUEnv, column: EpisodeColumn) -> None:
        """Let the environment read its quantities from the arrays."""
        own = env._episode
        for name in READ:
            setattr(column, name, getattr(own, name))
        column.parameters = own.parameters
        column.variables.update(own.variables)
        env._episode = column

    def step(self, env: FMUEnv, action: Any) -> Result:
        """Do a step.

        Raises:
            ConfigError: If the action does not fit, or the inputs that it makes are not finite.
            SimulationError: After a fault with ``on_fault="raise"``.
        """
        env._ended = True  # until the step is done: after an exception no episode goes on
        try:
            played = self._play(action, False)
        except _REFUSALS as error:
            require_refusal(error)
            played = self._play_element(env, action)
        troubled, ended, reward, terminated, truncated, seen, _ = played
        if troubled:
            return self._conclude_again(env)
        if ended:
            self._arrays.ended[0] = False  # a reset begins the next episode, not the pool
        else:
            env._ended = False
        if self._layout.is_plain:
            return seen[0], reward, terminated, truncated, {}
        observation, info = self._layout.of_one(seen)
        return observation, reward, terminated, truncated, info

    def _play_element(self, env: FMUEnv, action: Any) -> Any:
        """Do a step with an action that the pool has refused in its own type or shape."""
        env._ended = False
        element = as_element(env, action)
        env._ended = True
        return self._play(element if element.shape else element.item(), False)

    def _conclude_again(self, env: FMUEnv) -> Result:
        """Conclude a step in Python, whose status or a number is not good, from before it on."""
        arrays, read, conversions = self._arrays, env._episode, env._conversions
        values, read.outputs = read.outputs, arrays.kept[:, 0]
        for name in self._updated:
            arrays.variables[name][...] = arrays.before[name]
        read.done, arrays.ended[0] = False, False
        if not np.isfinite(env._instance.inputs).all():
            read.step_count -= 1
            conversions.input_writer.checked(
                env._get_inputs(), read.action
            )  # it says what is wrong
        if conversions.pool_observes:
            with np.errstate(over="ignore"):  # what is infinite then is a fault
                env._instance.observation[:] = values[: env.interface.output_count]
        result = conclude(env, env._instance.pool.statuses.item(0), values)
        env._ended = result[2] or result[3]
        return result
