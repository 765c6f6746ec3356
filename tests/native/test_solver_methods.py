"""The methods of integration by themselves: their orders, and how many steps they do."""

import math
from contextlib import closing

import exchange_tools
import numpy as np
import pytest
from pool_tools import open_pool, start, step

from fmugym import FMU

ORDERS = {"euler": 1, "rk4": 4, "dormand_prince": 5, "rosenbrock": 5}
ANY = 0.9
"""A tolerance with which steps are as long as they may be."""


@pytest.fixture(scope="module", name="path_of")
def compiled(tmp_path_factory):
    folder = tmp_path_factory.mktemp("methods")
    models = "season", "circuit", "relay"
    return {name: exchange_tools.exchange_fmu(folder / f"{name}.fmu", name) for name in models}


def ends(path, output, time_step, count=1, starts=None, **spec):
    """The value of an output after each step."""
    fmu = FMU(path, probe_timeout=None)
    with closing(open_pool(fmu, (), [output], time_step, **spec)) as pool:
        start(pool, starts)
        return [step(pool)[0, 0] for _ in range(count)]


def require_order(order, errors, lengths):
    assert (np.diff(np.log(errors)) / np.diff(np.log(lengths))).min() > order - 0.25


@pytest.mark.parametrize("method", ORDERS)
def test_orders(path_of, method):
    """x' = x cos(t) and x(0) = 1, so that x = exp(sin(t))."""
    lengths, errors = [0.1, 0.05, 0.025], []
    for length in lengths:
        spec = {"solver": method, "max_step": length, "tolerance": ANY}
        (found,) = ends(path_of["season"], "x", 2.0, **spec)
        errors.append(abs(found - math.exp(math.sin(2.0))))
    require_order(ORDERS[method], errors, lengths)


@pytest.mark.parametrize(("method", "order"), [("euler", 0.9), ("rk4", 3.0)])
def test_orders_between_the_ends_of_a_step(path_of, method, order):
    """The capacitor is discharged at two fifths of a step, and charged anew from then on."""
    tau, limit = 0.3, 0.8
    discharge = -tau * math.log(1.0 - limit)
    lengths, errors = [discharge / (count + 0.4) for count in (10, 20, 40)], []
    starts = {"limit": limit, "tau": tau, "period": 100.0}
    for length in lengths:
        spec = {"solver": method, "max_step": length, "tolerance": 1e-12, "starts": starts}
        (found,) = ends(path_of["circuit"], "voltage", discharge + 4 * length, **spec)
        errors.append(abs(found - 1.0 + math.exp(-4 * length / tau)))
    require_order(order, errors, lengths)


@pytest.mark.parametrize("method", ORDERS)
def test_steps_are_as_long_as_they_may_be(path_of, method):
    """Rounding of the time does not divide the last one: 0.8 + 0.1 is less than 0.9."""
    spec = {"solver": method, "max_step": 0.1, "tolerance": ANY}
    steps = ends(path_of["relay"], "steps", 0.5, 4, **spec)
    assert np.diff(steps).tolist() == [5, 5, 5]  # the first steps find out how long they may be
