"""Swing a pendulum up and hold it upright by model predictive control, 20 times a second.

    python examples/mpc_pendulum.py

Nothing is learnt. In each step of 50 ms, the controller tries sequences of 30 torques on copies of
the FMU. The plant is a rod of 1 kg and 1 m, whose largest torque of 2 N m is too weak to lift it
directly. The FMU solves it by the classical Runge-Kutta method of order 4 with internal steps of
25 ms, for the controller as for the plant.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from matplotlib.figure import Figure

import fmugym
from fmugym.control import MPC

Array = npt.NDArray[np.float64]

PERIOD = 0.05  # of the controller, in s
TORQUE = 2.0  # the largest, in N m
PLANT = {"m": 1.0, "l": 1.0, "g": 10.0, "b": 0.05, "body": 2, "tau_max": TORQUE}  # 2 is a rod
SOLVER = {"solver": 3, "max_step": 0.025}  # 3 is Runge-Kutta of order 4
UPRIGHT = 5.0  # what counts as upright, in degrees


class SwingUp(fmugym.FMI2CSEnv):
    """Reach the upright position from below, and stay there."""

    def __init__(self) -> None:
        config = {
            "model_input_names": "tau",
            "model_output_names": ["theta", "theta_dot"],  # theta is 0 upright
            "model_parameters": PLANT | SOLVER | {"theta_0": -np.pi},  # hanging
            "bounds": {"tau": (-TORQUE, TORQUE)},
            "time_step": PERIOD,
            "terminated": False,
            "reward": "-(4 * (1 - cos(theta)) + 0.1 * theta_dot**2 + 0.001 * tau**2)",
        }
        super().__init__(fmugym.bundled_fmu("Pendulum"), config)


class Run(NamedTuple):
    """A row for each step: angle in rad, torque in N m, seconds of the decision."""

    angles: Array
    torques: Array
    seconds: Array


def planner(candidates: int, **options: Any) -> MPC:
    """The controller, which looks 1.5 s ahead; it begins each decision in the observed state."""
    states = {"theta": "theta_0", "theta_dot": "theta_dot_0"}
    return MPC(1.5, candidates, states=states, correction=1.0, **options)


def run(controller: MPC, steps: int) -> Run:
    """Let the controller swing the pendulum up."""
    rows = []
    with SwingUp() as env:
        controller.bind(env)
        state, _ = env.reset(seed=0)
        for _ in range(steps):
            begin = time.perf_counter()
            torque = controller.act(state)
            rows.append((state[0], torque[0], time.perf_counter() - begin))
            state = env.step(torque)[0]
        controller.close()
    return Run(*np.array(rows).T)


def seconds_upright(found: Run) -> float:
    """How long the pendulum was upright at the end, in s."""
    off = np.abs(np.degrees((found.angles + np.pi) % (2 * np.pi) - np.pi))
    return PERIOD * float(np.argmax(np.append(off[::-1], np.inf) > UPRIGHT))


def plot(found: Run) -> Figure:
    """Draw what happened."""
    figure = Figure(figsize=(7, 6), layout="constrained")
    angle, torque, clock = figure.subplots(3, 1, height_ratios=[3, 1, 1])
    seconds = np.arange(len(found.angles)) * PERIOD
    angle.plot(seconds, np.degrees(found.angles))
    angle.set(ylabel="angle from upright [degrees]", xlim=(0, seconds[-1]))
    torque.step(seconds, found.torques, where="post")
    torque.set(ylabel="torque [N m]", xlabel="time [s]", xlim=(0, seconds[-1]))
    clock.hist(1e3 * found.seconds, bins=40, color="0.5")
    clock.axvline(1e3 * PERIOD, color="tab:red")
    clock.set(xlabel="time of a decision [ms]; red: what there is", ylabel="decisions")
    return figure


def main(arguments: Sequence[str] | None = None) -> None:
    """Swing up, and plot."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--candidates", type=int, default=512, metavar="N")
    parser.add_argument("--steps", type=int, default=200, metavar="N", help="of 50 ms each")
    parser.add_argument("--output", type=Path, default=Path("mpc_pendulum.png"))
    options = parser.parse_args(arguments)
    found = run(planner(options.candidates), options.steps)
    decision, late = 1e3 * np.median(found.seconds), np.mean(found.seconds > PERIOD)
    print(f"upright in the last {seconds_upright(found):.1f} s of {options.steps * PERIOD:g} s")
    print(f"Runge-Kutta of order 4 by {1e3 * SOLVER['max_step']:g} ms; ", end="")
    print(f"{options.candidates} sequences of 30 torques a decision")
    print(f"a decision takes {decision:.1f} ms; {late:.0%} took more than the 50 ms that there are")
    plot(found).savefig(options.output, dpi=100)
    print(f"plot: {options.output}")


if __name__ == "__main__":
    main()
