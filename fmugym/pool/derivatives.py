"""Derivatives of FMUs, and of systems by the chain rule, from those of components."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence

import numpy as np
import numpy.typing as npt

from fmugym.errors import SimulationError
from fmugym.fmi.description import ModelDescription
from fmugym.fmi.systems.system_description import PartVariable, SystemDescription
from fmugym.fmi.systems.system_layout import Route, SystemLayout
from fmugym.fmi.variable import Variable
from fmugym.pool.pool import FloatArray
from fmugym.pool.pool_form import table_of
from fmugym.pool.pool_spec import PoolSpec

__all__ = ["Variables", "chained_jacobian", "differentiated"]

_FloatArray = npt.NDArray[np.float64]
Ends = Sequence[Sequence[PartVariable]]
Differentiate = Callable[[int, tuple[Variable, ...], tuple[Variable, ...]], _FloatArray]
"""Takes the number of a component, its k unknowns and its m knowns; gives shape (N, k, m)."""


def chained_jacobian(
    layout: SystemLayout, differentiate: Differentiate, count: int, unknowns: Ends, knowns: Ends
) -> _FloatArray:
    """Differentiate variables of a system by others, as if values were exchanged at all times.

    What connections carry, y, depends on the knowns k directly and by way of other connections:
    dy = M dy + N dk, so that dy/dk = (1 - M)^-1 N. Algebraic loops make M no triangular matrix.
    Only continuous Reals have derivatives; other connections are held constant.

    Args:
        layout: The slots and routes of the system.
        differentiate: Differentiates one component of all instances at the present point.
        count: The number N of instances.
        unknowns: Ends of the variables to differentiate, in components; the first end counts.
        knowns: Ends of the variables to differentiate by, in components: one or several.

    Returns:
        The partial derivatives, shape (N, len(unknowns), len(knowns)), in the units of the system.
    """
    routes = [route for route in layout.routes if _is_continuous(layout, route)]
    carried = [_source(layout, route) for route in routes]
    chain = _Chain(layout, differentiate, count, routes)
    links = chain.by_routes(carried)
    direct = chain.by_knowns(carried, knowns)
    by_links = np.linalg.solve(np.eye(len(routes)) - links, direct)
    ends = [behind[0] for behind in unknowns]
    return chain.by_knowns(ends, knowns) + chain.by_routes(ends) @ by_links


class _Chain:
    """The derivatives of some variables by connections and by knowns."""

    def __init__(
        self,
        layout: SystemLayout,
        differentiate: Differentiate,
        count: int,
        routes: Sequence[Route],
    ) -> None:
        self._layout, self._differentiate = layout, differentiate
        self._count, self._routes = count, routes

    def by_routes(self, ends: Sequence[PartVariable]) -> _FloatArray:
        """By the sources of connections, which act on their targets."""
        targets = [[_target(self._layout, route)] for route in self._routes]
        return self.by_knowns(ends, targets)

    def by_knowns(self, ends: Sequence[PartVariable], knowns: Ends) -> _FloatArray:
        """By variables, without the way of connections."""
        result = np.zeros((self._count, len(ends), len(knowns)))
        for part in {end.part for end in ends}:
            rows = [row for row, end in enumerate(ends) if end.part == part]
            pairs = [(j, end) for j, known in enumerate(knowns) for end in _within(known, part)]
            of = tuple(ends[row].variable for row in rows)
            found = self._differentiate(part, of, tuple(end.variable for _, end in pairs))
            gains = np.array([ends[row].reading[0] for row in rows])
            for place, (column, end) in enumerate(pairs):
                result[:, rows, column] += found[:, :, place] * gains * end.gain
        return result


def _within(ends: Iterable[PartVariable], part: int) -> list[PartVariable]:
    return [end for end in ends if end.part == part]


def _source(layout: SystemLayout, route: Route) -> PartVariable:
    part = layout.parts[route.source_part]
    return PartVariable(route.source_part, part.outputs[route.source - part.first_output])


def _target(layout: SystemLayout, route: Route) -> PartVariable:
    part = layout.parts[route.target_part]
    variable = part.inputs[route.target - part.first_input]
    return PartVariable(route.target_part, variable, route.gain)


def _is_continuous(layout: SystemLayout, route: Route) -> bool:
    ends = _source(layout, route).variable, _target(layout, route).variable
    return all(one.kind == "real" and one.variability == "continuous" for one in ends)


Variables = tuple[Variable, ...]


Ask = Callable[[bool, int, int, Variables, Variables], FloatArray]
"""Asks an engine to differentiate; see ``native/pool/derivatives.h``.

The arguments are: whether the FMU differentiates unknowns by all knowns, not all unknowns by a
known; the component of a system, 0 for an FMU; the version as of
``fmugym.pool.pool_form.table_of``; the unknowns in the first case, otherwise the knowns; and the
others. The result has the shape of these two, and N on the last axis."""


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
