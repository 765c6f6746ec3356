"""The methods of integration by themselves: their orders, and what they ask of an FMU."""

import math
from itertools import pairwise

import pytest

from fmugym.fmi.equations import Equations, Events
from fmugym.fmi.methods import METHODS
from fmugym.fmi.solver import Solver, Solving

ORDERS = {"euler": 1, "rk4": 4, "dormand_prince": 5, "rosenbrock": 5}


class Growth(Equations):
    """x' = x cos(t) and x(0) = 1, so that x = exp(sin(t)); it notes the calls."""

    number_of_states = 1
    number_of_indicators = 0
    completes = True

    def __init__(self):
        self.time, self.x, self.calls = None, 1.0, []

    def set_time(self, time):
        assert time != self.time, "the FMU has this time already"
        self.time = time

    def set_states(self, x):
        (self.x,) = x

    def get_states(self):
        return [self.x]

    def get_rates(self):
        return [self.x * math.cos(self.time)]

    def get_nominals(self):
        return [1.0]

    def get_indicators(self):
        return []

    def enter_events(self):
        pass

    def update(self):
        self.time = None  # an event may change everything
        return Events(again=False, terminate=False, next_event=math.inf)

    def enter_continuous(self):
        pass

    def complete(self):
        self.calls.append("complete")
        return False, False

    def differentiate_by(self, state):
        return None

    is_active = activate = interval = shift = set_interval = set_inputs = None


def solver_of(method, **options):
    solver = Solver(Growth(), Solving(method, **options), pytest.fail)
    solver.enter_events()
    return solver


def error_of(method, steps, fraction):
    """Of steps of equal length to t = 2, and of the dense output in the last one."""
    solver, way = solver_of(method), METHODS[method]()
    solver.advance(0.0)
    error = 0.0
    for i in range(steps):
        solver._know()
        end = 2.0 * (i + 1) / steps
        (after,), _ = way.step(solver, end)
        time = solver.time + fraction * (end - solver.time)
        (between,) = way.between(solver, end, fraction)
        error = max(error, abs(between - math.exp(math.sin(time))))
        solver._place(end, [after])
        solver._move_on(end, [after], [], interrupted=True)
    assert solver._fmu.x == after
    return error


@pytest.mark.parametrize(("fraction", "lost"), [(1.0, 0), (0.4, 1)])
@pytest.mark.parametrize("method", sorted(METHODS))
def test_orders(method, fraction, lost):
    """The error falls with the order; between the ends of a step it may be of one order less."""
    errors = [error_of(method, steps, fraction) for steps in (20, 40, 80)]
    assert min(math.log2(a / b) for a, b in pairwise(errors)) > ORDERS[method] - lost - 0.25


@pytest.mark.parametrize("method", sorted(METHODS))
def test_a_time_is_set_once(method):
    solver = solver_of(method, max_step=0.1)
    for end in (0.5, 1.0):
        solver.advance(end)
    assert solver._fmu.time == 1.0
    assert solver._fmu.x == pytest.approx(
        math.exp(math.sin(1.0)), abs=5e-6 if method != "euler" else 0.1
    )


@pytest.mark.parametrize("method", sorted(METHODS))
def test_steps_are_as_long_as_they_may_be(method):
    """Rounding of the time does not divide the last one: 0.8 + 0.1 is less than 0.9."""
    solver = solver_of(method, max_step=0.1, tolerance=1e-3)
    solver._remember(step=0.1)
    for end in (0.5, 1.0):
        solver.advance(end)
    assert solver._fmu.calls.count("complete") == 10
