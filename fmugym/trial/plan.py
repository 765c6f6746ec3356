"""How a pool is opened: the caller's demands, completed with the results of a trial."""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

from fmugym.archive.fmu import FMU
from fmugym.errors import FMULoadError, unknown_name
from fmugym.pool.base import first_of
from fmugym.pool.spec import ISOLATIONS, ResetMethod
from fmugym.trial.candidate import Candidate
from fmugym.trial.verdict import Grade, Neighbours, Verdict
from fmugym.wine.prefix import Wine

__all__ = ["Plan", "is_alone"]


@dataclass(frozen=True)
class Plan:
    """How to open a pool: the caller's demands, completed with the results of a trial."""

    reset_method: str | None = None
    threads: int | None = None
    private_libraries: bool | None = None
    isolation: str | None = None
    workers: int | None = None
    component_resets: tuple[ResetMethod, ...] = ()
    one_initialization: bool = False
    own_files: bool = False

    def checked(self, fmu: FMU) -> Plan:
        """Refuse unknown names; in Wine, refuse what is not possible there."""
        if self.isolation not in (None, *ISOLATIONS):
            raise unknown_name("isolation", self.isolation, ISOLATIONS)
        if self.reset_method not in (None, *ResetMethod):
            raise unknown_name("reset method", self.reset_method, list(map(str, ResetMethod)))
        if not fmu.in_wine:
            isolated = self.isolation is None and fmu.isolated
            return replace(self, isolation="process") if isolated else self
        _prepare_wine(fmu, self.private_libraries, self.isolation)
        return replace(self, threads=1, private_libraries=None, isolation="process")

    @property
    def method(self) -> ResetMethod:
        """How episodes begin."""
        return ResetMethod(self.reset_method or ResetMethod.RESET)

    @property
    def has_own_workers(self) -> bool:
        """Whether the caller has decided which instances share a process."""
        return self.isolation == "process" and self.workers is not None

    def completed(
        self, fmu: FMU, verdict: Verdict, num_instances: int, log: logging.Logger
    ) -> Plan:
        """Decide what the caller has left open, and log every unusual choice."""
        plan = self
        if plan.reset_method is None:
            method, components = verdict.reset_method, verdict.components
            plan = replace(plan, reset_method=method, component_resets=components)
            _tell_of_resets(fmu, verdict, log)
        if plan.private_libraries is None and num_instances > 1 and not plan.has_own_workers:
            if is_alone(fmu):
                plan = plan._in_processes(fmu, num_instances, log)
            else:
                neighbours = verdict.neighbours or Neighbours.INDEPENDENT
                plan = plan._apart(fmu, neighbours, num_instances, log)
        if verdict.isolate and plan.isolation is None:
            why = f": {verdict.reasons[-1]}" if verdict.reasons else ""
            log.warning("%s harms its process%s. It runs in worker processes", fmu.path.name, why)
            plan = replace(plan, isolation="process")
        return plan._with_means_of_reset(num_instances)

    def _in_processes(self, fmu: FMU, num_instances: int, log: logging.Logger) -> Plan:
        """Give each instance a process, as the FMU demands, unless the caller insists."""
        if self.isolation == "none":
            what = "isolation='none' keeps more in it all the same"
            plan = self
        else:
            what = "each gets a process with a copy of the FMU's files"
            plan = self._with_a_process_each(num_instances)
        level = logging.INFO if self.isolation == "process" else logging.WARNING
        log.log(level, "a process may have one instance of %s: %s", fmu.path.name, what)
        return plan

    def _with_a_process_each(self, num_instances: int) -> Plan:
        workers = self.workers or num_instances
        return replace(self, isolation="process", workers=workers, own_files=True)

    def _apart(
        self, fmu: FMU, neighbours: Neighbours, num_instances: int, log: logging.Logger
    ) -> Plan:
        if neighbours is Neighbours.INDEPENDENT:
            return self
        if neighbours is Neighbours.ONE_INITIALIZATION:
            log.info("%s: its instances are initialized one at a time", fmu.path.name)
            return replace(self, one_initialization=True)
        plan, what = replace(self, threads=1), "all are stepped by one thread"
        in_process = self.isolation == "none"
        if neighbours is Neighbours.LIBRARIES and (in_process or self._can_copy_libraries):
            plan, what = replace(self, private_libraries=True), "each gets a copy of the library"
        elif neighbours is Neighbours.PROCESSES and in_process:
            plan, what = self, "isolation='none' keeps them in one process all the same"
        elif neighbours is not Neighbours.ONE_THREAD:
            plan = self._with_a_process_each(num_instances)
            what = "each gets a process with a copy of the FMU's files"
        asked_for = self.isolation == "process"
        level = logging.INFO if asked_for else logging.WARNING
        log.log(level, "the instances of %s disturb each other: %s", fmu.path.name, what)
        return plan

    @property
    def _can_copy_libraries(self) -> bool:
        return self.isolation is None

    def _with_means_of_reset(self, num_instances: int) -> Plan:
        """Provide the private libraries or the processes that the reset method needs."""
        method = self.method
        reloads = ResetMethod.LIBRARY in (method, *self.component_resets)
        if reloads and self.isolation == "process":
            method = ResetMethod.PROCESS
        elif reloads:
            return replace(self, private_libraries=True)
        if method is ResetMethod.PROCESS:
            plan = replace(self, reset_method=method, component_resets=())
            return replace(plan, isolation="process", workers=num_instances)
        return replace(self, reset_method=method)


def _prepare_wine(fmu: FMU, private_libraries: bool | None, isolation: str | None) -> None:
    """Refuse what is not possible in Wine, and make ready what every worker needs.

    Raises:
        FMULoadError: If Wine or something else is missing, or a wish cannot be granted.
    """
    wishes = {
        "private_libraries": private_libraries,
        "isolation='none'": isolation == "none",
        "preload": fmu.preload,
    }
    refused = [wish for wish, is_given in wishes.items() if is_given]
    try:
        if refused:
            raise FMULoadError(
                f"{fmu.path.name} has libraries for Windows only, which run here in worker "
                f"processes in Wine, but this leaves no choice for: {', '.join(refused)}"
            )
        Wine.ready()
    except BaseException:
        fmu.close()
        raise


def is_alone(fmu: FMU) -> bool:
    """Whether the FMU says that a process may have only one instance."""
    return fmu.description.capabilities.can_be_instantiated_only_once_per_process


_warned: Final[set[tuple[Path, str]]] = set()


def _level_of(fmu: FMU, subject: str) -> int:
    """A program that makes many environments of an FMU is warned of each subject once."""
    is_new = (fmu.path, subject) not in _warned
    _warned.add((fmu.path, subject))
    return logging.WARNING if is_new else logging.INFO


def _tell_of_resets(fmu: FMU, verdict: Verdict, log: logging.Logger) -> None:
    """Log the reset methods that the FMU offers but that do not work correctly."""
    wrong = [m for m, g in verdict.resets.items() if g in (Grade.WRONG, Grade.FAILS)]
    if not verdict.deterministic:
        text = "%s gives other values of %s each time, even if it begins afresh"
        log.log(_level_of(fmu, "outputs"), text, fmu.path.name, first_of(verdict.noisy))
    if ResetMethod.RESET in wrong:
        log.log(
            _level_of(fmu, str(verdict.reset_method)),
            "%s does not begin anew when it is reset; episodes begin by the method %r instead",
            fmu.path.name,
            str(verdict.reset_method),
        )
    elif verdict.resets:
        log.info("%s: episodes begin by the method %r", fmu.path.name, str(verdict.reset_method))
    for component, method in verdict.components_of(Candidate.of(fmu).plan).items():
        log.info("%s: component %r begins by the method %r", fmu.path.name, component, method)
