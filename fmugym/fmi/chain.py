"""Chain rule: the derivatives of a system, from the derivatives of its components."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence

import numpy as np
import numpy.typing as npt

from fmugym.archive.variable import Variable
from fmugym.systems.system_description import PartVariable
from fmugym.systems.system_layout import Route, SystemLayout

__all__ = ["chained_jacobian"]

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
