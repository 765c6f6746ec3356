"""Compiled steps of a single environment, which are those of a batch of one."""

from __future__ import annotations

import logging
import sys
import weakref
from collections.abc import Callable, Iterator, Mapping
from copy import deepcopy
from functools import partial
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt

from fmugym.env import FMUEnv
from fmugym.expressions.program import UntraceableError
from fmugym.task.inside import Inside
from fmugym.task.judging import Result, after_step, judged
from fmugym.task.native_draws import no_draws
from fmugym.task.readings import READINGS, Readings, reading
from fmugym.task.step import ORDER
from fmugym.vector.contents import borrowed, differs
from fmugym.vector.engines.layout import Layout
from fmugym.vector.engines.programs import attempt, compile_hooks
from fmugym.vector.hooks.check import find_difference, sample_states, states_around
from fmugym.vector.hooks.formula_programs import formulas_of
from fmugym.vector.hooks.memory import Memory
from fmugym.vector.hooks.patches import exclusive
from fmugym.vector.hooks.purity import names_in_hooks, require_pure
from fmugym.vector.hooks.task_programs import TaskPrograms
from fmugym.vector.views import batched, column

__all__ = ["Player", "player_of"]

logger = logging.getLogger(__name__)

_REACHES: Final = ((0.01, 0.1, 0.3), (0.5, 1.0, 3.0))
"""How far the states are from the present one in which programs and hooks are compared. In those
that are far, hooks may fail; both batches are of the same size."""

_NUMBERS: Final = (bool, int, float, np.bool_, np.integer, np.floating)


def player_of(env: FMUEnv, required: bool) -> Player | None:
    """Compile the hooks of an environment in an episode.

    Args:
        env: The environment, with a native pool of its own.
        required: Whether hooks that cannot be compiled are an error.

    Returns:
        None if they cannot.

    Raises:
        ConfigError: If they cannot, but must.
    """
    return attempt(env, lambda: Player(env), required, "in Python")


class Player:
    """Steps an environment by programs that its pool runs.

    Between two steps, the environment reads from the pool's arrays. As soon as Python has to do a
    step, to write what hooks read, or to start an episode, it reads from an object of its own
    again. The programs hold the values that attributes had when they were made. A number that is
    assigned later becomes an array of one, as ``set_attr`` of a vector environment makes it.

    Args:
        env: The environment, in an episode.

    Attributes:
        readings: What hooks read from the pool's arrays.
        step: Does a step by an action and the environment; see
            ``_native.Pool.step_one``.

    Raises:
        UntraceableError: If one of the hooks cannot be compiled.
    """

    step: Callable[[Any, FMUEnv], Any]

    def __init__(self, env: FMUEnv) -> None:
        env.inside.keep()
        self._env = weakref.ref(env)
        self._own = env.inside.own_readings
        self._pool: Any = env.inside.pool
        self._numbers: dict[str, npt.NDArray[Any]] = {}
        self._compile(env)

    def _compile(self, env: FMUEnv) -> None:
        self._watched = tuple(_watched_in(env))
        task = _traced(env, self._numbers)
        draws, ended = env.inside.draws, np.ones(1, np.bool_)
        self._rows = batched(env, 1, self._pool.outputs, self._pool.inputs)
        starts = draws.constants[:, None].copy()
        self._memory = memory = Memory(env, self._rows, ended, self._numbers)
        memory.parameters = dict(zip(draws.parameter_names, starts, strict=True))
        memory.hold(task)
        self._task = task
        reads = task.inputs.loads("parameter") or task.judgement.loads("parameter")
        self._parameters = memory.parameters if reads else {}
        shapes, form, divided = Layout(task, env, 1).of_one()
        self._complete = None if divided is None else partial(_complete, divided)
        memory.prepare(
            self._pool,
            task,
            starts,
            (no_draws(), (), np.zeros((1, 6), np.uint64)),
            env.inside.step_limit,
            (tuple, form, (), shapes, (None,) * 3),
        )
        self.readings: Any = PoolReadings(env, self._own, self._rows)
        self._watch()

    def _watch(self) -> None:
        """Let the pool compare the attributes before each step."""
        self._may_change = [one for one in self._watched if one.copy is not None]
        watched = tuple(part for one in self._watched for part in one[:2])
        judge = partial(_judge_again, self._env)
        self.step = partial(self._pool.step_one, judge, self._complete, watched)

    def play(self, env: FMUEnv, action: Any) -> Result | None:
        """Let the pool do the whole step.

        Returns:
            None if Python must do it.
        """
        result = None
        if env.inside.readings is self.readings or self._take_over(env):
            result = self.step(action, env)
        if result is None and self._renew(env) and self._take_over(env):
            result = self.step(action, env)
        return result

    # From Python to the pool and back.

    def _take_over(self, env: FMUEnv) -> bool:
        """Copy what the environment keeps to the pool's arrays, and let it read from there.

        Returns:
            False if there is no episode, or if the environment keeps what programs cannot hold.
        """
        if env.inside.ended:
            return False
        if any(map(Watched.has_changed, self._may_change)) and not self._renew(env):
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

    def _renew(self, env: FMUEnv) -> bool:
        """Take over attributes that were assigned or changed.

        Returns:
            Whether there were any, and compiled steps may go on.
        """
        changed = [one for one in self._watched if one.differs_in(env) or one.has_changed()]
        if not changed:
            return False
        self.keep(env.inside)
        try:
            taken = [self._takes(one.name, vars(env).get(one.name)) for one in changed]
            if all(taken):
                self._watched = tuple(_watched_in(env))
                self._watch()
            else:
                self._compile(env)
        except Exception as reason:  # as in ``player_of``
            env.inside.player = None
            text = f"the hooks of {type(env).__name__} cannot be compiled any more: {reason}"
            logger.info("%s. They run in Python, which is slower", text)
            return False
        return True

    def _takes(self, name: str, value: Any) -> bool:
        """Whether a number goes to an array that the programs read already; otherwise make one."""
        array = self._numbers.pop(name, None)
        if not isinstance(value, _NUMBERS):
            return False
        self._numbers[name] = row = np.array([value]) if array is None else array
        if array is None or np.asarray(value).dtype != row.dtype:
            self._numbers[name] = np.array([value])
            return False
        row[0] = value
        return True


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


class Watched(NamedTuple):
    """An attribute that programs depend on.

    Attributes:
        name: Its name.
        value: The object that it is; an ellipsis for an attribute of the class only.
        copy: What a list, dict or array held.
    """

    name: str
    value: Any
    copy: Any

    def differs_in(self, env: FMUEnv) -> bool:
        """Whether the attribute of an environment is another object."""
        return vars(env).get(self.name, ...) is not self.value

    def has_changed(self) -> bool:
        """Whether the object has changed in place."""
        return self.copy is not None and differs(self.copy, self.value)


def _watched_in(env: FMUEnv) -> Iterator[Watched]:
    """The attributes to which hooks refer by name, and the hooks themselves."""
    attributes, names = vars(env), set() if formulas_of(env) else names_in_hooks(env)
    if "getattr" in names:
        names |= attributes.keys()
    for name in sorted((names - env.inside.own_names) | set(ORDER)):
        value = attributes.get(name, ...)
        if value is not ... or hasattr(type(env), name):
            can_change = isinstance(value, (list, dict, set, tuple, np.ndarray))
            yield Watched(name, value, deepcopy(value) if can_change else None)


def _traced(env: FMUEnv, numbers: Mapping[str, npt.NDArray[Any]]) -> TaskPrograms:
    """Compile the hooks, and compare the programs with them on states around the present one.

    Formulas need no comparison.
    """
    if formulas_of(env):
        return compile_hooks(env, [])
    if _is_debugged():
        raise UntraceableError("a debugger is attached")
    require_pure(env)
    near, far = (sample_states(env, (1.0,), states_around(env, r)) for r in _REACHES)
    with borrowed(env, outside=True) as contents:
        _call_hooks(env, column(near, 0))
        changes = contents.changes()
    changed = changes.outside or changes.added
    if changed is not None:
        raise UntraceableError(f"it changes {changed} outside of self")
    count = len(near.step_count)
    with exclusive, borrowed(env):  # in this order, as tracing does
        vars(env).update({name: np.repeat(number, count) for name, number in numbers.items()})
        task = compile_hooks(env, [near, far], numbers)
    if task.left:
        raise UntraceableError("; ".join(task.left.values()))
    difference = find_difference(env, near)
    if difference is not None:
        raise UntraceableError(difference)
    return task


def _call_hooks(env: FMUEnv, readings: Readings) -> None:
    """Call each hook once, whatever it returns or raises."""
    with reading(env, readings), np.errstate(all="ignore"):
        for name in ORDER:
            try:
                getattr(env, name)()
            except Exception:  # hooks may raise anything
                continue


def _is_debugged() -> bool:
    """Whether something follows each line, except for what measures the coverage of tests."""
    follower = sys.gettrace()
    return follower is not None and not type(follower).__module__.startswith("coverage")


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
