"""What the C code needs to know of a system; ``native/python/systems.c`` takes it."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any, Final

import numpy as np

from fmugym.archive.loadable import LoadableFMU
from fmugym.pool.settings import (
    PlaceOfFMU,
    library_settings,
    listing,
    manner_of,
    solving_settings,
    type_number,
)
from fmugym.pool.spec import PoolSpec, ResetMethod
from fmugym.systems.description import PartVariable, SystemDescription
from fmugym.systems.layout import Layout, PartLayout, array_key
from fmugym.systems.plan import Loop

__all__ = ["system_settings"]

_RUNGS: Final = tuple(ResetMethod)
"""In the order of ``Rung`` of ``native/system.h``."""


def system_settings(fmu: LoadableFMU, spec: PoolSpec, folder: Path) -> tuple[Any, ...] | None:
    """What ``take_system`` of ``native/python/systems.c`` takes; None for an FMU.

    Args:
        fmu: The system or FMU.
        spec: That of the pool.
        folder: That of the extracted system.
    """
    description = fmu.description
    if not isinstance(description, SystemDescription):
        return None
    layout = Layout(description, spec.inputs, spec.outputs)
    rungs = spec.component_resets or (ResetMethod.RESET,) * len(layout.parts)
    return (
        tuple(
            _part(part, one, spec, rung, folder / str(i))
            for i, (part, one, rung) in enumerate(zip(layout.parts, fmu.parts, rungs, strict=True))
        ),
        _routes(layout),
        (*_arrays(layout), *_variables(layout)),
        _groups(layout),
        _transfers(layout),
        layout.plan.master == "jacobi",
    )


def _part(
    part: PartLayout,
    fmu: LoadableFMU,
    spec: PoolSpec,
    rung: ResetMethod,
    folder: Path,
) -> tuple[Any, ...]:
    description = part.description
    version = description.fmi_major_version
    place = PlaceOfFMU.here(folder, (folder / fmu.library,), version)
    known = library_settings(description, spec, place)
    label = part.label
    numbers = [(v, float(x)) for v, x in part.starts if v.numeric]
    texts = [(v.value_reference, str(x).encode()) for v, x in part.starts if not v.numeric]
    return (
        (
            part.component.name.encode(),
            label.encode(),
            f"{label}, whose outputs are not finite".encode(),
        ),
        (version, manner_of(description, spec), part.has_mode, _RUNGS.index(rung)),
        (known["model"], known["token"], known["resources"]),
        known["categories"],
        part.component.steps,
        solving_settings(description, spec),
        listing(part.inputs, version),
        _doubles(part.starts_of(part.inputs)),
        listing(part.outputs, version),
        listing([v for v, _ in numbers], version),
        _doubles(x for _, x in numbers),
        tuple(texts),
        (known["structural_references"], known["structural_values"]),
    )


def _routes(layout: Layout) -> tuple[bytes, ...]:
    routes = layout.routes
    return (
        _numbers(route.source for route in routes),
        _numbers(route.target for route in routes),
        _numbers(route.count for route in routes),
        _doubles(route.gain for route in routes),
        _doubles(route.offset for route in routes),
    )


def _arrays(layout: Layout) -> tuple[bytes, ...]:
    """The arrays that variables of the system are elements of."""
    arrays = list(layout.arrays.values())
    starts = (
        layout.parts[part].starts_of(array.elements)
        if array.settable_at_start
        else [0.0] * array.size
        for part, array in arrays
    )
    return (
        _numbers(array.size for _, array in arrays),
        _doubles(number for numbers in starts for number in numbers),
    )


def _variables(layout: Layout) -> tuple[bytes, ...]:
    """The ends of all variables, and where those of each variable begin."""
    groups = layout.description.ends
    ends = [end for group in groups for end in group]
    firsts = np.cumsum([0, *map(len, groups)])
    numbers = {key: number for number, key in enumerate(layout.arrays)}
    return (
        firsts.astype(np.uint32).tobytes(),
        _numbers(end.part for end in ends),
        bytes(_type(layout, end) for end in ends),
        _numbers(end.variable.value_reference for end in ends),
        np.array([layout.input_slot(end) for end in ends], np.int32).tobytes(),
        np.array([layout.output_slot(end) for end in ends], np.int32).tobytes(),
        np.array([numbers.get(array_key(end), -1) for end in ends], np.int32).tobytes(),
        _numbers(end.variable.place for end in ends),
        _doubles(end.gain for end in ends),
        _doubles(end.offset for end in ends),
        _doubles(end.reading[0] for end in ends),
        _doubles(end.reading[1] for end in ends),
    )


def _type(layout: Layout, end: PartVariable) -> int:
    """The C type; strings have none, and are never read."""
    if end.variable.kind == "string":
        return 0
    return type_number(end.variable, layout.parts[end.part].description.fmi_major_version)


def _groups(layout: Layout) -> tuple[tuple[Any, ...], ...]:
    found = []
    for group in layout.plan.groups:
        parts = layout.parts_of(group)
        loop = _loop(group.loop, layout.loop_label(parts))
        found.append((_numbers(parts), _numbers(layout.inner_routes(group)), loop))
    return tuple(found)


def _transfers(layout: Layout) -> tuple[tuple[Any, ...], ...]:
    found = []
    for evaluation in layout.plan.initialization:
        routes = layout.routes_of(evaluation)
        label = layout.loop_label(layout.routes[i].source_part for i in routes)
        found.append((_numbers(routes), _loop(evaluation.loop, label)))
    return tuple(found)


def _loop(loop: Loop | None, label: str) -> tuple[Any, ...] | None:
    if loop is None:
        return None
    newton = loop.method == "newton"
    return newton, loop.tolerance, loop.max_iterations, label.encode()


def _numbers(values: Iterable[int]) -> bytes:
    return np.array(list(values), np.uint32).tobytes()


def _doubles(values: Iterable[float]) -> bytes:
    return np.array(list(values), np.float64).tobytes()
