"""What hooks read in a batch of N environments, and in one environment of it."""

from __future__ import annotations

from types import MappingProxyType
from typing import Any

import numpy as np
import numpy.typing as npt

from fmugym.env import FMUEnv
from fmugym.task.readings import Readings
from fmugym.task.values import EpisodeVariables

__all__ = ["batched", "column", "some", "take"]


def batched(env: FMUEnv, count: int, outputs: Any = None, inputs: Any = None) -> Readings:
    """Make the readings of a batch: arrays with environments on the last axis, all zero.

    Args:
        env: The prototype.
        count: The number of environments.
        outputs: The array of outputs and monitored variables, by default a new one.
        inputs: The array of inputs, by default a new one.
    """
    outputs = np.zeros((len(env.out), count)) if outputs is None else outputs
    space: Any = env.action_space
    action = np.zeros((*space.shape, count), space.dtype)
    variables = EpisodeVariables(env.config.variable_starts)
    variables.update({n: np.zeros((*np.shape(v), count)) for n, v in variables.items()})
    starts = env.inside.draws.variable_starts
    variables.update({n: np.repeat(start, count, axis=-1) for n, start in starts.items()})
    return Readings(
        values=outputs,
        out=env.out.over(lambda: outputs),
        state=outputs[: env.inside.output_count],
        previous_state=np.zeros((env.inside.output_count, count)),
        inputs=np.zeros((len(env.inside.start_inputs), count)) if inputs is None else inputs,
        action=action,
        previous_action=action.copy(),
        step_count=np.zeros(count, np.int64),
        done=np.zeros(count, np.bool_),
        after_end=np.zeros(count, np.bool_),
        parameters=MappingProxyType({}),
        variables=variables,
    )


def some(batch: Readings, which: npt.NDArray[np.intp] | slice = slice(None)) -> Readings:
    """Return copies of what the hooks of some environments of a batch read, in the same form.

    Args:
        batch: What the hooks of all read.
        which: Their indices, or a slice.
    """
    return batch.mapped(lambda values: np.array(np.asarray(values)[..., which]))


def column(batch: Readings, index: int) -> Readings:
    """Return what the hooks of one environment of a batch read, as Python's numbers."""
    one = batch.mapped(lambda row: take(row, index))
    for name in ("values", "previous_state", "inputs", "step_count", "done", "after_end"):
        numbers = getattr(one, name).tolist()
        setattr(one, name, tuple(numbers) if isinstance(numbers, list) else numbers)
    one.state = one.values[: len(batch.state)]
    return one


def take(values: Any, index: int) -> Any:
    """Take one environment's part of an array that has the environments in its last axis."""
    part = np.asarray(values)[..., index]
    return part.item() if part.ndim == 0 and part.dtype.kind == "f" else part[()]
