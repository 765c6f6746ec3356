"""Balance a pendulum by linear feedback, computed from the FMU's own derivatives.

    python examples/lqr_pendulum.py

`linearize` asks the FMU for the linear model of the upright position. The regulator that is
optimal for this model (LQR) is four lines of `fmugym.baselines`. It drives the nonlinear FMU from
six angles. Small ones follow the prediction of the linear model. Beyond 23.6 degrees, the largest
torque of 2 N m is weaker than the weight, and the pendulum falls.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from mpc_pendulum import PERIOD, PLANT, TORQUE, Array, SwingUp

import fmugym
from fmugym.baselines import LQR
from fmugym.linearization import linearize, linearize_along

ANGLES = (5.0, 10.0, 15.0, 20.0, 22.0, 24.0)  # where it begins, in degrees from upright
WEIGHTS = (4.0, 0.1)  # of angle and velocity; the reward of SwingUp has them, too
EFFORT = 0.1  # the weight of the torque


def regulator(envs: fmugym.FMUVectorEnv) -> LQR:
    """The regulator for the upright position, bound to environments."""
    fmu = fmugym.bundled_fmu("Pendulum")
    model = linearize(fmu, at=PLANT | {"q_0": np.pi, "q_dot_0": 0.0})
    return LQR(model, WEIGHTS, [EFFORT]).bind(envs)


def start(envs: fmugym.FMUVectorEnv, angles: Array) -> Array:
    """Begin at angles from upright, in degrees; returns the observations."""
    envs.set_attr("theta_0", np.radians(angles))
    return envs.reset(seed=0)[0]


def run(angles: Sequence[float] = ANGLES, steps: int = 60) -> tuple[Array, Array, Array]:
    """Let the regulator act on the FMU.

    Returns:
        Angles in degrees, shape (n, steps), torques in N m, and what the linear model predicts
        without a limit of the torque.
    """
    with_limits = fmugym.FMUVectorEnv(SwingUp, len(angles))
    controller, rows = regulator(with_limits), []
    observations = start(with_limits, np.array(angles))
    for _ in range(steps):
        torques = controller.act(observations)
        rows.append((np.degrees(observations[:, 0]), torques[:, 0]))
        observations = with_limits.step(torques)[0]
    with_limits.close()
    found, torques = np.transpose(rows, (1, 2, 0))
    return found, torques, predicted(controller.gain, np.array(angles), steps)


def predicted(gain: Array, angles: Array, steps: int) -> Array:
    """The angles of the linear model with the regulator, in degrees."""
    envs = fmugym.FMUVectorEnv(SwingUp, 1)
    start(envs, np.zeros(1))
    model = linearize_along(envs, envs.save_state(), np.zeros((1, 1)))  # of one step
    envs.close()
    closed = model.A[0] - model.B[0] @ gain
    x, rows = np.stack([angles, np.zeros_like(angles)]), []
    for _ in range(steps):
        rows.append(x[0])
        x = closed @ x
    return np.array(rows).T


def plot(found: tuple[Array, Array, Array]) -> Figure:
    """Draw the angles with the predictions, and the torques."""
    figure = Figure(figsize=(7, 5), layout="constrained")
    angle, torque = figure.subplots(2, 1, sharex=True, height_ratios=[2, 1])
    seconds = PERIOD * np.arange(found[0].shape[1])
    for index, (angles, torques, linear) in enumerate(zip(*found, strict=True)):
        color = f"C{index}"
        angle.plot(seconds, angles, color=color, label=f"from {angles[0]:.0f} degrees")
        angle.plot(seconds, linear, color=color, ls=":")
        torque.step(seconds, torques, color=color, where="post")
    angle.set(ylabel="angle from upright [degrees]", ylim=(-5, 60))
    angle.set_title("LQR on the FMU; dotted: what the linear model predicts")
    angle.legend()
    torque.axhline(TORQUE, color="0.7", lw=0.7)
    torque.axhline(-TORQUE, color="0.7", lw=0.7)
    torque.set(ylabel="torque [N m]", xlabel="time [s]")
    return figure


def main(arguments: Sequence[str] | None = None) -> None:
    """Balance, and plot."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--steps", type=int, default=60, metavar="N", help="of 50 ms each")
    parser.add_argument("--output", type=Path, default=Path("lqr_pendulum.png"))
    options = parser.parse_args(arguments)
    found = run(steps=options.steps)
    for angles in found[0]:
        held = "is held" if abs(angles[-1]) < 1.0 else "falls"
        print(f"from {angles[0]:4.1f} degrees it {held}")
    plot(found).savefig(options.output, dpi=100)
    print(f"plot: {options.output}")


if __name__ == "__main__":
    main()
