"""Pools in the caller's process: native if the extension was built, otherwise in Python."""

from __future__ import annotations

import logging

from fmugym.archive.loadable import LoadableFMU
from fmugym.errors import FMULoadError
from fmugym.pool.attendant import Attendant
from fmugym.pool.extension import has_native_pool
from fmugym.pool.health import HealthArray
from fmugym.pool.mark import Mark
from fmugym.pool.patience import licence_errors
from fmugym.pool.progress import INITIALIZATION, STEP, announce
from fmugym.pool.python import PythonPool
from fmugym.pool.saving import SavingPool
from fmugym.pool.spec import PoolSpec

__all__ = ["local_pool"]


@licence_errors()
def local_pool(
    fmu: LoadableFMU,
    spec: PoolSpec,
    num_instances: int,
    log: logging.Logger,
    *,
    native: bool | None = None,
    threads: int | None = None,
    private_libraries: bool | None = False,
    first_index: int = 0,
    counts: HealthArray | None = None,
    attended: bool = True,
    mark: Mark | None = None,
) -> SavingPool:
    """Make a pool that loads the FMU into this process.

    Args:
        fmu: The FMU; closed with the pool.
        spec: What to do at each reset and step.
        num_instances: N.
        log: The logger that gets the FMU's messages.
        native: Whether to use the native pool; by default True if the extension was built.
        threads: See ``NativePool``; the Python pool has one thread.
        private_libraries: See ``NativePool``; the Python pool has one library.
        first_index: See ``NativePool``.
        counts: See ``NativePool``.
        attended: Whether an ``Attendant`` goes with resets where one is needed.
        mark: Where a crash inside the FMU is noted.

    Raises:
        LicenceError: If the FMU gets no licence.
        FMULoadError: If the FMU cannot be loaded or instantiated, or if the Python pool is asked
            for private libraries.
    """
    native = has_native_pool() if native is None else native
    if private_libraries and not native:
        fmu.close()
        raise FMULoadError(
            f"{fmu.path.name} needs a library of its own for each of {num_instances} "
            "instances, which only the native pool or isolation='process' can provide"
        )
    announce(INITIALIZATION)  # an FMU may do all of its work when it is instantiated
    pool: SavingPool
    if native:
        from fmugym.pool.native import NativePool

        pool = NativePool(
            fmu,
            spec,
            num_instances,
            log,
            threads=threads,
            private_libraries=private_libraries,
            first_index=first_index,
            counts=counts,
            mark=mark,
        )
    else:
        pool = PythonPool(fmu, spec, num_instances, log, counts=counts, mark=mark)
    pool.attend(Attendant.of(fmu.path.name, spec, log) if attended else None)
    announce(STEP)
    return pool
