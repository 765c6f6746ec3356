"""How outputs follow inputs: whether they do at all, and whether episodes are long enough."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import replace
from itertools import chain
from typing import Final, NamedTuple

import numpy as np

from fmugym.archive.variable import Variable
from fmugym.pool.base import FloatArray
from fmugym.tools.accuracy import Course, Replay
from fmugym.tools.advice import Advice, Doubt, rounded_down

__all__ = ["advise_episodes"]

_STEPS: Final = 200
_STEPS_OF_AN_EPISODE: Final = 25
"""So many steps of the first response are an episode; those of the next ones are longer."""

_FACTORS: Final = tuple(8**power for power in range(7))
_MOST_SUBSTEPS: Final = 64
"""The FMU's own steps stay as long as they are, up to this factor."""

_SECONDS: Final = 0.25
"""After a response that took so long in real time, there are no longer ones."""

_SETTLED: Final = 0.02
"""The part of a response by which it changes in its second half, at most, if it has settled."""

_TIME_CONSTANTS: Final = 3
"""An episode should take so many of them."""

_MANY: Final = 2000
"""Steps of an episode for which longer ones are recommended."""


class _Response(NamedTuple):
    """Real outputs with the lowest and with the highest inputs, each of shape (T + 1, k)."""

    time_step: float
    low: FloatArray
    high: FloatArray


def advise_episodes(replay: Replay, steps: int) -> Iterator[Advice | Doubt]:
    """Tell outputs that never change, and recommend longer episodes where outputs are slow.

    Outputs that do not settle, such as positions and levels, give no time constant.

    Args:
        replay: An episode.
        steps: How many steps one takes.
    """
    outputs = [one for one in replay.spec.outputs if one.kind == "real"]
    responses = _responses(replay, steps)
    first = next(responses, None)
    if first is not None:
        yield from _of_still(outputs, first)
        constants = _time_constants(outputs, chain([first], responses))
        yield from _longer(replay.spec.time_step, steps, constants)


def _responses(replay: Replay, steps: int) -> Iterator[_Response]:
    """Those with longer and longer steps, as far as the FMU goes."""
    first = max(1, round(steps / _STEPS_OF_AN_EPISODE))
    for factor in _FACTORS:
        low, high = (
            _held(replay, values, first * factor)
            for values in (replay.inputs.min(axis=0), replay.inputs.max(axis=0))
        )
        if low is None or high is None:
            return
        yield _Response(first * factor * replay.spec.time_step, low.outputs, high.outputs)
        if _STEPS * (low.seconds + high.seconds) > _SECONDS:
            return


def _held(replay: Replay, inputs: FloatArray, factor: int) -> Course | None:
    """What the FMU gives with constant inputs and longer steps; None if it does not go so far."""
    course = replace(replay, inputs=np.tile(inputs, (_STEPS, 1))).run(
        time_step=factor * replay.spec.time_step,
        substeps=min(factor, _MOST_SUBSTEPS) * replay.spec.substeps,
        stop_time=None,
    )
    is_there = course is not None and course.is_whole and np.isfinite(course.outputs).all()
    return course if is_there else None


def _of_still(outputs: list[Variable], response: _Response) -> Iterator[Doubt]:
    both = np.concatenate([response.low, response.high])
    still = [
        output.name
        for output, values in zip(outputs, both.T, strict=True)
        if output.variability == "continuous" and np.ptp(values) == 0.0
    ]
    if still:
        text = f"never change, whatever the inputs: {', '.join(still)}"
        yield Doubt(text, "leave them out of observations under [agent]", "observations")


def _time_constants(outputs: list[Variable], responses: Iterable[_Response]) -> dict[str, float]:
    """Those of the outputs that settle after a step of all inputs, in s, by name."""
    found: dict[str, float] = {}
    for time_step, low, high in responses:
        for output, away in zip(outputs, np.abs(high - low).T, strict=True):
            is_settled = np.ptp(away[_STEPS // 2 :]) <= _SETTLED * away[-1]
            if output.name not in found and is_settled:
                steps = int(np.argmax(away >= (1 - math.exp(-1)) * away[-1]))
                found[output.name] = steps * time_step
        if len(found) == len(outputs):
            break
    return found


def _longer(time_step: float, steps: int, constants: dict[str, float]) -> Iterator[Advice]:
    """What makes an episode longer than the slowest response."""
    slowest = max(constants, key=lambda name: constants[name], default=None)
    length = steps * time_step
    if slowest is None or constants[slowest] <= length:
        return
    needed = _TIME_CONSTANTS * constants[slowest]
    if needed > _MANY * time_step:
        time_step = rounded_down(needed / _STEPS)
        yield Advice("", "time_step", time_step, "for an episode of a few hundred steps")
    value = float(f"{math.ceil(needed / time_step) * time_step:.12g}")
    why = f"{slowest} follows with a time constant of {constants[slowest]:.3g} s"
    yield Advice("", "episode_length", value, f"{why}, but an episode takes {length:g} s")
