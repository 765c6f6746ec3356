"""An unknown FMU on trial: its instances are in worker processes, whose deaths are findings."""

from __future__ import annotations

import logging
import re
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, Final, ParamSpec, TypeVar

import numpy as np
import numpy.typing as npt

from fmugym.archive.fmu import DEFAULT_PROBE_TIMEOUT, FMU
from fmugym.archive.variable import Variable
from fmugym.errors import FMUGymError, LicenceError
from fmugym.fmi.words import as_messages, quoted
from fmugym.pool.base import FloatArray, MaskArray, StatusArray
from fmugym.pool.bundle import Bundle, IndexArray
from fmugym.pool.patience import licence_errors, speaks_of_licence
from fmugym.pool.process.pool import ProcessPool
from fmugym.pool.process.supervisor import Loss, WorkerError
from fmugym.pool.progress import progress
from fmugym.pool.spec import INITIALIZATION_FACTOR, PoolSpec

__all__ = ["CLOSING", "STEP", "DeathError", "Subject", "TriedPool"]

logger = logging.getLogger(__name__)

P = ParamSpec("P")
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

_SILENT: Final = logging.Logger("fmugym.trial", logging.CRITICAL + 1)
"""Takes the messages of FMUs; the last ones explain deaths."""


class DeathError(Exception):
    """A process has not survived a call of the FMU; the text says how it ended.

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


class _Limits:
    """How long calls may take: at first long, then as it follows from the calls before.

    Args:
        timeout: Seconds for a step that nothing is known of; ten times as long for a call that
            makes or initializes instances.
    """

    def __init__(self, timeout: float) -> None:
        self._timeout = timeout
        self._longest: dict[str, float] = {}

    def seconds(self, call: str) -> float:
        """How long a call may take."""
        most, longest = self._timeout * _factor(call), self._longest.get(_kind(call))
        return most if longest is None else min(most, max(_LEAST, _EVENT * longest))

    def call_timeout(self, call: str) -> float:
        """The same as a time-out of a ``ProcessPool``."""
        return self.seconds(call) / _factor(call)

    def explained(self, call: str) -> str:
        """How long a call may take, and why."""
        seconds = self.seconds(call)
        why = "ten times probe_timeout" if _factor(call) > 1 else "probe_timeout"
        if seconds < self._timeout * _factor(call):
            why = f"those before took up to {self._longest[_kind(call)]:.2g} s"
        return f"{seconds:g} s ({why})"

    def note(self, call: str, begin: float) -> None:
        """Note a call that has begun at that time of ``time.perf_counter``."""
        kind, seconds = _kind(call), time.perf_counter() - begin
        self._longest[kind] = max(self._longest.get(kind, 0.0), seconds)


def _kind(call: str) -> str:
    return STEP if call == FIRST_STEP else call


def _factor(call: str) -> int:
    return INITIALIZATION_FACTOR if call in (OPENING, INITIALIZATION) else 1


class Subject:
    """An FMU on trial.

    Args:
        fmu: The FMU.

    Attributes:
        fmu: As given.
        checks_heap: Whether the C library looks for memory errors.
        is_harmful: Whether a lone instance has harmed its process.
        reasons: How processes have ended, a sentence each.
        instances: How many instances there were at once at most.
        initializations: How many initializations there were.
    """

    def __init__(self, fmu: FMU) -> None:
        self.fmu = fmu
        self.checks_heap = not self.fmu.in_wine
        self.is_harmful = False
        self.reasons: list[str] = []
        self.instances, self.initializations = 1, 0
        self._limits = _Limits(fmu.probe_timeout or DEFAULT_PROBE_TIMEOUT)

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
                self._limits.note(CLOSING, begin)
                self.initializations += pool.initializations
            pool.require_alive(CLOSING)

    def _open(self, stage: str, *arguments: Any, **options: Any) -> TriedPool:
        begin = time.perf_counter()
        with licence_errors():
            try:
                pool = TriedPool(self._limits, stage, *arguments, **options)
            except WorkerError as error:
                if error.loss is None:
                    raise
                raise _death(OPENING, stage, error.loss, self._limits) from None
        self._limits.note(OPENING, begin)
        return pool

    def attempt(self, attempt: Callable[[], R], *, refused: R, died: R, alone: bool = False) -> R:
        """Try something.

        Args:
            attempt: It.
            refused: What is true if the FMU returns errors.
            died: What is true if its process dies.
            alone: Whether the process has nothing but a fresh instance.

        Returns:
            What it finds, or one of these.

        Raises:
            LicenceError: If the FMU gets no licence, which tells nothing of it.
        """
        try:
            return attempt()
        except LicenceError:
            raise
        except FMUGymError:
            return refused
        except DeathError as death:
            self.note(death, alone=alone)
            return died

    def note(self, death: DeathError, *, alone: bool = False) -> None:
        """Note how a process has ended.

        Args:
            death: How.
            alone: Whether it had nothing but a fresh instance.

        Raises:
            LicenceError: If it got no licence, which tells nothing of the FMU.
        """
        is_quick = alone and death.call != STEP  # or else the call does not tell how far it came
        reason = f"in {death.call if is_quick else death.stage} {death}"
        if speaks_of_licence(reason):
            raise LicenceError(reason)
        self.reasons.append(reason)
        self.is_harmful |= alone


class TriedPool(ProcessPool):
    """Instances on trial in one process.

    Args:
        limits: How long calls may take.
        stage: The part of the trial.
        fmu: The FMU; closed with the pool.
        spec: What to do at each reset and step.
        num_instances: N.
        options: See ``ProcessPool``.

    Attributes:
        fmu: As given.
    """

    def __init__(
        self,
        limits: _Limits,
        stage: str,
        fmu: FMU,
        spec: PoolSpec,
        num_instances: int,
        threads: int = 1,
        **options: Any,
    ) -> None:
        self.fmu, self._limits, self._stage = fmu, limits, stage
        self._next_step = FIRST_STEP
        super().__init__(
            fmu,
            spec,
            num_instances,
            _SILENT,
            workers=1,
            threads=threads,
            call_timeout=limits.call_timeout(OPENING),
            closing_time=limits.seconds(CLOSING),
            on_trial=True,
            **options,
        )

    def require_alive(self, call: str) -> None:
        """Raise a ``DeathError`` if the process has not survived a call."""
        if self.losses:
            raise _death(call, self._stage, self.losses[0], self._limits)

    def _ask(self, call: str, function: Callable[P, R], *args: P.args, **named: P.kwargs) -> R:
        """Limit the time of a call, and see whether the process survives it."""
        self.limit_calls(self._limits.call_timeout(call))
        begin = time.perf_counter()
        try:
            return function(*args, **named)
        finally:
            self.require_alive(call)
            self._limits.note(call, begin)

    def reset(
        self, variables: tuple[Variable, ...], values: FloatArray, mask: MaskArray | None = None
    ) -> tuple[FloatArray, StatusArray]:
        """See ``Pool.reset``."""
        return self._ask(INITIALIZATION, super().reset, variables, values, mask)

    def step(
        self,
        inputs: FloatArray | None = None,
        skip: MaskArray | None = None,
        observations: npt.NDArray[np.float32] | None = None,
    ) -> tuple[FloatArray, StatusArray]:
        """See ``Pool.step``."""
        call, self._next_step = self._next_step, STEP
        return self._ask(call, super().step, inputs, skip, observations)

    def save_instances(self, indices: IndexArray) -> Bundle:
        """See ``Pool.save_instances``."""
        return self._ask(STEP, super().save_instances, indices)

    def restore_instances(
        self, bundle: Bundle, sources: IndexArray, indices: IndexArray
    ) -> StatusArray:
        """See ``Pool.restore_instances``."""
        return self._ask(STEP, super().restore_instances, bundle, sources, indices)


def _death(call: str, stage: str, loss: Loss, limits: _Limits) -> DeathError:
    how = loss.how.replace("ended with", "ended the process with", 1)
    if loss.is_late:
        how = f"did not come back within {limits.explained(call)}"
    return DeathError(call, stage, how, loss.lines)
