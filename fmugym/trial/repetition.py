"""The rehearsal repeated in training: a spare instance plays a recorded episode again.

The spare is a fresh instance in a process of its own. It cannot harm the training, and its library
shares nothing with the others. If it gives other outputs than the training has seen, the reset
method does not make instances like new. Later episodes then begin by the next method, and so do
those of later environments.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from fmugym.errors import FMUGymError, LicenceError
from fmugym.fmi.status import WARNING_CODE, Status
from fmugym.pool.base import FloatArray, Pool
from fmugym.pool.process.pool import ProcessPool
from fmugym.pool.spec import PoolSpec, ResetMethod
from fmugym.pool.tape import Tape
from fmugym.trial.candidate import Candidate
from fmugym.trial.rehearsal import difference, tolerance_of
from fmugym.trial.seats import taking
from fmugym.trial.verdict import Grade, Verdict

__all__ = ["Repetition"]

_silent: Final = logging.Logger("fmugym.trial.spare", logging.CRITICAL + 1)
"""Drops what the spare says: the FMU says the same in training."""


@dataclass(frozen=True)
class _Run:
    """The outputs before the first step and after each, and the statuses of the steps.

    A step with a warning counts as one without.
    """

    rows: FloatArray
    statuses: tuple[int, ...]

    @classmethod
    def of(cls, tape: Tape) -> _Run:
        """What the training has seen."""
        rows = np.vstack([tape.first_outputs, tape.outputs])
        return cls(rows, tuple(map(_without_warning, tape.statuses.tolist())))

    def until(self, step: int) -> tuple[bytes, tuple[int, ...]]:
        """The run up to a step; equal runs are the same to the last bit."""
        return self.rows[: step + 1].tobytes(), self.statuses[:step]

    def equals(self, other: _Run) -> bool:
        """Whether two runs are the same to the last bit."""
        return self.until(len(self.rows)) == other.until(len(other.rows))


class Repetition:
    """Judges recorded episodes; a ``fmugym.pool.tape.Judge``.

    Args:
        candidate: The FMU.
        spec: That of the pool that records.
        verdict: That of the trial.
        revise: Keeps a new verdict for later environments.
        log: Is warned if episodes do not begin anew.
    """

    def __init__(
        self,
        candidate: Candidate,
        spec: PoolSpec,
        verdict: Verdict,
        revise: Callable[[Verdict], None],
        log: logging.Logger,
    ) -> None:
        self._candidate, self._spec, self._verdict = candidate, spec, verdict
        self._revise, self._log = revise, log
        self._crash = ""

    def __call__(self, tape: Tape, begin_by: Callable[[ResetMethod], bool]) -> bool:
        """See ``fmugym.pool.tape.Judge``."""
        name, seen = self._candidate.path.name, _Run.of(tape)
        try:
            fresh = self._play(tape)
            if self._crash:
                return self._isolate_later()
            if self._is_close(seen, fresh):
                self._log.info("%s: a fresh instance repeats %d steps", name, len(tape.inputs))
                return True
            if not fresh.equals(self._play(tape)):
                self._log.info("%s: two fresh instances differ, nothing can be compared", name)
                return False
        except LicenceError as error:
            self._log.info("%s: no spare instance for now: %s", name, error)
            return True
        except FMUGymError as error:
            self._log.info("%s: no spare instance plays an episode again: %s", name, error)
            return False
        return self._go_down(self._describe(seen, fresh), begin_by)

    def _play(self, tape: Tape) -> _Run:
        """Play a recorded episode on a fresh instance."""
        with taking(self._candidate, self._spec, 1, "a rehearsal"):
            return self._play_now(tape)

    def _play_now(self, tape: Tape) -> _Run:
        spec = replace(self._spec.beginning_by(ResetMethod.RESET), leak_limit=None)
        pool = ProcessPool(
            self._candidate.open(),
            spec,
            1,
            _silent,
            workers=1,
            note_crash=self._note_crash,
        )
        try:
            return _played(pool, tape)
        finally:
            pool.close()

    def _note_crash(self, how: str) -> None:
        self._crash = how

    def _isolate_later(self) -> bool:
        """Let later environments run in processes: this one has survived by luck only."""
        name = self._candidate.path.name
        self._log.warning(
            "%s: %s when it played an episode of the training again. Later environments run in "
            "worker processes",
            *(name, self._crash),
        )
        reason = f"in a rehearsal, {self._crash}"
        reasons = (*self._verdict.reasons, reason)
        self._verdict = replace(self._verdict, isolate=True, reasons=reasons)
        self._revise(self._verdict)
        return False

    def _is_close(self, seen: _Run, fresh: _Run) -> bool:
        if seen.equals(fresh):
            return True
        loose = self._verdict.resets.get(self._spec.reset_method) is Grade.TOLERANCE
        if not loose or seen.statuses != fresh.statuses:
            return False
        return bool(np.all(difference(seen.rows, fresh.rows) <= tolerance_of(self._spec)))

    def _describe(self, seen: _Run, fresh: _Run) -> str:
        """Name the first difference: the step, and its statuses or a variable with its values."""
        step = next(i for i in range(len(seen.rows)) if seen.until(i) != fresh.until(i))
        if step and seen.statuses[step - 1] != fresh.statuses[step - 1]:
            got, expected = (Status(run.statuses[step - 1]).name.title() for run in (seen, fresh))
            return f"step {step} returned {got}, and {expected} with a fresh instance"
        rows = seen.rows[step].tolist(), fresh.rows[step].tolist()
        index = next(i for i, (a, b) in enumerate(zip(*rows, strict=True)) if repr(a) != repr(b))
        name = self._spec.outputs[index].name
        got, expected = rows[0][index], rows[1][index]
        return f"{name} was {got!r} after {step} steps, and {expected!r} with a fresh instance"

    def _go_down(self, what: str, begin_by: Callable[[ResetMethod], bool]) -> bool:
        """Take the next reset method; returns whether this pool can do so."""
        used, own = self._spec.reset_method, self._spec.component_resets
        method = max(used, ResetMethod.INSTANCE, key=_rank) if own else self._next()
        now = begin_by(method)
        how = f"methods of its components {', '.join(own)}" if own else f"method {str(used)!r}"
        self._log.warning(
            "%s does not begin anew by the %s: %s. %s begin by the method %r",
            *(self._candidate.path.name, how, what),
            *("Episodes now" if now else "The episodes of later environments", str(method)),
        )
        resets = dict(self._verdict.resets) | {used: Grade.WRONG, method: Grade.BITWISE}
        reasons = (*self._verdict.reasons, f"in training, with the {how}, {what}")
        self._verdict = replace(self._verdict, resets=resets, components=(), reasons=reasons)
        self._spec = self._spec.beginning_by(method)
        self._revise(self._verdict)
        return now

    def _next(self) -> ResetMethod:
        """The next method after the one that is used."""
        bad, used = (Grade.WRONG, Grade.FAILS), self._spec.reset_method
        lower = [m for m in ResetMethod if self._verdict.resets.get(m) not in bad]
        return next((m for m in lower if _rank(m) > _rank(used)), ResetMethod.PROCESS)


def _rank(method: ResetMethod) -> int:
    return list(ResetMethod).index(method)


def _without_warning(status: int) -> int:
    return Status.OK if status == Status.WARNING else status


def _played(pool: Pool, tape: Tape) -> _Run:
    outputs, statuses = pool.reset(tape.variables, tape.starts[:, None])
    rows, codes = [outputs[:, 0].copy()], []
    for row in tape.inputs:
        if statuses[0] > WARNING_CODE:
            break
        outputs, statuses = pool.step(row[:, None])
        rows.append(outputs[:, 0].copy())
        codes.append(_without_warning(int(statuses[0])))
    return _Run(np.array(rows), tuple(codes))
