"""Pools that save the states of single instances, and restore them in any others.

Recorded inputs of an episode may be in its saved state.
"""

from __future__ import annotations

import contextlib
import itertools
import logging
from abc import abstractmethod
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from fmugym.errors import SimulationError
from fmugym.fmi.description import ModelDescription
from fmugym.fmi.fmu import FMU
from fmugym.fmi.status import WARNING_CODE
from fmugym.fmi.variable import Variable, with_texts
from fmugym.pool.licences import RetryingPool
from fmugym.pool.pool import FloatArray, MaskArray, StatusArray
from fmugym.pool.pool_form import START_TIME_TYPE, table_of, type_number
from fmugym.pool.pool_spec import START_TIME, PoolSpec, ResetMethod
from fmugym.pool.states import (
    Bundle,
    Copies,
    IndexArray,
    InstanceSnapshot,
    SaveMethod,
    head_of,
    outputs_of,
)

__all__ = ["RecordedInputs", "SavingPool", "inputs_in", "keeps_records", "offered_method"]


def _variables_of(
    description: ModelDescription,
    types: Sequence[int],
    references: Sequence[int],
    places: Sequence[int],
    texts: Iterable[str],
) -> tuple[Variable, ...]:
    """Find start variables by C type, value reference and place in an array.

    Aliases are as good. A String knows the text that it got.
    """
    version = table_of(description)
    known = {
        (type_number(one, version), one.value_reference): one
        for v in description.variables.values()
        if v.is_number or v.kind == "string"
        for one in (v.elements if v.driven is not None else (v,))
    }
    known[START_TIME_TYPE, START_TIME.value_reference] = START_TIME
    found = [
        known[type_, reference].elements[place]
        for type_, reference, place in zip(types, references, places, strict=True)
    ]
    left = [*texts]
    return tuple(
        with_texts(variable, [left.pop(0)]) if variable.kind == "string" else variable
        for variable in found
    )


_START: Final = np.dtype(
    [("value", "f8"), *((name, "u4") for name in ("type", "reference", "place", "size"))]
)
"""A start value among recorded inputs; ``RecordedStart`` of ``native/pool/pool.h``."""


@dataclass(frozen=True, eq=False)
class RecordedInputs:
    """Record of the inputs of an instance in its episode until it was saved.

    Attributes:
        variables: Those that were set before initialization.
        starts: Their values, shape (P,).
        inputs: The inputs of each step, shape (steps, k_in).
    """

    variables: tuple[Variable, ...]
    starts: FloatArray
    inputs: FloatArray


def inputs_in(description: ModelDescription, spec: PoolSpec, state: bytes) -> RecordedInputs:
    """Read the recorded inputs in a state that has some.

    Args:
        description: That of the FMU.
        spec: That of the pool.
        state: The state. That of a worker may be anything.

    Raises:
        SimulationError: If it has none of this FMU.
    """
    try:
        return _inputs_in(description, spec, state)
    except (KeyError, IndexError, ValueError):
        raise SimulationError("the recorded inputs of an episode are damaged") from None


def _inputs_in(description: ModelDescription, spec: PoolSpec, state: bytes) -> RecordedInputs:
    head, (_, content) = head_of(state), outputs_of(state, len(spec.outputs))
    end = head.starts * _START.itemsize
    starts = np.frombuffer(content[:end], _START)
    types, references, places = (starts[n].tolist() for n in ("type", "reference", "place"))
    after = end + int(starts["size"].sum())
    texts = content[end:after].decode().split("\0")[:-1]
    inputs = np.frombuffer(content[after:]).reshape(head.rows, len(spec.inputs))
    variables = _variables_of(description, types, references, places, texts)
    return RecordedInputs(variables, starts["value"], inputs)


logger = logging.getLogger(__name__)


def keeps_records(description: ModelDescription, spec: PoolSpec) -> bool:
    """Whether a pool must keep the inputs of its episodes."""
    return spec.records or offered_method(description, spec) is not SaveMethod.STATE


def offered_method(description: ModelDescription, spec: PoolSpec) -> SaveMethod:
    """Method by which states can be saved in this pool, as the FMU says.

    Only where resets restore states is an FMU told in each step that it may be set back.
    """
    able = description.capabilities
    if spec.reset_method != ResetMethod.RESTORE or not able.can_get_and_set_fmu_state:
        return SaveMethod.REPLAY
    return SaveMethod.STATE if able.can_serialize_fmu_state else SaveMethod.COPY


class SavingPool(RetryingPool):
    """A pool that saves states, or keeps the inputs of episodes to play them again.

    A subclass calls ``_prepare`` in its constructor.
    """

    _form: tuple[ModelDescription, PoolSpec]
    _offered = SaveMethod.REPLAY
    _ask_for_method: Callable[[], SaveMethod] | None = None

    def _prepare(self, fmu: FMU, spec: PoolSpec, log: logging.Logger) -> None:
        """Keep the arguments of resets and of saving."""
        self._form = fmu.description, spec
        self._numbers: Iterator[int] = itertools.count(1)
        self._dropped: deque[int] = deque()
        self._offered = offered_method(fmu.description, spec)
        if spec.licence_wait or log.isEnabledFor(logging.INFO):
            self._patience = fmu.path.name, log

    def save_by(self, ask_for_method: Callable[[], SaveMethod]) -> None:
        """Let the first call that saves or restores ask which method works."""
        self._ask_for_method = ask_for_method

    @property
    def save_method(self) -> SaveMethod:
        """See ``Pool.save_method``; the first call may take as long as a trial of the FMU."""
        if self._offered is not SaveMethod.REPLAY and self._ask_for_method is not None:
            ask, self._ask_for_method = self._ask_for_method, None
            self._offered = ask()
        return self._offered

    def save_instances(self, indices: IndexArray) -> Bundle:
        """See ``Pool.save_instances``."""
        replays = self.save_method is not SaveMethod.STATE
        states = tuple(self.save_states(indices, replays))
        return Bundle(states, replays, self._copies(indices))

    def _records(self, states: Sequence[bytes]) -> list[RecordedInputs]:
        """The records among states."""
        return [inputs_in(*self._form, state) for state in states if head_of(state).is_record]

    def _copies(self, indices: IndexArray) -> Copies | None:
        """Copy the states of all instances; None if some are not asked for, or cannot be copied."""
        if self.save_method is not SaveMethod.COPY or len(indices) != self.num_instances:
            return None
        if np.any(self.statuses > WARNING_CODE):
            return None
        try:
            return Copies(self.save(), np.array(indices))
        except SimulationError:  # an episode has ended in another way
            return None

    def restore_instances(
        self, bundle: Bundle, sources: IndexArray, indices: IndexArray
    ) -> npt.NDArray[np.int8]:
        """See ``Pool.restore_instances``."""
        if bundle.replays:
            there = self._restore_copies(bundle, sources, indices)
            there |= ~np.array([head.is_record for head in bundle.heads], np.bool_)[sources]
            self._replay(bundle.states_at(sources[~there]), indices[~there])
            sources, indices = sources[there], indices[there]
        elif self.save_method is not SaveMethod.STATE:
            raise SimulationError(
                "the snapshot has serialized FMU states, which do not work in this pool"
            )
        if len(indices):
            self.restore_states(bundle.states, sources, indices)
        return self.statuses

    @abstractmethod
    def save_states(self, indices: IndexArray, records: bool) -> Sequence[bytes]:
        """Save the states of instances, or the records of their episodes.

        Raises:
            SimulationError: If an instance fails, or its episode is not known from the reset on.
        """

    @abstractmethod
    def restore_states(
        self, states: Sequence[bytes], sources: IndexArray, indices: IndexArray
    ) -> None:
        """Restore a state in each of some instances.

        Args:
            states: The states; a record only tells what the episode was of an instance that is
                where it leads to.
            sources: Which of them the instances get, shape (M,).
            indices: The instances, shape (M,).
        """

    # Copies

    def save(self) -> InstanceSnapshot:
        """Copy the FMU states and times of all instances.

        Returns:
            A snapshot for ``restore`` of the same pool. After its last reference it is freed with
            the next call of ``save``.

        Raises:
            SimulationError: If the FMU offers no state, or an instance cannot save it now.
        """
        number = next(self._numbers)
        dropped = self._taken_dropped()
        try:
            self._save_snapshot(number, dropped)
        except BaseException:  # some workers may have saved
            self._dropped.extend((number, *dropped))
            raise
        return InstanceSnapshot(self, number, self._dropped)

    def _taken_dropped(self) -> list[int]:
        """The snapshots that nobody needs any more; another thread may take some of them."""
        taken: list[int] = []
        with contextlib.suppress(IndexError):
            while True:
                taken.append(self._dropped.popleft())
        return taken

    @abstractmethod
    def _save_snapshot(self, number: int, dropped: Sequence[int]) -> None:
        """Save all instances in a new snapshot, and free the dropped ones; all are numbers."""

    def restore(
        self, snapshot: InstanceSnapshot, mask: MaskArray | None = None
    ) -> tuple[FloatArray, StatusArray]:
        """Return instances to a snapshot.

        Args:
            snapshot: From ``save``.
            mask: Which instances, shape (N,); None for all.

        Returns:
            As ``reset``.

        Raises:
            SimulationError: If the snapshot is of another pool, or an instance was replaced since.
        """
        if not isinstance(snapshot, InstanceSnapshot) or snapshot.pool() is not self:
            raise SimulationError("the snapshot was taken from another pool")
        self._restore_snapshot(snapshot.number, self._as_mask(mask))
        return self.outputs, self.statuses

    @abstractmethod
    def _restore_snapshot(self, number: int, mask: MaskArray) -> None:
        """Restore the instances in the mask."""

    def _restore_copies(
        self, bundle: Bundle, sources: IndexArray, indices: IndexArray
    ) -> MaskArray:
        """Restore copies that are of the same instances; returns where that was possible.

        No instance may have been replaced since.
        """
        own, copies = np.zeros(len(indices), np.bool_), bundle.copies
        if copies is None or copies.snapshot.pool() is not self:
            return own
        mask = np.zeros(self.num_instances, np.bool_)
        own = copies.indices[sources] == indices
        mask[indices[own]] = True
        try:
            self.restore(copies.snapshot, mask)
        except SimulationError:
            mask[:] = False
        fine: MaskArray = own & (mask & (self.statuses <= WARNING_CODE))[indices]
        return fine

    # Playing episodes again

    def _replay(self, states: Sequence[bytes], indices: IndexArray) -> None:
        records = list(zip(self._records(states), indices.tolist(), strict=True))
        before = self.inputs.copy()  # of the other instances, too
        try:
            self._start_again(records)
            self._step_again(records)
        finally:
            np.copyto(self.inputs, before)
        for state, index in zip(states, indices.tolist(), strict=True):
            self._take_outputs(index, outputs_of(state, len(self.outputs))[0])

    def _start_again(self, records: Sequence[tuple[RecordedInputs, int]]) -> None:
        by_variables: dict[tuple[Variable, ...], list[tuple[RecordedInputs, int]]] = {}
        for record, index in records:
            by_variables.setdefault(record.variables, []).append((record, index))
        for variables, group in by_variables.items():
            values = np.zeros((len(variables), self.num_instances))
            mask = np.zeros(self.num_instances, np.bool_)
            for record, index in group:
                values[:, index], mask[index] = record.starts, True
            self.reset(variables, values, mask)

    def _step_again(self, records: Sequence[tuple[RecordedInputs, int]]) -> None:
        inputs, skip = self.inputs.copy(), np.ones(self.num_instances, np.bool_)
        for step in range(max((len(record.inputs) for record, _ in records), default=0)):
            skip[:] = True
            for record, index in records:
                if step < len(record.inputs) and self.statuses[index] <= WARNING_CODE:
                    inputs[:, index], skip[index] = record.inputs[step], False
            self.step(inputs, skip)

    def _take_outputs(self, index: int, wanted: FloatArray) -> None:
        """Take the outputs that were saved; warn of an FMU whose episodes are not reproducible."""
        same = np.array_equal(self.outputs[:, index], wanted)
        if not same and self.statuses[index] <= WARNING_CODE:
            logger.warning("instance %d: played again, its episode has led to other outputs", index)
        self.outputs[:, index] = wanted
