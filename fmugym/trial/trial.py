"""The first trial of an FMU, in processes that it may crash.

An FMU is native code: a fault in it ends the process that loads it. So worker processes load,
instantiate, initialize and step an unknown FMU before this process touches it. Success is cached by
the file's content. Failures are not cached: a missing licence may return.

A process protects from accidents but not from malice: a worker has all the rights of its user.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import replace
from typing import Final

from fmugym.archive.fmu import FMU
from fmugym.errors import FMULoadError, LicenceError, SimulationError
from fmugym.pool.component_resets import find_component_resets, offers_of
from fmugym.pool.instance_limit import claim_instances
from fmugym.pool.licences import speaks_of_licence
from fmugym.pool.process.supervisor import WorkerError
from fmugym.pool.spec import PoolSpec, ResetMethod
from fmugym.trial.known import content_key, recall, remember, verdict_key, with_harm
from fmugym.trial.neighbours import need_in_turn, need_of_several
from fmugym.trial.rehearsal import Rehearsal
from fmugym.trial.subject import CLOSING, STEP, DeathError, Subject
from fmugym.trial.trial_episodes import Starts, start
from fmugym.trial.verdict import FRUGAL, Grade, Neighbours, Verdict

__all__ = ["compare", "examine"]

logger = logging.getLogger(__name__)

_MOST_UNREADABLE: Final = 5
"""The most outputs that a verdict names because they cannot be read."""


def examine(
    fmu: FMU,
    spec: PoolSpec,
    starts: Starts | None = None,
    *,
    several: bool = False,
    must_survive: bool = True,
) -> Verdict:
    """Find out in worker processes how to treat an FMU.

    Args:
        fmu: The FMU; this does not extract it.
        spec: What to do at each reset and step.
        starts: The start values of two episodes; by default those of the FMU.
        several: Whether to try several instances.
        must_survive: Whether it is an error if a lone instance ends the process. If not, the
            verdict asks for isolation.

    Returns:
        The verdict, from the cache if the same request was made before.

    Raises:
        FMULoadError: If a process does not survive a single instance, and ``must_survive``. The
            text has the reason and the last lines.
        LicenceError: If an instance got no licence.
    """
    key = verdict_key(fmu, spec, starts)
    known = Verdict.from_text(recall(key))
    if known is not None and (known.neighbours is not None or not several):
        return with_harm(known, fmu)
    subject = Subject(fmu)
    rehearsal = Rehearsal(subject, spec, starts or Starts())
    with closing(claim_instances(fmu, spec, 2 if several else 1, "a trial")), _naming(subject):
        verdict = _of_one(rehearsal, known or Verdict(), must_survive=must_survive)
        if several and verdict.complete:
            verdict = replace(verdict, neighbours=need_of_several(rehearsal, verdict))
    verdict = replace(
        verdict,
        isolate=verdict.isolate or subject.is_harmful,
        instances=subject.instances,
        initializations=verdict.initializations + subject.initializations,
        reasons=tuple(dict.fromkeys((*verdict.reasons, *subject.reasons))),
    )
    logger.info(
        "%s was tried with %d instance(s) at once at most, and %d initialization(s) in all",
        *(fmu.path.name, verdict.instances, verdict.initializations),
    )
    verdict = with_harm(verdict, fmu)
    if verdict.complete:
        remember(content_key(fmu), verdict.to_text())
        remember(key, verdict.to_text())
    return verdict


def compare(fmu: FMU, spec: PoolSpec, starts: Starts | None = None) -> Verdict:
    """Find out whether instances disturb each other in turn, and no more.

    Args:
        fmu: An FMU that is exempt from trials.
        spec: What to do at each reset and step.
        starts: The start values of two instances; by default those of the FMU.

    Raises:
        LicenceError: If an instance got no licence.
    """
    key = f"{verdict_key(fmu, spec, starts)}-in-turn"
    known = Verdict.from_text(recall(key))
    if known is not None:
        return known
    subject = Subject(fmu)

    def need() -> Neighbours:
        rehearsal = Rehearsal(subject, spec, starts or Starts())
        rehearsal.find_reference()
        return need_in_turn(rehearsal, ResetMethod.INSTANCE)

    unknown = Neighbours.INDEPENDENT
    with closing(claim_instances(fmu, spec, 2, "a trial")), _naming(subject):
        found = Verdict(neighbours=subject.attempt(need, refused=unknown, died=unknown))
    remember(key, found.to_text())
    return found


@contextmanager
def _naming(subject: Subject) -> Iterator[None]:
    """Name the FMU and what the trial has used if an instance gets no licence."""
    try:
        yield
    except LicenceError as error:
        raise LicenceError(
            f"{subject.fmu.path.name} got no licence in its trial, which used "
            f"{subject.instances} instance(s) at once: {error}"
        ) from None


def _of_one(rehearsal: Rehearsal, known: Verdict, *, must_survive: bool) -> Verdict:
    """Find out what a lone instance shows, as far as that is not known."""
    subject, name = rehearsal.subject, rehearsal.subject.fmu.path.name
    subject.checks_heap &= not known.isolate
    try:
        _survive(rehearsal)
        if known.complete:
            return known
        verdict = Verdict(complete=True, blind_start=rehearsal.spec.blind_start)
        if rehearsal.possible:
            return _with_resets(verdict, rehearsal)
        return replace(verdict, unreadable=tuple(_unreadable(rehearsal)))
    except DeathError as death:
        if not must_survive:
            subject.note(death, alone=True)
            return Verdict(neighbours=Neighbours.PROCESSES)
        text = (
            f"{name} cannot be used: in {death.call} {death}. That was a trial in a process of its "
            "own; probe_timeout=None turns it off"
        )
        raise LicenceError(text) if speaks_of_licence(text) else FMULoadError(text) from None
    except WorkerError as error:
        logger.warning("%s could not be tried before: %s", name, error)
        return Verdict()
    except LicenceError:
        raise
    except FMULoadError:  # the process is alive, and the caller will get the error too
        return Verdict()


def _survive(rehearsal: Rehearsal) -> None:
    """Let fresh instances play, with checked heaps at first; note whether that does harm.

    Raises:
        DeathError: If a process does not even survive one step.
    """
    subject = rehearsal.subject
    try:
        rehearsal.find_reference()
    except DeathError as death:
        only_checked = subject.checks_heap and death.shows_memory_error
        if death.call not in (STEP, CLOSING) and not only_checked:
            raise
        subject.note(death, alone=True)
        if only_checked:  # it might live on without the checks
            subject.checks_heap = False
            _survive(rehearsal)
        elif death.call == CLOSING:
            rehearsal.step_once()


def _unreadable(rehearsal: Rehearsal) -> Iterator[str]:
    """Find the first outputs that cannot be read after an initialization."""
    if not rehearsal.fails_in_reading:
        return
    spec, left = replace(rehearsal.spec, outputs=()), _MOST_UNREADABLE
    with rehearsal.subject.pool("the search for outputs that cannot be read", spec) as pool:
        start(pool, rehearsal.starts, 0)
        for variable in rehearsal.spec.outputs:
            try:
                pool.read((variable,))
            except SimulationError:
                yield variable.name
                left -= 1
                if not left:
                    return
                start(pool, rehearsal.starts, 0)


def _with_resets(verdict: Verdict, rehearsal: Rehearsal) -> Verdict:
    """Grade the reset methods, fastest first, until one is exact to the last bit."""
    able = rehearsal.subject.fmu.description.capabilities.can_get_and_set_fmu_state
    methods = [ResetMethod.RESTORE] if able else []
    methods += [ResetMethod.RESET, ResetMethod.INSTANCE]
    methods += [ResetMethod.LIBRARY] if rehearsal.subject.can_copy_libraries else []
    grades: dict[ResetMethod, Grade] = {}
    for method in methods:
        grades[method] = rehearsal.grade(method)
        if grades[method] is Grade.BITWISE:
            break
    frugal = (FRUGAL,) * rehearsal.is_frugal
    verdict = replace(verdict, resets=grades, noisy=rehearsal.noisy, reasons=frugal)
    return replace(verdict, components=_components(verdict, rehearsal))


def _components(verdict: Verdict, rehearsal: Rehearsal) -> tuple[ResetMethod, ...]:
    """Find a method for each component of a system that does not begin anew by restores."""
    base, subject = verdict.reset_method, rehearsal.subject
    parts = subject.fmu.description.components
    tried = verdict.resets.get(base) is Grade.BITWISE and base is not ResetMethod.RESTORE
    if not tried or rehearsal.is_frugal or not parts:
        return ()
    offers = [offers_of(part, reloads=subject.can_copy_libraries) for part in parts]
    return find_component_resets(
        offers, base, lambda found: rehearsal.grade(base, found) is Grade.BITWISE
    )
