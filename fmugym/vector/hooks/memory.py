"""Arrays of compiled steps, and their description for the pool."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from fmugym.env import FMUEnv
from fmugym.expressions.program import LETTERS, Row
from fmugym.expressions.quantities import PREVIOUS
from fmugym.pool.base import FloatArray, MaskArray, Play, Pool
from fmugym.task.episode import Episode
from fmugym.task.episode_start import Draw
from fmugym.vector.hooks import hook_results
from fmugym.vector.hooks.task_programs import TaskPrograms

__all__ = ["StepArrays"]

_FLOAT_CHECKS = {np.dtype(np.float64): 2, np.dtype(np.float32): 3}
"""The numbers of ``ActionCheck`` in ``native/play.h``: what refuses a NaN."""

_KEPT_BY_THE_POOL: Final = frozenset({"previous_state", "previous_action"})
"""The quantities before the step that the pool keeps by itself, from ``kept`` and ``actions``."""


class StepArrays:
    """The arrays of N environments that compiled steps read and write in place.

    Args:
        env: An environment, for what all have in common.
        episodes: What the hooks of all read; its arrays become those that steps keep.
        ended: Which episodes have ended, shape (N,).

    Attributes:
        ended: As given.
        parameters: The rows of the parameters by name; to be set before steps.
        given: The inputs that hooks on arrays have made, shape (m, N).
        kept: The outputs before the step, shape (k, N).
        actions: Those of this step and of the one before, environments first.
        variables: The episode variables by name, environments last.
        before: The same before the step.
    """

    def __init__(self, env: FMUEnv, episodes: Episode, ended: MaskArray) -> None:
        self._env, self._episodes = env, episodes
        self._n = len(ended)
        self.ended, self.parameters = ended, episodes.parameters
        self.given = np.zeros_like(episodes.inputs)
        self.kept, self._done = np.zeros_like(episodes.outputs), np.zeros(self._n, np.bool_)
        self.actions = _copied(episodes.action), _copied(episodes.previous_action)
        self.variables: dict[str, npt.NDArray[Any]] = {}
        self.before: dict[str, npt.NDArray[Any]] = {}

    def hold(self, task: TaskPrograms) -> None:
        """Make the arrays of the episode variables in the types that programs store."""
        self.variables, self.before = {}, {}
        for name, dtype in task.variables.items():
            row = hook_results.variable(name, self._episodes.variables[name], self._n)
            self.variables[name] = np.ascontiguousarray(row, dtype).copy()
            self.before[name] = self.variables[name].copy()
        self.show()

    def take_back(self, before: Mapping[str, npt.NDArray[Any]]) -> None:
        """Keep values of variables before the step, in other types and shapes than now."""
        every = np.ones(self._n, np.bool_)
        for name, values in before.items():
            hook_results.restore_variable(name, self.before[name], every, values)

    def show(self) -> None:
        """Show hooks the arrays that the pool keeps."""
        read, width = self._episodes, self._env.interface.output_count
        read.action, read.previous_action = (np.moveaxis(a, 0, -1) for a in self.actions)
        self.kept[:width] = read.previous_state
        read.previous_state = self.kept[:width]
        self._done[:] = read.done
        read.done = self._done
        read.variables.update(self.variables)

    def keep_done(self, done: MaskArray) -> None:
        """Keep which tasks have ended, which a hook on arrays has told."""
        self._done[:] = done
        self._episodes.done = self._done

    def prepare(
        self,
        pool: Pool,
        task: TaskPrograms,
        starts: FloatArray,
        draws: tuple[Any, Sequence[Draw], npt.NDArray[np.uint64]],
        limit: int,
        form: tuple[Any, ...],
    ) -> Play:
        """Give a pool everything it needs for steps.

        Args:
            pool: Has the FMUs.
            task: The programs; their variables are held.
            starts: The values of each parameter, a row each.
            draws: What draws values natively, what it draws, and the streams.
            limit: The number of steps after which episodes are truncated.
            form: How the pool makes results: their type, the forms of observations and infos, the
                shapes and types of their arrays, and what makes the info of a reset.
        """
        native, drawn, streams = draws
        *kinds, shapes, late = form
        flags, real = ((self._n,), self._done.dtype), np.dtype(np.float64)
        judged = ((self._n,), real), flags, flags, flags
        return pool.prepare_play(
            self._env.episode_start.model_variables,
            (task.inputs.with_rows(self.find), task.judgement.with_rows(self.find)),
            self._action_group(),
            starts,
            (native, streams),
            (self._episodes.step_count, self.ended, limit),
            self._surroundings(
                task, drawn, (*kinds, (*shapes, *judged, ((len(drawn), self._n), real)), late)
            ),
        )

    def find(self, row: Row) -> Any:
        """The array of a row that a program loads or stores."""
        kind, *rest = row
        index: Any = rest[-1]
        name: Any = rest[0]
        match kind:
            case "output":
                return self._episodes.outputs[index]
            case "kept":
                return self.kept[index]
            case "input":
                return self._episodes.inputs[index]
            case "parameter":
                return self.parameters[name]
            case "given":
                return self.given[index]
            case "step_count":
                return self._episodes.step_count
            case str() if kind in PREVIOUS:
                return _row(getattr(self._episodes, kind), index)
        arrays = self.variables if kind == "variable" else self.before
        return arrays[name].reshape(-1, self._n)[index]

    def _elements(self, name: str, start: Any) -> npt.NDArray[Any]:
        """The start value of each element of a variable."""
        return np.broadcast_to(start, self.variables[name].shape[:-1]).reshape(-1)

    def _action_group(self) -> dict[str, Any]:
        """Description of actions for the pool."""
        env, dtype = self._env, self.actions[0].dtype
        space: Any = env.action_space
        is_discrete = isinstance(space, spaces.Discrete)
        check = 1 if is_discrete else _FLOAT_CHECKS.get(dtype, 0)
        low, high = (int(space.start), int(space.start + space.n - 1)) if is_discrete else (0, 0)
        flat = [actions.reshape(-1) for actions in self.actions]
        return {
            "shape": self.actions[0].shape[1:],
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
        self, task: TaskPrograms, drawn: Sequence[Draw], results: tuple[Any, ...]
    ) -> dict[str, Any]:
        """Description of everything beside the programs; see ``NativePool.prepare_play``.

        Args:
            task: The programs.
            drawn: What the pool draws.
            results: How it makes results.
        """
        env, draws, read = self._env, self._env.episode_start, self._episodes
        names = draws.parameter_names
        flat = {name: row.reshape(-1, self._n) for name, row in self.variables.items()}
        before = {name: row.reshape(-1, self._n) for name, row in self.before.items()}
        constants = draws.constant_variables
        return {
            "kept": self.kept,
            "done": self._done,
            "reads_kept": task.judgement.loads("kept"),
            "before_inputs": tuple(
                (_row(getattr(read, now), index), _row(getattr(read, name), index))
                for name, now in PREVIOUS.items()
                if name not in _KEPT_BY_THE_POOL
                for index in range(getattr(read, name).size // self._n)
            ),
            "before_judgement": tuple(
                pair for name in flat for pair in zip(flat[name], before[name], strict=True)
            ),
            "input_starts": tuple(
                (names.index(name), start) if name in names else (-1, start)
                for name, start in env.interface.start_inputs
            ),
            "drawn_variables": tuple(
                (flat[draw.name][draw.element or 0], number)
                for number, draw in enumerate(drawn)
                if draw.name in flat
            ),
            "variable_starts": tuple(
                (row, np.array(value, row.dtype).tobytes())
                for name, start in constants.items()
                if name in flat
                for row, value in zip(flat[name], self._elements(name, start), strict=True)
            ),
            "results": results,
        }


def _row(array: npt.NDArray[Any], index: int) -> npt.NDArray[Any]:
    """The row of an element of a quantity, shape (N,)."""
    row: npt.NDArray[Any] = array.reshape(-1, array.shape[-1])[index]
    return row


def _copied(actions: Any) -> npt.NDArray[Any]:
    """A copy of actions with environments first, in the order of memory."""
    return np.array(np.moveaxis(actions, -1, 0), order="C")
