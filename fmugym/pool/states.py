"""States of instances, as values and on disk, where later runs of Python find them.

The values fit any instance of the same FMU, in any process. The files are in the cache folder: a
digest, and the bytes that a caller makes of a state. A file that is damaged, too large, or no
regular file is no state.
"""

from __future__ import annotations

import hashlib
import logging
import os
import struct
import weakref
from collections import deque
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from enum import StrEnum
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt

from fmugym.files import read_file, replace_file
from fmugym.pool.pool_spec import PoolSpec

__all__ = [
    "MOST_BYTES",
    "NO_SNAPSHOT",
    "SIZE_OF_HEAD",
    "Bundle",
    "Copies",
    "Head",
    "InstanceSnapshot",
    "SaveMethod",
    "StateFiles",
    "ended_state",
    "essence",
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
"""Kinds of states. The C extension makes all but the last one; see ``native/pool/states.h``."""

NO_SNAPSHOT: Final = 0
"""No number of a snapshot; ``native/pool/snapshots.h`` has the same."""


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
        """The states at these places."""
        return tuple(map(self.states.__getitem__, places.tolist()))

    @classmethod
    def of_all(cls, bundles: Sequence[Bundle]) -> Bundle:
        """Put bundles of one pool together."""
        return cls(sum((b.states for b in bundles), ()), bundles[0].replays)


logger = logging.getLogger(__name__)

MOST_BYTES: Final = 2**30
"""The size of all states together, in bytes; the ones that were not used for longest go first."""

_LARGEST: Final = 2**28
"""The largest size of one state, in bytes."""

_MAGIC: Final = b"fmugym initial state 2\n"
_DIGEST: Final = hashlib.sha256().digest_size


class StateFiles:
    """States on disk.

    Args:
        prefix: The folder, and the beginning of the files' names, which stands for the FMU.
    """

    def __init__(self, prefix: str) -> None:
        self._prefix = Path(prefix)

    def path(self, key: str) -> Path:
        """The file of a state."""
        return self._prefix.with_name(f"{self._prefix.name}-{key}")

    def find(self, key: str) -> bytes | None:
        """Read a state; None if there is none, or only a damaged one."""
        path = self.path(key)
        try:
            state = _parsed(read_file(path, _LARGEST))
            os.utime(path)
        except OSError:
            return None
        return state

    def keep(self, key: str, state: bytes) -> None:
        """Write a state; if that is not possible, nothing is kept, and no error is raised."""
        if len(state) > _LARGEST // 2:
            return
        try:
            self._prefix.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
            replace_file(self.path(key), _MAGIC + hashlib.sha256(state).digest() + state)
            _remove_old(self._prefix.parent)
        except OSError as error:
            logger.debug("no state is kept: %s", error)


def _parsed(content: bytes) -> bytes | None:
    start = len(_MAGIC) + _DIGEST
    digest, state = content[len(_MAGIC) : start], content[start:]
    is_sound = content[: len(_MAGIC)] == _MAGIC and hashlib.sha256(state).digest() == digest
    return state if is_sound else None


def _remove_old(folder: Path) -> None:
    """Remove the states that were not used for longest until the others are few enough."""
    files = []
    for path in folder.iterdir():
        with suppress(OSError):  # another process has removed it
            status = path.lstat()
            files.append((status.st_mtime_ns, status.st_size, path))
    total = 0
    for _, size, path in sorted(files, reverse=True):
        total += size
        if total > MOST_BYTES:
            with suppress(OSError):
                path.unlink()


def essence(spec: PoolSpec) -> PoolSpec:
    """The part of a spec on which states depend."""
    return replace(
        spec,
        inputs=tuple(replace(variable, bounds=None) for variable in spec.inputs),
        outputs=tuple(replace(variable, bounds=None) for variable in spec.outputs),
        num_observed=0,
        fault_retries=0,
        leak_limit=None,
        one_initialization=False,
        max_instances=None,
        licence_wait=0.0,
        records=False,
    )
