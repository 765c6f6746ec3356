"""Options of a pool, as a caller gives them to ``open_pool``."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

from fmugym.archive.fmu import FMU
from fmugym.checks import check_option
from fmugym.errors import FMULoadError
from fmugym.pool.spec import DEFAULT_CALL_TIMEOUT, ISOLATIONS, ResetMethod
from fmugym.trial.trial_episodes import Starts

__all__ = ["PoolOptions"]


@dataclass(frozen=True)
class PoolOptions:
    """Options of a pool; ``Execution`` decides by the trial of the FMU where they leave a choice.

    Attributes:
        backend: ``"native"``, ``"fmpy"`` (see ``FMPyInstance``), or ``"auto"`` (also ``"fmu"``):
            native if the extension was built. Or an object that replaces the FMU; see
            ``BackendPool``. One with the method ``open_pool``, of the same arguments as the
            function, opens the pool itself, as a ``Surrogate`` does.
        isolation: ``"process"`` for worker processes, ``"none"`` for this process. By default this
            process, unless the FMU says that it can be instantiated only once per process,
            instances disturb each other and private libraries do not help, it has harmed its
            process in the trial, or a component of a system shall be isolated.
        workers: See ``ProcessPool``; by default one for each instance if they disturb each other.
        threads: See ``NativePool``; FMPy has one thread. By default one if instances disturb each
            other when they run at the same time, or if the FMU calls Python.
        private_libraries: See ``NativePool``; by default True if two instances disturb each other
            in the trial. With FMPy each always has one.
        reset_method: One of ``ResetMethod``; by default the fastest one that gives correct
            results in the trial.
        call_timeout: See ``ProcessPool``; calls in this process have no time limit.
        starts: The start values of two episodes, for the trial; by default those of the FMU.
        max_episode_steps: The most steps of an episode, for the trial; None if nothing but the
            stop time limits them.

    Raises:
        ConfigError: If there is no isolation or no reset method of this name.
    """

    backend: Any = "auto"
    isolation: str | None = None
    workers: int | None = None
    threads: int | None = None
    private_libraries: bool | None = None
    reset_method: str | None = None
    call_timeout: float | None = DEFAULT_CALL_TIMEOUT
    starts: Starts = field(default_factory=Starts)
    max_episode_steps: int | None = None

    def __post_init__(self) -> None:
        if self.isolation is not None:
            check_option("isolation", self.isolation, ISOLATIONS)
        if self.reset_method is not None:
            check_option("reset method", self.reset_method, map(str, ResetMethod))

    @property
    def is_isolated(self) -> bool:
        """Whether the instances are in worker processes."""
        return self.isolation == "process"

    def fitting(self, fmu: FMU) -> PoolOptions:
        """The options for this FMU, which may leave no choice of the processes.

        Raises:
            FMULoadError: If the FMU can only run in Wine, where an option is not possible.
        """
        if fmu.in_wine:
            self._require_wine(fmu)
            return replace(self, threads=1, private_libraries=None, isolation="process")
        isolated = self.isolation is None and fmu.isolated
        return replace(self, isolation="process") if isolated else self

    def _require_wine(self, fmu: FMU) -> None:
        given = {
            "private_libraries": self.private_libraries,
            "isolation='none'": self.isolation == "none",
            "preload": fmu.preload,
        }
        refused = [option for option, is_given in given.items() if is_given]
        if refused:
            raise FMULoadError(
                f"{fmu.path.name} has libraries for Windows only, which run here in worker "
                f"processes in Wine, but this leaves no choice for: {', '.join(refused)}"
            )

    def decide_sharing(self, num_instances: int) -> bool:
        """Whether they say which of N instances share a library, or that none do."""
        in_workers = self.is_isolated and (self.workers or 0) >= num_instances
        return self.private_libraries is not None or in_workers
