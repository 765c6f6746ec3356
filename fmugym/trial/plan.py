"""Plan of opening a pool: the caller's wishes, completed with the results of a trial."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

from fmugym.archive.fmu import FMU
from fmugym.errors import first_of, printable
from fmugym.pool.bundle import SaveMethod
from fmugym.pool.spec import PoolSpec, ResetMethod
from fmugym.pool.wishes import Wishes
from fmugym.trial.verdict import Grade, Neighbours, Verdict

__all__ = ["Plan", "is_alone"]

_FILES: Final = "each gets a process with a copy of the FMU's files"


@dataclass(frozen=True)
class Plan:
    """How a pool of the native engine is opened.

    Attributes:
        fmu: The FMU; closed with the pool.
        num_instances: N.
        spec: What to do at each reset and step.
        how: The wishes, and what follows where they have left something open.
        own_files: See ``ProcessPool``.
        notes: Why, for the log, with the levels of these messages.
        save_by: Finds out how states can be saved; it may take as long as a trial.
    """

    fmu: FMU
    num_instances: int
    spec: PoolSpec
    how: Wishes
    own_files: bool = False
    notes: tuple[tuple[int, str], ...] = ()
    save_by: Callable[[], SaveMethod] = lambda: SaveMethod.REPLAY

    def completed(self, verdict: Verdict) -> Plan:
        """Decide by the verdict of a trial what the wishes leave open."""
        spec = replace(self.spec, blind_start=verdict.blind_start)
        wished = self.how.reset_method
        plan = replace(self, spec=spec.beginning_by(ResetMethod(wished or verdict.reset_method)))
        if wished is None:
            plan = plan._with_resets(verdict)
        if self.num_instances > 1 and not self.how.decides_who_shares(self.num_instances):
            plan = plan._with_neighbours(verdict.neighbours or Neighbours.INDEPENDENT)
        if verdict.isolate and plan.how.isolation is None:
            plan = plan._with(isolation="process")
            text = f"{plan._name} harms its process: {verdict.harm}. It runs in worker processes"
            plan = plan._noting(text)
        return plan._with_means_of_reset()._with_limits_of_reading(verdict)

    @property
    def is_isolated(self) -> bool:
        """Whether the instances are in worker processes."""
        return self.how.isolation == "process"

    @property
    def _name(self) -> str:
        return self.fmu.path.name

    def _with(self, **how: Any) -> Plan:
        return replace(self, how=replace(self.how, **how))

    def _noting(self, text: str, level: int = logging.WARNING) -> Plan:
        return replace(self, notes=(*self.notes, (level, text)))

    def _with_resets(self, verdict: Verdict) -> Plan:
        """Begin episodes as the verdict says; note the methods that do not work correctly."""
        plan = replace(self, spec=replace(self.spec, component_resets=verdict.components))
        name, method = self._name, str(verdict.reset_method)
        if not verdict.deterministic:
            noisy = first_of(verdict.noisy)
            text = f"{name} gives other values of {noisy} each time, even if it begins afresh"
            plan = plan._noting(text, self._level_of("outputs"))
        if verdict.resets.get(ResetMethod.RESET) in (Grade.WRONG, Grade.FAILS):
            text = f"{name} does not begin anew when it is reset; episodes begin by the method "
            plan = plan._noting(f"{text}{method!r} instead", self._level_of(method))
        elif verdict.resets:
            plan = plan._noting(f"{name}: episodes begin by the method {method!r}", logging.INFO)
        for component, own in verdict.components_of(getattr(self.fmu, "plan", None)).items():
            text = f"{name}: component {component!r} begins by the method {own!r}"
            plan = plan._noting(text, logging.INFO)
        return plan

    def _level_of(self, subject: str) -> int:
        """A program that makes many environments of an FMU is warned of each subject once."""
        is_new = (self.fmu.path, subject) not in _warned
        _warned.add((self.fmu.path, subject))
        return logging.WARNING if is_new else logging.INFO

    def _with_neighbours(self, neighbours: Neighbours) -> Plan:
        """Keep instances from disturbing each other, unless the caller insists."""
        why = f"the instances of {self._name} disturb each other"
        kept = "isolation='none' keeps them in one process all the same"
        few = f"workers={self.how.workers} keeps several in one process all the same"
        if is_alone(self.fmu):
            why, neighbours = (
                f"a process may have one instance of {self._name}",
                Neighbours.PROCESSES,
            )
            kept = "isolation='none' keeps more in it all the same"
        elif neighbours is Neighbours.INDEPENDENT:
            return self
        elif neighbours is Neighbours.ONE_INITIALIZATION:
            plan = replace(self, spec=replace(self.spec, one_initialization=True))
            text = f"{self._name}: its instances are initialized one at a time"
            return plan._noting(text, logging.INFO)
        if neighbours is Neighbours.ONE_THREAD:
            plan, what = self._with(threads=1), "all are stepped by one thread, one after another"
            why += " in threads"
        elif neighbours is Neighbours.LIBRARIES and self._shares_processes:
            plan, what = self._with(private_libraries=True), "each gets a copy of the library"
        elif self.how.isolation == "none":
            plan, what = self, kept
        else:
            workers = self.how.workers or self.num_instances
            plan = replace(self._with(isolation="process", workers=workers), own_files=True)
            what = _FILES if workers >= self.num_instances else few
        is_cured = self.is_isolated and what not in (kept, few)
        return plan._noting(f"{why}: {what}", logging.INFO if is_cured else logging.WARNING)

    @property
    def _shares_processes(self) -> bool:
        """Whether several instances are in one process, and stay there."""
        return not self.is_isolated or self.how.workers is not None

    def _with_means_of_reset(self) -> Plan:
        """Provide the private libraries or the processes that the reset method needs."""
        if self.spec.reloads and not self.is_isolated:
            return self._with(private_libraries=True)
        if self.spec.reloads or self.spec.reset_method is ResetMethod.PROCESS:
            plan = replace(self, spec=self.spec.beginning_by(ResetMethod.PROCESS))
            return plan._with(isolation="process", workers=self.num_instances)
        return self

    def _with_limits_of_reading(self, verdict: Verdict) -> Plan:
        """Note what cannot be read, or not at any time."""
        plan = self
        if verdict.blind_start:
            plan = plan._noting(
                f"{self._name} cannot be read before its first step: until then, its outputs have "
                "the start values of the model description"
            )
        if verdict.unreadable:
            names = printable(", ".join(verdict.unreadable))
            plan = plan._noting(f"{self._name}: its trial could not read the output(s) {names}")
        return plan

    def saving_by(self, method: SaveMethod) -> Plan:
        """The plan if it is known how states can be saved."""
        spec = replace(self.spec, records=method is not SaveMethod.STATE)
        return replace(self, spec=spec, save_by=lambda: method)


def is_alone(fmu: FMU) -> bool:
    """Whether the FMU says that a process may have only one instance."""
    return fmu.description.capabilities.can_be_instantiated_only_once_per_process


_warned: Final[set[tuple[Path, str]]] = set()
