"""Swing a pendulum up with nothing but a noisy angle: a Kalman filter feeds the controller.

    python examples/ukf_pendulum.py

The controller of mpc_pendulum.py needs the angle and the velocity. Here a sensor tells the angle
only, with noise of 3 degrees, and the torque is disturbed by 0.05 N m, both normally distributed.
An unscented Kalman filter estimates both states (S. Julier, J. Uhlmann, "Unscented Filtering and
Nonlinear Estimation", Proceedings of the IEEE 92(3), 2004). One rollout predicts where its five
sigma points go. For comparison, the same controller gets the angle and its differences over time.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure
from mpc_pendulum import PERIOD, TORQUE, Array, SwingUp, planner

import fmugym

NOISE = np.radians(3.0)  # standard deviation of a measured angle
DISTURBANCE = 0.05  # standard deviation of what is added to the torque of each step, in N m
CHANGE = 3.0 * DISTURBANCE * PERIOD * np.array([0.5 * PERIOD, 1.0])  # what it does to the rod
CENTRE = 1.0  # how much the centre counts, as against 1/2 for each of the four other sigma points
NEAR, JUDGED = 15.0, 60  # what counts as upright, in degrees, and in which steps at the end
LABELS = ("angle from upright [degrees]", "velocity [rad/s]")


class Filter:
    """Estimates angle and velocity from angles."""

    def __init__(self) -> None:
        self.mean, self.covariance = np.array([-np.pi, 0.0]), np.diag([0.1, 0.1]) ** 2
        self.envs = fmugym.FMUVectorEnv(SwingUp, 5)
        self._weights = np.array([CENTRE, *[0.5] * 4]) / (2 + CENTRE)

    def correct(self, angle: float) -> None:
        """Take a measured angle into account; it is linear in the states."""
        gain = self.covariance[:, 0] / (self.covariance[0, 0] + NOISE**2)
        self.mean = self.mean + gain * (angle - self.mean[0])
        self.covariance = self.covariance - np.outer(gain, self.covariance[0])

    def predict(self, torque: Array) -> None:
        """Go on by one step."""
        root = np.linalg.cholesky((2 + CENTRE) * self.covariance).T
        points = self.mean + np.concatenate([np.zeros((1, 2)), root, -root])
        self.envs.set_attr("theta_0", points[:, 0])
        self.envs.set_attr("theta_dot_0", points[:, 1])
        self.envs.reset()
        ahead = self.envs.rollout(None, np.tile(torque, (5, 1, 1))).observations[:, 0]
        self.mean = self._weights @ ahead
        off = (ahead - self.mean).T
        self.covariance = self._weights * off @ off.T + np.outer(CHANGE, CHANGE)


class Differences:
    """Takes angles as they are, and their differences as velocities."""

    mean = np.array([-np.pi, 0.0])

    def correct(self, angle: float) -> None:
        """Take a measured angle over."""
        self.mean = np.array([angle, (angle - self.mean[0]) / PERIOD])

    def predict(self, torque: Array) -> None:
        """Do nothing."""


class Run(NamedTuple):
    """A row for each step: angle and velocity, those that were estimated, and the measurement."""

    states: Array
    estimates: Array
    measured: Array

    @property
    def errors(self) -> Array:
        """Root mean squares: of the measurement, of estimated angles and velocities."""
        off = np.column_stack([self.measured, self.estimates]) - self.states[:, [0, 0, 1]]
        return np.asarray(np.sqrt(np.mean(off[10:] ** 2, axis=0)))  # without the first half second

    @property
    def upright(self) -> float:
        """The share of the last steps in which the pendulum is upright."""
        return float(np.mean(np.cos(self.states[-JUDGED:, 0]) > np.cos(np.radians(NEAR))))


def run(estimator: Filter | Differences, steps: int, candidates: int, seed: int = 0) -> Run:
    """Let the controller act on estimates."""
    controller, rows = planner(candidates), []
    rng = np.random.default_rng(seed)
    with SwingUp() as plant:
        controller.bind(plant)
        state, _ = plant.reset(seed=seed)
        for _ in range(steps):
            measured = state[0] + rng.normal(0, NOISE)
            estimator.correct(measured)
            rows.append((state, estimator.mean, measured))
            torque = controller.act(estimator.mean)
            disturbed = torque + rng.normal(0, DISTURBANCE)
            state = plant.step(np.clip(disturbed, -TORQUE, TORQUE).astype(np.float32))[0]
            estimator.predict(torque)
        controller.close()
    return Run(*map(np.array, zip(*rows, strict=True)))


def plot(runs: dict[str, Run]) -> Figure:
    """Draw angles and velocities."""
    figure = Figure(figsize=(8, 5.5), layout="constrained")
    axes = figure.subplots(2, len(runs), sharex=True, sharey="row", squeeze=False)
    for (angle, velocity), (name, found) in zip(axes.T, runs.items(), strict=True):
        seconds = PERIOD * np.arange(len(found.states))
        angle.plot(seconds, np.degrees(found.measured), ".", color="0.6", ms=3, label="measured")
        angle.plot(seconds, np.degrees(found.states[:, 0]), color="tab:blue", label="true")
        angle.set_title(name)
        velocity.plot(seconds, found.estimates[:, 1], color="tab:orange", label="estimated")
        velocity.plot(seconds, found.states[:, 1], color="tab:blue", label="true")
        velocity.set(xlabel="time [s]")
    for axis, label in zip(axes[:, 0], LABELS, strict=True):
        axis.set(ylabel=label)
        axis.legend()
    return figure


def main(arguments: Sequence[str] | None = None) -> None:
    """Run with both estimators, and plot."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--candidates", type=int, default=2048, metavar="N")
    parser.add_argument("--steps", type=int, default=200, metavar="N", help="of 50 ms each")
    parser.add_argument("--output", type=Path, default=Path("ukf_pendulum.png"))
    options = parser.parse_args(arguments)
    runs = {}
    for name, estimator in (("Kalman filter", Filter()), ("differences", Differences())):
        runs[name] = run(estimator, options.steps, options.candidates)
        noise, angle, velocity = runs[name].errors
        print(f"{name}: {np.degrees(angle):.1f} degrees and {velocity:.2f} rad/s wrong, the sensor")
        print(f"  {np.degrees(noise):.1f} degrees; upright in {runs[name].upright:.0%} of the end")
    plot(runs).savefig(options.output, dpi=100)
    print(f"plot: {options.output}")


if __name__ == "__main__":
    main()
