"""The parts of a config that follow from a task directly."""

from __future__ import annotations

import sys
from typing import Any

from fmugym.environment.distributions import is_distribution
from fmugym.fmi.description import ModelDescription
from fmugym.task.declarations import Declarations
from fmugym.task.scenarios import read_begin, read_scenarios
from fmugym.task.task_entries import Entry, steps_in
from fmugym.task.task_names import CLOCK, Naming

__all__ = ["beginning_of", "bounds_of", "samplings_of", "time_step_of", "times_of"]


def time_step_of(root: Entry, description: ModelDescription) -> float:
    """Length of a step in seconds, as the task gives it, or the default of the FMU.

    Raises:
        ConfigError: If neither gives a positive one.
    """
    own: float | None = root.child("time_step").value
    step = description.step_size if own is None else own
    if step is None:
        text = "the key 'time_step' is missing, and the FMU has no default step size"
        raise root.lack(text, "time_step")
    return step


def times_of(naming: Naming) -> dict[str, Any]:
    """The lengths and times of a config. If one is no multiple of the time step, it is noted."""
    declared, time_step = naming.declared, naming.time_step
    root, times = declared.root, dict[str, Any](time_step=time_step)
    start, substeps, length = map(root.child, ("start_time", "substeps", "episode_length"))
    if declared.warm_up.period:
        times["warm_up"] = declared.warm_up.period
    if substeps.value is not None:
        times["substeps"] = substeps.value
    with length.noting():
        if length.value is not None:
            times["max_episode_steps"] = steps_in(length, length.value, time_step, sys.maxsize)
    with start.noting():
        if start.value is not None:
            steps = times.get("max_episode_steps", 0)
            times["start_time"] = _start_time(declared, steps * time_step)
    return times


def _start_time(declared: Declarations, length: float) -> Any:
    """Start time of the FMU, or its distribution; a warm-up and the episode follow."""
    root = declared.root
    start, scenarios = root.child("start_time"), read_scenarios(root)
    span = declared.warm_up.period + length
    found, _ = read_begin(start, scenarios, span, files=declared.files)
    if is_distribution(found) and root.child("clock").value is not None:
        raise start.error(
            "start_time and clock cannot both be given where the start time is drawn: data follow "
            "the time of the FMU"
        )
    return found


def beginning_of(naming: Naming) -> dict[str, Any]:
    """The episode variables that tell when an episode begins, and in which files of data.

    Raises:
        ConfigError: If there is no time for an episode.
    """
    declared, step = naming.declared, naming.time_step
    root, scenarios = declared.root, read_scenarios(declared.root)
    clock, start = root.child("clock"), root.child("start_time")
    length = times_of(naming).get("max_episode_steps", 0) * step
    if clock.value is None:
        span = declared.warm_up.period + length
        return read_begin(start, scenarios, span, files=declared.files)[1]
    before = naming.warm_steps * step
    begin, files = read_begin(clock, scenarios, length, before, declared.files)
    return {CLOCK: begin, **files}


def samplings_of(naming: Naming) -> dict[str, str]:
    """Samplings of outputs that differ from ``"last"``, by the names in the FMU."""
    names = (*naming.outputs, *naming.monitors)
    found = [naming.declared.variables[name].fmu_variable for name in names]
    return {one.name: one.sampling for one in found if one.sampling != "last"}


def bounds_of(naming: Naming) -> dict[str, tuple[float, float]]:
    """Limits that the task gives for its inputs, observations and start values."""
    declared = naming.declared
    names = (*declared.written, *naming.outputs, *declared.parameters)
    found = [declared.variables[name].fmu_variable for name in names]
    return {one.name: one.bounds for one in found if one.bounds is not None}
