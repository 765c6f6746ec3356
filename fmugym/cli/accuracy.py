"""Accuracy of an FMU under other settings: an episode, repeated with the same inputs.

The inputs of an episode are kept. The FMU alone repeats them, with other communication steps or
solvers. What changes is an error of these settings.
"""

from __future__ import annotations

import logging
import statistics
import time
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np

from fmugym.environment.env import FMUEnv
from fmugym.environment.pool_opening import pool_options
from fmugym.errors import FMUGymError
from fmugym.fmi.fmu import FMU
from fmugym.fmi.status import WARNING_CODE
from fmugym.fmi.variable import Variable, checked_value
from fmugym.pool.opening import PoolOptions, open_pool
from fmugym.pool.pool import FloatArray, Pool
from fmugym.pool.pool_spec import PoolSpec

__all__ = ["TOLERANCE", "OutputTrajectory", "Replay", "error_of", "substeps_of"]

TOLERANCE: Final = 0.01
"""Tolerated error of settings, as a part of the variation of outputs."""

_CONVERGED: Final = 0.2 * TOLERANCE
_STEPS: Final = 50
_FEW: Final = 10
"""Steps that are compared if 50 of them depend on the smallest errors, as chaos does."""

_MOST_SUBSTEPS: Final = 512
_SECONDS: Final = 2.0
"""Real time after which a repetition is cut short."""

_NOTHING: Final = 1e-9
"""Outputs that vary by a smaller fraction of their size do not vary."""


_silent: Final = logging.Logger("fmugym.validate.settings", logging.CRITICAL + 1)
"""Drops messages of the FMU, which may fail with settings other than the task's."""


@dataclass(frozen=True)
class OutputTrajectory:
    """Outputs of an FMU in an episode.

    Attributes:
        outputs: Its real outputs at the start and after each step, shape (T + 1, k); NaN after a
            failure.
        seconds: The real time of a step, the median.
        is_whole: Whether there was time for all steps.
    """

    outputs: FloatArray
    seconds: float
    is_whole: bool = True


@dataclass(frozen=True)
class Replay:
    """The inputs of an episode, to be repeated.

    Attributes:
        fmu: The FMU.
        spec: The settings of the task.
        options: Those of the pool.
        variables: Those that are set at the start.
        starts: Their values, shape (P, 1).
        inputs: The values of the inputs in each step, shape (T, m).
    """

    fmu: FMU
    spec: PoolSpec
    options: PoolOptions
    variables: tuple[Variable, ...]
    starts: FloatArray
    inputs: FloatArray

    @classmethod
    def of(cls, env: FMUEnv) -> Replay:
        """Play the beginning of an episode with random actions, and keep the FMU's inputs."""
        env.action_space.seed(0)
        env.reset(seed=0)
        draws, pool = env.episode_start, env.pool
        pairs = zip(draws.model_variables, draws.parameter_names, strict=True)
        starts = [checked_value(variable, env.parameters[name]) for variable, name in pairs]
        inputs: list[Any] = []
        fails = False
        while len(inputs) < _STEPS:
            _, _, terminated, truncated, info = env.step(env.action_space.sample())
            inputs.append(pool.inputs[:, 0].copy())
            fails = fails or "fault" in info
            if terminated or truncated:
                break
        rows = np.array(inputs, np.float64).reshape(len(inputs), len(pool.inputs))
        if fails:  # with other settings it may go on
            rows = np.resize(rows, (_STEPS, len(pool.inputs)))
        variables, values = draws.model_variables, np.array([starts]).T
        return cls(env.fmu, env.pool_spec, pool_options(env), variables, values, rows)

    def run(self, **changes: Any) -> OutputTrajectory | None:
        """Repeat the episode with other settings.

        Args:
            changes: Attributes of ``PoolSpec``.

        Returns:
            What the FMU gave; None if it does not begin with these settings.
        """
        spec = replace(self.spec, warm_up_steps=0, **changes)
        fmu = _untried(self.fmu)
        options = replace(self.options, isolation=None if fmu.bundled else "process")
        try:
            pool = open_pool(fmu, spec, 1, _silent, options)
        except FMUGymError:
            fmu.close()
            return None
        with closing(pool):
            pool.reset(self.variables, self.starts)
            return None if pool.statuses[0] > WARNING_CODE else self._played(pool)

    def _played(self, pool: Pool) -> OutputTrajectory:
        real = [i for i, one in enumerate(self.spec.outputs) if one.kind == "real"]
        rows = np.full((1 + len(self.inputs), len(real)), np.nan)
        rows[0] = pool.outputs[real, 0]
        times: list[float] = []
        for row, inputs in zip(rows[1:], self.inputs, strict=True):
            begin = time.perf_counter()
            pool.step(inputs[:, np.newaxis])
            times.append(time.perf_counter() - begin)
            if pool.statuses[0] > WARNING_CODE:
                break
            row[:] = pool.outputs[real, 0]
            if sum(times) > _SECONDS:
                return OutputTrajectory(
                    rows[: 1 + len(times)], statistics.median(times), is_whole=False
                )
        return OutputTrajectory(rows, statistics.median(times))


def _untried(fmu: FMU) -> FMU:
    """An FMU without trials, since each setting would have a trial of its own.

    So an FMU that is not bundled runs in a worker process, whose end is a failure of the setting.
    """
    own = fmu.again()
    own.probe_timeout = None
    return own


def error_of(
    course: OutputTrajectory | None, reference: OutputTrajectory, steps: int | None = None
) -> float:
    """Difference of two trajectories, as a part of the variation of the outputs.

    It is the root of the mean square over the steps, of the worst output. It is infinite for a
    course with a failure.
    """
    if course is None:
        return np.inf
    count = min(len(course.outputs), len(reference.outputs), 1 + (steps or _STEPS))
    one, other = course.outputs[:count], reference.outputs[:count]
    if not count or not one.shape[1]:
        return 0.0
    if not (np.isfinite(one).all() and np.isfinite(other).all()):
        return np.inf
    scale, differences = _variation(other), _root_mean_square(one - other)
    with np.errstate(all="ignore"):
        errors = np.where(scale > 0, differences / scale, np.where(_variation(one) > 0, np.inf, 0))
    return float(errors.max())


def _variation(rows: FloatArray) -> FloatArray:
    """Variation of each output, beyond its rounding."""
    varies: FloatArray = _root_mean_square(rows - rows[0])
    return np.where(varies > _NOTHING * np.abs(rows).max(axis=0), varies, 0.0)


def _root_mean_square(rows: FloatArray) -> FloatArray:
    with np.errstate(over="ignore"):
        root: FloatArray = np.sqrt(np.mean(rows**2, axis=0))
    return root


@dataclass(frozen=True)
class Substeps:
    """Results of other numbers of substeps.

    Attributes:
        needed: The least number that is exact enough; None if the results do not settle.
        error: Error of the task's own number of substeps.
        least: The difference of the two finest repetitions.
        finest: The largest number that was tried.
        seconds: The real time of a step by the number of substeps.
    """

    needed: int | None
    error: float
    least: float
    finest: int
    seconds: dict[int, float]


def substeps_of(replay: Replay) -> Substeps | None:
    """Find the necessary number of substeps.

    The number is doubled until the results settle.

    Returns:
        What was found; None if the FMU allows no other number.
    """
    own = replay.spec.substeps
    courses = {own: replay.run(), **dict(_ladder(replay))}
    *others, finest = sorted(count for count in courses if courses[count] is not None) or [own]
    reference = courses[finest]
    if reference is None or not others or finest < own:
        return None
    if not np.isfinite(reference.outputs).all():  # no number of substeps helps
        return None
    steps = next((n for n in (_STEPS, _FEW) if _difference(courses, finest, n) <= TOLERANCE), _FEW)
    errors = {count: error_of(course, reference, steps) for count, course in courses.items()}
    least = _difference(courses, finest, steps)
    fine = [count for count in sorted(courses) if errors[count] <= TOLERANCE]
    seconds = {n: one.seconds for n, one in courses.items() if one is not None}
    needed = fine[0] if least <= TOLERANCE else None
    return Substeps(needed, errors[own], least, finest, seconds)


def _difference(courses: dict[int, OutputTrajectory | None], finest: int, steps: int) -> float:
    """Difference of the finest repetition and the one before."""
    reference = courses[finest]
    before = max((n for n in courses if n < finest), default=finest)
    return np.inf if reference is None else error_of(courses[before], reference, steps)


def _ladder(replay: Replay) -> Iterator[tuple[int, OutputTrajectory | None]]:
    """Courses with 1, 2, 4 ... substeps, until they settle."""
    internal = replay.fmu.description.fixed_internal_step_size or 0.0
    before, count = None, 1
    while count <= max(_MOST_SUBSTEPS, 2 * replay.spec.substeps):
        if replay.spec.time_step / count < 0.999999 * internal:
            return
        course = replay.run(substeps=count)
        yield count, course
        if course is not None and not course.is_whole:
            return
        settled = course is not None and error_of(before, course) <= _CONVERGED
        if settled and count >= replay.spec.substeps:
            return
        before, count = course, 2 * count
