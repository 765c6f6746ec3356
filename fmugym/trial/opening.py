"""Opening of a pool: the choice of its engine, the trial of the FMU, and its instances.

.. code-block:: python

    fmu = FMU("tank.fmu")
    spec = PoolSpec((fmu.variable("valve"),), (fmu.variable("level"),), time_step=0.1)
    pool = open_pool(fmu, spec, 64, logger, PoolOptions(isolation="process"))
    print(*pool.execution, sep="; ")  # how its instances run, and why
"""

from __future__ import annotations

import logging
from dataclasses import replace
from functools import partial
from math import floor, isfinite
from typing import Any, Final

from fmugym.archive.fmu import FMU
from fmugym.checks import check_option
from fmugym.errors import ConfigError, warn_once
from fmugym.pool.backend.backend_pool import BackendPool
from fmugym.pool.backend.fmpy_pool import fmpy_pool
from fmugym.pool.base import Pool
from fmugym.pool.bundle import SaveMethod
from fmugym.pool.extension import has_native_pool, needs_engine, require_engine
from fmugym.pool.instance_limit import claim_instances
from fmugym.pool.licences import licence_errors, wait_for_licence
from fmugym.pool.process.pool import ProcessPool
from fmugym.pool.progress import progress
from fmugym.pool.saving_pool import SavingPool, offered_method
from fmugym.pool.spec import PoolSpec, ResetMethod
from fmugym.trial.execution import Execution
from fmugym.trial.known import is_exempt, known_resuming
from fmugym.trial.pool_options import PoolOptions
from fmugym.trial.trial import compare, examine, saving_method
from fmugym.trial.trial_episodes import Starts
from fmugym.trial.verdict import Grade, Verdict
from fmugym.wine.prefix import Wine

__all__ = ["open_pool"]

logger = logging.getLogger(__name__)

_BACKENDS: Final = ("auto", "fmpy", "fmu", "native")
_DEFAULTS: Final = PoolOptions()


def open_pool(
    fmu: FMU,
    spec: PoolSpec,
    num_instances: int,
    log: logging.Logger,
    options: PoolOptions = _DEFAULTS,
) -> Pool:
    """Open the fastest pool that gives correct values.

    Args:
        fmu: The FMU; closed with the pool.
        spec: What to do at each reset and step.
        num_instances: N.
        log: The logger that gets the FMU's messages, and learns how the pool runs, and why.
        options: Where it runs, and how.

    Returns:
        The pool. Its ``execution`` says how it runs, and why.

    Raises:
        ConfigError: If the backend is unknown, not available, or cannot do what the spec says; or
            if the spec allows fewer instances.
        LicenceError: If the FMU gets no licence within ``spec.licence_wait``.
        FMULoadError: If the FMU cannot be loaded or instantiated.
    """
    _require_allowed(fmu, spec, num_instances)
    backend = options.backend
    if hasattr(backend, "open_pool"):
        own: Pool = backend.open_pool(fmu, spec, num_instances, log, options)
        return own
    if not isinstance(backend, str):
        pool = BackendPool(fmu, spec, num_instances, backend)
        pool.execution = (f"{fmu.path.name}: the given backend steps in its place",)
        log.info("%s", *pool.execution)
        return pool
    if _is_fmpy(backend):
        return fmpy_pool(fmu, spec, num_instances, log, options.reset_method, options.isolation)
    options = options.fitting(fmu)
    if fmu.in_wine:
        Wine.ready()
    opening = partial(_open_tried, fmu, spec, num_instances, log, options)
    return wait_for_licence(spec.licence_wait, log, opening)


def _require_allowed(fmu: FMU, spec: PoolSpec, num_instances: int) -> None:
    most = spec.max_instances
    if most is not None and num_instances > most:
        raise ConfigError(
            f"{fmu.path.name}: {num_instances} environments need {num_instances} "
            f"instances, but 'max_instances' of 'foreign' allows {most}"
        )


def _is_fmpy(backend: str) -> bool:
    """Whether FMPy steps the FMUs, because the caller says so, or there is no extension."""
    check_option("backend", backend, _BACKENDS)
    if backend == "native":
        require_engine("backend='native'")
    elif backend != "fmpy" and not has_native_pool():
        text = "FMUs are stepped by FMPy, which is slow"
        warn_once(logger, f"{text}: {needs_engine('speed')}")
        return True
    return backend == "fmpy"


# The engine: a trial, the decision, the instances


def _open_tried(
    fmu: FMU, spec: PoolSpec, num_instances: int, log: logging.Logger, options: PoolOptions
) -> Pool:
    tried = replace(spec, num_observed=0, leak_limit=None, fault_retries=0, licence_wait=0.0)
    task = fmu, tried, options.starts, _episode_length(spec, options)
    execution = Execution.decided(
        fmu, spec, num_instances, options, _verdict(*task, num_instances, options)
    )
    if fmu.calls_python():
        execution = execution.in_one_thread("calls Python, which one thread at a time can use")
    saving = _saving_method(execution, *task)
    spec = replace(execution.spec, records=saving is not SaveMethod.STATE)
    execution = replace(execution, spec=spec)
    execution.log(log)
    pool = _claimed_pool(execution, log)
    pool.execution = execution.sentences
    pool.save_by(partial(saving_method, *task) if saving is None else lambda: saving)
    return pool


def _episode_length(spec: PoolSpec, options: PoolOptions) -> int | None:
    """The most steps of an episode; None if nothing limits them."""
    limits = [options.max_episode_steps]
    if spec.stop_time is not None:
        steps = (spec.stop_time - spec.start_time) / spec.time_step
        limits.append(max(1, floor(steps + 1e-9)) if isfinite(steps) else None)
    return min((limit for limit in limits if limit is not None), default=None)


def _verdict(
    fmu: FMU,
    spec: PoolSpec,
    starts: Starts,
    length: int | None,
    num_instances: int,
    options: PoolOptions,
) -> Verdict:
    """Verdict of a trial on options that are open, if the FMU is not exempt."""
    exempt = is_exempt(fmu)
    if fmu.bundled:
        return Verdict(True, resets={ResetMethod.RESTORE: Grade.BITWISE})
    once = fmu.description.capabilities.can_be_instantiated_only_once_per_process
    count = 1 if once or options.decide_sharing(num_instances) else num_instances
    if not exempt:
        fatal = not options.is_isolated
        return examine(fmu, spec, starts, num_instances=count, length=length, must_survive=fatal)
    if count == 1:
        return Verdict()
    return compare(fmu, spec, starts, num_instances=count, length=length)


def _saving_method(execution: Execution, *task: Any) -> SaveMethod | None:
    """Method of saving states; None if a trial shall find it when one is first saved."""
    fmu, spec = execution.fmu, execution.spec
    offered = offered_method(fmu.description, spec)
    if fmu.bundled or offered is SaveMethod.REPLAY:
        return offered
    if is_exempt(fmu):
        return SaveMethod.REPLAY
    may_try = spec.max_instances is None or execution.num_instances < spec.max_instances
    return known_resuming(*task) or (None if may_try else SaveMethod.REPLAY)


@licence_errors()
def _claimed_pool(execution: Execution, log: logging.Logger) -> SavingPool:
    """Make the instances, which count as those of an environment until the pool is closed."""
    fmu, count = execution.fmu, execution.num_instances
    claim = claim_instances(fmu, execution.spec, count, "an environment")
    try:
        with progress(log, f"{fmu.path.name}: the instantiation of {count} instance(s)"):
            pool = _pool(execution, log)
    except BaseException:
        claim.close()
        raise
    pool.hold(claim.close)
    return pool


def _pool(execution: Execution, log: logging.Logger) -> SavingPool:
    of, options = (execution.fmu, execution.spec, execution.num_instances, log), execution.options
    if options.is_isolated:
        return ProcessPool(
            *of,
            workers=options.workers,
            threads=options.threads,
            private_libraries=bool(options.private_libraries),
            own_files=execution.own_files,
            call_timeout=options.call_timeout,
        )
    from fmugym.pool.native import NativePool

    private = bool(options.private_libraries)
    return NativePool(*of, threads=options.threads, private_libraries=private)
