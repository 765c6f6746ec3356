"""From simulation to the lab: swing a pendulum up with a policy that only knows the FMU.

    pip install -e ".[examples,identification]"
    python examples/pendulum_sim_to_lab.py

The policy pumps energy into the pendulum with 0.03 N m, too little to lift it, and balances it near
the top by a linear-quadratic regulator (LQR). Both are computed from the FMU's directional
derivatives. The policy is tried on FMUs with random masses, lengths and friction, and then runs on
cells of the simulated lab, whose friction, noise and delays it has not seen, in real time: 11 s for
each seed. `--fast` moves the lab's time by hand. Written is a plot of both trajectories.

The environment is the same on both sides, but for its `backend`. For a cell of the real lab make it
with `backend=cloudpendulumclient.client.Client(), user_token="..."`.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy.linalg import expm, solve_discrete_are

import fmugym
from fmugym.lab import CellType, Lab, ManualClock

ENV = "fmugym/CloudPendulum-v0"
PERIOD = 0.02  # s, from one sample to the next
STEPS = 500
TORQUE_LIMIT = 0.15  # N m, of an action of 1
SWING_TORQUE = 0.03  # N m; the weight of the horizontal pendulum is 0.059 N m
ENERGY_GAIN = 4.0  # N m/J: full swing torque but for the last 7.5 mJ of 118
CATCH = 0.7  # rad from upright, where balancing begins
AT_REST = 0.3  # rad/s; slower than that the velocity's sign says nothing
UPRIGHT = 10.0  # degrees, the largest angle that counts as upright
LAST = round(3.0 / PERIOD)  # samples that count

RANDOMIZED = {
    "m": fmugym.Uniform(0.048, 0.072),  # kg, +- 20 %
    "l": fmugym.Uniform(0.09, 0.11),  # m, +- 10 %
    "b": fmugym.LogUniform(1e-4, 1e-3),  # N m s/rad
    "c": fmugym.Uniform(0.0, 0.006),  # N m
}

Array = NDArray[np.float64]


def delayed_lqr(model: fmugym.LinearModel) -> Array:
    """Return the gains of angle, velocity and the torque that is still to come.

    What is computed from a sample acts one period later, so the torque on its way is a third state.
    """
    continuous = np.zeros((3, 3))
    continuous[:2] = np.hstack([model.A, model.B])
    a = expm(continuous * PERIOD)  # x and the torque over a period, with the torque held
    a[2] = 0.0  # after which the new torque takes its place
    b = np.array([[0.0], [0.0], [1.0]])
    q, r = np.diag([1.0, 0.01, 0.0]), 100.0  # 1 rad is as bad as 10 rad/s and 0.1 N m
    p = solve_discrete_are(a, b, q, [[r]])
    return np.linalg.solve(r + b.T @ p @ b, b.T @ p @ a)[0]


class Policy:
    """Energy shaping far from the top, LQR near it; one for each episode.

    Args:
        model: The upright pendulum, whose states are the angle from upright and its velocity.
    """

    def __init__(self, model: fmugym.LinearModel) -> None:
        self.gravity = model.A[1, 0]  # 1/s^2, g / l
        self.inertia = 1 / model.B[1, 0]  # kg m^2
        self.gains = delayed_lqr(model)
        self.torque = np.zeros(())  # N m, on its way

    def __call__(self, observation: NDArray[np.float32]) -> NDArray[np.float32]:
        """The action for an observation (cos q, sin q, velocity), or actions for rows of them."""
        cosine, sine, velocity = np.asarray(observation, float).T
        angle = np.arctan2(-sine, -cosine)
        near = np.abs(angle) < CATCH
        limit = np.where(near, TORQUE_LIMIT, SWING_TORQUE)
        torque = np.where(near, self.balance(angle, velocity), self.swing(cosine, sine, velocity))
        self.torque = np.clip(torque, -limit, limit)
        return (self.torque[..., np.newaxis] / TORQUE_LIMIT).astype(np.float32)

    def balance(self, angle: Array, velocity: Array) -> Array:
        """Linear feedback of the angle from upright."""
        of_angle, of_velocity, of_torque = self.gains
        return -(of_angle * angle + of_velocity * velocity + of_torque * self.torque)

    def swing(self, cosine: Array, sine: Array, velocity: Array) -> Array:
        """Push along with the motion, in proportion to the energy that is missing."""
        missing = self.inertia * (self.gravity * (1 + cosine) - velocity**2 / 2)  # J
        motion = np.where(np.abs(velocity) > AT_REST, velocity, -sine)  # at rest: what comes next
        return ENERGY_GAIN * missing * np.copysign(1.0, motion)


def play(env: Any, model: fmugym.LinearModel, seed: int) -> Array:
    """Play an episode; return q, velocity and torque, (3, steps), or (3, steps, envs)."""
    policy, rows = Policy(model), []
    observation, _ = env.reset(seed=seed)
    for _ in range(STEPS):
        cosine, sine, velocity = observation.T
        torque = np.broadcast_to(policy.torque, velocity.shape)
        rows.append([np.arctan2(sine, cosine), velocity, torque])
        observation, _, terminated, truncated, _ = env.step(policy(observation))
        if np.all(terminated | truncated):
            break
    env.close()
    return np.array(rows).swapaxes(0, 1)


def play_on_lab(
    model: fmugym.LinearModel,
    seed: int,
    fast: bool = False,
    plant: Mapping[str, float] | None = None,
    **options: Any,
) -> Array:
    """Play an episode on a cell of a lab of its own.

    Args:
        model: For the policy.
        seed: Of the lab's friction, noise and delays, and of the start.
        fast: Whether the lab's time is moved by hand.
        plant: Parameters of the cell's FMU.
        options: Options of the lab that are not to be those of the preset `hardware`.
    """
    clock, parameters = ManualClock() if fast else None, {CellType.SINGLE: plant or {}}
    with Lab("hardware", clock=clock, seed=seed, parameters=parameters, **options) as lab:
        return play(gymnasium.make(ENV, backend=lab), model, seed)


def worst_angles(q: Array) -> Array:
    """The largest angles from upright in the last 3 s, in degrees; 180 if the episode broke off."""
    if len(q) < STEPS:
        return np.full(q.shape[1:], 180.0)
    return np.degrees(np.pi - np.abs(q[-LAST:])).max(axis=0)


def plot(randomized: Array, simulated: Array, measured: Array) -> Figure:
    """Draw the trajectories, turned so that all of them end at +180 degrees."""
    figure = Figure(figsize=(7, 4.5), layout="constrained")
    axes = figure.subplots(2, 1, sharex=True)
    many = {"color": "0.75", "linewidth": 0.5}
    curves = [("random FMUs", randomized, many), ("FMU", simulated, {}), ("lab", measured, {})]
    for label, (q, _, torque), style in curves:
        seconds, q = np.arange(len(q)) * PERIOD, np.unwrap(q, axis=0)
        side = np.sign(q[-1])
        lines = axes[0].plot(seconds, side * np.degrees(q), **style)
        lines[0].set_label(label)
        axes[1].plot(seconds, side * 1e3 * torque, **style)
    axes[0].axhspan(180 - UPRIGHT, 180 + UPRIGHT, xmin=0.7, color="tab:green", alpha=0.2)
    axes[0].set(ylabel="angle [degrees]", title="One policy on the FMU and in the lab")
    axes[1].set(ylabel="torque [mN m]", xlabel="time [s]", xlim=(0, STEPS * PERIOD))
    axes[0].legend(loc="lower right")
    return figure


def main(arguments: Sequence[str] | None = None) -> None:
    """Design, try on FMUs, run on the lab, plot."""
    parser = argparse.ArgumentParser(description="Swing up a pendulum of the lab.")
    parser.add_argument("--seeds", type=int, default=10, metavar="N", help="number of labs")
    parser.add_argument("--envs", type=int, default=256, metavar="N", help="number of random FMUs")
    parser.add_argument("--fast", action="store_true", help="do not wait for real time")
    parser.add_argument("--output", type=Path, default=Path("pendulum_sim_to_lab.png"))
    options = parser.parse_args(arguments)

    model = fmugym.linearize(fmugym.bundled_fmu("Pendulum"))  # which starts upright
    simulated = play(gymnasium.make(ENV), model, seed=0)
    many = gymnasium.make_vec(ENV, options.envs, model_parameters=RANDOMIZED)
    randomized = play(many, model, seed=0)
    upright = np.sum(worst_angles(randomized[0]) < UPRIGHT)
    print(f"random FMUs: upright in {upright} of {options.envs}")

    runs = []
    for seed in range(options.seeds):
        runs.append(play_on_lab(model, seed, options.fast))
        worst = worst_angles(runs[-1][0])
        print(f"lab, seed {seed}: within {worst:.2f} degrees of upright in the last 3 s")
    upright = sum(worst_angles(run[0]) < UPRIGHT for run in runs)
    print(f"lab: upright in {upright} of {options.seeds}")

    plot(randomized[:, :, :50], simulated, runs[0]).savefig(options.output, dpi=100)
    print(f"plot: {options.output}")


if __name__ == "__main__":
    main()
