"""Compiled steps of a single environment, which are those of a batch of one."""

from __future__ import annotations

import logging
import weakref
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from fmugym.env import FMUEnv
from fmugym.expressions.program import UncompilableError
from fmugym.task.inside import Inside
from fmugym.task.judging import Result, after_step, judged
from fmugym.task.native_draws import no_draws
from fmugym.task.readings import READINGS, Readings
from fmugym.vector.engines.layout import Layout
from fmugym.vector.hooks.formula_programs import compile_formulas, formulas_of
from fmugym.vector.hooks.memory import Memory
from fmugym.vector.hooks.task_programs import TaskPrograms
from fmugym.vector.views import batched

__all__ = ["Player", "player_of"]

logger = logging.getLogger(__name__)


def player_of(env: FMUEnv) -> Player | None:
    """Compile the expressions of an environment in an episode.

    Args:
        env: The environment, with a native pool of its own.

    Returns:
        None if they cannot be compiled, or if there is another hook.
    """
    formulas = formulas_of(env)
    if formulas is None:
        return None
    try:
        return Player(env, compile_formulas(env, formulas))
    except UncompilableError as reason:
        text = f"the expressions of {type(env).__name__} cannot be compiled: {reason}"
        logger.info("%s. They are evaluated in Python, which is slower", text)
        return None


class Player:
    """Steps an environment by programs that its pool runs.

    Between two steps, the environment reads from the pool's arrays. As soon as Python has to do a
    step, to write what hooks read, or to start an episode, it reads from an object of its own
    again.

    Args:
        env: The environment, in an episode.
        task: The programs of its expressions.

    Attributes:
        readings: What hooks read from the pool's arrays.
        step: Does a step by an action; see ``_native.Pool.step_one``.
    """

    step: Callable[[Any], Any]

    def __init__(self, env: FMUEnv, task: TaskPrograms) -> None:
        env.inside.keep()
        self._own = env.inside.own_readings
        pool: Any = env.inside.pool
        self._pool = env.inside.pool
        draws, ended = env.inside.draws, np.ones(1, np.bool_)
        self._rows = batched(env, 1, self._pool.outputs, self._pool.inputs)
        starts = draws.constants[:, None].copy()
        self._memory = memory = Memory(env, self._rows, ended)
        memory.parameters = dict(zip(draws.parameter_names, starts, strict=True))
        memory.hold(task)
        self._task = task
        reads = task.inputs.loads("parameter") or task.judgement.loads("parameter")
        self._parameters = memory.parameters if reads else {}
        shapes, form, divided = Layout(task, env, 1).of_one()
        complete = None if divided is None else partial(_complete, divided)
        memory.prepare(
            self._pool,
            task,
            starts,
            (no_draws(), (), np.zeros((1, 6), np.uint64)),
            env.inside.step_limit,
            (tuple, form, (), shapes, (None,) * 3),
        )
        self.readings: Any = PoolReadings(env, self._own, self._rows)
        judge = partial(_judge_again, weakref.ref(env))
        self.step = partial(pool.step_one, judge, complete)

    def play(self, env: FMUEnv, action: Any) -> Result | None:
        """Let the pool do the whole step.

        Returns:
            None if Python must do it.
        """
        if env.inside.readings is self.readings or self._take_over(env):
            result: Result | None = self.step(action)
            return result
        return None

    # From Python to the pool and back.

    def _take_over(self, env: FMUEnv) -> bool:
        """Copy what the environment keeps to the pool's arrays, and let it read from there.

        Returns:
            False if there is no episode, or if the environment keeps what programs cannot hold.
        """
        if env.inside.ended:
            return False
        own, memory = self._own, self._memory
        none = env.inside.no_action
        try:
            for name, row in memory.variables.items():
                row[..., 0] = _exactly(own.variables[name], row.dtype)
            for row, action in zip(memory.actions, (own.action, own.previous_action), strict=True):
                known = action is none  # an episode has begun
                row[0] = none if known else _exactly(action, row.dtype).reshape(row.shape[1:])
            for name in self._parameters:
                if name in own.parameters:
                    number = own.parameters[name]
                    memory.parameters[name][0] = np.nan if isinstance(number, str) else number
        except Exception:  # a user may have assigned anything
            return False
        self._rows.step_count[0], memory.ended[0] = own.step_count, False
        self._pool.inputs[:, 0] = own.inputs
        env.inside.readings = self.readings
        return True

    def keep(self, inside: Inside) -> None:
        """Let the environment keep again what hooks read, as after the latest step."""
        own, now = self._own, self.readings
        if inside.readings is not now:
            return
        inside.readings = own
        inside.ended = inside.ended or bool(self._memory.ended[0])
        self._memory.ended[0] = True  # the pool must not step
        if now.step_count == own.step_count:
            return  # nothing has happened
        for name in _KEPT:
            setattr(own, name, getattr(now, name))
        for name in self._task.updated:
            own.variables[name] = _number_of(self._memory.variables[name][..., 0])

    def begin(self) -> None:
        """Let the pool not step: Python begins an episode."""
        self._memory.ended[0] = True

    def go_back(self, inside: Inside) -> None:
        """Let the environment keep what hooks read when the FMU has stepped, but was not judged."""
        self.keep(inside)
        own, memory = self._own, self._memory
        own.values = tuple(memory.kept[:, 0].tolist())
        own.state = own.previous_state
        own.done = inside.ended = False
        for name in self._task.updated:
            own.variables[name] = _number_of(memory.before[name][..., 0])


def _judge_again(ref: weakref.ref[FMUEnv]) -> Result:
    """Judge a step in Python: its status or a number is not good, or a hook raises."""
    env: Any = ref()
    inside = env.inside
    inside.player.go_back(inside)
    if inside.pool_observes:
        with np.errstate(over="ignore"):  # what is infinite then is a fault
            inside.observation_row[:] = inside.output_row[: inside.output_count]
    return after_step(env, judged, inside.pool.statuses.item(0))


def _complete(divided: Callable[[Any], Any], result: Result) -> Result:
    """Divide what the pool has filled."""
    observation, info = divided(result[0])
    return observation, *result[1:4], info


_KEPT: Final = ("values", *(name for name in READINGS if name not in {"out", "variables"}))


class PoolReadings:
    """What hooks of a single environment read from the pool's arrays; see ``Readings``.

    Each value is made when it is asked for. Who asks for the variables may write them, so that the
    environment keeps everything itself again.
    """

    parameters = property(lambda self: self._own.parameters)
    after_end = property(lambda self: self._own.after_end)

    def __init__(self, env: FMUEnv, own: Readings, rows: Readings) -> None:
        self._env, self._own, self.out = weakref.ref(env), own, own.out
        self._views = {name: getattr(rows, name)[..., 0] for name in _FROM_POOL}

    @property
    def variables(self) -> Any:
        env: Any = self._env()
        env.inside.keep()
        return self._own.variables


def _read_from_pool(name: str, make: Callable[[npt.NDArray[Any]], Any]) -> property:
    return property(lambda self: make(self._views[name]))


_FROM_POOL: Final[Mapping[str, Callable[[npt.NDArray[Any]], Any]]] = {
    **dict.fromkeys(
        ("values", "state", "previous_state", "inputs"), lambda part: tuple(part.tolist())
    ),
    **dict.fromkeys(("action", "previous_action"), lambda part: part[()].copy()),
    **dict.fromkeys(("step_count", "done"), lambda part: part.item()),
}
"""What makes a reading of the part of an array that belongs to the environment."""

for _name, _make in _FROM_POOL.items():
    setattr(PoolReadings, _name, _read_from_pool(_name, _make))


def _exactly(value: Any, dtype: np.dtype[Any]) -> npt.NDArray[Any]:
    """The same numbers in another type.

    Raises:
        ValueError: If that type does not have them.
    """
    given = np.asarray(value)
    same = given.astype(dtype)
    if given.dtype != dtype and not np.array_equal(same, given, equal_nan=True):
        raise ValueError(f"{given} are no numbers of the type {dtype}")
    return same


def _number_of(values: Any) -> Any:
    """An episode variable as the hooks of a single environment read it."""
    return values.item() if values.ndim == 0 else values.copy()
