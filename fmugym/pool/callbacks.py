"""What the C extension calls: for messages of FMUs, and with recordings of episodes.

Neither callback may refer to the pool, or the pool would live for ever.
"""

from __future__ import annotations

import logging

import numpy as np

from fmugym import _native
from fmugym.archive.description import ModelDescription
from fmugym.pool.base import PoolSpec
from fmugym.pool.reports import as_record
from fmugym.pool.settings import variables_of
from fmugym.pool.tape import Rehearsals, Tape
from fmugym.systems.description import SystemDescription

__all__ = ["Listener", "Receiver"]


class Receiver:
    """Passes on the FMU's messages.

    Args:
        log: Gets them.
        description: Of the FMU, or of a system, whose components are named.
        first: The number of the first instance.
    """

    def __init__(self, log: logging.Logger, description: ModelDescription, first: int) -> None:
        self._log, self._model, self._first_index = log, description.model_identifier, first
        self._parts = [""]
        if isinstance(description, SystemDescription):
            self._parts = [f".{component.name}" for component in description.plan.components]

    def __call__(self, index: int, status: int, category: str, message: str) -> None:
        """Log a message of an instance, or of a component of one."""
        instance, part = divmod(index, len(self._parts))
        name = f"{self._model}_{self._first_index + instance}{self._parts[part]}"
        level, text = as_record(name, status, category, message)
        self._log.log(level, "%s", text)


class Listener:
    """Passes on recordings of episodes.

    Args:
        description: Of the FMU.
        spec: What the pool does.

    Attributes:
        rehearsals: Get the recordings; None for nobody.
    """

    def __init__(self, description: ModelDescription, spec: PoolSpec) -> None:
        self._description = description
        self._widths = len(spec.inputs), len(spec.outputs)
        self.rehearsals: Rehearsals | None = None

    def __call__(self, recording: _native.Recording) -> None:
        """Hand a recording over to be rehearsed."""
        if self.rehearsals is not None:
            self.rehearsals.receive(self._tape(*recording))

    def _tape(
        self,
        types: bytes,
        elements: bytes,
        starts: bytes,
        first_outputs: bytes,
        inputs: bytes,
        outputs: bytes,
        statuses: bytes,
    ) -> Tape:
        count, (width_in, width_out) = len(statuses), self._widths
        references, places, _ = np.frombuffer(elements, np.uint32).reshape(-1, 3).T.tolist()
        values = np.frombuffer(starts)
        return Tape(
            variables_of(self._description, types, references, places, values.tolist()),
            values,
            np.frombuffer(first_outputs),
            np.frombuffer(inputs).reshape(count, width_in),
            np.frombuffer(outputs).reshape(count, width_out),
            np.frombuffer(statuses, np.int8),
        )
