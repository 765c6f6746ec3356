"""The choice of an FMU's pool, from the caller's wishes and the results of the first trial."""

from __future__ import annotations

import logging
from dataclasses import replace
from functools import partial
from typing import Any

from fmugym.archive.fmu import FMU
from fmugym.pool.backend.backend_choice import pool_of_backend
from fmugym.pool.base import Pool
from fmugym.pool.bundle import SaveMethod
from fmugym.pool.instance_limit import claim_instances
from fmugym.pool.licences import licence_errors, wait_for_licence
from fmugym.pool.process.pool import ProcessPool
from fmugym.pool.progress import progress
from fmugym.pool.saving_pool import SavingPool, offered_method
from fmugym.pool.spec import PoolSpec, ResetMethod
from fmugym.pool.wishes import Wishes
from fmugym.trial.known import is_exempt, known_resuming
from fmugym.trial.plan import Plan, is_alone
from fmugym.trial.trial import compare, examine, saving_method
from fmugym.trial.trial_episodes import Starts
from fmugym.trial.verdict import Grade, Verdict

__all__ = ["make_pool"]


def make_pool(
    fmu: FMU,
    spec: PoolSpec,
    num_instances: int,
    log: logging.Logger,
    *,
    starts: Starts | None = None,
    length: int | None = None,
    spare: bool = True,
    **wishes: Any,
) -> Pool:
    """Make the fastest pool that gives correct values.

    Args:
        fmu: The FMU; closed with the pool.
        spec: What to do at each reset and step.
        num_instances: N.
        log: The logger that gets the FMU's messages.
        starts: The start values of two episodes, for the trial.
        length: The most steps of an episode, for the trial; None if nothing limits them.
        spare: Whether there may be one more instance, in a trial of saved states.
        wishes: See ``fmugym.pool.wishes.Wishes``.

    Raises:
        ConfigError: If the backend, the isolation or the reset method is unknown.
        LicenceError: If the FMU gets no licence within ``spec.licence_wait``.
        FMULoadError: If the FMU cannot be loaded or instantiated, or the backend is not available.
    """
    maker = getattr(wishes.get("backend"), "make_pool", None)
    if maker is not None:
        task: dict[str, Any] = {"starts": starts, "length": length, "spare": spare}
        own: Pool = maker(fmu, spec, num_instances, log, **task, **wishes)
        return own
    wished = Wishes(**wishes)
    pool = pool_of_backend(fmu, spec, num_instances, log, wished)
    if pool is not None:
        return pool
    wishing = Plan(fmu, num_instances, spec, wished.for_native(fmu))

    def attempt() -> Pool:
        return _open(_made(wishing, starts, length, spare=spare), log)

    return wait_for_licence(spec.licence_wait, log, attempt)


def _made(plan: Plan, starts: Starts | None, length: int | None, *, spare: bool) -> Plan:
    """Complete a plan; that may take a trial of the FMU."""
    fmu, exempt = plan.fmu, is_exempt(plan.fmu)
    tried = replace(plan.spec, num_observed=0, leak_limit=None, fault_retries=0, licence_wait=0.0)
    plan = plan.completed(_verdict(plan, tried, starts, length))
    offered = offered_method(fmu.description, plan.spec)
    if fmu.bundled or offered is SaveMethod.REPLAY:
        return plan.saving_by(offered)
    known = SaveMethod.REPLAY if exempt else known_resuming(fmu, tried, starts, length)
    if known is not None or not spare:
        return plan.saving_by(known or SaveMethod.REPLAY)
    ask = partial(saving_method, fmu, tried, starts, length)
    return replace(plan, spec=replace(plan.spec, records=True), save_by=ask)


def _verdict(plan: Plan, spec: PoolSpec, starts: Starts | None, length: int | None) -> Verdict:
    """Get the verdict on an FMU from a trial, if it is not exempt."""
    fmu = plan.fmu
    if fmu.bundled:
        return Verdict(True, resets={ResetMethod.RESTORE: Grade.BITWISE})
    shared = not (plan.how.decides_who_shares(plan.num_instances) or is_alone(fmu))
    count = plan.num_instances if shared else 1
    task: dict[str, Any] = {"num_instances": count, "length": length}
    if is_exempt(fmu):
        return compare(fmu, spec, starts, **task) if count > 1 else Verdict()
    return examine(fmu, spec, starts, must_survive=not plan.is_isolated, **task)


@licence_errors()
def _open(plan: Plan, log: logging.Logger) -> SavingPool:
    """Carry a plan out, and log what is unusual about it."""
    for level, text in plan.notes:
        log.log(level, "%s", text)
    fmu, count = plan.fmu, plan.num_instances
    claim = claim_instances(fmu, plan.spec, count, "an environment")
    try:
        with progress(log, f"{fmu.path.name}: the instantiation of {count} instance(s)"):
            pool = _pool(plan, log)
    except BaseException:
        claim.close()
        raise
    pool.hold(claim.close)
    pool.save_by(plan.save_by)
    return pool


def _pool(plan: Plan, log: logging.Logger) -> SavingPool:
    what, how = (plan.fmu, plan.spec, plan.num_instances, log), plan.how
    threads = how.threads
    if threads is None and plan.fmu.calls_python():
        threads = 1  # several would spend most of the time with handing Python over
    if not plan.is_isolated:
        from fmugym.pool.native import NativePool

        alone = is_alone(plan.fmu) and plan.num_instances > 1
        private = alone if how.private_libraries is None else how.private_libraries
        return NativePool(*what, threads=threads, private_libraries=private)
    return ProcessPool(
        *what,
        workers=how.workers,
        threads=threads,
        own_files=plan.own_files,
        private_libraries=bool(how.private_libraries),
        call_timeout=how.call_timeout,
    )
