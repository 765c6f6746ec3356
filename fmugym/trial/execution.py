"""Execution of a pool: the processes and threads of its instances, with the reasons."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final, NamedTuple

from fmugym.archive.fmu import FMU
from fmugym.errors import first_of, printable
from fmugym.pool.processors import available_processors
from fmugym.pool.spec import PoolSpec, ResetMethod
from fmugym.trial.pool_options import PoolOptions
from fmugym.trial.verdict import Grade, Neighbours, Verdict

__all__ = ["Execution"]


class Reason(NamedTuple):
    """A sentence on why a pool runs in this way.

    Attributes:
        text: The sentence.
        level: Its level in the log.
        once: Whether a program is told of it once for each FMU at this level, then at INFO.
    """

    text: str
    level: int
    once: bool


@dataclass(frozen=True)
class Execution:
    """Execution of a pool: the options of the caller, completed by the trial of the FMU.

    Attributes:
        fmu: The FMU.
        spec: What to do at each reset and step, the way in which episodes begin included.
        num_instances: N.
        options: The caller's, with decisions where they left a choice.
        own_files: Whether each worker process has a copy of the FMU's files.
        reasons: Sentences on what is unusual.
    """

    fmu: FMU
    spec: PoolSpec
    num_instances: int
    options: PoolOptions
    own_files: bool = False
    reasons: tuple[Reason, ...] = ()

    @classmethod
    def decided(
        cls,
        fmu: FMU,
        spec: PoolSpec,
        num_instances: int,
        options: PoolOptions,
        verdict: Verdict,
    ) -> Execution:
        """Decide how a pool runs: as the caller says, else as the verdict of the trial asks for."""
        spec = replace(spec, blind_start=verdict.blind_start)
        execution = cls(fmu, spec, num_instances, options)._with_resets(verdict)
        if num_instances > 1 and not options.decide_sharing(num_instances):
            execution = execution._with_neighbours(verdict.neighbours or Neighbours.INDEPENDENT)
        if verdict.isolate and execution.options.isolation is None:
            execution = execution._with(isolation="process")._because(
                f"{fmu.path.name} harms its process: {verdict.harm}. It runs in worker processes"
            )
        return execution._with_means_of_reset()._with_limits_of_reading(verdict)

    def in_one_thread(self, why: str) -> Execution:
        """The same with one thread in each process, unless the caller says how many."""
        if self.options.threads is not None:
            return self
        return self._with(threads=1)._because(f"{self.fmu.path.name} {why}", logging.INFO)

    # Words

    @property
    def sentences(self) -> tuple[str, ...]:
        """Sentences on the execution of the pool, with the reasons."""
        return self._summary, *(reason.text for reason in self.reasons)

    def log(self, logger: logging.Logger) -> None:
        """Tell a logger the execution of the pool, with the reasons."""
        logger.info("%s", self._summary)
        for text, level, once in self.reasons:
            is_known = once and (self.fmu.path, text) in _told
            _told.add((self.fmu.path, text))
            logger.log(logging.INFO if is_known else level, "%s", text)

    @property
    def _summary(self) -> str:
        count, spec = self.num_instances, self.spec.fitting(self.fmu.description)
        run = "instance runs" if count == 1 else "instances run"
        method = repr(str(spec.reset_method))
        if spec.component_resets:
            method = "the methods of its components"
        where = ", ".join([self._place, *self._separation])
        return f"{self.fmu.path.name}: {count} {run} {where}; episodes begin by {method}"

    @property
    def _place(self) -> str:
        if not self.options.is_isolated:
            return "in this process"
        workers = min(self.num_instances, self.options.workers or available_processors())
        return "in a worker process" if workers == 1 else f"in {workers} worker processes"

    @property
    def _separation(self) -> Iterator[str]:
        """Measure that keeps the instances from disturbing each other."""
        each = "each " if self.num_instances > 1 else ""
        if self.own_files or self.spec.reset_method is ResetMethod.PROCESS:
            yield f"{each}with a copy of the FMU's files"
        elif self.options.private_libraries:
            yield f"{each}with a copy of the library"
        if each and self.options.threads == 1 and not self.options.is_isolated:
            yield "stepped one after another"
        if each and self.spec.one_initialization:
            yield "initialized one at a time"

    # The decisions

    def _with(self, **options: Any) -> Execution:
        return replace(self, options=replace(self.options, **options))

    def _because(self, text: str, level: int = logging.WARNING, *, once: bool = False) -> Execution:
        return replace(self, reasons=(*self.reasons, Reason(text, level, once)))

    def _with_resets(self, verdict: Verdict) -> Execution:
        """Begin episodes as the caller or else the verdict says."""
        if self.options.reset_method is not None:
            method = ResetMethod(self.options.reset_method)
            return replace(self, spec=self.spec.beginning_by(method))
        name, method = self.fmu.path.name, verdict.reset_method
        spec = replace(self.spec, reset_method=method, component_resets=verdict.components)
        execution = replace(self, spec=spec)
        if not verdict.deterministic:
            execution = execution._because(
                f"{name} gives other values of {first_of(verdict.noisy)} each time, even if it "
                "begins afresh",
                once=True,
            )
        if verdict.resets.get(ResetMethod.RESET) in (Grade.WRONG, Grade.FAILS):
            execution = execution._because(
                f"{name} does not begin anew when it is reset; episodes begin by the method "
                f"{str(method)!r} instead",
                once=True,
            )
        for component, own in verdict.components_of(getattr(self.fmu, "plan", None)).items():
            text = f"{name}: component {component!r} begins by the method {own!r}"
            execution = execution._because(text, logging.INFO)
        return execution

    def _with_neighbours(self, neighbours: Neighbours) -> Execution:
        """Keep instances from disturbing each other, unless the caller insists."""
        name, options = self.fmu.path.name, self.options
        if self.fmu.description.capabilities.can_be_instantiated_only_once_per_process:
            kept = "isolation='none' keeps more in it all the same"
            execution = self._in_processes(f"a process may have one instance of {name}", kept)
            if execution.options.is_isolated:
                return execution
            return execution._with(private_libraries=True)
        disturbed = f"the instances of {name} disturb each other"
        # A cure within worker processes, which the caller has asked for, is nothing unusual.
        cured = logging.INFO if options.is_isolated else logging.WARNING
        match neighbours:
            case Neighbours.INDEPENDENT:
                return self
            case Neighbours.ONE_INITIALIZATION:
                execution = replace(self, spec=replace(self.spec, one_initialization=True))
                text = f"{name}: its instances are initialized one at a time"
                return execution._because(text, logging.INFO)
            case Neighbours.ONE_THREAD:
                how = "in threads: all are stepped by one thread, one after another"
                return self._with(threads=1)._because(f"{disturbed} {how}", cured)
            case Neighbours.LIBRARIES if not options.is_isolated or options.workers is not None:
                text = f"{disturbed}: each gets a copy of the library"
                return self._with(private_libraries=True)._because(text, cured)
        kept = "isolation='none' keeps them in one process all the same"
        return self._in_processes(disturbed, kept)

    def _in_processes(self, why: str, kept: str) -> Execution:
        """Give each instance a process of its own, unless the caller insists.

        Args:
            why: The reason.
            kept: What the caller insists on with ``isolation="none"``.
        """
        options, count = self.options, self.num_instances
        if options.isolation == "none":
            return self._because(f"{why}: {kept}")
        workers = options.workers or count
        execution = replace(self._with(isolation="process", workers=workers), own_files=True)
        if workers < count:
            kept = f"workers={workers} keeps several in one process all the same"
            return execution._because(f"{why}: {kept}")
        level = logging.INFO if options.is_isolated else logging.WARNING
        cure = "each gets a process with a copy of the FMU's files"
        return execution._because(f"{why}: {cure}", level)

    def _with_means_of_reset(self) -> Execution:
        """Provide the private libraries or the processes that the reset method needs."""
        spec = self.spec
        if spec.reloads and not self.options.is_isolated:
            return self._with(private_libraries=True)
        if spec.reloads or spec.reset_method is ResetMethod.PROCESS:
            execution = replace(self, spec=spec.beginning_by(ResetMethod.PROCESS))
            return execution._with(isolation="process", workers=self.num_instances)
        return self

    def _with_limits_of_reading(self, verdict: Verdict) -> Execution:
        """Tell the variables that cannot be read, or not at any time."""
        execution, name = self, self.fmu.path.name
        if verdict.blind_start:
            execution = execution._because(
                f"{name} cannot be read before its first step: until then, its outputs have "
                "the start values of the model description"
            )
        if verdict.unreadable:
            names = printable(", ".join(verdict.unreadable))
            text = f"{name}: its trial could not read the output(s) {names}"
            execution = execution._because(text)
        return execution


_told: Final[set[tuple[Path, str]]] = set()
"""The reasons that loggers were told in this process, by the FMU."""
