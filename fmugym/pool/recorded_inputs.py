"""The recorded inputs of episodes that are in saved states."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from fmugym.archive.description import ModelDescription
from fmugym.archive.texts import text_of, with_texts
from fmugym.archive.variable import Variable
from fmugym.errors import SimulationError
from fmugym.pool.bundle import FloatArray, head_of, outputs_of
from fmugym.pool.form import START_TIME_TYPE, table_of, type_number
from fmugym.pool.spec import START_TIME, PoolSpec

__all__ = ["RecordedInputs", "inputs_in"]


def _variables_of(
    description: ModelDescription,
    types: Sequence[int],
    references: Sequence[int],
    places: Sequence[int],
    values: Sequence[float],
) -> tuple[Variable, ...]:
    """Find start variables by C type, value reference and place in an array.

    Aliases are as good. A String knows the text that its value stands for.
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
    return tuple(
        with_texts(variable, [text_of(value)]) if variable.kind == "string" else variable
        for variable, value in zip(found, values, strict=True)
    )


_START: Final = np.dtype(
    [("value", "f8"), *((name, "u4") for name in ("type", "reference", "place", "unused"))]
)
"""A start value among recorded inputs; ``RecordedStart`` of ``native/pool.h``."""


@dataclass(frozen=True, eq=False)
class RecordedInputs:
    """What an instance was given in its episode until it was saved.

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
    parts = (starts[name].tolist() for name in ("type", "reference", "place", "value"))
    inputs = np.frombuffer(content[end:]).reshape(head.rows, len(spec.inputs))
    return RecordedInputs(_variables_of(description, *parts), starts["value"], inputs)
