"""Pools in the caller's process."""

from __future__ import annotations

import logging

from fmugym.archive.fmu import FMU
from fmugym.pool.licences import licence_errors
from fmugym.pool.saving_pool import SavingPool
from fmugym.pool.spec import PoolSpec

__all__ = ["local_pool"]


@licence_errors()
def local_pool(
    fmu: FMU,
    spec: PoolSpec,
    num_instances: int,
    log: logging.Logger,
    *,
    threads: int | None = None,
    private_libraries: bool | None = False,
) -> SavingPool:
    """Make a pool that loads the FMU into this process.

    Args:
        fmu: The FMU; closed with the pool.
        spec: What to do at each reset and step.
        num_instances: N.
        log: The logger that gets the FMU's messages.
        threads: See ``NativePool``.
        private_libraries: See ``NativePool``.

    Raises:
        LicenceError: If the FMU gets no licence.
        FMULoadError: If the FMU cannot be loaded or instantiated.
    """
    from fmugym.pool.native import NativePool

    pool = NativePool(
        fmu,
        spec,
        num_instances,
        log,
        threads=threads,
        private_libraries=private_libraries,
    )
    pool.retry_resets(fmu.path.name, log)
    return pool
