"""Wishes of a caller for a pool: backend, isolation, threads and reset method."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

from fmugym.archive.fmu import FMU
from fmugym.checks import check_option
from fmugym.errors import FMULoadError
from fmugym.pool.spec import DEFAULT_CALL_TIMEOUT, ISOLATIONS, ResetMethod
from fmugym.wine.prefix import Wine

__all__ = ["Wishes"]


@dataclass(frozen=True)
class Wishes:
    """What a caller wishes of a pool.

    Attributes:
        backend: ``"native"``, ``"fmpy"`` (see ``FMPyInstance``), or ``"auto"`` (also ``"fmu"``):
            native if the extension was built. Or an object that replaces the FMU; see
            ``BackendPool``. One with the method ``make_pool`` makes the pool itself, as a
            ``Surrogate`` does.
        reset_method: One of ``ResetMethod``; by default the fastest one that gives correct
            results in the trial.
        threads: See ``NativePool``; FMPy has one thread. By default one if instances disturb each
            other when they run at the same time, or if the FMU calls Python.
        private_libraries: See ``NativePool``; by default True if two instances disturb each other
            in the trial. With FMPy each always has one.
        isolation: ``"process"`` for worker processes, ``"none"`` for this process. By default this
            process, unless the FMU says that it can be instantiated only once per process,
            instances disturb each other and private libraries do not help, it has harmed its
            process in the trial, or a component of a system shall be isolated.
        workers: See ``ProcessPool``; by default one for each instance if they disturb each other.
        call_timeout: See ``ProcessPool``; calls in this process have no time limit.
    """

    backend: Any = "auto"
    reset_method: str | None = None
    threads: int | None = None
    private_libraries: bool | None = None
    isolation: str | None = None
    workers: int | None = None
    call_timeout: float | None = DEFAULT_CALL_TIMEOUT

    def for_native(self, fmu: FMU) -> Wishes:
        """Check them, and add what the FMU leaves no choice for.

        Raises:
            ConfigError: If the isolation or the reset method is unknown.
            FMULoadError: If the FMU can only run in Wine, and that is not there, or a wish cannot
                be granted there.
        """
        if self.isolation is not None:
            check_option("isolation", self.isolation, ISOLATIONS)
        if self.reset_method is not None:
            check_option("reset method", self.reset_method, map(str, ResetMethod))
        if fmu.in_wine:
            self._prepare_wine(fmu)
            return replace(self, threads=1, private_libraries=None, isolation="process")
        isolated = self.isolation is None and fmu.isolated
        return replace(self, isolation="process") if isolated else self

    def _prepare_wine(self, fmu: FMU) -> None:
        """Refuse what is not possible in Wine, and make ready what every worker needs."""
        wishes = {
            "private_libraries": self.private_libraries,
            "isolation='none'": self.isolation == "none",
            "preload": fmu.preload,
        }
        refused = [wish for wish, is_given in wishes.items() if is_given]
        if refused:
            raise FMULoadError(
                f"{fmu.path.name} has libraries for Windows only, which run here in worker "
                f"processes in Wine, but this leaves no choice for: {', '.join(refused)}"
            )
        Wine.ready()

    def decides_who_shares(self, num_instances: int) -> bool:
        """Whether the caller has decided which of N instances share a library, or that none do."""
        in_workers = self.isolation == "process" and (self.workers or 0) >= num_instances
        return self.private_libraries is not None or in_workers
