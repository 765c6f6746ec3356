"""Swing up and hold a pendulum of the lab by thinking ahead on the FMU.

    python examples/mpc_cell.py

The controller of mpc_pendulum.py drives a cell of the simulated lab, with the preset ``hardware``:
friction, noise and delays that its model does not have. The state of a real system cannot be saved.
So each decision starts the model anew at the measured angle and velocity, and lets it do the step
that is under way: a torque takes effect one period after the measurement it was computed from.

The model solves the point mass by the classical Runge-Kutta method of order 4 with internal steps
of 10 ms. Only the ``backend`` changes for a cell of the real lab. The lab's clock waits for
decisions here; with ``--real-time`` it does not.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from matplotlib.figure import Figure
from mpc_pendulum import Array, PathIntegral

import fmugym
from fmugym.lab import Lab, ManualClock

PERIOD = 0.02  # from one measurement to the next, in s
TORQUE = 0.08  # the largest that it uses, in N m; the weight of the horizontal arm is 0.059 N m
PLATFORM = 0.15  # the torque of an action of 1, in N m
FRICTION = 2e-3  # a guess of the Coulomb friction, in N m
LAST = 150  # the steps at the end that are judged


class Model(fmugym.FMI2CSEnv):
    """The pendulum without delays. Its state is the angle from upright and the velocity."""

    def __init__(self) -> None:
        config = {
            "model_input_names": "tau",
            "model_output_names": ["theta", "theta_dot"],
            "model_parameters": {"q_0": 0.0, "q_dot_0": 0.0, "c": FRICTION, "max_step": 0.01},
            "bounds": {"tau": (-TORQUE, TORQUE)},
            "time_step": PERIOD,
        }
        super().__init__(fmugym.bundled_fmu("Pendulum"), config)

    def _is_done(self) -> Any:
        return self.out["theta"] != self.out["theta"]  # never

    def _reward_policy(self) -> Any:
        theta, theta_dot = self.state
        away = abs(theta + np.pi) > 5.5  # the lab ends the session beyond a turn from hanging
        effort = self.inputs[0] / TORQUE
        return -(4 * (1 - np.cos(theta)) + 0.02 * theta_dot**2 + 0.01 * effort**2) - 100.0 * away


class Prediction:
    """Where the pendulum will be when the next torque takes effect."""

    def __init__(self) -> None:
        self._model = Model()

    def __call__(self, q: float, q_dot: float, pending: Array) -> fmugym.Snapshot:
        """Return the model's state after the step that is under way."""
        start = {"q_0": q, "q_dot_0": q_dot}
        self._model.reset(options={"model_parameters": start})
        self._model.step(pending)
        return self._model.save_state()


def run(seed: int, steps: int = 500, candidates: int = 512, real_time: bool = False) -> Array:
    """Play an episode on a cell; return angles from hanging and torques, shape (2, steps)."""
    controller, predict = PathIntegral(candidates, 25, Model), Prediction()
    torque, rows = np.zeros(1, np.float32), []
    with Lab("hardware", clock=None if real_time else ManualClock(), seed=seed) as lab:
        env = gymnasium.make("fmugym/CloudPendulum-v0", backend=lab)
        env.reset(seed=seed)
        cell: Any = env.unwrapped
        for _ in range(steps):
            q, q_dot = cell.state
            rows.append((q, float(torque[0])))
            torque, _ = controller.decide(predict(q, q_dot, torque))
            if any(env.step(torque / np.float32(PLATFORM))[2:4]):
                break
        env.close()
    controller.envs.close()
    return np.array(rows).T


def worst(angles: Array) -> float:
    """The largest angle from upright in the last 3 s, in degrees."""
    return float(np.degrees(np.abs(np.abs(angles[-LAST:]) - np.pi)).max())


def plot(runs: Sequence[Array]) -> Figure:
    """Draw the angles and the torques of all runs."""
    figure = Figure(figsize=(7, 4.5), layout="constrained")
    angle, torque = figure.subplots(2, 1, sharex=True, height_ratios=[2, 1])
    for angles, torques in runs:
        seconds, side = np.arange(len(angles)) * PERIOD, np.sign(angles[-1])
        angle.plot(seconds, side * np.degrees(angles))
        torque.step(seconds, side * 1e3 * torques, where="post", lw=0.7)
    angle.axhline(180, color="tab:green", lw=0.7, zorder=0)
    angle.set(ylabel="angle [degrees]", title="Cells of the lab, controlled by thinking ahead")
    torque.set(ylabel="torque [mN m]", xlabel="time [s]")
    return figure


def main(arguments: Sequence[str] | None = None) -> None:
    """Run on several cells, and plot."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=5, metavar="N", help="number of labs")
    parser.add_argument("--steps", type=int, default=500, metavar="N", help="of 20 ms each")
    parser.add_argument("--real-time", action="store_true", help="the lab does not wait")
    parser.add_argument("--output", type=Path, default=Path("mpc_cell.png"))
    options = parser.parse_args(arguments)
    runs = []
    for seed in range(options.seeds):
        runs.append(run(seed, options.steps, real_time=options.real_time))
        print(f"lab {seed}: within {worst(runs[-1][0]):.1f} degrees of upright in the last 3 s")
    plot(runs).savefig(options.output, dpi=100)
    print(f"plot: {options.output}")


if __name__ == "__main__":
    main()
