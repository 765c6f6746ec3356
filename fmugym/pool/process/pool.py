"""The pool of processes: whatever an FMU does to its process, it is not this one.

Each worker process has a block of the instances in a pool of its own (``NativePool`` or
``PythonPool``) and shares its inputs and outputs through memory. A worker that dies or hangs is
replaced: its instances have the status ``FATAL``, with the cause, until the next reset makes them
anew. Those of other workers are not concerned.
"""

from __future__ import annotations

import itertools
import logging
import math
import os
import time
import weakref
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from threading import RLock
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from fmugym.archive.description import Variable
from fmugym.archive.fmu import FMU
from fmugym.errors import FMUGymError, FMULoadError, SimulationError
from fmugym.fmi.status import Status
from fmugym.pool.base import (
    DEFAULT_CALL_TIMEOUT,
    FloatArray,
    MaskArray,
    PoolSpec,
    StatusArray,
    available_processors,
)
from fmugym.pool.health import Column, CountedPool, HealthArray
from fmugym.pool.process.channel import Code
from fmugym.pool.process.shared_memory import Arrays, Memory, make_arrays, size_for
from fmugym.pool.process.supervisor import LostError, Supervisor
from fmugym.pool.process.worker import Setup

__all__ = ["ProcessPool"]

_CLOSING_TIME: Final = 5.0
"""How long workers may take to free their instances, in seconds."""

_pools: weakref.WeakSet[ProcessPool] = weakref.WeakSet()


class ProcessPool(CountedPool):
    """N instances in blocks of supervised processes; see ``Pool`` for the contract.

    Args:
        fmu: The FMU; closed with the pool.
        spec: What to do at each reset and step.
        num_instances: N.
        log: The logger that gets the FMU's messages.
        native: Whether the workers have native pools, or Python ones.
        workers: How many processes; by default one for each processor that this process may use,
            and at most N.
        threads: The most threads in each of them; by default so many that there is one for each
            processor.
        call_timeout: How long a call may take, in seconds of real time; None for ever. A worker
            that takes longer is ended, unless a debugger holds it.

    Attributes:
        workers: How many processes there are.

    Raises:
        FMULoadError: If the FMU cannot be loaded or instantiated.
    """

    def __init__(
        self,
        fmu: FMU,
        spec: PoolSpec,
        num_instances: int,
        log: logging.Logger,
        *,
        native: bool = True,
        workers: int | None = None,
        threads: int | None = None,
        call_timeout: float | None = DEFAULT_CALL_TIMEOUT,
    ) -> None:
        processors = available_processors()
        self.num_instances = num_instances
        self.workers = min(num_instances, processors if workers is None else max(1, workers))
        self._call_timeout = math.inf if call_timeout is None else call_timeout
        self._lock = RLock()
        self._spec = spec
        self._refusal = ""
        self._lost: MaskArray = np.zeros(num_instances, np.bool_)
        self._numbers: dict[tuple[Variable, ...], int] = {}
        try:
            fmu.extract()
            memory = Memory(size_for(spec, num_instances, self.workers))
        except BaseException:
            fmu.close()
            raise
        self._share(make_arrays(memory, spec, num_instances))
        setup = Setup.of(fmu, spec, num_instances, log)
        setup = replace(setup, native=native, threads=threads or max(1, processors // self.workers))
        blocks = _blocks(num_instances, self.workers)
        setups = [replace(setup, block=b, number=i) for i, b in enumerate(blocks)]
        self._supervisors = [Supervisor(one, memory, log) for one in setups]
        self._note_lost()
        patience = min(_CLOSING_TIME, self._call_timeout)
        self._close = weakref.finalize(self, _close, self._supervisors, memory, fmu, patience)
        _pools.add(self)
        self._open()

    def _share(self, arrays: Arrays) -> None:
        self.inputs, self.outputs = arrays.inputs, arrays.outputs
        self.observations, self.statuses = arrays.observations, arrays.statuses
        self._mask, self._counts = arrays.mask, arrays.counts

    def _open(self) -> None:
        """Let all workers make their instances at the same time."""
        try:
            for supervisor in self._supervisors:
                supervisor.start()
            for supervisor in self._supervisors:
                supervisor.finish_opening(self._deadline())
        except LostError as lost:
            self.close()
            raise FMULoadError(str(lost)) from None
        except BaseException:
            self.close()
            raise

    # The contract of Pool.

    def reset(
        self, variables: tuple[Variable, ...], values: FloatArray, mask: MaskArray | None = None
    ) -> tuple[FloatArray, StatusArray]:
        """See ``Pool.reset``; a worker that dies of it is replaced, and has a second try."""
        values = np.asarray(values, np.float64)
        mask = np.ones(self.num_instances, np.bool_) if mask is None else np.asarray(mask, np.bool_)
        with self._lock:
            concerned = [s for s in self._supervisors if mask[s.block].any()]
            self._retire_grown(concerned, mask)
            for _ in range(2):
                concerned = self._reset(concerned, variables, values, mask)
            self._note_lost()
        return self.outputs, self.statuses

    def _reset(
        self,
        supervisors: Sequence[Supervisor],
        variables: tuple[Variable, ...],
        values: FloatArray,
        mask: MaskArray,
    ) -> list[Supervisor]:
        """Reset blocks; returns those that could be reset by a new worker."""
        number = self._numbers.setdefault(variables, len(self._numbers))
        used = [s for s in supervisors if not s.is_new]
        alive = [s for s in supervisors if self._is_revived(s)]

        def tell(supervisor: Supervisor) -> None:
            block = supervisor.block
            told = None if number in supervisor.known else variables
            supervisor.known.add(number)
            supervisor.tell("reset", number, told, values[:, block], mask[block])

        for supervisor, growth in self._run("a reset", alive, tell).items():
            supervisor.note_success()
            supervisor.growth = growth
            block = supervisor.block
            self._lost[block] &= ~mask[block]
        return [s for s in used if s.is_new]

    def _retire_grown(self, supervisors: Sequence[Supervisor], mask: MaskArray) -> None:
        """Replace workers that leak, though their instances were recycled.

        That is best done where all instances of a worker start anew. Otherwise the others lose
        their episodes, so it is put off until twice as much is lost.
        """
        limit = math.inf if self._spec.leak_limit is None else 2 * self._spec.leak_limit
        for supervisor in supervisors:
            block = supervisor.block
            if supervisor.growth > (limit if mask[block].all() else 2 * limit):
                grown = f"by {supervisor.growth / 2**20:.0f} MB"
                reason = f"worker process {supervisor.pid} was replaced: it had grown {grown}"
                supervisor.retire(reason, self._deadline())
                self._lost[block] = True
                self._counts[block, [[Column.REPLACEMENTS], [Column.RECYCLINGS]]] += 1

    def _is_revived(self, supervisor: Supervisor) -> bool:
        try:
            supervisor.revive()
        except LostError:
            return False
        return True

    def step(
        self,
        inputs: FloatArray | None = None,
        skip: MaskArray | None = None,
        observations: npt.NDArray[np.float32] | None = None,
    ) -> tuple[FloatArray, StatusArray]:
        """See ``Pool.step``."""
        self.step_into(inputs, skip, observations)
        return self.outputs, self.statuses

    def step_into(
        self,
        inputs: FloatArray | None = None,
        skip: MaskArray | None = None,
        observations: npt.NDArray[np.float32] | None = None,
    ) -> int:
        """Do one step as ``step`` does.

        Returns:
            How many of the instances have a status worse than a warning.
        """
        with self._lock:
            if inputs is not None:
                np.copyto(self.inputs, inputs)
            troubled = self._step(skip)
            if observations is not None:
                np.copyto(observations, self.observations)
            return troubled

    def step_own(self) -> int:
        """See ``Pool.step_own``."""
        with self._lock:
            return self._step(None)

    def _step(self, skip: MaskArray | None) -> int:
        code = Code.STEP
        if skip is not None or self._any_lost:
            code = Code.STEP_SOME
            np.logical_or(self._lost, False if skip is None else skip, out=self._mask)
        replies = self._run("a step", self._able, lambda supervisor: supervisor.step(code))
        if not self._any_lost and Code.TROUBLE not in replies.values():
            return 0
        self._note_lost()
        return int(np.count_nonzero(self.statuses > Status.WARNING))

    def save(self) -> _Snapshot:
        """See ``Pool.save``."""
        with self._lock:
            self._require_present()
            numbers = self._run("saving a state", self._supervisors, lambda s: s.tell("save"))
            self._require_present()
            return _Snapshot({s: (s.generation, number) for s, number in numbers.items()})

    def restore(
        self, snapshot: _Snapshot, mask: MaskArray | None = None
    ) -> tuple[FloatArray, StatusArray]:
        """See ``Pool.restore``; a state goes with the process that it was saved in."""
        mask = np.ones(self.num_instances, np.bool_) if mask is None else np.asarray(mask, np.bool_)
        parts = snapshot.parts if isinstance(snapshot, _Snapshot) else {}
        if parts.keys() != set(self._supervisors):
            raise SimulationError("the snapshot was taken from another pool")
        with self._lock:
            self._require_present(mask)
            concerned = [s for s in self._supervisors if mask[s.block].any()]
            for supervisor in concerned:
                if parts[supervisor][0] != supervisor.generation:
                    raise SimulationError(
                        "the snapshot is of instances whose process has been replaced since: "
                        f"{supervisor.reason}"
                    )
            self._run(
                "restoring a state",
                concerned,
                lambda s: s.tell("restore", parts[s][1], mask[s.block]),
            )
            self._note_lost()
        return self.outputs, self.statuses

    def failure(self, index: int) -> str:
        """See ``Pool.failure``."""
        with self._lock:
            supervisor = next(s for s in self._supervisors if index < s.block.stop)
            if not self._lost[index]:
                within = index - supervisor.block.start
                texts = self._run("a question", [supervisor], lambda s: s.tell("failure", within))
                for text in texts.values():
                    return str(text)
            return supervisor.reason

    def _count_steps(self) -> None:
        """A worker that dies does not tell of its last episode's steps."""
        with self._lock:
            if not self._refusal:
                self._run("a question", self._able, lambda s: s.tell("count_steps"))

    def _memory_growth(self) -> HealthArray:
        growth = np.zeros(self.num_instances, np.int64)
        for supervisor in self._supervisors:
            growth[supervisor.block] = supervisor.growth
        return growth

    def read(self, variables: tuple[Variable, ...]) -> FloatArray:
        """See ``Pool.read``."""
        with self._lock:
            self._require_present()
            parts = self._run(
                "reading variables", self._supervisors, lambda s: s.tell("read", variables)
            )
            self._require_present()
            return np.concatenate(list(parts.values()), axis=1)

    def close(self) -> None:
        """See ``Pool.close``."""
        with self._lock:
            self._refusal = self._refusal or "the pool is closed"
            self._close()

    # Processes.

    def processes(self) -> list[int]:
        """The process numbers of the workers; 0 where one was given up."""
        return [supervisor.pid for supervisor in self._supervisors]

    def _deadline(self) -> float:
        return time.monotonic() + self._call_timeout

    def _run(
        self,
        doing: str,
        supervisors: Sequence[Supervisor],
        tell: Callable[[Supervisor], None],
    ) -> dict[Supervisor, Any]:
        """Let workers do something at the same time.

        Args:
            doing: What, for the cause of deaths.
            supervisors: Theirs.
            tell: Tells one.

        Returns:
            What those reply that live. The instances of the others are lost.

        Raises:
            SimulationError: If a worker raises it, or the pool is closed.
        """
        if self._refusal:
            raise SimulationError(self._refusal)
        deadline = self._deadline()
        replies: dict[Supervisor, Any] = {}
        try:
            for supervisor in supervisors:
                tell(supervisor)
            for supervisor in supervisors:
                try:
                    replies[supervisor] = supervisor.reply(deadline, doing)
                except LostError:
                    self._lose(supervisor)
        except BaseException:  # such as KeyboardInterrupt: the replies would come in its place
            self._stop_busy(supervisors)
            raise
        _raise_any(replies.values())
        return replies

    def _lose(self, supervisor: Supervisor) -> None:
        """Note the loss of a block, and start its next worker before anybody waits for it."""
        block = supervisor.block
        self._counts[block, Column.DEATHS] += 1
        self._lost[block] = True
        np.copyto(self.observations[block], self.outputs[: self.observations.shape[1], block].T)
        self._note_lost()
        supervisor.start_ahead()

    def _stop_busy(self, supervisors: Iterable[Supervisor]) -> None:
        for supervisor in supervisors:
            if supervisor.is_busy:
                supervisor.bury("the call was interrupted")
                self._lost[supervisor.block] = True
        self._note_lost()

    def _note_lost(self) -> None:
        self._any_lost = bool(self._lost.any())
        self._able = [s for s in self._supervisors if not self._lost[s.block].all()]
        self.statuses[self._lost] = Status.FATAL

    def _require_present(self, mask: MaskArray | None = None) -> None:
        lost = np.flatnonzero(self._lost if mask is None else self._lost & mask)
        if lost.size:
            raise SimulationError(self.failure(int(lost[0])))

    def forget(self) -> None:
        """Let go of the workers: this process is a fork of the one that they belong to."""
        self._refusal = "the pool belongs to the process that this one was forked from"
        self._close.detach()
        for supervisor in self._supervisors:
            supervisor.forget()


class _Snapshot:
    """The numbers of the workers' snapshots, with the generations of their processes."""

    def __init__(self, parts: dict[Supervisor, tuple[int, int]]) -> None:
        self.parts = parts
        weakref.finalize(self, _release, parts).atexit = False


def _release(parts: dict[Supervisor, tuple[int, int]]) -> None:
    for supervisor, part in parts.items():
        supervisor.released.append(part)


def _raise_any(replies: Iterable[Any]) -> None:
    for reply in replies:
        if isinstance(reply, FMUGymError):
            raise SimulationError(str(reply))


def _blocks(num_instances: int, workers: int) -> list[slice]:
    bounds = [num_instances * index // workers for index in range(workers + 1)]
    return [slice(*pair) for pair in itertools.pairwise(bounds)]


def _close(supervisors: Sequence[Supervisor], memory: Memory, fmu: FMU, patience: float) -> None:
    deadline = time.monotonic() + patience
    for supervisor in supervisors:
        supervisor.begin_closing()
    for supervisor in supervisors:
        supervisor.close(deadline)
    memory.close()
    fmu.close()


def _forget_pools() -> None:
    for pool in list(_pools):
        pool.forget()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_forget_pools)
