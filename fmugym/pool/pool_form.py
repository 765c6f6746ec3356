"""Forms that open a pool of the C extension, as bytes.

``NativePool`` hands the bytes to the C extension of this process, and ``ProcessPool`` to those of
its workers. ``native/pool/pool_form.c`` and ``native/program/program_form.c`` read them, in the
same order.

A form is a row of numbers of 8 bytes: integers, flags and floating-point numbers. A block has its
size before it, and zeros after it up to the next multiple of 8. A text is a block that ends with a
zero. So every number lies at an address that is a multiple of its size.
"""

from __future__ import annotations

import math
import os
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Self

import numpy as np

from fmugym.fmi.description import Capabilities, ModelDescription, ModelExchange
from fmugym.fmi.fmu import FMU
from fmugym.fmi.systems.system_description import PartVariable, SystemDescription
from fmugym.fmi.systems.system_layout import PartLayout, SystemLayout, array_key
from fmugym.fmi.systems.system_plan import Loop
from fmugym.fmi.variable import Variable, texts_of, unlisted
from fmugym.fmi.wine import windows_path, windows_uri
from fmugym.pool.pool_spec import DEFAULT_TOLERANCE, SAMPLINGS, PoolSpec, ResetMethod, is_start_time

__all__ = [
    "BLANK",
    "FLOAT64",
    "INTEGER",
    "START_TIME_TYPE",
    "Files",
    "Writer",
    "form_of_draws",
    "form_of_listing",
    "form_of_pool",
    "form_of_program",
    "form_of_programs",
    "manner_of",
    "table_of",
    "type_number",
]

_VERSION: Final = 1
"""Of all forms and of the requests to workers; ``native/forms/form.h`` has the same number."""

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
    "-Float64",
    "-Int32",
    "-Boolean",
)
"""The C types, ordered like ``enum Type`` of ``native/fmi/fmi.h``; negated aliases come last."""

START_TIME_TYPE: Final = 255
"""Stands for a type where the start time is meant; ``native/fmi/access.h`` has the same number."""

_OLD_NAMES: Final = {"Real": "Float64", "Integer": "Int32"}

INTEGER, FLOAT64 = struct.Struct("=q"), struct.Struct("=d")
_CLOCK: Final = struct.Struct("=IIdqqdqqq")
_CLOCKED: Final = struct.Struct("=III")
_NO_CLOCK: Final = 2**32 - 1
BLANK: Final = 8
"""Every item begins at a multiple of so many bytes."""

_RESET_METHODS: Final = tuple(ResetMethod)
"""In the order of ``ResetMethod`` of ``native/system/system.h``."""

_NO_FMU: Final = ModelDescription(
    *("2.0", "", "", "", (), "", ""), *(0.0, None, None, None, None), Capabilities(), {}, {}, ()
)
"""Stands for an FMU whose functions are never called."""


class Writer:
    """Writes a form; each method returns the writer."""

    def __init__(self) -> None:
        self._parts: list[bytes] = []

    def form(self) -> bytes:
        """Written bytes."""
        return b"".join(self._parts)

    def forms(self, *forms: bytes) -> Self:
        """Write the content of other writers."""
        self._parts += forms
        return self

    def integers(self, *numbers: int) -> Self:
        """Write integers or flags."""
        self._parts += [INTEGER.pack(number) for number in numbers]
        return self

    def numbers(self, *numbers: float) -> Self:
        """Write floating-point numbers."""
        self._parts += [FLOAT64.pack(number) for number in numbers]
        return self

    def optional(self, number: float | None) -> Self:
        """Write whether there is a number, and the number."""
        return self.integers(number is not None).numbers(number or 0.0)

    def block(self, data: bytes) -> Self:
        """Write bytes with their size."""
        self._parts += [INTEGER.pack(len(data)), data, bytes(-len(data) % BLANK)]
        return self

    def array(self, values: Any, dtype: Any) -> Self:
        """Write a block of values of one type."""
        return self.block(np.ascontiguousarray(values, dtype).tobytes())

    def text(self, text: bytes) -> Self:
        """Write a text."""
        return self.block(text + b"\0")

    def texts(self, texts: Sequence[bytes]) -> Self:
        """Write a number of texts."""
        self.integers(len(texts))
        for text in texts:
            self.text(text)
        return self

    def listing(self, variables: Sequence[Variable], version: int) -> Self:
        """Write a list of variables.

        Args:
            variables: The variables.
            version: See ``table_of``; the values of systems are all of type Float64.
        """
        rest = unlisted(variables)  # FMI sets whole arrays only
        both = [*variables, *rest]
        self.block(bytes(type_number(variable, version) for variable in both))
        self.array([(v.value_reference, v.place, v.size) for v in both], np.uint32)
        self.array([v.start_number for v in rest], np.float64)
        strings = [texts_of(variable) for variable in variables if variable.kind == "string"]
        self.array([len(texts) for texts in strings], np.uint32)
        return self.block(b"".join(text.encode() + b"\0" for texts in strings for text in texts))


def form_of_listing(variables: Sequence[Variable], version: int = 2, manner: int = 0) -> bytes:
    """The form of a list of variables.

    Args:
        variables: The variables.
        version: See ``table_of``; by default that of pools without an FMU.
        manner: See ``manner_of``.
    """
    return Writer().integers(version, manner).listing(variables, version).form()


def type_number(variable: Variable, version: int) -> int:
    """The C type of a variable of an FMI version, or of a system; see ``table_of``."""
    if is_start_time(variable):
        return START_TIME_TYPE
    if variable.kind == "string":
        return _TYPES.index("String")
    if version == 0:
        return _TYPES.index("Float64")
    if variable.kind == "enumeration":
        return _TYPES.index("Int64" if version == 3 else "Int32")
    name = _OLD_NAMES.get(variable.type, variable.type)
    return _TYPES.index(f"-{name}" if variable.negated else name)


def table_of(description: ModelDescription) -> int:
    """The table of functions in C: the major FMI version, or 0 for systems."""
    is_system = isinstance(description, SystemDescription)
    return 0 if is_system else description.fmi_major_version


def manner_of(description: ModelDescription) -> int:
    """The number of the way to run the FMU, one of ``enum Manner`` of ``native/fmi/fmi.h``."""
    if description.model_exchange is not None:
        return 1
    return 2 if description.uses_event_mode else 0


# Files


@dataclass(frozen=True)
class Files:
    """Places of the files of an FMU, or of the FMUs of a system, in their process.

    Attributes:
        paths: Those of the libraries, or of the private copies.
        resources: For each FMU, the location of its resources in the form of its FMI version.
    """

    paths: tuple[bytes, ...]
    resources: tuple[bytes, ...]

    @classmethod
    def here(cls, fmu: FMU, folder: Path, paths: Sequence[Path]) -> Files:
        """For a process of this system.

        Args:
            fmu: The FMU or system.
            folder: Where it was extracted to.
            paths: As the attribute.
        """
        return cls(
            tuple(map(os.fsencode, paths)),
            tuple(
                os.fsencode(os.path.join(place, "resources", ""))
                if part.description.fmi_major_version == 3
                else _place_of_resources(part, place).as_uri().encode()
                for part, place in fmu.parts_in(folder)
            ),
        )

    @classmethod
    def in_wine(cls, fmu: FMU, folder: Path) -> Files:
        """For a process in Wine, which has no private copies; see ``here``."""
        return cls(
            tuple(os.fsencode(windows_path(path)) for _, path in fmu.libraries_in(folder)),
            tuple(
                os.fsencode(windows_path(place / "resources") + "\\")
                if part.description.fmi_major_version == 3
                else os.fsencode(windows_uri(_place_of_resources(part, place)))
                for part, place in fmu.parts_in(folder)
            ),
        )


def _place_of_resources(fmu: FMU, folder: Path) -> Path:
    return folder if fmu.description.fmi_major_version == 1 else folder / "resources"


# A pool


def form_of_pool(
    description: ModelDescription,
    spec: PoolSpec,
    files: Files,
    count: int,
    threads: int,
    *,
    private_libraries: bool = False,
    logging: bool = False,
    records: bool = False,
) -> bytes:
    """The form of a pool.

    Args:
        description: That of the FMU or system.
        spec: What to do at each reset and step; see ``PoolSpec.fitting``.
        files: Where the FMU is.
        count: The number of instances.
        threads: The most threads.
        private_libraries: Whether each instance has its own library.
        logging: Whether FMUs are asked to log everything.
        records: Whether the inputs of episodes are kept.
    """
    writer, version = Writer(), table_of(description)
    writer.integers(_VERSION, version, manner_of(description))
    _write_identity(writer, description, files.resources[0])
    writer.texts(files.paths)
    states = description.capabilities.can_get_and_set_fmu_state
    writer.integers(private_libraries, logging, states)
    _write_solving(writer, description, spec)
    if isinstance(description, SystemDescription):
        _write_system(writer, description, spec, files)
    _write_experiment(writer, spec, records)
    _write_variables(writer, spec, version)
    writer.integers(count, threads)
    return writer.form()


def form_of_programs(spec: PoolSpec, count: int, threads: int) -> bytes:
    """The form of a pool whose instances are elsewhere: it runs programs only.

    Args:
        spec: As for ``form_of_pool``.
        count: As for ``form_of_pool``.
        threads: As for ``form_of_pool``.
    """
    return form_of_pool(_NO_FMU, spec, Files((), (b"",)), count, threads)


def _write_identity(writer: Writer, description: ModelDescription, resources: bytes) -> None:
    """Name of the FMU, and its arguments for each instance."""
    writer.text(description.model_identifier.encode())
    writer.text(description.instantiation_token.encode())
    writer.text(resources)
    writer.texts([category.encode() for category in description.error_categories])
    structure = description.structure
    writer.array([variable.value_reference for variable, _ in structure], np.uint32)
    writer.array([value for _, value in structure], np.uint64)


def _write_solving(writer: Writer, description: ModelDescription, spec: PoolSpec) -> None:
    """Settings of the solver of an FMU and of its events."""
    model = description.model_exchange
    is_system = isinstance(description, SystemDescription)  # its components have their own
    solves = not is_system and (model is not None or description.uses_event_mode)
    writer.integers(solves)
    if not solves:
        return
    if model is None:
        model = ModelExchange(0, 0, False)
        writer.text(b"by_fmu").numbers(1.0, math.inf)
    else:
        tolerance = DEFAULT_TOLERANCE if spec.tolerance is None else spec.tolerance
        writer.text(spec.solver.encode()).numbers(tolerance, spec.max_step or math.inf)
    writer.integers(
        model.number_of_states,
        model.number_of_event_indicators,
        model.needs_completed_integrator_step,
    )
    differentiable = description.capabilities.provides_directional_derivatives
    writer.array(model.state_references if differentiable else (), np.uint32)
    writer.array(model.derivative_references if differentiable else (), np.uint32)
    for block in _clocks(description):
        writer.block(block)


def _clocks(description: ModelDescription) -> tuple[bytes, bytes]:
    """The arrays of ``Clock`` and ``Clocked`` of ``native/model_exchange/clock.h``."""
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


def _write_experiment(writer: Writer, spec: PoolSpec, records: bool) -> None:
    """Settings of initialization, of steps and of the beginning of episodes."""
    method = spec.whole_reset_method
    writer.numbers(spec.start_time)
    writer.optional(spec.stop_time)
    writer.optional(spec.tolerance)
    writer.numbers(spec.time_step)
    writer.integers(spec.substeps, spec.warm_up_steps, spec.fault_retries)
    writer.integers(
        method == ResetMethod.RESTORE,
        method not in (ResetMethod.RESTORE, ResetMethod.RESET),
        method == ResetMethod.LIBRARY,
        spec.one_initialization,
        records,
        spec.blind_start,
    )
    writer.array(spec.start_outputs if spec.blind_start else (), np.float64)


def _write_variables(writer: Writer, spec: PoolSpec, version: int) -> None:
    writer.listing(spec.inputs, version)
    writer.listing(spec.outputs, version)
    writer.integers(spec.num_observed)
    writer.block(bytes(SAMPLINGS.index(name) for name in spec.samplings))


# A system


def _write_system(
    writer: Writer, description: SystemDescription, spec: PoolSpec, files: Files
) -> None:
    layout = SystemLayout(description, spec.inputs, spec.outputs)
    methods = spec.component_resets or (ResetMethod.RESET,) * len(layout.parts)
    writer.integers(layout.plan.master == "jacobi", len(layout.parts))
    for part, method, resources in zip(layout.parts, methods, files.resources, strict=True):
        _write_part(writer, part, spec, method, resources)
    _write_routes(writer, layout)
    _write_arrays(writer, layout)
    _write_ends(writer, layout)
    writer.integers(len(layout.plan.groups))
    for group in layout.plan.groups:
        parts = layout.parts_of(group)
        writer.array(parts, np.uint32)
        writer.array(layout.inner_routes(group), np.uint32)
        _write_loop(writer, group.loop, layout.loop_label(parts))
    writer.integers(len(layout.plan.initialization))
    for evaluation in layout.plan.initialization:
        routes = layout.routes_of(evaluation)
        writer.array(routes, np.uint32)
        label = layout.loop_label(layout.routes[i].source_part for i in routes)
        _write_loop(writer, evaluation.loop, label)


def _write_part(
    writer: Writer, part: PartLayout, spec: PoolSpec, method: ResetMethod, resources: bytes
) -> None:
    description, label = part.description, part.label
    version = description.fmi_major_version
    for name in (part.component.name, label, f"{label}, whose outputs are not finite"):
        writer.text(name.encode())
    writer.integers(version, manner_of(description), part.has_mode, _RESET_METHODS.index(method))
    writer.integers(part.component.steps)
    _write_identity(writer, description, resources)
    _write_solving(writer, description, spec)
    numbers = [(v, float(x)) for v, x in part.starts if v.numeric]
    writer.listing(part.inputs, version)
    writer.array(list(part.starts_of(part.inputs)), np.float64)
    writer.listing(part.outputs, version)
    writer.listing([v for v, _ in numbers], version)
    writer.array([x for _, x in numbers], np.float64)
    strings = [(v, x) for v, x in part.starts if not v.numeric]
    writer.array([v.value_reference for v, _ in strings], np.uint32)
    writer.texts([str(x).encode() for _, x in strings])


def _write_routes(writer: Writer, layout: SystemLayout) -> None:
    routes = layout.routes
    writer.array([(route.source, route.target, route.count) for route in routes], np.uint32)
    writer.array([(route.gain, route.offset) for route in routes], np.float64)


def _write_arrays(writer: Writer, layout: SystemLayout) -> None:
    """The arrays that variables of the system are elements of, and their start values."""
    arrays = list(layout.arrays.values())
    starts = (
        layout.parts[part].starts_of(array.elements)
        if array.settable_at_start
        else [0.0] * array.size
        for part, array in arrays
    )
    writer.array([array.size for _, array in arrays], np.uint32)
    writer.array([number for numbers in starts for number in numbers], np.float64)


def _write_ends(writer: Writer, layout: SystemLayout) -> None:
    """Places at which the ends of each variable begin, and all ends."""
    groups = layout.description.ends
    ends = [end for group in groups for end in group]
    numbers = {key: number for number, key in enumerate(layout.arrays)}
    writer.array(np.cumsum([0, *map(len, groups)]), np.uint32)
    writer.array(
        [
            (
                end.part,
                _type(layout, end),
                end.variable.value_reference,
                end.variable.place,
                layout.input_slot(end),
                layout.output_slot(end),
                numbers.get(array_key(end), -1),
            )
            for end in ends
        ],
        np.int64,
    )
    writer.array([(end.gain, end.offset, *end.reading) for end in ends], np.float64)


def _type(layout: SystemLayout, end: PartVariable) -> int:
    """The C type; strings have none, and are never read."""
    if end.variable.kind == "string":
        return 0
    return type_number(end.variable, layout.parts[end.part].description.fmi_major_version)


def _write_loop(writer: Writer, loop: Loop | None, label: str) -> None:
    writer.integers(loop is not None)
    if loop is not None:
        writer.integers(loop.max_iterations)
        writer.numbers(loop.tolerance)
        writer.text(label.encode())


# Programs


def form_of_program(
    code: bytes,
    constants: bytes,
    tables: Sequence[Any],
    registers: int,
) -> bytes:
    """The form of a program; see ``fmugym.expressions.program``.

    Args:
        code: The instructions.
        constants: Registers that keep a value.
        tables: Values to look up.
        registers: How many registers there are.
    """
    writer = Writer().integers(registers).block(code).block(constants)
    writer.integers(len(tables))
    for table in tables:
        writer.integers(table.itemsize)
        writer.block(table.tobytes())
    return writer.form()


def form_of_draws(table: Any, numbers: Any) -> bytes:
    """The form of the draws of an episode; see ``fmugym.environment.episode_start``.

    Args:
        table: For each its kind, the row of the start value that it sets or -1, and the place and
            the number of its numbers; shape (draws, 4).
        numbers: The numbers of all.
    """
    return Writer().array(table, np.int64).array(numbers, np.float64).form()
