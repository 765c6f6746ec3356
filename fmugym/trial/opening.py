"""The choice of an FMU's pool, from the caller's wishes and the results of the first trial."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Final

from fmugym.archive.fmu import FMU
from fmugym.errors import (
    ConfigError,
    FMULoadError,
    LicenceError,
    SimulationError,
    printable,
    unknown_name,
)
from fmugym.pool.attendant import Attendant
from fmugym.pool.backend.by_fmpy import fmpy_pool
from fmugym.pool.backend.pool import BackendPool
from fmugym.pool.base import Pool
from fmugym.pool.bundle import SaveMethod
from fmugym.pool.extension import HOW_TO_BUILD, has_native_pool, warn_of_slow_path
from fmugym.pool.local import local_pool
from fmugym.pool.patience import Patience, licence_errors
from fmugym.pool.process.pool import ProcessPool
from fmugym.pool.progress import progress
from fmugym.pool.saving import SavingPool, offered_method
from fmugym.pool.spec import DEFAULT_CALL_TIMEOUT, PoolSpec, ResetMethod
from fmugym.retired import warn_of_gone
from fmugym.trial.candidate import Candidate
from fmugym.trial.known import (
    known_resuming,
)
from fmugym.trial.neighbours import disturb_in_turn
from fmugym.trial.plan import Plan, is_alone
from fmugym.trial.rehearsal import Starts
from fmugym.trial.resuming import method_that_works
from fmugym.trial.seats import take, taking
from fmugym.trial.trial import examine
from fmugym.trial.verdict import Grade, Neighbours, Verdict

__all__ = ["make_pool"]

logger = logging.getLogger(__name__)

_BLIND: Final = (
    "%s cannot be read before its first step: until then, its outputs have the start values of the "
    "model description"
)
_NAMES = ("auto", "fmpy", "fmu", "native", "python")


def make_pool(
    fmu: FMU,
    spec: PoolSpec,
    num_instances: int,
    log: logging.Logger,
    backend: Any = "auto",
    *,
    starts: Starts | None = None,
    reset_method: str | None = None,
    threads: int | None = None,
    private_libraries: bool | None = None,
    isolation: str | None = None,
    workers: int | None = None,
    call_timeout: float | None = DEFAULT_CALL_TIMEOUT,
    spare: bool = True,
) -> Pool:
    """Make the fastest pool that gives correct values.

    Args:
        fmu: The FMU; closed with the pool.
        spec: What to do at each reset and step.
        num_instances: N.
        log: The logger that gets the FMU's messages.
        backend: ``"native"``, ``"fmpy"`` (see ``fmpy_pool``), or ``"auto"`` (also ``"fmu"``):
            native if the extension was built. Or an object that replaces the FMU; see
            ``BackendPool``.
        starts: The start values of two episodes, for the trial of resets.
        reset_method: One of ``ResetMethod``; by default the fastest one that gives correct
            results in the trial.
        threads: See ``NativePool``; FMPy has one thread. By default one if instances disturb each
            other when they run at the same time.
        private_libraries: See ``NativePool``; by default True if two instances disturb each other
            in the trial. With FMPy each always has one.
        isolation: ``"process"`` for worker processes, ``"none"`` for this process. By default this
            process, unless the FMU says that it can be instantiated only once per process,
            instances disturb each other and private libraries do not help, it has harmed its
            process in the trial, or a component of a system shall be isolated.
        workers: See ``ProcessPool``; by default one for each instance if they disturb each other.
        call_timeout: See ``ProcessPool``; calls in this process have no time limit.
        spare: Whether there may be one more instance, in a trial of saved states.

    Raises:
        ConfigError: If the backend, the isolation or the reset method is unknown.
        LicenceError: If the FMU gets no licence within ``spec.licence_wait``.
        FMULoadError: If the FMU cannot be loaded or instantiated, or the backend is not available.
    """
    if not isinstance(backend, str):
        if spec.fault_retries:
            fmu.close()
            raise ConfigError("config key 'fault_retries': a backend's steps cannot be repeated")
        return BackendPool(fmu, spec, num_instances, backend)
    backend = _chosen(backend)
    if backend == "fmpy":
        return fmpy_pool(
            fmu, spec, num_instances, log, reset_method=reset_method, isolation=isolation
        )
    plan = Plan(reset_method, threads, private_libraries, isolation, workers)
    plan = plan.checked(fmu)

    def attempt() -> Pool:
        verdict = _verdict(fmu, spec, starts, num_instances, plan)
        completed = plan.completed(fmu, verdict, num_instances, log)

        actual = replace(spec, blind_start=verdict.blind_start)
        _tell_of_reading(fmu, verdict, log)
        with progress(log, f"{fmu.path.name}: the instantiation of {num_instances} instance(s)"):
            trust = _Trust.of(fmu, actual, starts, completed, spare=spare)
            pool = _open(fmu, trust.spec, num_instances, log, completed, call_timeout)
        pool.save_by(trust.method_that_works)
        return pool

    return Patience(spec.licence_wait, log).call(attempt)


@licence_errors()
def _open(
    fmu: FMU,
    spec: PoolSpec,
    num_instances: int,
    log: logging.Logger,
    plan: Plan,
    call_timeout: float | None,
) -> SavingPool:
    spec = replace(
        spec,
        reset_method=plan.method,
        component_resets=plan.component_resets,
        one_initialization=plan.one_initialization,
    )
    claim = take(Candidate.of(fmu), spec, num_instances, "an environment")
    try:
        pool = _open_now(fmu, spec, num_instances, log, plan, call_timeout)
    except BaseException:
        if claim is not None:
            claim.release()
        raise
    if claim is not None:
        pool.hold(claim.release)
    return pool


def _open_now(
    fmu: FMU,
    spec: PoolSpec,
    num_instances: int,
    log: logging.Logger,
    plan: Plan,
    call_timeout: float | None,
) -> SavingPool:
    if plan.isolation == "process":
        pool = ProcessPool(
            fmu,
            spec,
            num_instances,
            log,
            workers=plan.workers,
            threads=plan.threads,
            own_files=plan.own_files,
            call_timeout=call_timeout,
        )
        pool.attend(Attendant.of(fmu.path.name, spec, log))
        return pool
    return local_pool(
        fmu,
        spec,
        num_instances,
        log,
        threads=plan.threads,
        private_libraries=plan.private_libraries,
    )


@dataclass(frozen=True)
class _Trust:
    """Whether serialized states work, as far as known when a pool is opened.

    Attributes:
        spec: What the pool does; records are kept until it is known that states work.
        method_that_works: Finds it out.
    """

    spec: PoolSpec
    method_that_works: Callable[[], SaveMethod]

    @classmethod
    def of(
        cls, fmu: FMU, spec: PoolSpec, starts: Starts | None, plan: Plan, *, spare: bool
    ) -> _Trust:
        """Look up what earlier trials have shown; without a spare instance there is no other."""
        candidate, tried = Candidate.of(fmu), _tried(spec)
        method = offered_method(fmu.description, replace(spec, reset_method=plan.method))
        if method is SaveMethod.REPLAY:
            return cls(spec, lambda: method)
        known: SaveMethod | None = SaveMethod.REPLAY
        if fmu.bundled:
            known = method
        elif not candidate.exempt:
            known = known_resuming(candidate, tried, starts)
            known = SaveMethod.REPLAY if known is None and not spare else known
        ask = partial(method_that_works, candidate, tried, starts)
        records = known is not SaveMethod.STATE
        return cls(replace(spec, records=records), ask if known is None else lambda: known)


def _tried(spec: PoolSpec) -> PoolSpec:
    """The part of a spec that a trial uses."""
    return replace(spec, num_observed=0, leak_limit=None, fault_retries=0, blind_start=False)


def _chosen(backend: str) -> str:
    """The way to step the FMU: ``"native"`` or ``"fmpy"``."""
    if backend not in _NAMES:
        raise unknown_name("backend", backend, _NAMES)
    if backend == "native" and not has_native_pool():
        raise FMULoadError(f"the native pool is not there: {HOW_TO_BUILD}")
    if backend == "python":
        warn_of_gone("backend='python' means 'fmpy' now: say so")
        return "fmpy"
    if backend in ("auto", "fmu") and not has_native_pool():
        warn_of_slow_path()
        return "fmpy"
    return "fmpy" if backend == "fmpy" else "native"


def _tell_of_reading(fmu: FMU, verdict: Verdict, log: logging.Logger) -> None:
    """Log what cannot be read, or not at any time."""
    if verdict.blind_start:
        log.warning(_BLIND, fmu.path.name)
    if verdict.unreadable:
        names = printable(", ".join(verdict.unreadable))
        log.warning("%s: its trial could not read the output(s) %s", fmu.path.name, names)


def _verdict(
    fmu: FMU, spec: PoolSpec, starts: Starts | None, num_instances: int, plan: Plan
) -> Verdict:
    """Get the verdict on an FMU from a trial, or from this process if trials are turned off."""
    candidate = Candidate.of(fmu)
    spec = _tried(spec)
    if fmu.bundled:
        return Verdict(True, resets={ResetMethod.RESTORE: Grade.BITWISE})
    several = num_instances > 1 and plan.private_libraries is None and not plan.has_own_workers
    several = several and not is_alone(fmu)
    isolated = plan.isolation == "process"
    if not candidate.exempt:
        return examine(candidate, spec, starts, several=several, must_survive=not isolated)
    if several and (isolated or _disturb_here(candidate, spec)):
        verdict = examine(candidate, spec, several=True, alone=not isolated, must_survive=False)
        return Verdict(neighbours=verdict.neighbours or Neighbours.PROCESSES)
    return Verdict()


def _disturb_here(candidate: Candidate, spec: PoolSpec) -> bool:
    """Compare two instances in this process, in which the FMU will run without a trial anyway."""
    try:
        with taking(candidate, spec, 2, "a trial"):
            return disturb_in_turn(candidate, spec)
    except LicenceError:
        raise
    except SimulationError:  # a lone instance fails too: it needs the caller's values
        return False
