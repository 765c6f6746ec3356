"""Repeating a discarded communication step as smaller ones."""

from __future__ import annotations

from typing import Final

from fmugym.errors import SimulationError
from fmugym.fmi.instance import Instance
from fmugym.fmi.status import Phase, Status
from fmugym.pool.health import Column, HealthArray

__all__ = ["step_with_retries"]

_STATUSES: Final = {Phase.FAILED: Status.ERROR, Phase.DEAD: Status.FATAL}


def step_with_retries(
    instance: Instance, time: float, step_size: float, retries: int, counts: HealthArray
) -> int:
    """Step; if the step is discarded, repeat it as 2, 4, 8 ... smaller ones.

    Each attempt begins at the state before the first, because no step may follow a discarded one.

    Args:
        instance: Steps and can save its state.
        time: The communication point in seconds.
        step_size: The communication step size in seconds.
        retries: The most attempts after the first.
        counts: The counts of the instance, shape (HEALTH_COUNTS,), which get those attempts.

    Returns:
        The status of the last attempt.
    """
    try:
        before = instance.save_state()
        status = instance.step(time, step_size)
        for exponent in range(1, retries + 1):
            if status != Status.DISCARD:
                break
            instance.restore_state(before)
            counts[[Column.RETRIES, Column.RETRIED]] += 1
            status = _step_in_parts(instance, time, step_size, 2**exponent)
        before.release()
    except SimulationError:  # the state could not be saved or restored
        status = Status.DISCARD
        instance.forbid_steps()
    return _STATUSES.get(instance.phase, status)


def _step_in_parts(instance: Instance, time: float, step_size: float, parts: int) -> int:
    size, status = step_size / parts, 0
    for index in range(parts):
        status = instance.step(time + index * size, size)
        if status < 0 or status > Status.WARNING:
            break
    return status
