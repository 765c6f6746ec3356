"""Whole steps of a single environment in one call of the native pool."""

from __future__ import annotations

import logging
import weakref
from collections.abc import Callable, Mapping
from functools import partial
from inspect import getattr_static
from math import prod
from typing import Any

import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from fmugym.env import FMUEnv
from fmugym.errors import ConfigError
from fmugym.signals import ordinary
from fmugym.single.compare import require_equal
from fmugym.single.left import HooksLeft, require_few
from fmugym.single.trace import Kind, SingleTask, kind_of, trace_single
from fmugym.task.readings import LATE, LateReading, make_late
from fmugym.task.waiting import STEPS_BEFORE
from fmugym.vector.actions import is_array_space
from fmugym.vector.hooks.program import Row, UntraceableError

__all__ = ["Player"]

logger = logging.getLogger(__name__)


class Player:
    """Steps an environment with compiled hooks.

    Between two steps, the environment does not have the attributes that hooks read. ``read`` makes
    one when it is asked for.

    Args:
        required: Whether hooks that cannot be compiled are an error.

    Attributes:
        may_have_moved: Whether an exception out of a step ends the episode: not before the FMU.
    """

    def __init__(self, required: bool) -> None:
        self._required = required
        self._pause = STEPS_BEFORE // 2
        self._wait = 0
        self._known = -1
        self._has_methods = False
        self._task: SingleTask | None = None
        self._variables: Any = None
        self._ended_by_task = False
        self._told: set[str] = set()
        self.may_have_moved = True

    def ready(self, env: FMUEnv, action: Any) -> Any:
        """Make the function that steps the environment, if its hooks are compiled or can be.

        Returns:
            A function of the action, the attributes and their number. It returns the result of the
            step; None if nothing has happened, and Python must do the step; and False if the FMU
            has stepped, but Python must judge it. Without compiled hooks, None.
        """
        attributes = vars(env)
        if self._task is not None and (self._has_methods or len(attributes) != self._known):
            self._look_again(self._task, attributes)
        if self._task is None:
            if self._wait > 0:
                self._wait -= 1
                return None
            if not _is_plain(env, action):
                return None
            self._compile(env, action)
        if self._task is None or not self._take_over(env, self._task):
            return None
        env._width = len(attributes)
        return self._step

    def doubt(self, env: FMUEnv) -> None:
        """Leave a step to Python; before the next one, look for attributes that have changed."""
        self._known = -1
        if env._play is not None:
            self.give_back(env)

    def _look_again(self, task: SingleTask, attributes: Mapping[str, Any]) -> None:
        """Drop the programs if an attribute has changed that they depend on."""
        self._known = len(attributes)
        if not task.still_holds(attributes):
            self._task, self._pause = None, 2 * self._pause
            self._wait = self._pause

    # Compiling.

    def _compile(self, env: FMUEnv, action: Any) -> None:
        try:
            _require_late(env)
            task = trace_single(env, action)
            require_few(task.left)
            require_equal(env, task)
            self._prepare(env, task)
            make_late(FMUEnv)
            self._task, self._known = task, len(vars(env))
        except ordinary(Exception) as reason:  # hooks may raise anything
            env._player = None
            text = f"the hooks of {type(env).__name__} cannot be compiled: {reason}"
            if self._required:
                raise ConfigError(text) from None
            logger.info("%s. They run in Python, which is slower", text)
        else:
            self._tell_of_left(env, task)
            self._required = False

    def _tell_of_left(self, env: FMUEnv, task: SingleTask) -> None:
        """Tell once of each hook that stays in Python."""
        for name, why in task.left.items():
            text = f"a hook of {type(env).__name__} cannot be compiled: {why}"
            if self._required:
                env._player = None
                raise ConfigError(text)
            if name not in self._told:
                logger.info("%s. It runs in Python, the others are compiled", text)
        self._told |= task.left.keys()

    def _prepare(self, env: FMUEnv, task: SingleTask) -> None:
        """Make the arrays that the programs use, and hand everything to the pool."""
        self._pool: Any = env._open_pool("step")
        rows = {name: prod(kind.shape or ()) for name, kind in task.variables.items()}
        kinds = task.variables
        self._now = {name: np.zeros((size, 1), kinds[name].dtype) for name, size in rows.items()}
        self._before = {name: row.copy() for name, row in self._now.items()}
        self._kept, self._wanted = np.zeros(len(env.out)), np.zeros(len(env.inputs))
        self._parameters = np.zeros((len(env.parameters), 1))
        self._count = np.zeros(1, np.int64)
        self._seen = tuple(np.zeros(array.shape, array.dtype) for array in task.seen)
        self._has_methods = any(one.is_method for one in task.watched)
        self._reads_inputs = task.inputs.loads("input")
        self._reads_parameters = task.loads("parameter")
        self._reads_actions = task.loads("load_previous_action")
        self._reads_variables = task.loads("variable") or task.loads("before")
        if self._reads_actions and task.action_type is int:
            raise UntraceableError("it reads previous_action, and actions are integers of Python")
        own = [array.copy for array in self._seen]
        self._calls = self._pool.prepare_single(
            inputs=task.inputs.with_rows(self._find),
            judgement=task.judgement.with_rows(self._find),
            actions=self._actions_of(env, task),
            rows=tuple(
                pair
                for name in task.updated
                for pair in zip(self._now[name], self._before[name], strict=True)
            ),
            wanted=self._wanted,
            kept=self._kept,
            episode=self._count,
            limit=env._step_limit,
            seen=self._seen,
            copies=tuple(own or [env._observation_row.copy]),
            names=task.keys,
            observed=env._pool_observes,
            watched=tuple(tuple(one) for one in task.watched if not one.is_method),
        )
        self._readers = self._make_readers(env)
        self._step, self.may_have_moved = self._calls.step, True
        if task.left:
            late = {"variables": self._present_variables} if self._reads_variables else {}
            self._left = HooksLeft(env, task.left, self._readers | late)
            self._step = partial(self._step_with_left, weakref.ref(env))

    def _step_with_left(
        self, ref: Callable[[], Any], action: Any, attributes: dict[str, Any], width: int
    ) -> Any:
        """Step as the pool does, but call some hooks in Python."""
        env, left = ref(), self._left
        if left.makes_inputs and not self._makes_inputs(env, action):
            return None
        result = self._calls.step(action, attributes, width)
        if not result:
            return result
        if env._play is None:
            self.forget(env)
        self._ended_by_task = result[2]
        return left.complete(env, result)

    def _makes_inputs(self, env: FMUEnv, action: Any) -> bool:
        """Let ``_get_inputs`` make the inputs; if it fails, Python does the step."""
        if not _is_plain(env, action):
            return False
        self.may_have_moved = False
        try:
            self._wanted[:] = self._left.inputs(env, action)
        except ordinary(Exception):  # hooks may raise anything
            self.may_have_moved = True
            return False
        self.may_have_moved = True
        return True

    def _actions_of(self, env: FMUEnv, task: SingleTask) -> dict[str, Any]:
        space: Any = env.action_space
        is_integer = isinstance(space, spaces.Discrete)
        low, high = (int(space.start), int(space.start + space.n - 1)) if is_integer else (0, 0)
        shape = space.shape or ()
        self._current, self._previous = (np.zeros(shape, space.dtype) for _ in range(2))
        return {
            "type": task.action_type,
            "shape": shape,
            "letter": space.dtype.char,
            "is_integer": is_integer,
            "lowest": low,
            "highest": high,
            "next": np.zeros(shape, space.dtype).reshape(-1),
            "current": self._current.reshape(-1),
            "previous": self._previous.reshape(-1),
        }

    def _find(self, row: Row) -> Any:
        """The memory of a row that a program loads or stores."""
        kind, *rest = row
        index: Any = rest[-1] if rest else 0
        match kind:
            case "output":
                return self._pool.outputs[index]
            case "kept":
                return self._kept[index : index + 1]
            case "input":
                return self._pool.inputs[index]
            case "wanted":
                return self._wanted[index : index + 1]
            case "parameter":
                return self._parameters[index]
            case "step_count":
                return self._count
        rows = self._now if kind == "variable" else self._before
        return rows[str(rest[0])][index]

    # From Python to the pool and back.

    def _take_over(self, env: FMUEnv, task: SingleTask) -> bool:
        """Copy what Python keeps to the pool's arrays, if it has the kinds of the trace."""
        for name, kind in task.variables.items():
            value = env.variables[name]
            if kind_of(value) != kind:
                return False
            self._now[name][:, 0] = self._before[name][:, 0] = np.ravel(value)
        if self._reads_parameters:
            values = env.parameters.values()
            self._parameters[:, 0] = [np.nan if type(v) is str else v for v in values]
        if self._reads_actions:
            if not _is_plain(env, env.action):
                return False
            self._current[...] = env.action
        self._count[0] = env.step_count
        if self._reads_inputs:
            env._input_row[:] = env.inputs
        self._calls.begin(env.action)
        self._ended_by_task = False
        return True

    def forget(self, env: FMUEnv) -> None:
        """Take the attributes away that the pool keeps from now on."""
        attributes = vars(env)
        for name in LATE:
            del attributes[name]
        if self._reads_variables:
            self._variables = attributes.pop("variables")
        env._play, env._width = self._step, len(attributes)

    def note_end(self, terminated: bool) -> None:
        """Note what ``_is_done`` returned in the last step of an episode."""
        self._ended_by_task = terminated

    def read(self, env: FMUEnv, name: str) -> Any:
        """Make an attribute that the environment does not have now.

        Episode variables may be written, so that the environment keeps everything itself again.
        Only ``_get_info`` does not write them.
        """
        if name != "variables":
            return self._readers[name]()
        if env._tells:
            return self._present_variables()
        self.give_back(env)
        return vars(env)[name]

    def _make_readers(self, env: FMUEnv) -> dict[str, Callable[[], Any]]:
        """The functions that make the attributes which the environment does not have now."""
        outputs, inputs, count = env._output_row, env._input_row, env._output_count
        kept = self._kept
        return {
            "_values": lambda: tuple(outputs.tolist()),
            "state": lambda: tuple(outputs.tolist()[:count]),
            "previous_state": lambda: tuple(kept.tolist()[:count]),
            "inputs": lambda: tuple(inputs.tolist()),
            "action": lambda: self._calls.actions()[0],
            "previous_action": lambda: self._calls.actions()[1],
            "step_count": self._count.item,
            "done": lambda: self._ended_by_task,
        }

    def _present_variables(self) -> Any:
        """The episode variables with their present values; writing to them has no effect."""
        if self._task is not None:
            dict.update(self._variables, self._updated(self._task, self._now))
        return self._variables

    def give_back(self, env: FMUEnv) -> None:
        """Let the environment keep all readings again; those that were set meanwhile stay."""
        attributes = vars(env)
        readings = {name: self._readers[name]() for name in LATE if name not in attributes}
        self.give_variables(env, self._now)
        attributes.update(readings)

    def begin(self, env: FMUEnv) -> None:
        """Give only the episode variables back: an episode starts, which sets everything else."""
        self.give_variables(env, None)

    def give_variables(self, env: FMUEnv, rows: Mapping[str, npt.NDArray[Any]] | None) -> None:
        """Give the episode variables back, with the values of these rows."""
        attributes = vars(env)
        env._play = None
        if self._variables is not None:
            attributes.setdefault("variables", self._variables)
            self._variables = None
        if rows is not None and self._task is not None:
            env.variables.update(self._updated(self._task, rows))

    @staticmethod
    def _updated(task: SingleTask, rows: Mapping[str, npt.NDArray[Any]]) -> dict[str, Any]:
        """The values of the variables that ``_update`` writes."""
        return {name: _value_of(task.variables[name], rows[name]) for name in task.updated}

    def go_back(self, env: FMUEnv) -> None:
        """Set what hooks read to what it is when the FMU has stepped, and nothing was judged."""
        values = tuple(self._kept.tolist())
        state = values[: env._output_count]
        readings = {name: self._readers[name]() for name in LATE}
        self.give_variables(env, self._before)
        vars(env).update(readings, _values=values, state=state, previous_state=state, done=False)


def _value_of(kind: Kind, row: npt.NDArray[Any]) -> Any:
    _, python, shape = kind
    if shape is not None:
        return row.reshape(shape).copy()
    return row.item() if python else row[0, 0]


def _is_plain(env: FMUEnv, action: Any) -> bool:
    """Whether an action is of the type that the action space has; integers may be Python's."""
    space: Any = env.action_space
    if isinstance(space, spaces.Discrete):
        return type(action) in (int, np.int64) and space.dtype == np.int64
    if type(action) is not np.ndarray or not is_array_space(space):
        return False
    return bool(action.dtype == space.dtype and action.shape == space.shape)


def _require_late(env: FMUEnv) -> None:
    """Refuse classes that have attributes of their own in the place of readings."""
    for name in (*LATE, "variables"):
        if not isinstance(getattr_static(type(env), name, None), LateReading | None):
            raise UntraceableError(f"the class has an attribute {name!r} of its own")
