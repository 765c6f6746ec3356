"""Response times of outputs, compared with the length of episodes."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from typing import Final

import numpy as np

from fmugym.archive.variable import Variable
from fmugym.pool.base import FloatArray
from fmugym.tools.accuracy import Replay
from fmugym.tools.findings import Advice
from fmugym.tools.skeleton import rounded_down

__all__ = ["advise_episodes"]

_STEPS: Final = 200
_STEPS_OF_AN_EPISODE: Final = 25
"""Number of steps of an episode in the first response; later ones are longer."""

_FACTORS: Final = tuple(8**power for power in range(7))
_MOST_SUBSTEPS: Final = 64
"""The FMU's own steps stay as long as they are, up to this factor."""

_SLOW: Final = 2e-3
"""After a response with longer steps in seconds of real time, there are no others."""

_RISEN: Final = 1 - math.exp(-1)
_SETTLED: Final = 0.02
"""The part of a response by which it changes in its second half, at most, if it has settled."""

_TIME_CONSTANTS: Final = 3
"""An episode should take so many of them."""

_MANY: Final = 2000
"""Steps of an episode for which longer ones are recommended."""

_LONG: Final = 800
"""Least number of steps of those, as actions may follow faster responses."""


def advise_episodes(replay: Replay, steps: int) -> Iterator[Advice]:
    """Recommend longer episodes for slow outputs.

    Args:
        replay: An episode.
        steps: How many steps one takes.
    """
    constants = _time_constants(replay, steps)
    seconds, name = max(((constants[one], one.name) for one in constants), default=(0.0, ""))
    time_step = replay.spec.time_step
    if seconds <= steps * time_step:
        return
    why = f"{name} follows with a time constant of {seconds:.3g} s: an episode ends before"
    needed = _TIME_CONSTANTS * seconds
    if needed > _MANY * time_step:
        time_step = rounded_down(needed / _LONG)
        yield Advice("", "time_step", time_step, why)
    value = float(f"{math.ceil(needed / time_step) * time_step:.12g}")
    yield Advice("", "episode_length", value, why)


def _time_constants(replay: Replay, steps: int) -> dict[Variable, float]:
    """Time constants of real outputs under constant inputs, in s; 0 without a change.

    The time at which one comes near the value where it rests counts: what swings has it soon.
    Outputs that do not settle, such as positions and levels, have none.
    """
    outputs = [one for one in replay.spec.outputs if one.kind == "real"]
    held = replace(replay, inputs=np.repeat(replay.inputs[:1], _STEPS, axis=0))
    found: dict[Variable, float] = {}
    courses: list[tuple[float, FloatArray]] = []  # the changes, and the step that they have
    for factor in (max(1, round(steps / _STEPS_OF_AN_EPISODE)) * one for one in _FACTORS):
        time_step = factor * replay.spec.time_step
        substeps = min(factor, _MOST_SUBSTEPS) * replay.spec.substeps
        course = held.run(time_step=time_step, substeps=substeps, stop_time=None)
        if course is None or not course.is_whole or not np.isfinite(course.outputs).all():
            break
        courses.append((time_step, np.abs(course.outputs - course.outputs[0]).T))
        for index, output in enumerate(outputs):
            away = courses[-1][1][index]
            if np.ptp(away[_STEPS // 2 :]) <= _SETTLED * away[-1]:
                risen = ((step, rows[index] >= _RISEN * away[-1]) for step, rows in courses)
                first = next(step * int(np.argmax(has)) for step, has in risen if has.any())
                found.setdefault(output, first)
        if len(found) == len(outputs) or course.seconds > _SLOW:
            break
    return found
