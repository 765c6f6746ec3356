"""Swing a pendulum up and hold it upright by thinking ahead, 20 times a second.

    python examples/mpc_pendulum.py

Nothing is learnt. In each step of 50 ms, the controller tries 2,048 sequences of 30 torques on
copies of the FMU and averages them, the better ones with more weight: model predictive path
integral control (G. Williams, A. Aldrich, E. Theodorou, "Model Predictive Path Integral Control",
Journal of Guidance, Control, and Dynamics 40(2), 2017). The plant is a rod of 1 kg and 1 m, whose
largest torque of 2 N m is too weak to lift it directly. The FMU solves it by the classical
Runge-Kutta method of order 4 with internal steps of 25 ms, for the controller as for the plant.
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
            "model_parameters": PLANT | SOLVER | {"q_0": 0.0},  # it starts hanging
            "bounds": {"tau": (-TORQUE, TORQUE)},
            "time_step": PERIOD,
        }
        super().__init__(fmugym.bundled_fmu("Pendulum"), config)

    def _is_done(self) -> Any:
        return self.out["theta"] != self.out["theta"]  # never

    def _reward_policy(self) -> Any:
        theta, theta_dot = self.state
        return -(4 * (1 - np.cos(theta)) + 0.1 * theta_dot**2 + 0.001 * self.inputs[0] ** 2)


class PathIntegral:
    """The controller: how many sequences of torques it tries in a decision, and how long ones."""

    temperature = 1.0  # how much worse than the best a sequence may be and still count

    def __init__(self, candidates: int = 2048, horizon: int = 30, model: Any = SwingUp) -> None:
        self.envs = fmugym.FMUVectorEnv(model, candidates, hooks="compiled")
        self._limit = self.envs.single_action_space.high[0]
        self._plan = np.zeros((horizon, 1))
        self._rng = np.random.default_rng(0)

    def decide(self, snapshot: fmugym.Snapshot) -> tuple[npt.NDArray[np.float32], Array]:
        """Return the next torque, and the angles that the 30 best candidates lead to."""
        shape = (self.envs.num_envs, *self._plan.shape)
        noise = self._rng.normal(0, 0.75 * self._limit, shape)
        noise[0] = 0.0  # the plan itself is a candidate
        tried = np.clip(self._plan + noise, -self._limit, self._limit).astype(np.float32)
        found = self.envs.rollout(snapshot, tried)
        returns = found.rewards.sum(axis=1)
        weights = np.exp((returns - returns.max()) / self.temperature)
        plan = np.tensordot(weights / weights.sum(), tried, axes=1)
        self._plan = np.append(plan[1:], plan[-1:], axis=0)
        best = np.argsort(returns)[-30:]
        return plan[0].astype(np.float32), found.observations[best, :, 0]


class Run(NamedTuple):
    """A row for each step: angle in rad, torque in N m, seconds of the decision, angles ahead."""

    angles: Array
    torques: Array
    seconds: Array
    ahead: Array


def run(controller: PathIntegral, steps: int) -> Run:
    """Let the controller swing the pendulum up."""
    rows = []
    with SwingUp() as env:
        env.reset(seed=0)
        for _ in range(steps):
            angle, begin = env.out["theta"], time.perf_counter()
            action, ahead = controller.decide(env.save_state())
            rows.append((angle, float(action[0]), time.perf_counter() - begin, ahead))
            env.step(action)
    return Run(*map(np.array, zip(*rows, strict=True)))


def seconds_upright(found: Run) -> float:
    """How long the pendulum was upright at the end, in s."""
    off = np.abs(np.degrees((found.angles + np.pi) % (2 * np.pi) - np.pi))
    return PERIOD * float(np.argmax(np.append(off[::-1], np.inf) > UPRIGHT))


def plot(found: Run) -> Figure:
    """Draw what happened, and what the controller expected every half second."""
    figure = Figure(figsize=(7, 6), layout="constrained")
    angle, torque, clock = figure.subplots(3, 1, height_ratios=[3, 1, 1])
    seconds = np.arange(len(found.angles)) * PERIOD
    for index in range(0, len(seconds), 10):
        later = seconds[index] + PERIOD * np.arange(1, found.ahead.shape[2] + 1)
        angle.plot(later, np.degrees(found.ahead[index]).T, color="tab:orange", alpha=0.1, lw=0.7)
    angle.plot(seconds, np.degrees(found.angles), color="tab:blue", lw=2)
    angle.set(ylabel="angle from upright [degrees]", xlim=(0, seconds[-1]))
    angle.set_title("The pendulum (blue), and the best futures tried every 0.5 s (orange)")
    torque.step(seconds, found.torques, where="post")
    torque.set(ylabel="torque [N m]", xlabel="time [s]", xlim=(0, seconds[-1]))
    clock.hist(1e3 * found.seconds, bins=40, color="0.5")
    clock.axvline(1e3 * PERIOD, color="tab:red")
    clock.set(xlabel="time of a decision [ms]; red: what there is", ylabel="decisions")
    return figure


def main(arguments: Sequence[str] | None = None) -> None:
    """Swing up, and plot."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--candidates", type=int, default=2048, metavar="N")
    parser.add_argument("--steps", type=int, default=200, metavar="N", help="of 50 ms each")
    parser.add_argument("--output", type=Path, default=Path("mpc_pendulum.png"))
    options = parser.parse_args(arguments)
    found = run(PathIntegral(options.candidates), options.steps)
    decision, late = 1e3 * np.median(found.seconds), np.mean(found.seconds > PERIOD)
    print(f"upright in the last {seconds_upright(found):.1f} s of {options.steps * PERIOD:g} s")
    print(f"Runge-Kutta of order 4 by {1e3 * SOLVER['max_step']:g} ms; ", end="")
    print(f"{options.candidates} sequences of 30 torques a decision")
    print(f"a decision takes {decision:.1f} ms; {late:.0%} took more than the 50 ms that there are")
    plot(found).savefig(options.output, dpi=100)
    print(f"plot: {options.output}")


if __name__ == "__main__":
    main()
