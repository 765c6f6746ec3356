"""The states and records of instances in worker processes, saved and restored block by block."""

from __future__ import annotations

import weakref

import numpy as np

from fmugym.errors import SimulationError
from fmugym.pool.base import MaskArray
from fmugym.pool.bundle import Bundle, IndexArray, Record, joined
from fmugym.pool.process.crew import Crew
from fmugym.pool.process.supervisor import Supervisor
from fmugym.pool.saving import Serialized

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
    """Saves and restores the instances of a crew of workers, for a caller that holds the pool.

    Args:
        crew: The workers.
    """

    def __init__(self, crew: Crew) -> None:
        self._crew = crew

    def save(self) -> SnapshotOfWorkers:
        """Let each worker keep the state of its block."""
        numbers = self._crew.run("saving a state", self._crew.supervisors, lambda s: s.tell("save"))
        return SnapshotOfWorkers({s: (s.generation, number) for s, number in numbers.items()})

    def require_own(self, snapshot: object) -> None:
        """Refuse a snapshot of other workers.

        Raises:
            SimulationError: If it is one, or no snapshot.
        """
        parts = snapshot.parts if isinstance(snapshot, SnapshotOfWorkers) else {}
        if parts.keys() != set(self._crew.supervisors):
            raise SimulationError("the snapshot was taken from another pool")

    def restore(self, snapshot: SnapshotOfWorkers, mask: MaskArray) -> None:
        """Restore the instances in the mask, in the processes that have saved them.

        Raises:
            SimulationError: If one of these processes was replaced since.
        """
        parts, concerned = snapshot.parts, self._crew.of_any(mask)
        for supervisor in concerned:
            _require_generation(supervisor, parts[supervisor][0])
        self._crew.run(
            "restoring a state",
            concerned,
            lambda s: s.tell("restore", parts[s][1], mask[s.block]),
        )
        self._crew.note_lost()

    def serialize(self, indices: IndexArray, start_time: float) -> Serialized:
        """Serialize instances; those that are lost get empty states at the start time."""
        parts = self._by_worker(indices[~self._crew.lost[indices]])
        replies = self._crew.run(
            "saving states", list(parts), lambda s: s.tell("bundle", _within(s, parts[s]))
        )
        states: dict[int, tuple[bytes, int, float]] = {}
        for supervisor, (data, ends, steps, times) in replies.items():
            one = Bundle(np.zeros((0, len(ends))), steps, times, data, ends)
            for place, index in enumerate(parts[supervisor].tolist()):
                states[index] = one.state(place), int(steps[place]), float(times[place])
        lost = b"", 0, start_time
        found = [states.get(index, lost) for index in indices.tolist()]
        data, ends = joined(state for state, *_ in found)
        steps = np.array([steps for _, steps, _ in found], np.int64)
        return data, ends, steps, np.array([time for *_, time in found], np.float64)

    def deserialize(self, bundle: Bundle, sources: IndexArray, indices: IndexArray) -> None:
        """Restore instances from serialized states; a lost worker is replaced."""
        parts = self._by_worker(indices)
        places = {int(index): int(source) for index, source in zip(indices, sources, strict=True)}
        alive = self._crew.revive(parts)

        def tell(supervisor: Supervisor) -> None:
            wanted = parts[supervisor]
            states = bundle.take([places[index] for index in wanted.tolist()])
            supervisor.tell("unbundle", states, _within(supervisor, wanted))

        for supervisor in self._crew.run("restoring states", alive, tell):
            supervisor.note_success()
            self._crew.lost[parts[supervisor]] = False
        self._crew.note_lost()

    def _by_worker(self, indices: IndexArray) -> dict[Supervisor, IndexArray]:
        """Divide instances among their workers."""
        blocks = {
            s: (indices >= s.block.start) & (indices < s.block.stop) for s in self._crew.supervisors
        }
        return {s: indices[own] for s, own in blocks.items() if own.any()}

    def record_of(self, index: int) -> Record | None:
        """The record of an instance; None if its worker has ended."""
        supervisor = self._crew.of(index)
        within = index - supervisor.block.start
        replies = self._crew.run("a question", [supervisor], lambda s: s.tell("record_of", within))
        record: Record | None = replies.get(supervisor)
        return record

    def replace_record(self, index: int, record: Record) -> None:
        """Give an instance another record."""
        supervisor = self._crew.of(index)
        within = index - supervisor.block.start
        self._crew.run("a change", [supervisor], lambda s: s.tell("replace_record", within, record))


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
