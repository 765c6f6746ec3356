"""Which pool an FMU gets: decided by what the caller asks for and what the first meeting shows."""

from __future__ import annotations

import logging
from typing import Any

from fmugym.archive.bundled import is_bundled
from fmugym.archive.fmu import FMU
from fmugym.errors import ConfigError, FMULoadError, SimulationError, unknown_name
from fmugym.pool.backend.pool import BackendPool
from fmugym.pool.base import Pool
from fmugym.pool.extension import HOW_TO_BUILD, has_native_pool, warn_of_slow_path
from fmugym.pool.local import local_pool
from fmugym.pool.process.pool import ProcessPool
from fmugym.pool.spec import DEFAULT_CALL_TIMEOUT, ISOLATIONS, PoolSpec
from fmugym.trial.shared_globals import shares_globals
from fmugym.trial.trial import Candidate, find_shared_globals, meet

__all__ = ["make_pool"]

_NAMES = ("auto", "fmu", "native", "python")


def make_pool(
    fmu: FMU,
    spec: PoolSpec,
    num_instances: int,
    log: logging.Logger,
    backend: Any = "auto",
    *,
    threads: int | None = None,
    private_libraries: bool | None = None,
    isolation: str | None = None,
    workers: int | None = None,
    call_timeout: float | None = DEFAULT_CALL_TIMEOUT,
) -> Pool:
    """Make the fastest pool there is.

    Args:
        fmu: The FMU; closed with the pool.
        spec: What to do at each reset and step.
        num_instances: N.
        log: The logger that gets the FMU's messages.
        backend: ``"native"``, ``"python"``, or ``"auto"`` (also ``"fmu"``): native where the
            extension was built. Or what stands in for the FMU; see ``BackendPool``.
        threads: See ``NativePool``; the Python pool has one thread.
        private_libraries: See ``NativePool``; by default where the FMU says that it can be
            instantiated only once per process, or where two instances are found to disturb each
            other. The Python pool has one library.
        isolation: ``"process"`` for worker processes, ``"none"`` for this one. By default this one,
            unless instances disturb each other and private libraries do not help.
        workers: See ``ProcessPool``; by default one for each instance where they disturb each
            other.
        call_timeout: See ``ProcessPool``; nothing limits a call in this process.

    Raises:
        ConfigError: If the backend or the isolation is unknown.
        FMULoadError: If the FMU cannot be loaded or instantiated, or the backend is not there.
    """
    if not isinstance(backend, str):
        if spec.fault_retries:
            fmu.close()
            raise ConfigError("config key 'fault_retries': a backend's steps cannot be repeated")
        return BackendPool(fmu, spec, num_instances, backend)
    native = _is_native(backend)
    if isolation not in (None, *ISOLATIONS):
        raise unknown_name("isolation", isolation, ISOLATIONS)
    apart = private_libraries
    if apart is None and num_instances > 1 and not (isolation == "process" and workers):
        apart = _disturb_each_other(fmu, spec, isolation)
        if apart and isolation is None:
            isolation = _least_isolation(fmu, spec, native, log)
    if isolation == "process":
        workers = num_instances if apart and not workers else workers
        return ProcessPool(
            fmu,
            spec,
            num_instances,
            log,
            native=native,
            workers=workers,
            threads=threads,
            call_timeout=call_timeout,
        )
    meet(fmu)
    options: Any = {"threads": threads, "private_libraries": apart}
    return local_pool(fmu, spec, num_instances, log, native=native, **options)


def _is_native(backend: str) -> bool:
    if backend not in _NAMES:
        raise unknown_name("backend", backend, _NAMES)
    if backend == "native" and not has_native_pool():
        raise FMULoadError(f"the native pool is not there: {HOW_TO_BUILD}")
    if backend in ("auto", "fmu") and not has_native_pool():
        warn_of_slow_path()
    return backend != "python" and has_native_pool()


def _disturb_each_other(fmu: FMU, spec: PoolSpec, isolation: str | None) -> bool:
    """Whether instances want globals of their own.

    Found out in a process of its own; or here, where this one must do and trials are turned off.
    """
    if is_bundled(fmu.path):
        return False
    if fmu.description.capabilities.can_be_instantiated_only_once_per_process:
        return True
    is_isolated = isolation == "process"
    if is_isolated or not Candidate.of(fmu).exempt:
        return find_shared_globals(Candidate.of(fmu), spec, must_survive=not is_isolated)
    try:
        return shares_globals(fmu, spec)
    except SimulationError:  # it fails alone too, without the values that the caller will set
        return False


def _least_isolation(fmu: FMU, spec: PoolSpec, native: bool, log: logging.Logger) -> str:
    """What instances that disturb each other need: private libraries, or private processes."""
    isolation, what = "process", "a process"
    if native and not find_shared_globals(
        Candidate.of(fmu), spec, private_libraries=True, must_survive=False
    ):
        isolation, what = "none", "a copy of the library"
    log.warning(
        "the instances of %s disturb each other: each gets %s of its own", fmu.path.name, what
    )
    return isolation
