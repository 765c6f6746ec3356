"""Pools: N instances of one FMU behind arrays, knowing nothing of actions and rewards."""

import functools
import logging

from fmugym.archive import FMU
from fmugym.bundled import is_bundled
from fmugym.errors import FMULoadError, SimulationError, unknown_name
from fmugym.pool.base import FloatArray, MaskArray, Pool, PoolSpec, StatusArray
from fmugym.pool.python import PythonPool

__all__ = [
    "FloatArray",
    "MaskArray",
    "Pool",
    "PoolSpec",
    "PythonPool",
    "StatusArray",
    "has_native_pool",
    "make_pool",
]

logger = logging.getLogger(__name__)


def make_pool(
    fmu: FMU,
    spec: PoolSpec,
    num_instances: int,
    log: logging.Logger,
    backend: str = "auto",
    *,
    threads: int | None = None,
    private_libraries: bool | None = None,
) -> Pool:
    """Make the fastest pool there is.

    Args:
        fmu: The FMU; closed with the pool.
        spec: What to do at each reset and step.
        num_instances: N.
        log: The logger that gets the FMU's messages.
        backend: ``"native"``, ``"python"``, or ``"auto"``: native where the extension was built.
        threads: See ``NativePool``; the Python pool has one thread.
        private_libraries: See ``NativePool``; by default where the FMU says that it can be
            instantiated only once per process, or where two instances are found to disturb each
            other. The Python pool has one library.

    Raises:
        ConfigError: If the backend is unknown.
        FMULoadError: If the FMU cannot be loaded or instantiated, or the backend is not there.
    """
    if backend not in ("auto", "native", "python"):
        raise unknown_name("backend", backend, ("auto", "native", "python"))
    if private_libraries is None and num_instances > 1:
        private_libraries = _needs_private_libraries(fmu, spec, log)
    if backend == "python" or (backend == "auto" and not has_native_pool()):
        if backend == "auto":
            _warn_of_slow_path()
        if private_libraries:
            fmu.close()
            raise FMULoadError(
                f"{fmu.path.name} needs a library of its own for each of {num_instances} "
                "instances, which only the native pool can give it"
            )
        return PythonPool(fmu, spec, num_instances, log)
    if not has_native_pool():
        raise FMULoadError(f"the native pool is not there: {_HOW_TO}")
    from fmugym.pool.native import NativePool

    return NativePool(
        fmu, spec, num_instances, log, threads=threads, private_libraries=private_libraries
    )


def _needs_private_libraries(fmu: FMU, spec: PoolSpec, log: logging.Logger) -> bool:
    from fmugym.pool.isolation import shares_globals

    if is_bundled(fmu.path):
        return False
    if fmu.description.capabilities.can_be_instantiated_only_once_per_process:
        return True
    try:
        shares = shares_globals(fmu, spec)
    except SimulationError:  # it fails alone too, without the values that the caller will set
        return False
    if shares:
        log.warning(
            "the instances of %s disturb each other: each gets a copy of the library of its own",
            fmu.path.name,
        )
    return shares


@functools.cache
def has_native_pool() -> bool:
    """Whether the C extension was built when this package was installed."""
    try:
        import fmugym._native  # noqa: F401
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
