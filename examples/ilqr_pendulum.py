"""Plan a swing-up by iterative LQR, with derivatives from the FMU, and follow the plan.

    python examples/ilqr_pendulum.py

Each iteration linearizes the trajectory by `linearize_along`, solves a linear-quadratic problem
backwards in time, and tries the new torques forwards with several lengths of step in one rollout
(Y. Tassa, T. Erez, E. Todorov, "Synthesis and stabilization of complex behaviors through online
trajectory optimization", IROS 2012). With its feedback, the plan suits a 5 % heavier pendulum, too.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure
from mpc_pendulum import PERIOD, PLANT, TORQUE, Array, SwingUp

import fmugym
from fmugym.linearization import linearize_along

HORIZON = 80  # steps of 50 ms
EFFORT = 1.0  # the weight of the torque squared
END = 30.0  # how much more the end of the plan counts
LENGTHS = 0.6 ** np.arange(12)  # of the steps that an iteration tries


class Plan(NamedTuple):
    """States (H + 1, 2), torques (H, 1), gains (H, 1, 2), and the costs of all iterations."""

    states: Array
    torques: Array
    gains: Array
    costs: list[float]


def cost(states: Array, torques: Array) -> Array:
    """Of trajectories, shapes (..., H + 1, 2) and (..., H, 1); an angle of 0 is upright."""
    each = 4 * (1 - np.cos(states[..., 0])) + 0.1 * states[..., 1] ** 2
    effort = EFFORT * np.sum(torques[..., 0] ** 2, -1)
    return np.asarray(each.sum(-1) + END * each[..., -1] + effort)


def backward(along: Any, torques: Array) -> tuple[Array, Array]:
    """The changes of the torques and the gains that minimize the quadratic model of the cost."""
    angles, velocities = along.x.T
    slope = np.stack([4 * np.sin(angles), 0.2 * velocities], axis=1)
    bend = np.stack([4 * np.maximum(np.cos(angles), 0.1), np.full_like(angles, 0.2)], axis=1)
    v, w = (1 + END) * slope[-1], (1 + END) * np.diag(bend[-1])  # of the cost still to come
    changes, gains = np.zeros_like(torques), np.zeros((len(torques), 1, 2))
    for k in reversed(range(len(torques))):
        a, b = along.A[k], along.B[k]
        by_u = 2 * EFFORT * torques[k] + b.T @ v
        by_uu, by_ux = 2 * EFFORT + b.T @ w @ b, b.T @ w @ a
        wanted = torques[k] - by_u / by_uu[0]
        changes[k] = np.clip(wanted, -TORQUE, TORQUE) - torques[k]
        free = abs(wanted[0]) < TORQUE  # at a limit, the torque does not follow the state
        gains[k] = -by_ux / by_uu * free
        v = slope[k] + a.T @ v + gains[k].T @ (by_uu @ changes[k] + by_u) + by_ux.T @ changes[k]
        w = np.diag(bend[k]) + a.T @ w @ a + gains[k].T @ by_uu @ gains[k]
        w = w + gains[k].T @ by_ux + by_ux.T @ gains[k]
    return changes, gains


def forward(envs: Any, here: Any, plan: Plan, changes: Array, gains: Array) -> tuple[Array, Array]:
    """Try the changes with all lengths of step; returns states and torques of each."""
    tried = []

    def policy(observations: Array) -> Array:
        k = len(tried)
        torques = plan.torques[k] + (observations - plan.states[k]) @ gains[k].T
        torques += LENGTHS[:, None] * changes[k]
        tried.append(np.clip(torques, -TORQUE, TORQUE).astype(np.float32))
        return tried[-1]

    found = envs.rollout(here, policy, horizon=len(changes)).observations
    first = np.tile(plan.states[:1], (len(LENGTHS), 1, 1))
    return np.concatenate([first, found], axis=1), np.stack(tried, axis=1)


def optimize(iterations: int = 80, seed: int = 0) -> Plan:
    """Improve small random torques until the cost no longer falls."""
    envs = fmugym.FMUVectorEnv(SwingUp, len(LENGTHS))
    envs.reset(seed=0)
    here = envs.save_state(0)
    torques = np.random.default_rng(seed).normal(0, 0.1, (HORIZON, 1))
    x = linearize_along(envs, here, torques).x
    plan = Plan(x, torques, np.zeros((HORIZON, 1, 2)), [float(cost(x, torques))])
    for _ in range(iterations):
        along = linearize_along(envs, here, plan.torques)
        changes, gains = backward(along, plan.torques)
        states, tried = forward(envs, here, plan, changes, gains)
        costs = cost(states, tried)
        best = costs.argmin()
        if costs[best] > plan.costs[-1] * (1 - 1e-5):
            break
        plan = Plan(states[best], tried[best], gains, [*plan.costs, float(costs[best])])
    envs.close()
    return plan


def follow(plan: Plan, feedback: bool, mass: float) -> Array:
    """Apply a plan to a pendulum; returns its angles."""
    angles = []
    with SwingUp() as env:
        state, _ = env.reset(options={"model_parameters": {"m": mass}})
        for x, torque, gain in zip(plan.states, plan.torques, plan.gains, strict=False):
            torque = torque + feedback * (gain @ (state - x))
            state = env.step(np.clip(torque, -TORQUE, TORQUE).astype(np.float32))[0]
            angles.append(state[0])
    return np.degrees(angles)


def plot(plan: Plan, heavier: dict[str, Array]) -> Figure:
    """Draw the plan, and what comes of it."""
    figure, seconds = Figure(figsize=(7, 5), layout="constrained"), PERIOD * np.arange(HORIZON + 1)
    angle, torque = figure.subplots(2, 1, height_ratios=[2, 1])
    angle.plot(seconds, np.degrees(plan.states[:, 0]), color="k", lw=2, label="plan")
    for name, angles in heavier.items():
        angle.plot(seconds[1:], angles, label=f"5 % heavier, {name}")
    angle.set(ylabel="angle from upright [degrees]", xlim=(0, seconds[-1]))
    angle.set_title("A swing-up planned by iterative LQR")
    angle.legend()
    torque.step(seconds[:-1], plan.torques[:, 0], where="post", color="k")
    torque.set(ylabel="torque [N m]", xlabel="time [s]", xlim=(0, seconds[-1]))
    return figure


def main(arguments: Sequence[str] | None = None) -> None:
    """Plan, follow, and plot."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--iterations", type=int, default=80, metavar="N", help="at the most")
    parser.add_argument("--output", type=Path, default=Path("ilqr_pendulum.png"))
    options = parser.parse_args(arguments)
    plan = optimize(options.iterations)
    print(f"cost {plan.costs[0]:.0f}, after {len(plan.costs) - 1} iterations {plan.costs[-1]:.1f}")
    mass, ways = 1.05 * PLANT["m"], {"only the torques": False, "feedback": True}
    heavier = {name: follow(plan, way, mass) for name, way in ways.items()}
    for name, angles in heavier.items():
        print(f"5 % heavier, {name}: it ends {abs(angles[-1]):.1f} degrees from upright")
    plot(plan, heavier).savefig(options.output, dpi=100)
    print(f"plot: {options.output}")


if __name__ == "__main__":
    main()
