"""Opening of a pool: its options, the choice of its engine, the trial of the FMU, its execution.

.. code-block:: python

    fmu = FMU("tank.fmu")
    spec = PoolSpec((fmu.variable("valve"),), (fmu.variable("level"),), time_step=0.1)
    pool = open_pool(fmu, spec, 64, logger, PoolOptions(isolation="process"))
    print(*pool.execution, sep="; ")  # how its instances run, and why

The execution is the processes and threads of the instances, with the reasons.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import partial
from math import floor, isfinite
from pathlib import Path
from typing import Any, Final, NamedTuple

from fmugym.checks import check_option, has_method
from fmugym.errors import ConfigError, FMULoadError, first_of, printable, warn_once
from fmugym.fmi.fmu import FMU
from fmugym.fmi.wine import Wine
from fmugym.pool.c_extension import has_native_pool, needs_engine, require_engine
from fmugym.pool.instance_limit import claim_instances
from fmugym.pool.licences import licence_errors, progress, wait_for_licence
from fmugym.pool.machine_limits import available_processors
from fmugym.pool.pool import Pool
from fmugym.pool.pool_spec import DEFAULT_CALL_TIMEOUT, ISOLATIONS, PoolSpec, ResetMethod
from fmugym.pool.processes.process_pool import ProcessPool
from fmugym.pool.rig.fmpy_pool import fmpy_pool
from fmugym.pool.rig.rig_pool import BackendPool
from fmugym.pool.saving_pool import SavingPool, offered_method
from fmugym.pool.states import SaveMethod
from fmugym.pool.trial.trial import compare, examine, saving_method
from fmugym.pool.trial.trial_episodes import Starts
from fmugym.pool.trial.verdict import Grade, Neighbours, Verdict, is_exempt, known_resuming

__all__ = ["Execution", "PoolOptions", "open_pool"]


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

logger = logging.getLogger(__name__)

_BACKENDS: Final = ("auto", "fmpy", "fmu", "native")
_DEFAULTS: Final = PoolOptions()


def open_pool(
    fmu: FMU,
    spec: PoolSpec,
    num_instances: int,
    log: logging.Logger,
    options: PoolOptions = _DEFAULTS,
) -> Pool:
    """Open the fastest pool that gives correct values.

    Args:
        fmu: The FMU; closed with the pool.
        spec: What to do at each reset and step.
        num_instances: N.
        log: The logger that gets the FMU's messages, and learns how the pool runs, and why.
        options: Where it runs, and how.

    Returns:
        The pool. Its ``execution`` says how it runs, and why.

    Raises:
        ConfigError: If the backend is unknown, not available, or cannot do what the spec says; or
            if the spec allows fewer instances.
        LicenceError: If the FMU gets no licence within ``spec.licence_wait``.
        FMULoadError: If the FMU cannot be loaded or instantiated.
    """
    _require_allowed(fmu, spec, num_instances)
    backend = options.backend
    given: Any = backend
    if has_method(given, "open_pool"):
        own: Pool = given.open_pool(fmu, spec, num_instances, log, options)
        return own
    if not isinstance(backend, str):
        pool = BackendPool(fmu, spec, num_instances, backend)
        pool.execution = (f"{fmu.path.name}: the given backend steps in its place",)
        log.info("%s", *pool.execution)
        return pool
    if _is_fmpy(backend):
        return fmpy_pool(fmu, spec, num_instances, log, options.reset_method, options.isolation)
    options = options.fitting(fmu)
    if fmu.in_wine:
        Wine.ready()
    opening = partial(_open_tried, fmu, spec, num_instances, log, options)
    return wait_for_licence(spec.licence_wait, log, opening)


def _require_allowed(fmu: FMU, spec: PoolSpec, num_instances: int) -> None:
    most = spec.max_instances
    if most is not None and num_instances > most:
        raise ConfigError(
            f"{fmu.path.name}: {num_instances} environments need {num_instances} "
            f"instances, but 'max_instances' of 'foreign' allows {most}"
        )


def _is_fmpy(backend: str) -> bool:
    """Whether FMPy steps the FMUs, because the caller says so, or there is no extension."""
    check_option("backend", backend, _BACKENDS)
    if backend == "native":
        require_engine("backend='native'")
    elif backend != "fmpy" and not has_native_pool():
        text = "FMUs are stepped by FMPy, which is slow"
        warn_once(logger, f"{text}: {needs_engine('speed')}")
        return True
    return backend == "fmpy"


# The engine: a trial, the decision, the instances


def _open_tried(
    fmu: FMU, spec: PoolSpec, num_instances: int, log: logging.Logger, options: PoolOptions
) -> Pool:
    tried = replace(spec, num_observed=0, leak_limit=None, fault_retries=0, licence_wait=0.0)
    task = fmu, tried, options.starts, _episode_length(spec, options)
    execution = Execution.decided(
        fmu, spec, num_instances, options, _verdict(*task, num_instances, options)
    )
    if fmu.calls_python():
        execution = execution.in_one_thread("calls Python, which one thread at a time can use")
    saving = _saving_method(execution, *task)
    spec = replace(execution.spec, records=saving is not SaveMethod.STATE)
    execution = replace(execution, spec=spec)
    execution.log(log)
    pool = _claimed_pool(execution, log)
    pool.execution = execution.sentences
    pool.save_by(partial(saving_method, *task) if saving is None else lambda: saving)
    return pool


def _episode_length(spec: PoolSpec, options: PoolOptions) -> int | None:
    """The most steps of an episode; None if nothing limits them."""
    limits = [options.max_episode_steps]
    if spec.stop_time is not None:
        steps = (spec.stop_time - spec.start_time) / spec.time_step
        limits.append(max(1, floor(steps + 1e-9)) if isfinite(steps) else None)
    return min((limit for limit in limits if limit is not None), default=None)


def _verdict(
    fmu: FMU,
    spec: PoolSpec,
    starts: Starts,
    length: int | None,
    num_instances: int,
    options: PoolOptions,
) -> Verdict:
    """Verdict of a trial on options that are open, if the FMU is not exempt."""
    exempt = is_exempt(fmu)
    if fmu.bundled:
        return Verdict(True, resets={ResetMethod.RESTORE: Grade.BITWISE})
    once = fmu.description.capabilities.can_be_instantiated_only_once_per_process
    count = 1 if once or options.decide_sharing(num_instances) else num_instances
    if not exempt:
        fatal = not options.is_isolated
        return examine(fmu, spec, starts, num_instances=count, length=length, must_survive=fatal)
    if count == 1:
        return Verdict()
    return compare(fmu, spec, starts, num_instances=count, length=length)


def _saving_method(execution: Execution, *task: Any) -> SaveMethod | None:
    """Method of saving states; None if a trial shall find it when one is first saved."""
    fmu, spec = execution.fmu, execution.spec
    offered = offered_method(fmu.description, spec)
    if fmu.bundled or offered is SaveMethod.REPLAY:
        return offered
    if is_exempt(fmu):
        return SaveMethod.REPLAY
    may_try = spec.max_instances is None or execution.num_instances < spec.max_instances
    return known_resuming(*task) or (None if may_try else SaveMethod.REPLAY)


@licence_errors()
def _claimed_pool(execution: Execution, log: logging.Logger) -> SavingPool:
    """Make the instances, which count as those of an environment until the pool is closed."""
    fmu, count = execution.fmu, execution.num_instances
    claim = claim_instances(fmu, execution.spec, count, "an environment")
    try:
        with progress(log, f"{fmu.path.name}: the instantiation of {count} instance(s)"):
            pool = _pool(execution, log)
    except BaseException:
        claim.close()
        raise
    pool.hold(claim.close)
    return pool


def _pool(execution: Execution, log: logging.Logger) -> SavingPool:
    of, options = (execution.fmu, execution.spec, execution.num_instances, log), execution.options
    if options.is_isolated:
        return ProcessPool(
            *of,
            workers=options.workers,
            threads=options.threads,
            private_libraries=bool(options.private_libraries),
            own_files=execution.own_files,
            call_timeout=options.call_timeout,
        )
    from fmugym.pool.native_pool import NativePool

    private = bool(options.private_libraries)
    return NativePool(*of, threads=options.threads, private_libraries=private)
