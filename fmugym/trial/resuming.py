"""Trials that show whether states saved in the middle of an episode work, here and elsewhere.

One process plays an episode, saves its state, plays on, restores the state and plays on again. A
second process restores the same bytes in an instance that has never been initialized. Serialized
states may hold addresses of the first process, so the second one may crash.
"""

from __future__ import annotations

import logging
import pickle
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np

from fmugym.errors import FMUGymError, LicenceError
from fmugym.fmi.status import WARNING_CODE
from fmugym.pool.base import FloatArray, PoolSpec
from fmugym.pool.bundle import Bundle, SaveMethod
from fmugym.pool.patience import require_licence
from fmugym.pool.saving import SavingPool
from fmugym.pool.spec import ResetMethod
from fmugym.trial.attempt import Request, run
from fmugym.trial.candidate import Candidate
from fmugym.trial.inputs import moving_inputs
from fmugym.trial.known import known_resuming, note_resuming
from fmugym.trial.pools import trial_pool
from fmugym.trial.rehearsal import Starts
from fmugym.trial.seats import taking
from fmugym.trial.verdict import Grade

__all__ = ["Halfway", "make_halfway", "method_that_works", "try_halfway"]

logger = logging.getLogger(__name__)

_BEFORE, _AFTER = 5, 25
"""The steps before and after the state."""

_AMPLITUDES: Final = (0.3, 0.05, 0.0)
"""How far inputs move, as fractions of their range; the smaller ones for FMUs that fail."""

_ONE: Final = np.zeros(1, np.int64)


@dataclass(frozen=True)
class Halfway:
    """A state in the middle of an episode, and what followed it.

    Attributes:
        state: The state.
        inputs: The inputs of the steps after it, shape (steps, k_in).
        rows: The outputs after each of them, shape (steps, k).
    """

    state: Bundle
    inputs: FloatArray
    rows: FloatArray


def method_that_works(candidate: Candidate, spec: PoolSpec, starts: Starts | None) -> SaveMethod:
    """Find out in two processes whether restored states lead to the same outputs, bit by bit.

    States that do so in the first process only are good for copies within a process.

    Args:
        candidate: The FMU.
        spec: The ``PoolSpec`` to try it with.
        starts: The ``Starts`` of episodes.
    """
    known = known_resuming(candidate, spec, starts)
    if known is not None:
        return known
    try:
        with taking(candidate, spec, 1, "a trial of saved states"):
            method, grade = _tried(Request(candidate, spec, starts, resume=True))
    except LicenceError as error:
        logger.warning("snapshots keep the inputs of the episode for now: %s", error)
        return SaveMethod.REPLAY
    if grade is not Grade.FAILS:  # a failure may have passing causes
        note_resuming(candidate, spec, starts, method)
    if grade is not Grade.BITWISE:
        logger.warning(
            "%s: %s%s; snapshots keep the inputs of the episode, and restoring one%s plays the "
            "episode again",
            candidate.path.name,
            *(_WHAT_IS_WRONG[grade], " in another process" if method is SaveMethod.COPY else ""),
            " in another environment" if method is SaveMethod.COPY else "",
        )
    return method


_WHAT_IS_WRONG: Final = {
    Grade.TOLERANCE: "outputs after a saved state are equal only within the solver's tolerance",
    Grade.WRONG: "an episode that goes on from a saved state has other outputs",
    Grade.FAILS: "a saved state cannot be restored",
    Grade.ABSENT: "its state cannot be saved",
}


def _tried(request: Request) -> tuple[SaveMethod, Grade]:
    """How states can be saved, and the grade of the last trial."""
    first = run(request)
    if first.sample is None:
        return SaveMethod.REPLAY, Grade(first.answer.get("resuming", Grade.FAILS))
    halfway: Halfway = pickle.loads(first.sample)
    if halfway.state.method is not SaveMethod.STATE:  # copies stay in their process
        return SaveMethod.COPY, Grade.BITWISE
    second = run(replace(request, resume=halfway))
    grade = Grade(second.answer.get("resuming", Grade.FAILS))
    return SaveMethod.STATE if grade is Grade.BITWISE else SaveMethod.COPY, grade


# In the worker


def make_halfway(request: Request) -> Halfway | Grade:
    """Save a state and restore it in the same instance; returns a grade if that does not work."""
    for amplitude in _AMPLITUDES:
        pool = _open(request)
        try:
            halfway = _play(pool, request, amplitude)
            if halfway is not None:
                again = _rows(pool, halfway)
                same = again.tobytes() == halfway.rows.tobytes()
                return halfway if same else Grade.WRONG
        except FMUGymError:
            return Grade.FAILS
        finally:
            pool.close()
    return Grade.FAILS


def try_halfway(request: Request) -> Grade:
    """Restore the state of another process in an instance that was never initialized."""
    halfway: Halfway = request.resume
    pool = _open(request)
    try:
        rows = _rows(pool, halfway)
    except FMUGymError:
        return Grade.FAILS
    finally:
        pool.close()
    return Grade.BITWISE if rows.tobytes() == halfway.rows.tobytes() else Grade.WRONG


def _open(request: Request) -> SavingPool:
    spec = replace(
        request.spec,
        num_observed=0,
        leak_limit=None,
        fault_retries=0,
        reset_method=ResetMethod.RESTORE,
    )
    return trial_pool(request.candidate.open(), spec, 1, logger)


def _play(pool: SavingPool, request: Request, amplitude: float) -> Halfway | None:
    """Play an episode with a state in its middle; None if the FMU does not get that far."""
    starts = request.starts or Starts()
    inputs = moving_inputs(request.spec, _BEFORE + _AFTER, amplitude)
    pool.reset(starts.variables, starts.column(0))
    require_licence(pool)
    if not _step(pool, inputs[:_BEFORE], []):
        return None
    state, rows = pool.save_instances(_ONE), list[Any]()
    _step(pool, inputs[_BEFORE:], rows)
    return Halfway(state, inputs[_BEFORE:], np.array(rows))


def _rows(pool: SavingPool, halfway: Halfway) -> FloatArray:
    pool.restore_instances(halfway.state, _ONE, _ONE)
    rows: list[Any] = []
    if pool.statuses[0] <= WARNING_CODE:
        _step(pool, halfway.inputs, rows)
    return np.array(rows)


def _step(pool: SavingPool, inputs: FloatArray, rows: list[Any]) -> bool:
    """Do steps until one fails; returns whether none has failed."""
    for row in inputs:
        outputs, statuses = pool.step(row[:, None])
        rows.append(outputs[:, 0].copy())
        if statuses[0] > WARNING_CODE:
            return False
    return bool(pool.statuses[0] <= WARNING_CODE)
