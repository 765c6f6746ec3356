"""Pools: N instances of one FMU behind arrays, knowing nothing of actions and rewards."""

import functools
import logging
from typing import Any

from fmugym.archive import FMU
from fmugym.bundled import is_bundled
from fmugym.errors import ConfigError, FMULoadError, SimulationError, unknown_name
from fmugym.pool.backend import Backend, BackendPool
from fmugym.pool.base import (
    DEFAULT_CALL_TIMEOUT,
    ISOLATIONS,
    FloatArray,
    MaskArray,
    Pool,
    PoolSpec,
    StatusArray,
)
from fmugym.pool.pacing import Paced
from fmugym.pool.python import PythonPool
from fmugym.probing import probe_globals

__all__ = [
    "DEFAULT_CALL_TIMEOUT",
    "ISOLATIONS",
    "Backend",
    "BackendPool",
    "FloatArray",
    "MaskArray",
    "Paced",
    "Pool",
    "PoolSpec",
    "PythonPool",
    "StatusArray",
    "has_native_pool",
    "make_pool",
]

logger = logging.getLogger(__name__)

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
        from fmugym.pool.process import ProcessPool

        workers = num_instances if apart and not workers else workers
        options: Any = {"workers": workers, "threads": threads, "call_timeout": call_timeout}
        return ProcessPool(fmu, spec, num_instances, log, native=native, **options)
    if native:
        from fmugym.pool.native import NativePool

        return NativePool(fmu, spec, num_instances, log, threads=threads, private_libraries=apart)
    if apart:
        fmu.close()
        raise FMULoadError(
            f"{fmu.path.name} needs a library of its own for each of {num_instances} "
            "instances, which only the native pool or isolation='process' can give it"
        )
    return PythonPool(fmu, spec, num_instances, log)


def _is_native(backend: str) -> bool:
    if backend not in _NAMES:
        raise unknown_name("backend", backend, _NAMES)
    if backend == "native" and not has_native_pool():
        raise FMULoadError(f"the native pool is not there: {_HOW_TO}")
    if backend in ("auto", "fmu") and not has_native_pool():
        _warn_of_slow_path()
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
    if is_isolated or not fmu.candidate.exempt:
        return probe_globals(fmu.candidate, spec, must_survive=not is_isolated)
    from fmugym.pool.isolation import shares_globals

    try:
        return shares_globals(fmu, spec)
    except SimulationError:  # it fails alone too, without the values that the caller will set
        return False


def _least_isolation(fmu: FMU, spec: PoolSpec, native: bool, log: logging.Logger) -> str:
    """What instances that disturb each other need: private libraries, or private processes."""
    isolation, what = "process", "a process"
    if native and not probe_globals(
        fmu.candidate, spec, private_libraries=True, must_survive=False
    ):
        isolation, what = "none", "a copy of the library"
    log.warning(
        "the instances of %s disturb each other: each gets %s of its own", fmu.path.name, what
    )
    return isolation


@functools.cache
def has_native_pool() -> bool:
    """Whether the C extension was built when this package was installed."""
    try:
        import fmugym._native  # noqa: F401  (can it be?)
    except ImportError:
        return False
    return True


_HOW_TO = (
    "the C extension of fmugym was not built. Install a C compiler (on Debian: apt install gcc; "
    "on macOS: xcode-select --install; on Windows: the Build Tools for Visual Studio) and install "
    "fmugym again with: pip install --force-reinstall --no-deps --no-binary :all: fmugym-toolbox"
)


@functools.cache
def _warn_of_slow_path() -> None:
    logger.warning("FMUs are stepped by Python, which is slow: %s", _HOW_TO)
