"""Arrays of N episodes, which compiled steps and hooks on arrays read and write in place."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from fmugym.env import FMUEnv
from fmugym.expressions.program import Row
from fmugym.expressions.quantities import PREVIOUS
from fmugym.pool.base import MaskArray
from fmugym.task.episode import Episode
from fmugym.vector.hooks import hook_results

__all__ = ["EpisodeArrays", "element_row"]


class EpisodeArrays:
    """Arrays of N episodes, which steps read and write in place.

    Args:
        env: An environment, for what all have in common.
        quantities: The quantities that hooks read; arrays of this object become theirs.
        ended: Which episodes have ended, shape (N,).

    Attributes:
        quantities, ended: As given.
        parameters: The rows of the parameters by name; to be set before steps.
        given: The inputs that hooks on arrays have made, shape (m, N).
        kept: The outputs before the step, shape (k, N).
        done: Where the latest step has ended the task, shape (N,).
        actions: Those of this step and of the one before, environments first.
        variables: The episode variables by name, environments last.
        before: The same before the step.
    """

    def __init__(self, env: FMUEnv, quantities: Episode, ended: MaskArray) -> None:
        self._width, self.quantities = env.interface.output_count, quantities
        self._n = len(ended)
        self.ended, self.parameters = ended, quantities.parameters
        self.given = np.zeros_like(quantities.inputs)
        self.kept, self.done = np.zeros_like(quantities.outputs), np.zeros(self._n, np.bool_)
        self.actions = _copied(quantities.action), _copied(quantities.previous_action)
        self.variables: dict[str, npt.NDArray[Any]] = {}
        self.before: dict[str, npt.NDArray[Any]] = {}

    def hold(self, types: Mapping[str, np.dtype[Any]]) -> None:
        """Make the arrays of the episode variables in these types, by name."""
        self.variables, self.before = {}, {}
        for name, dtype in types.items():
            row = hook_results.variable(name, self.quantities.variables[name], self._n)
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
        read, width = self.quantities, self._width
        read.action, read.previous_action = (np.moveaxis(a, 0, -1) for a in self.actions)
        self.kept[:width] = read.previous_state
        read.previous_state = self.kept[:width]
        self.done[:] = read.done
        read.done = self.done
        read.variables.update(self.variables)

    def keep_done(self, done: MaskArray) -> None:
        """Keep which tasks have ended, which a hook on arrays has told."""
        self.done[:] = done
        self.quantities.done = self.done

    def find(self, row: Row) -> Any:
        """The array of a row that a program loads or stores."""
        kind, *rest = row
        index: Any = rest[-1]
        name: Any = rest[0]
        match kind:
            case "output" | "input":
                return getattr(self.quantities, f"{kind}s")[index]
            case "kept" | "given":
                return getattr(self, kind)[index]
            case "parameter":
                return self.parameters[name]
            case "step_count":
                return self.quantities.step_count
            case "done" | "ended":
                return getattr(self, kind)
            case "action" | "previous_action":
                actions = self.actions[kind == "previous_action"]
                return actions.reshape(self._n, -1)[:, index]
            case str() if kind in PREVIOUS:
                return element_row(getattr(self.quantities, kind), index)
        arrays = self.variables if kind == "variable" else self.before
        return arrays[name].reshape(-1, self._n)[index]


def element_row(array: npt.NDArray[Any], index: int) -> npt.NDArray[Any]:
    """The row of an element of a quantity, shape (N,)."""
    row: npt.NDArray[Any] = array.reshape(-1, array.shape[-1])[index]
    return row


def _copied(actions: Any) -> npt.NDArray[Any]:
    """A copy of actions with environments first, in the order of memory."""
    return np.array(np.moveaxis(actions, -1, 0), order="C")
