"""Derivatives of FMUs, and of systems by the chain rule."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from fmugym.archive.description import ModelDescription
from fmugym.archive.variable import Variable
from fmugym.errors import SimulationError
from fmugym.fmi.chain import chained_jacobian
from fmugym.pool.base import FloatArray
from fmugym.pool.form import table_of
from fmugym.pool.spec import PoolSpec
from fmugym.systems.system_description import SystemDescription
from fmugym.systems.system_layout import SystemLayout

__all__ = ["Variables", "differentiated"]

Variables = tuple[Variable, ...]


Ask = Callable[[bool, int, int, Variables, Variables], FloatArray]
"""Asks an engine to differentiate; see ``native/derivatives.h``.

The arguments are: whether the FMU differentiates unknowns by all knowns, not all unknowns by a
known; the component of a system, 0 for an FMU; the version as of ``fmugym.pool.form.table_of``; the
unknowns in the first case, otherwise the knowns; and the others. The result has the shape of these
two, and N on the last axis."""


def differentiated(
    description: ModelDescription,
    spec: PoolSpec,
    count: int,
    ask: Ask,
    unknowns: Variables,
    knowns: Variables,
) -> FloatArray:
    """Differentiate; see ``Pool.differentiate``.

    Args:
        description: That of the FMU or system.
        spec: That of the pool.
        count: The number of instances.
        ask: Asks the engine.
        unknowns: As for ``Pool.differentiate``.
        knowns: As for ``Pool.differentiate``.
    """
    if not isinstance(description, SystemDescription):
        return _of_fmu(0, description, ask, unknowns, knowns)
    layout = SystemLayout(description, spec.inputs, spec.outputs)

    def differentiate(part: int, of: Variables, by: Variables) -> FloatArray:
        return np.moveaxis(_of_fmu(part, layout.parts[part].description, ask, of, by), -1, 0)

    ends = [[layout.ends_of(variable) for variable in some] for some in (unknowns, knowns)]
    found = chained_jacobian(layout, differentiate, count, *ends)
    return np.moveaxis(found, 0, -1)


def _of_fmu(
    part: int, description: ModelDescription, ask: Ask, unknowns: Variables, knowns: Variables
) -> FloatArray:
    capabilities = description.capabilities
    if not capabilities.provides_derivatives:
        raise SimulationError(f"{description.model_name} provides no derivatives")
    adjoint = not capabilities.provides_directional_derivatives
    seeded, others = (unknowns, knowns) if adjoint else (knowns, unknowns)
    found = ask(adjoint, part, table_of(description), seeded, others)
    return found if adjoint else found.swapaxes(0, 1)
