"""Workers of one pool: they work at the same time, and lost ones are replaced.

The states of their instances are saved and restored block by block.
"""

from __future__ import annotations

import contextlib
import logging
import os
import time
import weakref
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np

from fmugym.errors import FMUGymError, FMULoadError, SimulationError
from fmugym.fmi.fmu import FMU
from fmugym.fmi.status import Status
from fmugym.pool.engine import Request, read_states, request_restore, request_save
from fmugym.pool.health import Arrays, Column
from fmugym.pool.pool import FloatArray, MaskArray
from fmugym.pool.processes.shared_memory import Memory
from fmugym.pool.processes.supervisor import (
    INSTANTIATION,
    Loss,
    LostError,
    RefusedError,
    Supervisor,
    WorkerError,
    timeout_factor,
)
from fmugym.pool.processes.worker_setup import Setup
from fmugym.pool.states import IndexArray, ended_state

__all__ = ["StatesOfWorkers", "WorkerGroup"]

_groups: weakref.WeakSet[WorkerGroup] = weakref.WeakSet()


class WorkerGroup:
    """Supervisors of a pool's workers, and the fates of their instances.

    Args:
        fmu: The FMU; closed with the group.
        setups: What each worker needs to know.
        memories: Each shared with a worker; closed with the group.
        arrays: Those of all instances.
        log: Gets the FMU's messages.
        call_timeout: How long a call may take, in seconds; infinite for ever.
        closing_time: How long workers may take to free their instances at the end, in seconds.

    Attributes:
        call_timeout: As given; it may change from call to call.
        supervisors: One for each worker, in the order of the instances.
        lost: Which instances have no process, or were not reset since it started, shape (N,).
        any_lost: Whether there are any.
        able: The supervisors of blocks that are not wholly lost.
        refusal: Why nothing can be done any more; empty before.

    Raises:
        FMULoadError: If the FMU cannot be loaded or instantiated.
    """

    def __init__(
        self,
        fmu: FMU,
        setups: Sequence[Setup],
        memories: Sequence[Memory],
        arrays: Arrays,
        log: logging.Logger,
        call_timeout: float,
        closing_time: float,
    ) -> None:
        self.supervisors = [
            Supervisor(setup, memory, arrays, log)
            for setup, memory in zip(setups, memories, strict=True)
        ]
        self.lost: MaskArray = np.zeros(len(arrays.statuses), np.bool_)
        self.refusal = ""
        self._arrays, self.call_timeout = arrays, call_timeout
        self.note_lost()
        self._close = weakref.finalize(self, _close, self.supervisors, memories, fmu, closing_time)
        _groups.add(self)
        self._open()

    def _open(self) -> None:
        """Let all workers make their instances at the same time."""
        try:
            for supervisor in self.supervisors:
                supervisor.begin()
            for supervisor in self.supervisors:
                supervisor.confirm()
            for supervisor in self.supervisors:
                self._finish(supervisor)
        except RefusedError as refusal:
            self.close()
            raise FMULoadError(str(refusal)) from None
        except LostError as lost:
            self.close()
            error = WorkerError(str(lost))
            error.loss = next(iter(self.losses), None)
            raise error from None
        except BaseException:
            self.close()
            raise

    def _finish(self, supervisor: Supervisor) -> None:
        try:
            supervisor.finish_opening(self._deadline(INSTANTIATION))
        except LostError:
            if not supervisor.opens_again():
                raise
            supervisor.finish_opening(self._deadline(INSTANTIATION))

    @property
    def losses(self) -> list[Loss]:
        """Deaths and hangs of processes."""
        return [loss for supervisor in self.supervisors for loss in supervisor.losses]

    def _deadline(self, doing: str) -> float:
        return time.monotonic() + self.call_timeout * timeout_factor(doing)

    def run(
        self,
        doing: str,
        supervisors: Sequence[Supervisor],
        tell: Callable[[Supervisor], None],
    ) -> dict[Supervisor, Any]:
        """Let workers do something at the same time.

        Args:
            doing: What they do, for the cause of deaths.
            supervisors: The supervisors of these workers.
            tell: Sends the request to a worker.

        Returns:
            The replies of the workers that live. The instances of the others are lost.

        Raises:
            SimulationError: If a worker reports an error, or the pool is closed.
        """
        if self.refusal:
            raise SimulationError(self.refusal)
        deadline = self._deadline(doing)
        replies: dict[Supervisor, Any] = {}
        try:
            for supervisor in supervisors:
                supervisor.deadline = deadline
                tell(supervisor)
            for supervisor in supervisors:
                try:
                    replies[supervisor] = supervisor.reply(deadline, doing)
                except LostError:
                    self._lose(supervisor)
        except BaseException:  # such as KeyboardInterrupt: the next call would get these replies
            self._stop_busy(supervisors)
            raise
        for reply in replies.values():
            if isinstance(reply, FMUGymError):
                raise SimulationError(str(reply))
        return replies

    def _lose(self, supervisor: Supervisor) -> None:
        """Note the loss of a block, and start its next worker before it is needed."""
        block, arrays = supervisor.block, self._arrays
        supervisor.counts[:, Column.DEATHS] += 1
        self.lost[block] = True
        observed = arrays.observations.shape[1]
        np.copyto(arrays.observations[block], arrays.outputs[:observed, block].T)
        self.note_lost()
        supervisor.start_ahead()

    def _stop_busy(self, supervisors: Iterable[Supervisor]) -> None:
        for supervisor in supervisors:
            if supervisor.is_busy:
                self.lost[supervisor.block] = True
                supervisor.interrupt()
        self.note_lost()

    def note_lost(self) -> None:
        """Update the values that depend on ``lost``."""
        self.any_lost = bool(self.lost.any())
        self.able = [s for s in self.supervisors if not self.lost[s.block].all()]
        self._arrays.statuses[self.lost] = Status.FATAL

    def revive(self, supervisors: Iterable[Supervisor]) -> list[Supervisor]:
        """Start missing workers; returns the supervisors that have a worker now."""
        alive = []
        for supervisor in supervisors:
            with contextlib.suppress(LostError):
                supervisor.revive()
                alive.append(supervisor)
        return alive

    def retire(self, supervisor: Supervisor, reason: str) -> None:
        """End a worker that has not failed; its instances are lost until their reset."""
        block = supervisor.block
        self.lost[block] = True
        supervisor.retire(reason, self._deadline("its end"))
        supervisor.counts[:, [Column.REPLACEMENTS, Column.RECYCLINGS]] += 1

    def of(self, index: int) -> Supervisor:
        """The supervisor of an instance."""
        return next(s for s in self.supervisors if index < s.block.stop)

    def of_any(self, mask: MaskArray) -> list[Supervisor]:
        """The supervisors of the instances in a mask of shape (N,)."""
        return [s for s in self.supervisors if mask[s.block].any()]

    def close(self) -> None:
        """End the workers; calling it again is fine."""
        self.refusal = self.refusal or "the pool is closed"
        self._close()

    def forget(self) -> None:
        """Let go of the workers, because this process is a fork of the one that started them."""
        self.refusal = "the pool belongs to the process that this one was forked from"
        self._close.detach()
        for supervisor in self.supervisors:
            supervisor.forget()


def _close(
    supervisors: Sequence[Supervisor], memories: Sequence[Memory], fmu: FMU, timeout: float
) -> None:
    deadline = time.monotonic() + timeout
    try:
        for supervisor in supervisors:
            supervisor.begin_closing()
        for supervisor in supervisors:
            supervisor.close(deadline)
    finally:  # also after KeyboardInterrupt
        for memory in memories:
            memory.close()
        fmu.close()


def _forget_groups() -> None:
    for group in list(_groups):
        group.forget()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_forget_groups)


class StatesOfWorkers:
    """Saves and restores the instances of a group of workers, for a caller that holds the pool.

    Args:
        group: The workers.
    """

    def __init__(self, group: WorkerGroup) -> None:
        self._group = group

    def save(
        self, indices: IndexArray, records: bool, start_time: float, outputs: FloatArray
    ) -> list[bytes]:
        """Save instances; the episodes of those that are lost have ended with these outputs."""
        states: dict[int, bytes] = {}
        parts = self._by_worker(indices[~self._group.lost[indices]])

        def tell(supervisor: Supervisor) -> None:
            own = _within(supervisor, parts[supervisor])
            supervisor.tell(
                Request.SAVE,
                request_save(own, records),
                lambda reader: read_states(reader, len(own), len(outputs)),
            )

        replies = self._group.run("saving states", list(parts), tell)
        for supervisor, reply in replies.items():
            states.update(zip(parts[supervisor].tolist(), reply, strict=True))
        lost = indices[self._group.lost[indices]].tolist()  # some of them maybe just now
        states |= {index: ended_state(start_time, outputs[:, index]) for index in lost}
        return [states[index] for index in indices.tolist()]

    def restore(self, states: Sequence[bytes], sources: IndexArray, indices: IndexArray) -> None:
        """Restore instances; a lost worker is replaced."""
        parts = self._by_worker(indices)
        source_of = dict(zip(indices.tolist(), sources.tolist(), strict=True))
        alive = self._group.revive(parts)

        def tell(supervisor: Supervisor) -> None:
            wanted = parts[supervisor]
            own = np.array([source_of[index] for index in wanted.tolist()], np.int64)
            content = request_restore(states, own, _within(supervisor, wanted))
            supervisor.tell(Request.RESTORE, content)

        for supervisor in self._group.run("restoring states", alive, tell):
            supervisor.note_success()
            self._group.lost[parts[supervisor]] = False
        self._group.note_lost()

    def _by_worker(self, indices: IndexArray) -> dict[Supervisor, IndexArray]:
        """Divide instances among their workers."""
        blocks = {
            s: (indices >= s.block.start) & (indices < s.block.stop)
            for s in self._group.supervisors
        }
        return {s: indices[own] for s, own in blocks.items() if own.any()}


def _within(supervisor: Supervisor, indices: IndexArray) -> IndexArray:
    """The numbers of instances within the block of their worker."""
    within: IndexArray = indices - supervisor.block.start
    return within
