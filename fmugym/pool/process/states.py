"""The states of instances in worker processes, saved and restored block by block."""

from __future__ import annotations

import weakref
from collections.abc import Sequence

import numpy as np

from fmugym.errors import SimulationError
from fmugym.pool.base import FloatArray, MaskArray
from fmugym.pool.bundle import IndexArray, ended_state
from fmugym.pool.form import Writer
from fmugym.pool.process.supervisor import Supervisor
from fmugym.pool.process.worker_group import WorkerGroup
from fmugym.pool.requests import (
    Reader,
    Request,
    read_states,
    request_restore_states,
    request_save_states,
)

__all__ = ["SnapshotOfWorkers", "StatesOfWorkers"]


class SnapshotOfWorkers:
    """The numbers of the workers' snapshots, with the generations of their processes.

    Args:
        parts: Generation and number by the supervisor of each worker. When nobody holds the
            snapshot any more, the workers are told to free theirs.
    """

    def __init__(self, parts: dict[Supervisor, tuple[int, int]]) -> None:
        self.parts = parts
        weakref.finalize(self, _release, parts).atexit = False


class StatesOfWorkers:
    """Saves and restores the instances of a group of workers, for a caller that holds the pool.

    Args:
        group: The workers.
    """

    def __init__(self, group: WorkerGroup) -> None:
        self._group = group

    def save(self) -> SnapshotOfWorkers:
        """Let each worker keep the state of its block."""
        numbers = self._group.run(
            "saving a state",
            self._group.supervisors,
            lambda s: s.tell(Request.SAVE, read=_read_number),
        )
        return SnapshotOfWorkers({s: (s.generation, number) for s, number in numbers.items()})

    def require_own(self, snapshot: object) -> None:
        """Refuse a snapshot of other workers.

        Raises:
            SimulationError: If it is one, or no snapshot.
        """
        parts = snapshot.parts if isinstance(snapshot, SnapshotOfWorkers) else {}
        if parts.keys() != set(self._group.supervisors):
            raise SimulationError("the snapshot was taken from another pool")

    def restore(self, snapshot: SnapshotOfWorkers, mask: MaskArray) -> None:
        """Restore the instances in the mask, in the processes that have saved them.

        Raises:
            SimulationError: If one of these processes was replaced since.
        """
        parts, concerned = snapshot.parts, self._group.of_any(mask)
        for supervisor in concerned:
            _require_generation(supervisor, parts[supervisor][0])
        self._group.run(
            "restoring a state",
            concerned,
            lambda s: s.tell(Request.RESTORE, _request_restore(parts[s][1], mask[s.block])),
        )
        self._group.note_lost()

    def save_states(
        self, indices: IndexArray, records: bool, start_time: float, outputs: FloatArray
    ) -> list[bytes]:
        """Save instances; the episodes of those that are lost have ended with these outputs."""
        states: dict[int, bytes] = {}
        parts = self._by_worker(indices[~self._group.lost[indices]])

        def tell(supervisor: Supervisor) -> None:
            own = _within(supervisor, parts[supervisor])
            supervisor.tell(
                Request.SAVE_STATES,
                request_save_states(own, records),
                lambda reader: read_states(reader, len(own), len(outputs)),
            )

        replies = self._group.run("saving states", list(parts), tell)
        for supervisor, reply in replies.items():
            states.update(zip(parts[supervisor].tolist(), reply, strict=True))
        lost = indices[self._group.lost[indices]].tolist()  # some of them maybe just now
        states |= {index: ended_state(start_time, outputs[:, index]) for index in lost}
        return [states[index] for index in indices.tolist()]

    def restore_states(self, states: Sequence[bytes], indices: IndexArray) -> None:
        """Restore instances; a lost worker is replaced."""
        parts = self._by_worker(indices)
        state_of = dict(zip(indices.tolist(), states, strict=True))
        alive = self._group.revive(parts)

        def tell(supervisor: Supervisor) -> None:
            wanted = parts[supervisor]
            own = [state_of[index] for index in wanted.tolist()]
            content = request_restore_states(own, _within(supervisor, wanted))
            supervisor.tell(Request.RESTORE_STATES, content)

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


def _read_number(reader: Reader) -> int:
    number = reader.integer()
    reader.end()
    return number


def _request_restore(number: int, mask: MaskArray) -> bytes:
    return Writer().integers(number).array(mask, np.bool_).form()


def _within(supervisor: Supervisor, indices: IndexArray) -> IndexArray:
    """The numbers of instances within the block of their worker."""
    within: IndexArray = indices - supervisor.block.start
    return within


def _require_generation(supervisor: Supervisor, generation: int) -> None:
    if supervisor.generation != generation:
        raise SimulationError(
            "the snapshot is of instances whose process has been replaced since: "
            f"{supervisor.reason}"
        )


def _release(parts: dict[Supervisor, tuple[int, int]]) -> None:
    for supervisor, part in parts.items():
        supervisor.released.append(part)
