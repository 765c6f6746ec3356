"""Pools that save the states of single instances, and restore them in any others."""

from __future__ import annotations

import logging
from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence

import numpy as np
import numpy.typing as npt

from fmugym.archive.description import ModelDescription, Variable
from fmugym.errors import SimulationError
from fmugym.fmi.status import Status
from fmugym.pool.attendant import AttendedPool
from fmugym.pool.base import FloatArray
from fmugym.pool.bundle import Bundle, IndexArray, Record, SaveMethod
from fmugym.pool.spec import PoolSpec, ResetMethod

__all__ = ["SavingPool", "Serialized", "offers_states"]

logger = logging.getLogger(__name__)

Serialized = tuple[bytes, IndexArray, IndexArray]
"""Serialized states one after the other, where each ends, and the communication steps of each."""


def offers_states(description: ModelDescription, spec: PoolSpec) -> bool:
    """Whether states can be serialized in this pool.

    Only where resets restore states is an FMU told in each step that it may be set back.
    """
    able = description.capabilities
    restores = spec.reset_method == ResetMethod.RESTORE
    return restores and able.can_get_and_set_fmu_state and able.can_serialize_fmu_state


class SavingPool(AttendedPool):
    """A pool that saves states, or keeps the inputs of episodes to play them again.

    A subclass calls ``_prepare_saving`` in its constructor.
    """

    _variables: Mapping[str, Variable]
    _offers_states = False
    _do_states_work: Callable[[], bool] | None = None

    def _prepare_saving(self, description: ModelDescription, spec: PoolSpec) -> bool:
        """Take over what saving needs; returns whether the pool must keep records."""
        self._variables = description.variables
        self._offers_states = offers_states(description, spec)
        return spec.records or not self._offers_states

    def trust_states_if(self, do_states_work: Callable[[], bool]) -> None:
        """Let the first call that saves or restores ask whether serialized states work."""
        self._do_states_work = do_states_work

    @property
    def save_method(self) -> SaveMethod:
        """See ``Pool.save_method``; the first call may take as long as a trial of the FMU."""
        if self._offers_states and self._do_states_work is not None:
            ask, self._do_states_work = self._do_states_work, None
            self._offers_states = ask()
        return SaveMethod.STATE if self._offers_states else SaveMethod.REPLAY

    def save_instances(self, indices: IndexArray) -> Bundle:
        """See ``Pool.save_instances``."""
        outputs = np.ascontiguousarray(self.outputs[:, indices])
        if self.save_method is SaveMethod.STATE:
            data, ends, steps = self.serialize_states(indices)
            return Bundle(outputs, steps, data, ends)
        records = self._records(indices)
        lengths = [0 if record is None else len(record.inputs) for record in records]
        ends = np.zeros(len(indices), np.int64)
        return Bundle(outputs, np.array(lengths, np.int64), b"", ends, tuple(records))

    def restore_instances(
        self, bundle: Bundle, sources: IndexArray, indices: IndexArray
    ) -> npt.NDArray[np.int8]:
        """See ``Pool.restore_instances``."""
        self._drop_recording()
        if bundle.method is SaveMethod.REPLAY:
            self._replay(bundle, sources, indices)
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

    # Playing episodes again

    def _records(self, indices: IndexArray) -> list[Record | None]:
        records: list[Record | None] = []
        for index in indices.tolist():
            failed = self.statuses[index] > Status.WARNING
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
            values = np.zeros((len(names), self.num_instances))
            mask = np.zeros(self.num_instances, np.bool_)
            for record, index in group:
                values[:, index], mask[index] = record.starts, True
            self.reset(tuple(self._variables[name] for name in names), values, mask)

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
            if not same and self.statuses[index] <= Status.WARNING:
                logger.warning(
                    "instance %d: played again, its episode has led to other outputs", index
                )

    def _mistrust_states(self) -> None:
        """States have turned out to be wrong; from now on episodes are played again."""
        self._offers_states = False
