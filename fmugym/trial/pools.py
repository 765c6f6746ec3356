"""Pools for trials: all instances are in one process."""

from __future__ import annotations

import logging

from fmugym.archive.fmu import FMU
from fmugym.errors import FMULoadError
from fmugym.pool.local import local_pool
from fmugym.pool.patience import licence_errors
from fmugym.pool.process.pool import ProcessPool
from fmugym.pool.progress import INITIALIZATION, STEP, announce
from fmugym.pool.saving import SavingPool
from fmugym.pool.spec import PoolSpec

__all__ = ["trial_pool"]


def trial_pool(
    fmu: FMU,
    spec: PoolSpec,
    num_instances: int,
    log: logging.Logger,
    *,
    private_libraries: bool = False,
    isolated: bool = False,
) -> SavingPool:
    """Make a pool in this process, or in a worker process, as the FMU may need one in Wine.

    Args:
        fmu: The FMU; closed with the pool.
        spec: What to do at each reset and step.
        num_instances: N.
        log: The logger that gets the FMU's messages.
        private_libraries: See ``NativePool``.
        isolated: Whether to use a worker process.

    Raises:
        LicenceError: If the FMU gets no licence.
        FMULoadError: As ``local_pool``; or if private libraries are wanted in Wine.
    """
    if not (fmu.in_wine or isolated):
        return local_pool(
            fmu,
            spec,
            num_instances,
            log,
            threads=1,
            private_libraries=private_libraries,
        )
    if private_libraries:
        fmu.close()
        raise FMULoadError(f"{fmu.path.name} runs in Wine, with one native library a process")
    return _isolated_pool(fmu, spec, num_instances, log)


@licence_errors()
def _isolated_pool(fmu: FMU, spec: PoolSpec, num_instances: int, log: logging.Logger) -> SavingPool:
    announce(INITIALIZATION)
    pool = ProcessPool(fmu, spec, num_instances, log, workers=1, threads=1, call_timeout=None)
    announce(STEP)
    return pool
