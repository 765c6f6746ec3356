"""States of instances as values: they fit any instance of the same FMU, in any process."""

from __future__ import annotations

import struct
import weakref
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt

__all__ = [
    "NO_SNAPSHOT",
    "SIZE_OF_HEAD",
    "Bundle",
    "Copies",
    "Head",
    "InstanceSnapshot",
    "SaveMethod",
    "ended_state",
    "head_of",
    "outputs_of",
    "surrogate_state",
]

_FloatArray = npt.NDArray[np.float64]
IndexArray = npt.NDArray[np.int64]

_HEAD: Final = struct.Struct("<qqdqq")
SIZE_OF_HEAD: Final = _HEAD.size
_ENDED: Final = 0
_RECORD: Final = 2
_SURROGATE: Final = 3
"""Kinds of states. The C extension makes all but the last one; see ``native/states.h``."""

NO_SNAPSHOT: Final = 0
"""No number of a snapshot; ``native/snapshots.h`` has the same."""


class SaveMethod(StrEnum):
    """Method by which a pool saves the states of its instances."""

    STATE = "state"
    """The FMU serializes its state. Saving and restoring cost about as much as a step."""
    COPY = "copy"
    """The FMU copies its state, but cannot serialize it. The environment that has saved restores
    the copy; for others and for pickles, the inputs of the episode are kept, too."""
    REPLAY = "replay"
    """The inputs of the episode are kept. Saving costs nothing, restoring plays the episode again.
    """


class Head(NamedTuple):
    """Head of a state; the outputs follow, and then the FMU's bytes or a record.

    Attributes:
        kind: Whether it has such bytes, or a record, or nothing.
        steps: The communication steps of the episode.
        start_time: Its first communication point.
        starts: How many start values the record has.
        rows: Of how many steps the record has the inputs.
    """

    kind: int
    steps: int
    start_time: float
    starts: int
    rows: int

    @property
    def is_record(self) -> bool:
        """Whether the state is the start and the inputs of an episode."""
        return self.kind == _RECORD

    @property
    def is_of_surrogate(self) -> bool:
        """Whether the state is that of a surrogate, not of an FMU."""
        return self.kind == _SURROGATE


def head_of(state: bytes) -> Head:
    """Read the head of a state."""
    return Head(*_HEAD.unpack_from(state))


def outputs_of(state: bytes, count: int) -> tuple[_FloatArray, bytes]:
    """Read the outputs of a state, so many of them, and its rest."""
    end = _HEAD.size + 8 * count
    return np.frombuffer(state[_HEAD.size : end]), state[end:]


def ended_state(start_time: float, outputs: _FloatArray) -> bytes:
    """The state of an instance that is lost, and could not be stepped any more."""
    return _HEAD.pack(_ENDED, 0, start_time, 0, 0) + outputs.tobytes()


def surrogate_state(outputs: _FloatArray, content: bytes) -> bytes:
    """The state of an instance of a surrogate, which no FMU restores."""
    return _HEAD.pack(_SURROGATE, 0, 0.0, 0, 0) + outputs.tobytes() + content


class InstanceSnapshot:
    """States of all instances of a pool, which the FMU has copied in its own memory.

    Args:
        pool: The pool, of which there is only a weak reference.
        number: The number of the snapshot in the pool.
        dropped: Gets the number when nobody holds the snapshot any more.
    """

    def __init__(self, pool: Any, number: int, dropped: deque[int]) -> None:
        self.pool, self.number = weakref.ref(pool), number
        weakref.finalize(self, dropped.append, number).atexit = False


@dataclass(frozen=True, eq=False)
class Copies:
    """States that only the instances which have saved them can restore.

    Attributes:
        snapshot: A snapshot of their pool.
        indices: The instances, shape (M,).
    """

    snapshot: InstanceSnapshot
    indices: IndexArray


@dataclass(frozen=True, eq=False)
class Bundle:
    """The states of M instances.

    Attributes:
        states: One for each; see ``Head``.
        replays: Whether they are records, or nothing where an episode had ended.
        copies: Copies of the states, besides the records. They are no part of a pickle.
    """

    states: tuple[bytes, ...]
    replays: bool = False
    copies: Copies | None = None

    @property
    def method(self) -> SaveMethod:
        """Method by which the states were saved."""
        if not self.replays:
            return SaveMethod.STATE
        return SaveMethod.REPLAY if self.copies is None else SaveMethod.COPY

    def __reduce__(self) -> tuple[Any, ...]:
        return Bundle, (self.states, self.replays)

    def __len__(self) -> int:
        return len(self.states)

    @property
    def heads(self) -> list[Head]:
        """The head of each state."""
        return [head_of(state) for state in self.states]

    def take(self, places: Sequence[int] | IndexArray) -> Bundle:
        """The states at these places."""
        chosen = np.asarray(places, np.int64)
        copies = self.copies and replace(self.copies, indices=self.copies.indices[chosen])
        return replace(self, states=self.states_at(chosen), copies=copies)

    def states_at(self, places: IndexArray) -> tuple[bytes, ...]:
        """The states at these places, without a loop if these are all of them in their order."""
        if np.array_equal(places, np.arange(len(self.states))):
            return self.states
        return tuple(map(self.states.__getitem__, places.tolist()))

    @classmethod
    def of_all(cls, bundles: Sequence[Bundle]) -> Bundle:
        """Put bundles of one pool together."""
        return cls(sum((b.states for b in bundles), ()), bundles[0].replays)
