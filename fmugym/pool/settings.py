"""What the C code needs to know of an FMU and of the specification of a pool.

``NativePool`` tells it to ``fmugym._native``, and ``fmugym.pool.process.windows`` to the worker
program for Windows.
"""

from __future__ import annotations

import math
import os
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from fmugym.archive.description import ModelDescription
from fmugym.archive.texts import number_of, text_of, with_texts
from fmugym.archive.variable import Variable, unlisted
from fmugym.pool.bundle import FloatArray, head_of, outputs_of
from fmugym.pool.spec import (
    DEFAULT_TOLERANCE,
    SAMPLINGS,
    START_TIME,
    PoolSpec,
    ResetMethod,
    is_start_time,
)
from fmugym.systems.description import SystemDescription
from fmugym.wine.loader import windows_path, windows_uri

__all__ = [
    "PlaceOfFMU",
    "Record",
    "experiment_settings",
    "library_settings",
    "listing",
    "manner_of",
    "record_in",
    "solving_settings",
    "table_of",
    "type_number",
    "variable_settings",
]

_TYPES: Final = (
    "Float64",
    "Float32",
    "Int8",
    "Int16",
    "Int32",
    "Int64",
    "UInt8",
    "UInt16",
    "UInt32",
    "UInt64",
    "Boolean",
    "Clock",
    "String",
)
"""The C types in the order of ``enum Type`` of ``native/fmi.h``."""

_START_TIME: Final = 255
"""Stands for a type where the start time is meant; ``native/access.h`` has the same number."""

_CLOCK: Final = struct.Struct("=IIdqqdqqq")
_CLOCKED: Final = struct.Struct("=III")
_NO_CLOCK: Final = 2**32 - 1
_NUMBER: Final = struct.Struct("=d")

_OLD_NAMES: Final = {"Real": "Float64", "Integer": "Int32"}


@dataclass(frozen=True)
class PlaceOfFMU:
    """Where the files of an FMU are, as its process names them.

    Attributes:
        paths: Those of its library, or of the private copies.
        resources: The location of its resources in the form of its FMI version.
    """

    paths: tuple[bytes, ...]
    resources: bytes

    @classmethod
    def here(cls, folder: Path, paths: Sequence[Path], version: int) -> PlaceOfFMU:
        """For a process of this system.

        Args:
            folder: That of the extracted FMU.
            paths: As the attribute.
            version: The major FMI version.
        """
        if version == 3:
            resources = os.path.join(folder, "resources", "")
        else:
            resources = _place_of_resources(folder, version).as_uri()
        return cls(tuple(os.fsencode(path) for path in paths), resources.encode())

    @classmethod
    def in_wine(cls, folder: Path, library: Path, version: int) -> PlaceOfFMU:
        """For a process in Wine; see ``here``."""
        if version == 3:
            resources = windows_path(folder / "resources") + "\\"
        else:
            resources = windows_uri(_place_of_resources(folder, version))
        return cls((os.fsencode(windows_path(library)),), os.fsencode(resources))


def _place_of_resources(folder: Path, version: int) -> Path:
    return folder if version == 1 else folder / "resources"


def library_settings(
    description: ModelDescription, spec: PoolSpec, place: PlaceOfFMU
) -> dict[str, Any]:
    """What to load, and what is known of it."""
    return {
        "version": table_of(description),
        "manner": manner_of(description, spec),
        "model": description.model_identifier.encode(),
        "token": description.instantiation_token.encode(),
        "resources": place.resources,
        "paths": place.paths,
        "states": description.capabilities.can_get_and_set_fmu_state,
        "categories": tuple(c.encode() for c in description.error_categories),
    } | _structural_settings(description)


def _structural_settings(description: ModelDescription) -> dict[str, bytes]:
    """The value references and the values of structural parameters."""
    references = [variable.value_reference for variable, _ in description.structure]
    values = [value for _, value in description.structure]
    return {
        "structural_references": np.array(references, np.uint32).tobytes(),
        "structural_values": np.array(values, np.uint64).tobytes(),
    }


def experiment_settings(spec: PoolSpec, *, records: bool = False) -> dict[str, Any]:
    """How instances are initialized and stepped, and how episodes begin."""
    method = spec.whole_reset_method
    return {
        "start_time": spec.start_time,
        "stop_time": spec.stop_time,
        "tolerance": spec.tolerance,
        "time_step": spec.time_step,
        "substeps": spec.substeps,
        "warm_up_steps": spec.warm_up_steps,
        "retries": spec.fault_retries,
        "restores": method == ResetMethod.RESTORE,
        "rebuilds": method not in (ResetMethod.RESTORE, ResetMethod.RESET),
        "reloads": method == ResetMethod.LIBRARY,
        "one_initialization": spec.one_initialization,
        "records": records,
        "start_outputs": np.array(spec.start_outputs).tobytes() if spec.blind_start else None,
    }


def variable_settings(spec: PoolSpec) -> dict[str, Any]:
    """What is to be known of variables besides the lists of inputs and outputs."""
    return {
        "num_observed": spec.num_observed,
        "sampling": bytes(SAMPLINGS.index(name) for name in spec.samplings),
    }


def solving_settings(description: ModelDescription, spec: PoolSpec) -> tuple[Any, ...] | None:
    """What ``take_solving`` of ``native/python/solving.c`` takes; None in co-simulation."""
    if isinstance(description, SystemDescription):  # its components have their own
        return None
    model = description.model_exchange
    clocks = clocks_of(description)
    if model is None:
        if not description.uses_event_mode:
            return None
        return (b"by_fmu", 1.0, math.inf, 0, 0, False, None, None, *clocks)
    states, rates = None, None
    tolerance = DEFAULT_TOLERANCE if spec.tolerance is None else spec.tolerance
    if description.capabilities.provides_directional_derivatives and model.state_references:
        states = np.array(model.state_references, np.uint32).tobytes()
        rates = np.array(model.derivative_references, np.uint32).tobytes()
    return (
        spec.solver.encode(),
        tolerance,
        spec.max_step or math.inf,
        model.number_of_states,
        model.number_of_event_indicators,
        model.needs_completed_integrator_step,
        states,
        rates,
        *clocks,
    )


def manner_of(description: ModelDescription, spec: PoolSpec) -> int:
    """The number of the way in which the FMU is run, one of ``enum Manner`` of ``native/fmi.h``."""
    if description.model_exchange is not None:
        return 1
    return 2 if description.uses_event_mode else 0


def clocks_of(description: ModelDescription) -> tuple[bytes, bytes]:
    """The arrays of ``Clock`` and ``Clocked`` of ``native/clock.h``."""
    clocks = description.clocks
    indices = {clock.value_reference: index for index, clock in enumerate(clocks)}
    return (
        b"".join(
            _CLOCK.pack(c.value_reference, c.number, *c.interval, *c.shift, c.by_fractions)
            for c in clocks
        ),
        b"".join(
            _CLOCKED.pack(variable.value_reference, indices[reference], variable.size)
            for variable in description.clocked_inputs
            for reference in variable.clocks
        )
        + b"".join(
            _CLOCKED.pack(variable.value_reference, _NO_CLOCK, variable.size)
            for variable in description.arrays_beside_clocked
        ),
    )


def table_of(description: ModelDescription) -> int:
    """The table of functions in C: the major FMI version, or 0 for systems."""
    is_system = isinstance(description, SystemDescription)
    return 0 if is_system else description.fmi_major_version


def listing(variables: Sequence[Variable], version: int) -> tuple[bytes, bytes, bytes, bytes]:
    """What ``listing_take`` of ``native/access.h`` takes.

    Args:
        variables: The variables.
        version: See ``table_of``; the values of systems are all of type Float64.

    Returns:
        The C types of the variables, a byte each; their value references, places in their arrays,
        and the sizes of these, three times four bytes each; the values of the elements that FMI
        needs besides, float64 (the others come first); and the texts that Strings may get, each
        with its number before and a zero after it, by ascending numbers.
    """
    rest = unlisted(variables)
    both = [*variables, *rest]
    types = bytes(type_number(variable, version) for variable in both)
    elements = np.array([(v.value_reference, v.place, v.size) for v in both], np.uint32)
    values = np.array([v.start_number for v in rest]).tobytes()
    return types, elements.tobytes(), values, _texts(variables)


def _texts(variables: Sequence[Variable]) -> bytes:
    texts = {text for v in variables if v.kind == "string" for text, _ in v.items}
    return b"".join(
        _NUMBER.pack(number_of(text)) + text.encode() + b"\0"
        for text in sorted(texts, key=number_of)
    )


def type_number(variable: Variable, version: int) -> int:
    """The C type of a variable; see ``listing``."""
    if is_start_time(variable):
        return _START_TIME
    if variable.kind == "string":
        return _TYPES.index("String")
    if version == 0:
        return _TYPES.index("Float64")
    if variable.kind == "enumeration":
        return _TYPES.index("Int64" if version == 3 else "Int32")
    return _TYPES.index(_OLD_NAMES.get(variable.type, variable.type))


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
    known[_START_TIME, START_TIME.value_reference] = START_TIME
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
"""A start value in a record; ``RecordedStart`` of ``native/pool.h``."""


@dataclass(frozen=True, eq=False)
class Record:
    """The episode of an instance until it was saved.

    Attributes:
        variables: Those that were set before initialization.
        starts: Their values, shape (P,).
        inputs: The inputs of each step, shape (steps, k_in).
    """

    variables: tuple[Variable, ...]
    starts: FloatArray
    inputs: FloatArray


def record_in(description: ModelDescription, spec: PoolSpec, state: bytes) -> Record:
    """Read the record in a state that has one.

    Args:
        description: That of the FMU.
        spec: That of the pool.
        state: The state.
    """
    head, (_, content) = head_of(state), outputs_of(state, len(spec.outputs))
    end = head.starts * _START.itemsize
    starts = np.frombuffer(content[:end], _START)
    parts = (starts[name].tolist() for name in ("type", "reference", "place", "value"))
    inputs = np.frombuffer(content[end:]).reshape(head.rows, len(spec.inputs))
    return Record(_variables_of(description, *parts), starts["value"], inputs)
