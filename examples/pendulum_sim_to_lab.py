"""From simulation to the lab: swing a pendulum up with a policy computed from the FMU alone.

    pip install -e ".[examples,identification]"
    python examples/pendulum_sim_to_lab.py

The policy pumps energy into the pendulum with 0.03 N m, which is too little to lift it directly.
Near the top, a linear-quadratic regulator (LQR) balances it. Both parts are computed from the FMU's
directional derivatives. The program first tries the policy on FMUs with random masses, lengths and
friction. Then it runs the policy on cells of the simulated lab, which have friction, noise and
delays that the policy has not seen. Each seed takes 11 s in real time; with `--fast`, the program
advances the lab's clock itself. It writes a plot of the trajectories on both sides.

Only the `backend` of the environment differs between the two sides. For a cell of the real lab, use
`backend=cloudpendulumclient.client.Client(), user_token="..."`.
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
from fmugym.control.linearization import LinearModel, linearize
from fmugym.lab import CellType, Client, Lab, ManualClock

ENV = "fmugym/CloudPendulum-v0"
PERIOD = 0.02  # s, from one sample to the next
STEPS = 500
TORQUE_LIMIT = 0.15  # N m, for an action of 1
SWING_TORQUE = 0.03  # N m; the weight of the horizontal pendulum is 0.059 N m
ENERGY_GAIN = 4.0  # N m/J: full swing torque except for the last 7.5 of 118 mJ
CATCH = 0.7  # rad from upright, where balancing begins
AT_REST = 0.3  # rad/s; below this, the sign of the velocity means nothing
UPRIGHT = 10.0  # degrees, the largest angle that counts as upright
LAST = round(3.0 / PERIOD)  # samples at the end that are judged

RANDOMIZED = {
    "m": fmugym.Uniform(0.048, 0.072),  # kg, +- 20 %
    "l": fmugym.Uniform(0.09, 0.11),  # m, +- 10 %
    "b": fmugym.LogUniform(1e-4, 1e-3),  # N m s/rad
    "c": fmugym.Uniform(0.0, 0.006),  # N m
}

Array = NDArray[np.float64]


def delayed_lqr(model: LinearModel) -> Array:
    """Return the gains for the angle, the velocity and the pending torque.

    A torque takes effect one period after the sample from which it was computed. The pending torque
    is therefore a third state.
    """
    continuous = np.zeros((3, 3))
    continuous[:2] = np.hstack([model.A, model.B])
    a = expm(continuous * PERIOD)  # the state after a period with a constant torque
    a[2] = 0.0  # then the new torque replaces the pending one
    b = np.array([[0.0], [0.0], [1.0]])
    q, r = np.diag([1.0, 0.01, 0.0]), 100.0  # 1 rad is as bad as 10 rad/s and 0.1 N m
    p = solve_discrete_are(a, b, q, [[r]])
    return np.linalg.solve(r + b.T @ p @ b, b.T @ p @ a)[0]


class Policy:
    """Energy shaping far from the top, LQR near it. Make a new policy for each episode.

    Args:
        model: The pendulum linearized upright; its states are the angle and the velocity.
    """

    def __init__(self, model: LinearModel) -> None:
        self.gravity = model.A[1, 0]  # 1/s^2, g / l
        self.inertia = 1 / model.B[1, 0]  # kg m^2
        self.gains = delayed_lqr(model)
        self.torque = np.zeros(())  # N m, pending

    def __call__(self, observation: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the action for an observation (cos q, sin q, velocity), or for rows of them."""
        cosine, sine, velocity = np.asarray(observation, float).T
        angle = np.arctan2(-sine, -cosine)
        near = np.abs(angle) < CATCH
        limit = np.where(near, TORQUE_LIMIT, SWING_TORQUE)
        torque = np.where(near, self.balance(angle, velocity), self.swing(cosine, sine, velocity))
        self.torque = np.clip(torque, -limit, limit)
        return (self.torque[..., np.newaxis] / TORQUE_LIMIT).astype(np.float32)

    def balance(self, angle: Array, velocity: Array) -> Array:
        """Return the torque of the linear feedback."""
        of_angle, of_velocity, of_torque = self.gains
        return -(of_angle * angle + of_velocity * velocity + of_torque * self.torque)

    def swing(self, cosine: Array, sine: Array, velocity: Array) -> Array:
        """Return a torque along the motion, proportional to the missing energy."""
        missing = self.inertia * (self.gravity * (1 + cosine) - velocity**2 / 2)  # J
        motion = np.where(np.abs(velocity) > AT_REST, velocity, -sine)  # at rest: where it falls
        return ENERGY_GAIN * missing * np.copysign(1.0, motion)


def play(env: Any, model: LinearModel, seed: int) -> Array:
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
    model: LinearModel,
    seed: int,
    fast: bool = False,
    plant: Mapping[str, float] | None = None,
    **options: Any,
) -> Array:
    """Play an episode on a cell of a new lab.

    Args:
        model: Model for the policy.
        seed: Seed of the lab's friction, noise and delays, and of the start.
        fast: Whether to advance the lab's clock instead of waiting.
        plant: Parameters of the cell's FMU.
        options: Options of the lab.
    """
    clock, parameters = ManualClock() if fast else None, {CellType.SINGLE: plant or {}}
    with Lab(clock=clock, seed=seed, parameters=parameters, **options):
        return play(gymnasium.make(ENV, backend=Client()), model, seed)


def worst_angles(q: Array) -> Array:
    """Return the largest angles from upright in the last 3 s [degrees]; 180 for a short episode."""
    if len(q) < STEPS:
        return np.full(q.shape[1:], 180.0)
    return np.degrees(np.pi - np.abs(q[-LAST:])).max(axis=0)


def plot(randomized: Array, simulated: Array, measured: Array) -> Figure:
    """Draw the trajectories, mirrored where needed so that all end at +180 degrees."""
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
    """Compute the policy, try it on FMUs, run it in the lab, and plot."""
    parser = argparse.ArgumentParser(description="Swing up a pendulum of the lab.")
    parser.add_argument("--seeds", type=int, default=10, metavar="N", help="number of labs")
    parser.add_argument("--envs", type=int, default=256, metavar="N", help="number of random FMUs")
    parser.add_argument("--fast", action="store_true", help="do not wait for real time")
    parser.add_argument("--output", type=Path, default=Path("pendulum_sim_to_lab.png"))
    options = parser.parse_args(arguments)

    model = linearize(fmugym.bundled_fmu("Pendulum"))  # which starts upright
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
