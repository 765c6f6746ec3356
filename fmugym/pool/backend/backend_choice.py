"""The choice among the ways to step an FMU: the native engine, FMPy, or an object of the caller."""

from __future__ import annotations

import logging
from typing import Final

from fmugym.archive.fmu import FMU, copy_libraries
from fmugym.checks import check_option
from fmugym.errors import ConfigError, warn_once
from fmugym.pool.backend.backend_pool import BackendPool
from fmugym.pool.backend.by_fmpy import FMPyInstance
from fmugym.pool.base import Pool
from fmugym.pool.extension import has_native_pool, needs_engine, require_engine
from fmugym.pool.licences import licence_errors
from fmugym.pool.spec import PoolSpec
from fmugym.pool.wishes import Wishes

__all__ = ["pool_of_backend"]

logger = logging.getLogger(__name__)

_NAMES: Final = ("auto", "fmpy", "fmu", "native")


def pool_of_backend(
    fmu: FMU, spec: PoolSpec, num_instances: int, log: logging.Logger, wishes: Wishes
) -> Pool | None:
    """Make the pool of a backend; None if the native engine shall step the FMU.

    Args:
        fmu: The FMU; closed with the pool.
        spec: What to do at each reset and step.
        num_instances: N.
        log: The logger that gets the FMU's messages.
        wishes: Name the backend.

    Raises:
        ConfigError: If the backend is unknown, not available, or cannot do what the spec says.
        FMULoadError: If the FMU cannot be loaded.
    """
    if isinstance(wishes.backend, str):
        if not _steps_by_fmpy(wishes.backend):
            return None
        return _fmpy_pool(fmu, spec, num_instances, log, wishes)
    if spec.fault_retries:
        raise ConfigError("config key 'fault_retries': a backend's steps cannot be repeated")
    return BackendPool(fmu, spec, num_instances, wishes.backend)


def _steps_by_fmpy(backend: str) -> bool:
    check_option("backend", backend, _NAMES)
    if backend == "fmpy":
        return True
    if backend == "native":
        require_engine("backend='native'")
    elif not has_native_pool():
        text = "FMUs are stepped by FMPy, which is slow"
        warn_once(logger, f"{text}: {needs_engine('speed')}")
        return True
    return False


@licence_errors()
def _fmpy_pool(
    fmu: FMU, spec: PoolSpec, num_instances: int, log: logging.Logger, wishes: Wishes
) -> BackendPool:
    """Make a pool of instances that FMPy steps, one after another, in this process.

    Each of them has a copy of the FMU's library.
    """
    refused = [name for name, is_needed in _beyond_fmpy(fmu, spec, wishes).items() if is_needed]
    if refused:
        raise ConfigError(
            "FMPy steps FMUs for co-simulation with scalar variables here. "
            + needs_engine(f"{fmu.path.name} ({', '.join(refused)})")
        )

    def instances(count: int) -> list[FMPyInstance]:
        fmu.prepare_libraries()
        libraries = copy_libraries(fmu, count)
        return [FMPyInstance(fmu, spec, log, library) for library in libraries]

    return BackendPool(fmu, spec, num_instances, instances, is_real=False)


def _beyond_fmpy(fmu: FMU, spec: PoolSpec, wishes: Wishes) -> dict[str, bool]:
    """What only the engine can do, and whether it is needed."""
    about, variables = fmu.description, (*spec.inputs, *spec.outputs)
    return {
        "a system": bool(about.components),
        "model exchange": about.interface != "co_simulation",
        "clocks and event mode": about.uses_event_mode,
        "libraries for Windows": fmu.in_wine,
        "arrays": bool(about.structure) or any(not v.is_scalar for v in variables),
        "samplings": bool(spec.samplings),
        "fault_retries": bool(spec.fault_retries),
        "reset_method": wishes.reset_method is not None,
        "isolation='process'": wishes.isolation == "process",
    }
