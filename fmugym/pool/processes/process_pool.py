"""The pool of processes: an FMU may harm its own process, but not the caller's.

Each worker process has a block of the instances in a ``NativePool`` of its own, and shares its
inputs and outputs through memory. A worker that dies or hangs is replaced. Its instances have the
status ``FATAL`` and the cause, until the next reset makes them anew. Those of other workers go on.
"""

from __future__ import annotations

import functools
import itertools
import logging
import math
from collections.abc import Callable, Sequence
from contextlib import ExitStack, closing
from dataclasses import replace
from threading import RLock
from typing import Any, Final, TypeVar

import numpy as np
import numpy.typing as npt

from fmugym.checks import check_count, check_number
from fmugym.errors import FMULoadError, SimulationError
from fmugym.fmi.fmu import FMU, extracted_again
from fmugym.fmi.status import WARNING_CODE, Status
from fmugym.fmi.variable import Variable
from fmugym.pool.engine import (
    Answer,
    EnginePool,
    Reader,
    Request,
    request_listing,
    request_restore_snapshot,
)
from fmugym.pool.failure_texts import REFUSED_ANEW
from fmugym.pool.health import Column, new_arrays
from fmugym.pool.licences import speaks_of_licence
from fmugym.pool.pool import (
    DEFAULT_CALL_TIMEOUT,
    FloatArray,
    MaskArray,
    Play,
    PoolSpec,
    StatusArray,
    available_processors,
)
from fmugym.pool.pool_form import Writer
from fmugym.pool.pool_spec import ResetMethod
from fmugym.pool.processes.shared_memory import Memory
from fmugym.pool.processes.supervisor import A_STEP, INTERRUPTED, RESET, Supervisor
from fmugym.pool.processes.worker_group import StatesOfWorkers, WorkerGroup
from fmugym.pool.processes.worker_setup import Setup
from fmugym.pool.states import IndexArray

__all__ = ["ProcessPool"]

R = TypeVar("R")

_CLOSING_TIME: Final = 5.0


class ProcessPool(EnginePool):
    """N instances in blocks of supervised processes; see ``Pool`` for the contract.

    Args:
        fmu: The FMU; closed with the pool.
        spec: What to do at each reset and step.
        num_instances: N.
        log: The logger that gets the FMU's messages.
        workers: How many processes; by default one for each processor that this process may use,
            and at most N.
        threads: The most threads in each of them; by default, together one for each processor.
        call_timeout: How long a call may take, in seconds of real time; a reset or an instantiation
            may take ten times as long. None for ever. A worker that takes longer is ended, unless
            a debugger holds it.
        closing_time: How long workers may take to free their instances in ``close``, in seconds;
            by default 5, or ``call_timeout`` if that is shorter.
        make_group: What makes the workers, of the same arguments as a ``WorkerGroup``.
        options: As for ``Setup.of``.

    Attributes:
        workers: How many processes there are.

    Raises:
        ConfigError: If ``workers``, ``threads`` or ``call_timeout`` is no positive number.
        FMULoadError: If the FMU cannot be loaded or instantiated, or the system has no process,
            memory or temporary folder left.
    """

    def __init__(
        self,
        fmu: FMU,
        spec: PoolSpec,
        num_instances: int,
        log: logging.Logger,
        *,
        workers: int | None = None,
        threads: int | None = None,
        call_timeout: float | None = DEFAULT_CALL_TIMEOUT,
        closing_time: float | None = None,
        make_group: Callable[..., WorkerGroup] = WorkerGroup,
        **options: bool,
    ) -> None:
        self._spec, self._log = spec, log
        self._has_told = False
        self._lock = RLock()
        try:
            _check_options(workers, threads, call_timeout)
            self.workers = min(num_instances, workers or available_processors())
            threads = threads or max(1, available_processors() // self.workers)
            setup = Setup.of(fmu, spec, num_instances, log, threads=threads, **options)
            self._setup, setups = setup, _share_out(setup, self.workers)
            memories = _make_memories(spec, setups)
        except BaseException:
            fmu.close()
            raise
        self._prepare(fmu, spec, log)
        single = self.workers == 1
        arrays = memories[0].arrays if single else new_arrays(spec, num_instances)
        self._use(arrays)
        self._mask = arrays.mask
        timeout = math.inf if call_timeout is None else float(call_timeout)
        closing_time = closing_time or min(_CLOSING_TIME, timeout)
        self._group = make_group(fmu, setups, memories, arrays, log, timeout, closing_time)
        self._states = StatesOfWorkers(self._group)

    # The contract of Pool.

    def _reset_once(
        self, variables: tuple[Variable, ...], values: FloatArray, mask: MaskArray | None
    ) -> int:
        """Reset blocks; if a worker dies in it, a new one tries again; if it is killed, another."""
        values = np.asarray(values, np.float64)
        mask = self._as_mask(mask)
        with self._lock:
            concerned = self._group.of_any(mask)
            if self._spec.reset_method == ResetMethod.PROCESS:
                self._retire_used(concerned)
            self._retire_grown(concerned, mask)
            used = [s for s in concerned if not s.is_new]
            troubled = self._reset_until_done(concerned, variables, values, mask)
            exhausted = self._replace_exhausted(used, mask) if troubled else []
            if exhausted:
                troubled = self._reset_until_done(exhausted, variables, values, mask)
            return troubled

    def _reset_until_done(self, supervisors: list[Supervisor], *request: Any) -> int:
        """Reset blocks, also in new workers; return the number of troubled instances."""
        while supervisors:
            supervisors = self._reset(supervisors, *request)
        self._group.note_lost()
        return int(np.count_nonzero(self.statuses > WARNING_CODE))

    def extract(self) -> bool:
        """See ``Pool.extract``."""
        return extracted_again(self._setup.fmu, len(self._setup.copies) and self.num_instances)

    def _reset(
        self,
        supervisors: Sequence[Supervisor],
        variables: tuple[Variable, ...],
        values: FloatArray,
        mask: MaskArray,
    ) -> list[Supervisor]:
        """Reset blocks; returns those that lost a worker in whose place a new one may succeed.

        Either it was used before, or it was killed from outside.
        """
        listing, texts = request_listing(variables, self._version), _texts_of(variables)
        used = {s for s in supervisors if not s.is_new}
        kills = {s: s.kills for s in supervisors}
        alive = self._group.revive(supervisors)
        np.copyto(self._mask, mask)

        def tell(supervisor: Supervisor) -> None:
            content = Writer().block(listing).array(values[:, supervisor.block], np.float64).form()
            supervisor.forget_output()
            if texts:
                supervisor.lend(texts)
            supervisor.tell(Request.START, content, supervisor.read_growth)

        for supervisor in self._group.run(RESET, alive, tell):
            supervisor.note_success()
            block = supervisor.block
            self._group.lost[block] &= ~mask[block]
        return [s for s in supervisors if (s in used and s.is_new) or s.kills > kills[s]]

    def _is_exhausted(self, supervisor: Supervisor, mask: MaskArray) -> bool:
        """Whether the FMU makes no further instance in the process of a worker.

        It may have run out of something that is given back only with the process. A licence that
        it does not get is no reason: the other instances would lose theirs.
        """
        block = supervisor.block
        dead = mask[block] & (self.statuses[block] == Status.FATAL) & ~self._group.lost[block]
        texts = [self.failure(block.start + int(index)) for index in np.flatnonzero(dead)]
        return any(REFUSED_ANEW in text and not speaks_of_licence(text) for text in texts)

    def _replace_exhausted(self, used: Sequence[Supervisor], mask: MaskArray) -> list[Supervisor]:
        """End workers in which the FMU makes no further instance; returns their supervisors."""
        exhausted = [s for s in used if not s.is_new and self._is_exhausted(s, mask)]
        for supervisor in exhausted:
            how = "was replaced: its FMU made no further instance"
            reason = f"worker process {supervisor.pid} {how}"
            self._group.retire(supervisor, reason)
            if not self._has_told:
                self._has_told = True
                self._log.warning("%s: %s", self._setup.fmu.path.name, reason)
        return exhausted

    def _retire_used(self, supervisors: Sequence[Supervisor]) -> None:
        """End the workers that have played an episode, so that each episode has a new process."""
        for supervisor in supervisors:
            if not supervisor.is_new:
                self._group.retire(supervisor, "each episode has a new process")

    def _retire_grown(self, supervisors: Sequence[Supervisor], mask: MaskArray) -> None:
        """Replace workers that leak.

        The best moment is when all instances of a worker start anew. At any other moment the others
        lose their episodes, so the worker may first leak twice as much.
        """
        limit = math.inf if self._spec.leak_limit is None else self._spec.leak_limit
        for supervisor in supervisors:
            if supervisor.growth > (limit if mask[supervisor.block].all() else 2 * limit):
                grown = f"by {supervisor.growth / 2**20:.0f} MB"
                reason = f"worker process {supervisor.pid} was replaced: it had grown {grown}"
                self._group.retire(supervisor, reason)

    def step(
        self,
        inputs: FloatArray | None = None,
        skip: MaskArray | None = None,
    ) -> tuple[FloatArray, StatusArray]:
        """See ``Pool.step``."""
        with self._lock:
            if inputs is not None:
                np.copyto(self.inputs, inputs)
            self._step(skip)
            return self.outputs, self.statuses

    def step_own(self) -> int:
        """See ``Pool.step_own``."""
        with self._lock:
            return self._step(None)

    def _step(self, skip: MaskArray | None) -> int:
        np.copyto(self._mask, self._group.lost)
        if skip is not None:
            np.logical_or(self._mask, skip, out=self._mask)
        replies = self._group.run(A_STEP, self._group.able, Supervisor.step)
        if not self._group.any_lost and Answer.TROUBLE not in replies.values():
            return 0
        self._group.note_lost()
        return int(np.count_nonzero(self.statuses > WARNING_CODE))

    # Programs

    def prepare_play(self, variables: tuple[Variable, ...], *parts: Any) -> Play:
        """See ``Pool.prepare_play``: the programs run in this process, around workers' steps."""
        from fmugym.pool.native_pool import play_around

        return play_around(self, self._spec, variables, *parts)

    def _restore_snapshot(self, number: int, mask: MaskArray) -> None:
        """See ``SavingPool._restore_snapshot``; a state is lost with the process that saved it."""

        def tell(supervisor: Supervisor) -> None:
            indices = np.flatnonzero(mask[supervisor.block])
            supervisor.tell(Request.RESTORE, request_restore_snapshot(number, indices))

        with self._lock:
            self._require_present(mask)
            self._group.run("restoring a state", self._group.of_any(mask), tell)
            self._group.note_lost()

    def save_states(self, indices: IndexArray, records: bool) -> list[bytes]:
        """See ``SavingPool.save_states``; the episodes of lost instances have ended."""
        with self._lock:
            return self._states.save(indices, records, self._spec.start_time, self.outputs)

    def restore_states(
        self, states: Sequence[bytes], sources: IndexArray, indices: IndexArray
    ) -> None:
        """See ``SavingPool.restore_states``; a lost worker is replaced."""
        with self._lock:
            self._states.restore(states, sources, indices)

    def failure(self, index: int) -> str:
        """See ``Pool.failure``."""
        with self._lock:
            supervisor = self._group.of(index)
            if not self._group.lost[index]:
                within, tell = index - supervisor.block.start, supervisor.answers.failure
                question = Writer().integers(within).form(), lambda reader: tell(reader, within)
                replies = self._group.run(
                    "a question", [supervisor], lambda s: s.tell(Request.FAILURE, *question)
                )
                for text in replies.values():
                    if text or self.statuses[index] <= WARNING_CODE:
                        return f"{text}{supervisor.printed}"
            return supervisor.reason or INTERRUPTED

    def _count_steps(self) -> None:
        """See ``CountedPool``; workers count in the memory that they share."""
        with self._lock:
            for supervisor in self._group.supervisors:
                supervisor.take_counts()

    def forget_health(self) -> None:
        """See ``Pool.forget_health``."""
        super().forget_health()
        for supervisor in self._group.supervisors:
            supervisor.counts[:] = 0

    def note_fault(self, index: int) -> None:
        """See ``Pool.note_fault``."""
        supervisor = self._group.of(index)
        supervisor.counts[index - supervisor.block.start, Column.NOT_FINITE] += 1

    def info(self) -> dict[str, npt.NDArray[Any]]:
        """See ``Pool.info``."""
        if self._spec.fault_retries:
            self._count_steps()
        return super().info()

    def _ask(
        self,
        doing: str,
        request: Request,
        content: Callable[[slice], bytes],
        read: Callable[[Reader, int], R],
    ) -> list[R]:
        """See ``EnginePool._ask``; each worker has a block."""
        with self._lock:
            self._require_present()
            group = self._group

            def tell(supervisor: Supervisor) -> None:
                count = supervisor.answers.count
                supervisor.tell(
                    request, content(supervisor.block), lambda reader: read(reader, count)
                )

            parts = group.run(doing, group.supervisors, tell)
            self._require_present()
            return list(parts.values())

    def close(self) -> None:
        """See ``Pool.close``."""
        with self._lock:
            try:
                self._group.close()
            finally:
                self._release_claim()

    @property
    def initializations(self) -> int:
        """Number of initializations that the workers have begun."""
        return sum(supervisor.initializations for supervisor in self._group.supervisors)

    def processes(self) -> list[int]:
        """Return the process numbers of the workers; 0 for a worker that was given up."""
        return [supervisor.pid for supervisor in self._group.supervisors]

    def _require_present(self, mask: MaskArray | None = None) -> None:
        lost = self._group.lost
        missing = np.flatnonzero(lost if mask is None else lost & mask)
        if missing.size:
            raise SimulationError(self.failure(int(missing[0])))


@functools.lru_cache(maxsize=64)
def _texts_of(variables: tuple[Variable, ...]) -> tuple[str, ...]:
    """The texts that Strings may get, which may be paths."""
    return tuple(text for v in variables if v.kind == "string" for text, _ in v.items)


def _check_options(workers: Any, threads: Any, call_timeout: Any) -> None:
    if call_timeout is not None:
        check_number("call_timeout", call_timeout, positive=True)
    for what, count in (("workers", workers), ("threads", threads)):
        if count is not None:
            check_count(what, count)


def _make_memories(spec: PoolSpec, setups: Sequence[Setup]) -> list[Memory]:
    """Make the memory of each worker."""
    with ExitStack() as made:
        try:
            memories = [made.enter_context(closing(Memory(spec, one.count))) for one in setups]
        except OSError as error:
            text = f"no memory can be shared with worker processes: {error}"
            raise FMULoadError(text) from None
        made.pop_all()
        return memories


def _share_out(setup: Setup, workers: int) -> list[Setup]:
    """Give each worker a block of the instances, the blocks as equal as can be."""
    bounds = [setup.num_instances * index // workers for index in range(workers + 1)]
    blocks = itertools.starmap(slice, itertools.pairwise(bounds))
    return [replace(setup, block=block, number=number) for number, block in enumerate(blocks)]
