"""The master's work: one communication step of all components of a system.

``native/system.c`` does the same, operation by operation.
"""

from __future__ import annotations

from fmugym.fmi.loops import NotSolvedError, solve_loop
from fmugym.fmi.parts import FailedError, Parts, shared_out
from fmugym.fmi.status import Status
from fmugym.systems.plan import Group

__all__ = ["Master"]


class Master:
    """Lets the components of a system step, group by group.

    Args:
        parts: The components.

    Attributes:
        terminated: Whether one of them has asked to stop.
    """

    def __init__(self, parts: Parts) -> None:
        self._parts, self._layout = parts, parts.layout
        self.terminated = False

    def step(self, time: float, step_size: float) -> None:
        """Do one communication step.

        Args:
            time: The current communication point, in seconds.
            step_size: The communication step size, in seconds.

        Raises:
            FailedError: If a component fails.
        """
        if not self._parts.fresh:
            self._parts.refresh()
        self._parts.fresh = False
        if self._layout.plan.master == "jacobi":
            for route in self._layout.routes:
                self._parts.carry(route)
        for group in self._layout.plan.groups:
            self._step_group(group, time, step_size)
        for part in self._parts.all:
            part.inputs.values[list(part.layout.clocks)] = 0.0
        self._parts.fresh = True

    def _step_group(self, group: Group, time: float, step_size: float) -> None:
        is_jacobi = self._layout.plan.master == "jacobi"
        if group.loop is not None and not is_jacobi:
            self._solve(group, time, step_size)
            return
        for index in self._layout.parts_of(group):
            if not is_jacobi:
                self._parts.carry_to(index)
            self._step_part(index, time, step_size)

    def _step_part(self, index: int, time: float, step_size: float) -> None:
        """If the FMU asks to stop, the others do their step all the same."""
        part = self._parts.all[index]
        part.judge(part.inputs.set())
        self.terminated |= part.advance(time, step_size)
        part.read()

    def _solve(self, group: Group, time: float, step_size: float) -> None:
        """Repeat the steps of the components of a loop from the state before the step."""
        assert group.loop is not None
        indices = self._layout.parts_of(group)
        routes = [self._layout.routes[i] for i in self._layout.inner_routes(group)]
        for index in indices:
            self._parts.carry_to(index)
        x = [value for route in routes for value in self._parts.carried(route)]
        was_terminated = self.terminated
        before = [self._parts.save(index) for index in indices]
        moved = False

        def evaluate(x: list[float]) -> list[float]:
            nonlocal moved
            if moved:
                for index, state in zip(indices, before, strict=True):
                    self._parts.restore(index, state)
            moved = True
            for route, values in shared_out(routes, x):
                self._parts.take(route, values)
            for index in indices:
                self._step_part(index, time, step_size)
            return [value for route in routes for value in self._parts.carried(route)]

        try:
            solve_loop(group.loop, x, evaluate)
        except NotSolvedError:
            raise FailedError(Status.DISCARD, self._layout.loop_label(indices)) from None
        finally:
            for state in before:
                state.release()
        self.terminated |= was_terminated
