"""States of instances as values: they fit any instance of the same FMU, in any process."""

from __future__ import annotations

import weakref
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Any

import numpy as np
import numpy.typing as npt

from fmugym.archive.texts import text_among
from fmugym.archive.variable import Variable
from fmugym.pool.spec import START_TIME

__all__ = ["Bundle", "Copies", "Record", "SaveMethod", "joined"]

FloatArray = npt.NDArray[np.float64]
IndexArray = npt.NDArray[np.int64]


class SaveMethod(StrEnum):
    """How a pool saves the states of its instances."""

    STATE = "state"
    """The FMU serializes its state. Saving and restoring cost about as much as a step."""
    COPY = "copy"
    """The FMU copies its state, but cannot serialize it. The environment that has saved restores
    the copy; for others and for pickles, the inputs of the episode are kept, too."""
    REPLAY = "replay"
    """The inputs of the episode are kept. Saving costs nothing, restoring plays the episode again.
    """


@dataclass(frozen=True, eq=False)
class Record:
    """The episode of an instance until now.

    Attributes:
        names: The variables that were set before initialization.
        starts: Their values, shape (P,).
        inputs: The inputs of each step, shape (steps, k_in).
        texts: Those of the Strings among the variables; ``starts`` has their numbers.
    """

    names: tuple[str, ...]
    starts: FloatArray
    inputs: FloatArray
    texts: tuple[str, ...] = ()

    @classmethod
    def of(cls, variables: Sequence[Variable], starts: FloatArray, inputs: FloatArray) -> Record:
        """The record of an episode in which these variables were set; see the attributes."""
        pairs = zip(variables, starts.tolist(), strict=True)
        texts = tuple(text_among(v, value) for v, value in pairs if v.kind == "string")
        return cls(tuple(v.name for v in variables), starts, inputs, texts)

    def start_time(self, default: float) -> float:
        """The first communication point, which is the default unless it is among the starts."""
        for name, value in zip(self.names, self.starts, strict=True):
            if name == START_TIME.name:
                return float(value)
        return default

    @property
    def content(self) -> tuple[object, ...]:
        """What two equal records have in common."""
        return self.names, self.starts.tobytes(), self.inputs.shape, self.inputs.tobytes()


@dataclass(frozen=True, eq=False)
class Copies:
    """States that only the instances which have saved them can restore.

    Attributes:
        pool: A weak reference to their pool.
        snapshot: From its ``save``.
        indices: The instances, shape (M,).
    """

    pool: weakref.ref[Any]
    snapshot: Any
    indices: IndexArray


@dataclass(frozen=True, eq=False)
class Bundle:
    """The states of M instances.

    An instance that could not be stepped any more has an empty state.

    Attributes:
        outputs: Their outputs, shape (k, M).
        steps: Their communication steps, shape (M,).
        start_times: The first communication points of their episodes, shape (M,).
        data: The serialized states one after the other; ``b""`` if there are records.
        ends: Where each of them ends in the data, shape (M,).
        records: Or a record for each; None for an empty state.
        copies: Copies of the states, besides the records. They are no part of a pickle.
    """

    outputs: FloatArray
    steps: IndexArray
    start_times: FloatArray
    data: bytes
    ends: IndexArray
    records: tuple[Record | None, ...] | None = None
    copies: Copies | None = None

    @property
    def method(self) -> SaveMethod:
        """How the states were saved."""
        if self.records is None:
            return SaveMethod.STATE
        return SaveMethod.REPLAY if self.copies is None else SaveMethod.COPY

    def __reduce__(self) -> tuple[Any, ...]:
        arrays = self.outputs, self.steps, self.start_times
        return Bundle, (*arrays, self.data, self.ends, self.records)

    def __len__(self) -> int:
        return len(self.steps)

    def state(self, place: int) -> bytes:
        """One of the serialized states."""
        begin = int(self.ends[place - 1]) if place else 0
        return self.data[begin : int(self.ends[place])]

    def take(self, places: Sequence[int] | IndexArray) -> Bundle:
        """The states at these places."""
        chosen = np.asarray(places, np.int64)
        outputs = np.ascontiguousarray(self.outputs[:, chosen])
        arrays = outputs, self.steps[chosen], self.start_times[chosen]
        if self.records is not None:
            records = tuple(self.records[place] for place in chosen.tolist())
            copies = self.copies and replace(self.copies, indices=self.copies.indices[chosen])
            return Bundle(*arrays, b"", self.ends[chosen], records, copies)
        data, ends = joined(map(self.state, chosen.tolist()))
        return Bundle(*arrays, data, ends)

    @classmethod
    def of_all(cls, bundles: Sequence[Bundle]) -> Bundle:
        """Put bundles of one pool together."""
        outputs = np.concatenate([bundle.outputs for bundle in bundles], axis=1)
        steps = np.concatenate([bundle.steps for bundle in bundles])
        times = np.concatenate([bundle.start_times for bundle in bundles])
        data, ends = joined(b.state(place) for b in bundles for place in range(len(b)))
        records = [bundle.records for bundle in bundles if bundle.records is not None]
        return cls(outputs, steps, times, data, ends, sum(records, ()) if records else None)

    @property
    def content(self) -> tuple[object, ...]:
        """What two equal bundles have in common."""
        records = self.records
        held = None if records is None else tuple(None if r is None else r.content for r in records)
        arrays = (self.outputs, self.steps, self.start_times, self.ends)
        return (self.outputs.shape, *(a.tobytes() for a in arrays), self.data, held)


def joined(states: Iterable[bytes]) -> tuple[bytes, IndexArray]:
    """Put serialized states into one piece; returns it and where each of them ends."""
    parts = list(states)
    return b"".join(parts), np.cumsum([len(part) for part in parts], dtype=np.int64)
