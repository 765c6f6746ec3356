"""States of instances in worker processes, saved and restored block by block."""

from __future__ import annotations

from collections.abc import Sequence

from fmugym.pool.base import FloatArray
from fmugym.pool.bundle import IndexArray, ended_state
from fmugym.pool.process.supervisor import Supervisor
from fmugym.pool.process.worker_group import WorkerGroup
from fmugym.pool.requests import Request, read_states, request_restore, request_save

__all__ = ["StatesOfWorkers"]


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

    def restore(self, states: Sequence[bytes], indices: IndexArray) -> None:
        """Restore instances; a lost worker is replaced."""
        parts = self._by_worker(indices)
        state_of = dict(zip(indices.tolist(), states, strict=True))
        alive = self._group.revive(parts)

        def tell(supervisor: Supervisor) -> None:
            wanted = parts[supervisor]
            own = [state_of[index] for index in wanted.tolist()]
            supervisor.tell(Request.RESTORE, request_restore(own, _within(supervisor, wanted)))

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
