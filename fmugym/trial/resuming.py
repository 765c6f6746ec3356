"""Trials that show whether states saved in the middle of an episode work, here and elsewhere.

One process plays an episode, saves its state, plays on, restores the state and plays on again. A
second process restores the same bytes in an instance that has never been initialized. Serialized
states may hold addresses of the first process, so the second one may crash.
"""

from __future__ import annotations

import logging
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from typing import Final

import numpy as np

from fmugym.archive.fmu import FMU
from fmugym.errors import LicenceError
from fmugym.fmi.status import WARNING_CODE
from fmugym.pool.base import FloatArray, Pool
from fmugym.pool.bundle import Bundle, SaveMethod
from fmugym.pool.instance_limit import claim_instances
from fmugym.pool.spec import PoolSpec, ResetMethod
from fmugym.trial.inputs import moving_inputs
from fmugym.trial.known import known_resuming, note_resuming
from fmugym.trial.subject import Subject
from fmugym.trial.trial_episodes import Starts, start, steps
from fmugym.trial.verdict import Grade

__all__ = ["method_that_works"]

logger = logging.getLogger(__name__)

_BEFORE, _AFTER = 5, 25
"""The steps before and after the state."""

_AMPLITUDES: Final = (0.3, 0.05, 0.0)
"""How far inputs move, as fractions of their range; the smaller ones for FMUs that fail."""

_STAGE: Final = "the rehearsal of a state in the middle of an episode"
_ONE: Final = np.zeros(1, np.int64)


@dataclass(frozen=True)
class _Halfway:
    """A state in the middle of an episode, and what followed it.

    Attributes:
        state: The state.
        inputs: The inputs of the steps after it, shape (steps, k_in, 1).
        rows: The outputs after each of them.
    """

    state: Bundle
    inputs: FloatArray
    rows: list[bytes]

    @classmethod
    def of(cls, pool: Pool, inputs: FloatArray) -> _Halfway:
        """Save the state, and play on."""
        return cls(pool.save_instances(_ONE), inputs, _rows(pool, inputs))

    def grade(self, pool: Pool) -> Grade:
        """Restore the state; the same steps should lead to the same outputs."""
        pool.restore_instances(self.state, _ONE, _ONE)
        return Grade.BITWISE if _rows(pool, self.inputs) == self.rows else Grade.WRONG


def _rows(pool: Pool, inputs: FloatArray) -> list[bytes]:
    return [outputs.tobytes() for outputs in steps(pool, inputs)]


def method_that_works(fmu: FMU, spec: PoolSpec, starts: Starts | None) -> SaveMethod:
    """Find out in two processes whether restored states lead to the same outputs, bit by bit.

    States that do so in the first process only are good for copies within a process.

    Args:
        fmu: The FMU.
        spec: The ``PoolSpec`` to try it with.
        starts: The ``Starts`` of episodes.
    """
    known = known_resuming(fmu, spec, starts)
    if known is not None:
        return known
    try:
        with closing(claim_instances(fmu, spec, 1, "a trial of saved states")):
            method, grade = _tried(Subject(fmu), spec, starts or Starts())
    except LicenceError as error:
        logger.warning("snapshots keep the inputs of the episode for now: %s", error)
        return SaveMethod.REPLAY
    if grade is not Grade.FAILS:  # a failure may have passing causes
        note_resuming(fmu, spec, starts, method)
    if grade is not Grade.BITWISE:
        logger.warning(
            "%s: %s%s; snapshots keep the inputs of the episode, and restoring one%s plays the "
            "episode again",
            fmu.path.name,
            *(_WHAT_IS_WRONG[grade], " in another process" if method is SaveMethod.COPY else ""),
            " in another environment" if method is SaveMethod.COPY else "",
        )
    return method


_WHAT_IS_WRONG: Final = {
    Grade.WRONG: "an episode that goes on from a saved state has other outputs",
    Grade.FAILS: "a saved state cannot be restored",
}


def _tried(subject: Subject, spec: PoolSpec, starts: Starts) -> tuple[SaveMethod, Grade]:
    """How states can be saved, and the grade of the last attempt."""
    open_pool = partial(subject.pool, _STAGE, spec.beginning_by(ResetMethod.RESTORE))
    grade = partial(subject.attempt, refused=Grade.FAILS, died=Grade.FAILS)
    made: list[_Halfway] = []

    def here() -> Grade:
        for amplitude in _AMPLITUDES:
            with open_pool() as pool:
                inputs = moving_inputs(spec, _BEFORE + _AFTER, amplitude)[:, :, None]
                start(pool, starts, 0)
                _rows(pool, inputs[:_BEFORE])
                if pool.statuses[0] <= WARNING_CODE:
                    made.append(_Halfway.of(pool, inputs[_BEFORE:]))
                    return made[0].grade(pool)
        return Grade.FAILS

    def elsewhere() -> Grade:
        with open_pool() as pool:  # its instance was never initialized
            return made[0].grade(pool)

    found = grade(here)
    if found is not Grade.BITWISE:
        return SaveMethod.REPLAY, found
    if made[0].state.method is not SaveMethod.STATE:  # copies stay in their process
        return SaveMethod.COPY, found
    found = grade(elsewhere)
    return SaveMethod.STATE if found is Grade.BITWISE else SaveMethod.COPY, found
