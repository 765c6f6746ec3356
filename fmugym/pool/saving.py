"""Pools that save the states of single instances, and restore them in any others."""

from __future__ import annotations

import logging
import weakref
from abc import abstractmethod
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from fmugym.archive.description import ModelDescription
from fmugym.archive.variable import Variable
from fmugym.errors import SimulationError
from fmugym.fmi.status import WARNING_CODE
from fmugym.pool.attendant import AttendedPool
from fmugym.pool.base import FloatArray, MaskArray
from fmugym.pool.bundle import Bundle, Copies, IndexArray, Record, SaveMethod
from fmugym.pool.spec import PoolSpec, ResetMethod, start_variables

__all__ = ["SavingPool", "Serialized", "offered_method"]

logger = logging.getLogger(__name__)

Serialized = tuple[bytes, IndexArray, IndexArray, FloatArray]
"""Serialized states one after the other, where each ends, and the communication steps and the start
time of each."""


def offered_method(description: ModelDescription, spec: PoolSpec) -> SaveMethod:
    """How states can be saved in this pool, as the FMU says.

    Only where resets restore states is an FMU told in each step that it may be set back.
    """
    able = description.capabilities
    if spec.reset_method != ResetMethod.RESTORE or not able.can_get_and_set_fmu_state:
        return SaveMethod.REPLAY
    return SaveMethod.STATE if able.can_serialize_fmu_state else SaveMethod.COPY


class SavingPool(AttendedPool):
    """A pool that saves states, or keeps the inputs of episodes to play them again.

    A subclass calls ``_prepare_saving`` in its constructor.
    """

    _variable: Callable[[str], Variable]
    _start_time = 0.0
    _warm_up_steps, _substeps = 0, 1
    _offered = SaveMethod.REPLAY
    _ask_for_method: Callable[[], SaveMethod] | None = None

    def _prepare_saving(self, description: ModelDescription, spec: PoolSpec) -> bool:
        """Take over what saving needs; returns whether the pool must keep records."""
        self._variable, self._start_time = description.variable, spec.start_time
        self._warm_up_steps, self._substeps = spec.warm_up_steps, spec.substeps
        self._offered = offered_method(description, spec)
        return spec.records or self._offered is not SaveMethod.STATE

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
        outputs = np.ascontiguousarray(self.outputs[:, indices])
        if self.save_method is SaveMethod.STATE:
            data, ends, steps, start_times = self.serialize_states(indices)
            return Bundle(outputs, steps, start_times, data, ends)
        records = self._records(indices)
        lengths = [0 if record is None else len(record.inputs) for record in records]
        ends = np.zeros(len(indices), np.int64)
        steps = (np.array(lengths, np.int64) + self._warm_up_steps) * self._substeps
        copies = self._copies(indices)
        usual = self._start_time
        times = [usual if record is None else record.start_time(usual) for record in records]
        return Bundle(outputs, steps, np.array(times), b"", ends, tuple(records), copies)

    def _copies(self, indices: IndexArray) -> Copies | None:
        """Copy the states of all instances; None if some are not asked for, or cannot be copied."""
        every = len(indices) == self.num_instances and np.all(self.statuses <= WARNING_CODE)
        if self.save_method is not SaveMethod.COPY or not every:
            return None
        try:
            return Copies(weakref.ref(self), self._copy_all(), np.array(indices))
        except SimulationError:  # an episode has ended in another way
            return None

    def restore_instances(
        self, bundle: Bundle, sources: IndexArray, indices: IndexArray
    ) -> npt.NDArray[np.int8]:
        """See ``Pool.restore_instances``."""
        if bundle.records is not None:
            self._restore_or_replay(bundle, sources, indices)
        elif self.save_method is not SaveMethod.STATE:
            raise SimulationError(
                "the snapshot has serialized FMU states, which do not work in this pool"
            )
        else:
            self.deserialize_states(bundle, sources, indices)
        return self.statuses

    @abstractmethod
    def serialize_states(self, indices: IndexArray) -> Serialized:
        """Serialize the states of instances."""

    @abstractmethod
    def deserialize_states(self, bundle: Bundle, sources: IndexArray, indices: IndexArray) -> None:
        """Restore serialized states; instance ``indices[i]`` gets the one at ``sources[i]``."""

    @abstractmethod
    def record_of(self, index: int) -> Record | None:
        """The record of an instance; None if it does not reach from the reset until now."""

    # Copies

    def _copy_all(self) -> Any:
        """Copy all states as ``save`` does, but in a way that lets instances be replaced."""
        return self.save()

    def _restore_or_replay(self, bundle: Bundle, sources: IndexArray, indices: IndexArray) -> None:
        """Restore the copies that are of the same instances, and replay the other episodes."""
        own = self._are_own(bundle, sources, indices)
        if own.any() and not self._restore_copies(bundle, sources[own], indices[own]):
            own[:] = False
        if not own.all():
            self._replay(bundle, sources[~own], indices[~own])

    def _are_own(self, bundle: Bundle, sources: IndexArray, indices: IndexArray) -> MaskArray:
        copies, records = bundle.copies, bundle.records
        if copies is None or records is None or copies.pool() is not self:
            return np.zeros(len(indices), np.bool_)
        there = np.array([records[source] is not None for source in sources.tolist()], np.bool_)
        same: MaskArray = there & (copies.indices[sources] == indices)
        return same

    def _restore_copies(self, bundle: Bundle, sources: IndexArray, indices: IndexArray) -> bool:
        """Returns whether that was possible; no instance may have been replaced since."""
        assert bundle.copies is not None
        assert bundle.records is not None
        mask = np.zeros(self.num_instances, np.bool_)
        mask[indices] = True
        try:
            self.restore(bundle.copies.snapshot, mask)
        except SimulationError:
            return False
        if np.any(self.statuses[indices] > WARNING_CODE):
            return False
        for source, index in zip(sources.tolist(), indices.tolist(), strict=True):
            record = bundle.records[source]
            if record is not None:
                self.replace_record(index, record)
        self.outputs[:, indices] = bundle.outputs[:, sources]
        return True

    @abstractmethod
    def replace_record(self, index: int, record: Record) -> None:
        """Let the episode of an instance count as the one of a record."""

    # Playing episodes again

    def _records(self, indices: IndexArray) -> list[Record | None]:
        records: list[Record | None] = []
        for index in indices.tolist():
            failed = self.statuses[index] > WARNING_CODE
            record = None if failed else self.record_of(index)
            if record is None and not failed:
                raise SimulationError(
                    f"the episode of instance {index} cannot be saved: its inputs are not all "
                    "known. Either it is too long, or it began before they were kept"
                )
            records.append(record)
        return records

    def _replay(self, bundle: Bundle, sources: IndexArray, indices: IndexArray) -> None:
        assert bundle.records is not None
        chosen = [(bundle.records[s], i) for s, i in zip(sources, indices, strict=True)]
        records = [(record, int(index)) for record, index in chosen if record is not None]
        before = self.inputs.copy()  # of the other instances, too
        try:
            self._start_again(records)
            self._step_again(records)
        finally:
            np.copyto(self.inputs, before)
        wanted = bundle.outputs[:, sources]
        self._compare([index for _, index in records], wanted, indices)
        self.outputs[:, indices] = wanted

    def _start_again(self, records: Sequence[tuple[Record, int]]) -> None:
        by_names: dict[tuple[str, ...], list[tuple[Record, int]]] = {}
        for record, index in records:
            by_names.setdefault(record.names, []).append((record, index))
        for names, group in by_names.items():
            texts = [text for record, _ in group for text in record.texts]
            values = np.zeros((len(names), self.num_instances))
            mask = np.zeros(self.num_instances, np.bool_)
            for record, index in group:
                values[:, index], mask[index] = record.starts, True
            self.reset(start_variables(self._variable, names, texts), values, mask)

    def _step_again(self, records: Sequence[tuple[Record, int]]) -> None:
        inputs, skip = self.inputs.copy(), np.ones(self.num_instances, np.bool_)
        for step in range(max((len(record.inputs) for record, _ in records), default=0)):
            skip[:] = True
            for record, index in records:
                if step < len(record.inputs):
                    inputs[:, index], skip[index] = record.inputs[step], False
            self.step(inputs, skip)

    def _compare(self, replayed: Sequence[int], wanted: FloatArray, indices: IndexArray) -> None:
        """Warn of an FMU whose episodes are not reproducible."""
        places = {int(index): place for place, index in enumerate(indices)}
        for index in replayed:
            same = np.array_equal(self.outputs[:, index], wanted[:, places[index]])
            if not same and self.statuses[index] <= WARNING_CODE:
                logger.warning(
                    "instance %d: played again, its episode has led to other outputs", index
                )
