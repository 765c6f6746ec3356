"""Odd arguments of ``fmugym.control.identification``: each call ends well or in its own error.

    python tests/tools/fuzz_identification.py --count 2000 --seed 0

A case calls one public function, class or method with one or two arguments of a wrong type, range
or shape. See ``fuzz_driver.py``.
"""

import functools
import sys

import numpy as np
from fuzz_driver import main, of_kinds
from fuzz_odd_values import odd, spoil

from fmugym import bundled_fmu
from fmugym.control.identification import Trajectory, fit_parameters, plot_comparison

TIME = np.arange(0.0, 0.4, 0.02)
SWING = {"q": np.cos(9.9 * TIME), "q_dot": -9.9 * np.sin(9.9 * TIME)}
FIT = {
    "fmu": str(bundled_fmu("Pendulum")),
    "parameters": {"l": (0.05, 0.2)},
    "trajectories": [Trajectory(TIME, SWING)] * 3,
    "initial_states": {"q_0": "q"},
    "fixed": {"g": 9.81},
    "scales": {"q": 1.0},
    "time_step": 0.02,
    "wash_in": 0.1,
    "candidates": 1,
}
INSIDE = ("parameters", "initial_states", "fixed", "scales")


@functools.cache
def fitted():
    return fit_parameters(**FIT)


def fit(rng, folder):
    """Fit with odd arguments, or with odd values in a dict of them."""
    arguments = spoil(rng, FIT)
    if rng.random() < 0.5:
        name = rng.choice(INSIDE)
        arguments = FIT | {name: {rng.choice(("l", "m", "q", "q_0", "zzz")): odd(rng)}}
    return lambda: fit_parameters(**arguments)


def trajectory(rng, folder):
    arguments = {"time": TIME, "outputs": SWING, "inputs": {"tau": 0.0}, "label": "x"}
    if rng.random() < 0.5:
        name = rng.choice(("outputs", "inputs"))
        return lambda: Trajectory(**arguments | {name: {"q": odd(rng)}})
    spoiled = spoil(rng, arguments)
    return lambda: Trajectory(**spoiled)


def method(rng, folder):
    """Call a method of a result or of a trajectory with one odd argument."""
    made, value = FIT["trajectories"][0], odd(rng)
    calls = (
        *(made.select, fitted().confidence_intervals, fitted().rms, fitted().predict),
        *(fitted().comparison.residuals, fitted().rows, plot_comparison),
        *(lambda x: plot_comparison(fitted().comparison, x),),
    )
    call = rng.choice(calls)
    return lambda: call(value)


program = of_kinds((fit, trajectory, method, method))


if __name__ == "__main__":
    sys.exit(main(program, __doc__, 2000))
