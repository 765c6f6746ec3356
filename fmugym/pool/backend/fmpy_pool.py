"""Pool of an FMU that FMPy steps: the reference that the engine is compared with."""

from __future__ import annotations

import logging

from fmugym.archive.fmu import FMU, copy_libraries
from fmugym.errors import ConfigError
from fmugym.pool.backend.backend_pool import BackendPool
from fmugym.pool.backend.by_fmpy import FMPyInstance
from fmugym.pool.extension import needs_engine
from fmugym.pool.licences import licence_errors
from fmugym.pool.spec import PoolSpec

__all__ = ["fmpy_pool"]


@licence_errors()
def fmpy_pool(
    fmu: FMU,
    spec: PoolSpec,
    num_instances: int,
    log: logging.Logger,
    reset_method: str | None = None,
    isolation: str | None = None,
) -> BackendPool:
    """Make a pool of instances that FMPy steps, one after another, in this process.

    Each of them has a copy of the FMU's library.

    Args:
        fmu: The FMU; closed with the pool.
        spec: What to do at each reset and step.
        num_instances: N.
        log: The logger that gets the FMU's messages.
        reset_method: One that the caller asks for, which is refused.
        isolation: ``"process"`` is refused.

    Raises:
        ConfigError: If FMPy cannot do what is asked for.
        FMULoadError: If the FMU cannot be loaded.
    """
    needs = _beyond_fmpy(fmu, spec) | {
        "reset_method": reset_method is not None,
        "isolation='process'": isolation == "process",
    }
    refused = [name for name, is_needed in needs.items() if is_needed]
    if refused:
        raise ConfigError(
            "FMPy steps FMUs for co-simulation with scalar variables here. "
            + needs_engine(f"{fmu.path.name} ({', '.join(refused)})")
        )

    def instances(count: int) -> list[FMPyInstance]:
        fmu.prepare_libraries()
        libraries = copy_libraries(fmu, count)
        return [FMPyInstance(fmu, spec, log, library) for library in libraries]

    pool = BackendPool(fmu, spec, num_instances, instances, is_real=False)
    text = "by FMPy in this process, one after another, each with a copy of the library"
    pool.execution = (f"{fmu.path.name}: {num_instances} instance(s) are stepped {text}",)
    log.info("%s", *pool.execution)
    return pool


def _beyond_fmpy(fmu: FMU, spec: PoolSpec) -> dict[str, bool]:
    """Abilities of the engine that FMPy lacks, and whether they are needed."""
    about, variables = fmu.description, (*spec.inputs, *spec.outputs)
    return {
        "a system": bool(about.components),
        "model exchange": about.interface != "co_simulation",
        "clocks and event mode": about.uses_event_mode,
        "libraries for Windows": fmu.in_wine,
        "arrays": bool(about.structure) or any(not v.is_scalar for v in variables),
        "samplings": bool(spec.samplings),
        "fault_retries": bool(spec.fault_retries),
    }
