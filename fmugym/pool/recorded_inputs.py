"""The recorded inputs of episodes that are in saved states."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from fmugym.archive.description import ModelDescription
from fmugym.archive.texts import with_texts
from fmugym.archive.variable import Variable
from fmugym.errors import SimulationError
from fmugym.pool.base import FloatArray
from fmugym.pool.bundle import head_of, outputs_of
from fmugym.pool.form import START_TIME_TYPE, table_of, type_number
from fmugym.pool.spec import START_TIME, PoolSpec

__all__ = ["RecordedInputs", "inputs_in"]


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
"""A start value among recorded inputs; ``RecordedStart`` of ``native/pool.h``."""


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
