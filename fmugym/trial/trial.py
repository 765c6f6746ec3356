"""The first trial of an FMU, in a process that it may crash.

An FMU is native code: a fault in it ends the process that loads it. So a worker process
(``fmugym.trial.worker``) loads, instantiates, initializes and steps an unknown FMU once before this
process touches it. Success is cached by the file's content. Failures are not cached: a missing
licence may return.

A process protects from accidents but not from malice: the worker has all the rights of its user.
"""

from __future__ import annotations

import logging
from dataclasses import replace
from typing import Any, Final

from fmugym.archive.fmu import FMU
from fmugym.errors import FMULoadError, LicenceError
from fmugym.pool.patience import speaks_of_licence
from fmugym.pool.spec import ResetMethod
from fmugym.trial.attempt import Outcome, Request, Stage, run
from fmugym.trial.cache import recall, remember
from fmugym.trial.candidate import Candidate, content_key, verdict_key
from fmugym.trial.known import known_verdict, with_harm
from fmugym.trial.seats import taking
from fmugym.trial.verdict import FRUGAL, Grade, Neighbours, Verdict

__all__ = ["examine", "meet"]

logger = logging.getLogger(__name__)

_ALONE: Final = {
    *("loading and instantiation", "initialization", "the first step", "closing"),
    *(Stage.REFERENCE, Stage.SHARED_DATA),
}
"""The stages of a fresh instance. If a worker ends there only when memory is checked, the FMU
writes to memory that it must not touch."""


def meet(fmu: FMU) -> None:
    """Make sure that a process has loaded and stepped an FMU and survived.

    Every function that loads an FMU into this process calls this first.

    Args:
        fmu: The FMU; this does not extract it.

    Raises:
        FMULoadError: If the process did not survive. The text has the reason and the last lines.
        LicenceError: If the FMU got no licence.
    """
    candidate = Candidate.of(fmu)
    if not candidate.exempt and known_verdict(fmu) is None:
        _examine(Request(candidate), must_survive=True)


def examine(
    candidate: Candidate,
    spec: Any,
    starts: Any = None,
    *,
    several: bool = False,
    alone: bool = False,
    must_survive: bool = True,
) -> Verdict:
    """Find out in worker processes how to treat an FMU; includes ``meet``.

    Args:
        candidate: The FMU, exempt or not.
        spec: The ``PoolSpec`` to try it with.
        starts: The ``Starts`` of two episodes, or None.
        several: Whether to try several instances.
        alone: Whether it is known that instances must not share a copy of the library.
        must_survive: Whether it is an error if a lone instance ends the process. If not, the
            verdict asks for isolation.

    Returns:
        The verdict, from the cache if the same request was made before.

    Raises:
        FMULoadError: As ``meet``, if ``must_survive``.
        LicenceError: If an instance got no licence.
    """
    key = verdict_key(candidate, spec, starts)
    known = Verdict.from_text(recall(key))
    if known is not None and (known.neighbours is not None or not several):
        return with_harm(known, candidate)
    request = Request(candidate, spec, starts, several, alone)
    if known is not None and known.complete:
        request = replace(request, known=known, check_memory=not known.isolate)
    with taking(candidate, spec, 2 if several else 1, "a trial"):
        found = _examine(request, must_survive)
    if found.complete:
        remember(key, found.to_text())
    return found


def _examine(request: Request, must_survive: bool) -> Verdict:
    """Start workers until one finishes. Each skips the stages in which earlier ones crashed."""
    name, notes = request.candidate.path.name, _Notes()
    while True:
        outcome = run(request)
        if outcome.stage is None:
            logger.warning("%s could not be tried before: it %s%s", name, outcome.end, outcome.said)
            return Verdict()
        notes.add(outcome)
        _require_licence(name, outcome)
        if "finished" in outcome.answer:
            break
        if outcome.stage in _ALONE and request.check_memory and outcome.shows_memory_error:
            request = replace(request, check_memory=False)
        elif "complete" not in outcome.answer:
            return notes.died_alone(name, must_survive)
        elif outcome.stage in request.skip:  # it dies outside the requested stages
            break
        else:
            request = replace(request, skip=request.skip | {outcome.stage})
    verdict = notes.verdict
    if request.known is not None:
        verdict = _completed(request.known, verdict)
    verdict = with_harm(verdict, request.candidate)
    logger.info(
        "%s was tried with %d instance(s) at once at most, and %d initialization(s) in all",
        *(name, verdict.instances, verdict.initializations),
    )
    if verdict.complete:
        remember(content_key(request.candidate), verdict.to_text())
    return verdict


def _completed(known: Verdict, found: Verdict) -> Verdict:
    """Add to a verdict what several instances need."""
    return replace(
        known,
        neighbours=found.neighbours,
        instances=found.instances,
        initializations=known.initializations + found.initializations,
        reasons=tuple(dict.fromkeys((*known.reasons, *found.reasons))),
    )


def _require_licence(name: str, outcome: Outcome) -> None:
    """Give up if an instance got no licence: this tells nothing about the FMU itself.

    Raises:
        LicenceError: With the FMU's words.
    """
    answer, said = outcome.answer, outcome.said
    words = answer.get("refused", "")
    if "finished" not in answer and "complete" in answer and speaks_of_licence(said):
        words = f"it {outcome.end}{said}"
    if words:
        raise LicenceError(
            f"{name} got no licence in its trial, which used {answer['instances']} "
            f"instance(s) at once: {words}"
        )


class _Notes:
    """The findings of the workers of one trial."""

    def __init__(self) -> None:
        self._answer: dict[str, Any] = {}
        self._deaths: list[Outcome] = []
        self._initializations = 0

    def add(self, outcome: Outcome) -> None:
        """Record the answer of a worker, and how it ended if it did not finish."""
        self._answer |= outcome.answer
        self._initializations += int(outcome.answer.get("initializations", 0))
        if "finished" not in outcome.answer:
            self._deaths.append(outcome)

    @property
    def verdict(self) -> Verdict:
        """The verdict as far as it is known."""
        answer = self._answer
        neighbours = answer.get("neighbours")
        return Verdict(
            complete=bool(answer.get("complete")),
            noisy=tuple(answer.get("noisy", ())),
            resets={ResetMethod(m): Grade(g) for m, g in answer.get("resets", {}).items()},
            components=tuple(map(ResetMethod, answer.get("components", ()))),
            neighbours=None if neighbours is None else Neighbours(neighbours),
            instances=int(answer.get("instances", 1)),
            initializations=self._initializations,
            blind_start=bool(answer.get("blind_start")),
            unreadable=tuple(answer.get("unreadable", ())),
            isolate=any(death.stage in _ALONE for death in self._deaths),
            reasons=(FRUGAL,) * bool(answer.get("frugal"))
            + tuple(f"in {d.stage} it {d.end}{d.said}" for d in self._deaths),
        )

    def died_alone(self, name: str, must_survive: bool) -> Verdict:
        """Report that even a lone instance dies, or that it needs a separate process.

        Raises:
            FMULoadError: If ``must_survive``.
            LicenceError: If it also speaks of a licence.
        """
        last = self._deaths[-1]
        if must_survive:
            text = (
                f"{name} cannot be used: in {last.stage} it {last.end}{last.said}. That was a "
                "trial in a process of its own; probe_timeout=None turns it off"
            )
            raise LicenceError(text) if speaks_of_licence(last.said) else FMULoadError(text)
        return replace(self.verdict, isolate=True, neighbours=Neighbours.PROCESSES)
