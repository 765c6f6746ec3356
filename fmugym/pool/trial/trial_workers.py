"""Worker processes of a trial: an FMU may crash or hang in them, which is a finding."""

from __future__ import annotations

import logging
import math
import re
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from typing import Any, Final, TypeVar

from fmugym.errors import FMUGymError, LicenceError
from fmugym.fmi.fmu import DEFAULT_PROBE_TIMEOUT, FMU
from fmugym.pool.failure_texts import as_messages, quoted
from fmugym.pool.licences import licence_errors, progress, speaks_of_licence
from fmugym.pool.pool_spec import INITIALIZATION_FACTOR, PoolSpec
from fmugym.pool.processes.process_pool import ProcessPool
from fmugym.pool.processes.supervisor import A_STEP, RESET, Loss, Supervisor, WorkerError
from fmugym.pool.processes.worker_group import WorkerGroup

__all__ = ["CLOSING", "INITIALIZATION", "STEP", "DeathError", "TriedPool", "Workers"]

logger = logging.getLogger(__name__)

R = TypeVar("R")

OPENING: Final = "loading and instantiation"
INITIALIZATION: Final = "initialization"
FIRST_STEP: Final = "the first step"
STEP: Final = "a step"
CLOSING: Final = "closing"
"""What an FMU does when it dies."""

_LEAST: Final = 5.0
"""Seconds that every call may take."""

_EVENT: Final = 100
"""How many times as long as the calls before a call may take; an event may cost that much."""

_MEMORY_ERROR: Final = re.compile(r"(free|malloc|realloc|calloc|memalign|munmap_chunk)\w*\(\)")
"""How glibc begins its messages about memory errors."""

_SILENT: Final = logging.Logger("fmugym.pool.trial", logging.CRITICAL + 1)
"""Takes the messages of FMUs; the last ones explain deaths."""


class DeathError(Exception):
    """Error: a process has not survived a call of the FMU; the text describes its end.

    Args:
        call: What the FMU did.
        stage: The part of the trial.
        how: How the process ended.
        lines: What it said last.
    """

    def __init__(self, call: str, stage: str, how: str, lines: list[str]) -> None:
        super().__init__(f"it {how}{quoted(as_messages(lines), 'its last lines')}")
        self.call, self.stage = call, stage
        self.shows_memory_error = any(map(_MEMORY_ERROR.match, lines))


def _kind(call: str) -> str:
    return STEP if call == FIRST_STEP else call


def _factor(call: str) -> int:
    return INITIALIZATION_FACTOR if call in (OPENING, INITIALIZATION) else 1


class Workers:
    """Processes in which an FMU is tried, one after another.

    Args:
        fmu: The FMU.

    Attributes:
        fmu: As given.
        checks_heap: Whether the C library looks for memory errors.
        harm: How a lone instance has harmed its process; empty if none has.
        instances: How many instances there were at once at most.
        initializations: How many initializations there were.
    """

    def __init__(self, fmu: FMU) -> None:
        self.fmu = fmu
        self.checks_heap = not self.fmu.in_wine
        self.harm = ""
        self.instances, self.initializations = 1, 0
        self._longest: dict[str, float] = {}  # the seconds of calls

    @property
    def can_copy_libraries(self) -> bool:
        """Whether instances can have private copies of the library, or load it anew."""
        return not self.fmu.in_wine

    @contextmanager
    def pool(
        self, stage: str, spec: PoolSpec, num_instances: int = 1, **options: Any
    ) -> Iterator[TriedPool]:
        """Make instances in a new process, with a fresh copy of the FMU's files.

        Args:
            stage: The part of the trial.
            spec: What to do at each reset and step.
            num_instances: N.
            options: See ``ProcessPool``.

        Raises:
            DeathError: If the process does not survive all calls, closing included.
            LicenceError: If the FMU gets no licence.
            FMULoadError: If the FMU refuses in order, or no process can be started.
        """
        self.instances = max(self.instances, num_instances)
        with progress(logger, f"{self.fmu.path.name}: the trial, in {stage},"):
            options |= {"checks_heap": self.checks_heap}
            pool = self._open(stage, self.fmu.again(), spec, num_instances, **options)
            try:
                yield pool
            finally:
                begin = time.perf_counter()
                pool.close()
                self.note_call(CLOSING, begin)
                self.initializations += pool.initializations
            pool.require_survival()

    def _open(self, stage: str, *arguments: Any, **options: Any) -> TriedPool:
        begin = time.perf_counter()
        with licence_errors():
            try:
                pool = TriedPool(self, stage, *arguments, **options)
            except WorkerError as error:
                if error.loss is None:
                    raise
                raise self.death(OPENING, stage, error.loss) from None
        self.note_call(OPENING, begin)
        return pool

    # Limits of time: at first long, then as it follows from the calls before.

    def limit(self, call: str) -> tuple[float, str]:
        """Time-out of a call in seconds, and its reason."""
        timeout, factor = self.fmu.probe_timeout or DEFAULT_PROBE_TIMEOUT, _factor(call)
        longest = self._longest.get(_kind(call), math.inf)
        learnt = max(_LEAST, _EVENT * longest)
        if learnt < timeout * factor:
            return learnt, f"those before took up to {longest:.2g} s"
        return timeout * factor, "probe_timeout" if factor == 1 else "ten times probe_timeout"

    def call_timeout(self, call: str) -> float:
        """The same as a time-out of a ``ProcessPool``."""
        return self.limit(call)[0] / _factor(call)

    def note_call(self, call: str, begin: float) -> None:
        """Note a call that has begun at that time of ``time.perf_counter``."""
        kind, seconds = _kind(call), time.perf_counter() - begin
        self._longest[kind] = max(self._longest.get(kind, 0.0), seconds)

    def death(self, call: str, stage: str, loss: Loss) -> DeathError:
        """Describe the end of a process."""
        how = loss.how.replace("ended with", "ended the process with", 1)
        if loss.is_late:
            seconds, why = self.limit(call)
            how = f"did not come back within {seconds:g} s ({why})"
        return DeathError(call, stage, how, loss.lines)

    def attempt(self, attempt: Callable[[], R], *, failed: Callable[[str], R]) -> R:
        """Try something that is not only done with a fresh instance.

        Args:
            attempt: It.
            failed: What is true if the FMU returns errors or its process dies, by the reason.

        Raises:
            LicenceError: If the FMU gets no licence, which tells nothing of it.
        """
        try:
            return attempt()
        except LicenceError:
            raise
        except FMUGymError as error:
            return failed(f"it is refused: {error}")
        except DeathError as death:
            self.note(death)
            return failed(str(death))

    def note(self, death: DeathError, *, alone: bool = False) -> None:
        """Note the end of a process.

        Args:
            death: How.
            alone: Whether it had nothing but a fresh instance.

        Raises:
            LicenceError: If it got no licence, which tells nothing of the FMU.
        """
        is_told = alone and death.call not in (STEP, CLOSING)  # or else by the part of the trial
        reason = f"in {death.call if is_told else death.stage} {death}"
        if speaks_of_licence(reason):
            raise LicenceError(reason)
        self.harm = self.harm or (reason if alone else "")


class _TriedGroup(WorkerGroup):
    """A worker on trial: the time of its calls is limited, and its death is an error.

    Args:
        workers: The processes of the trial.
        stage: The part of the trial.
        arguments: See ``WorkerGroup``.
    """

    def __init__(self, workers: Workers, stage: str, *arguments: Any) -> None:
        self._workers, self._stage = workers, stage
        self._calls = {RESET: INITIALIZATION, A_STEP: FIRST_STEP}
        super().__init__(*arguments)

    def run(
        self, doing: str, supervisors: Sequence[Supervisor], tell: Callable[[Supervisor], None]
    ) -> dict[Supervisor, Any]:
        """See ``WorkerGroup.run``.

        Raises:
            DeathError: If the process has not survived.
        """
        call = self._calls.get(doing, STEP)
        self._calls[A_STEP] = STEP if doing == A_STEP else self._calls[A_STEP]
        self.call_timeout = self._workers.call_timeout(call)
        begin = time.perf_counter()
        try:
            return super().run(doing, supervisors, tell)
        finally:
            self.require_alive(call)
            self._workers.note_call(call, begin)

    def require_alive(self, call: str) -> None:
        """Raise a ``DeathError`` if the process has not survived a call."""
        if self.losses:
            raise self._workers.death(call, self._stage, self.losses[0])


class TriedPool(ProcessPool):
    """Instances on trial in one process.

    Args:
        workers: The processes of the trial.
        stage: The part of the trial.
        fmu: Its files; closed with the pool.
        spec: What to do at each reset and step.
        num_instances: N.
        options: See ``ProcessPool``.

    Attributes:
        fmu: As given.
        spec: As given.
    """

    _group: _TriedGroup

    def __init__(
        self,
        workers: Workers,
        stage: str,
        fmu: FMU,
        spec: PoolSpec,
        num_instances: int,
        **options: Any,
    ) -> None:
        self.fmu, self.spec = fmu, spec
        options = {"workers": 1, "threads": 1, "on_trial": True} | options
        options["call_timeout"] = workers.call_timeout(OPENING)
        options["closing_time"], _ = workers.limit(CLOSING)
        options["make_group"] = partial(_TriedGroup, workers, stage)
        super().__init__(fmu, spec, num_instances, _SILENT, **options)

    def require_survival(self) -> None:
        """Raise a ``DeathError`` if the process has not survived until its end."""
        self._group.require_alive(CLOSING)
