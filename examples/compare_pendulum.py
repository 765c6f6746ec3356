"""Compare random torques, PID, LQR, a trained agent and MPC on one pendulum.

    python examples/compare_pendulum.py

All of them control the rod of mpc_pendulum.py in the same ten episodes of 10 s: five begin within
10 degrees of the upright position, five hanging. The agent is a small policy with six weights. The
cross-entropy method trains it in a few seconds (P.-T. de Boer et al., "A Tutorial on the
Cross-Entropy Method", Annals of Operations Research 134, 2005): each generation is one rollout, in
which every environment follows weights of its own.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from lqr_pendulum import regulator, start
from matplotlib.figure import Figure
from mpc_pendulum import PERIOD, TORQUE, Array, SwingUp, planner

import fmugym
from fmugym.baselines import PID, Random

STEPS, NEAR = 200, 10.0  # of 50 ms; how many degrees off still count as upright
STARTS = np.array([-9.0, -5.0, 2.0, 4.0, 8.0, 171.0, 177.0, 180.0, 185.0, 190.0])  # degrees
LESSONS = np.array([180.0, 165.0, 100.0, 10.0])  # where training begins, give or take 10 degrees
STYLES = {"random": "C7", "PID": "C0-", "LQR": "C1--", "agent": "C2", "MPC": "C3"}
TRIED, KEPT = 64, 10  # weights of a generation, and how many of these make the next one
Act = Callable[[Array], Array]


class Score(NamedTuple):
    """Angles from upright in degrees (steps, n), rewards (steps, n), ms for a decision."""

    angles: Array
    rewards: Array
    ms: float

    @property
    def upright(self) -> Array:
        """The share of the last 3 s in which each pendulum is upright."""
        return np.asarray(np.mean(self.angles[-60:] < NEAR, axis=0))


def wrapped(observations: Array) -> Array:
    """The observations with angles between -pi and pi."""
    angles = (observations[:, 0] + np.pi) % (2 * np.pi) - np.pi
    return np.column_stack([angles, observations[:, 1]])


def policy(weights: Array, observations: Array) -> Array:
    """The torques for weights of shape (n, 6): tanh of a weighted sum of products."""
    angle, velocity = observations.T
    v, c, s = velocity / 5, np.cos(angle), np.sin(angle)
    seen = np.stack([s, v, s * c, v * c, v * s**2, v**3], axis=1)
    return (TORQUE * np.tanh(np.sum(weights * seen, axis=1)))[:, None].astype(np.float32)


def train(generations: int, seed: int = 0) -> tuple[Array, list[float]]:
    """Returns the weights, and the mean return of each generation."""
    rng, returns = np.random.default_rng(seed), []
    envs = fmugym.FMUVectorEnv(SwingUp, TRIED * len(LESSONS))
    mean, spread = np.zeros(6), np.full(6, 3.0)
    for _ in range(generations):
        start(envs, np.tile(LESSONS + rng.uniform(-10, 10, len(LESSONS)), TRIED))
        tried = mean + spread * rng.normal(size=(TRIED, 6))
        each = np.repeat(tried, len(LESSONS), axis=0)
        found = envs.rollout(None, lambda seen, each=each: policy(each, seen), horizon=140)
        totals = found.rewards.sum(axis=1).reshape(TRIED, -1).mean(axis=1)
        best = tried[totals.argsort()[-KEPT:]]
        mean, spread = best.mean(axis=0), 0.7 * best.std(axis=0) + 0.3 * spread
        returns.append(float(totals.mean()))
    envs.close()
    return mean, returns


def play(make: Callable[[fmugym.FMUVectorEnv], Act]) -> Score:
    """Play all episodes with a controller, which is made for the environments."""
    envs, rows = fmugym.FMUVectorEnv(SwingUp, len(STARTS)), []
    act, observations = make(envs), start(envs, STARTS)
    begin = time.perf_counter()
    for _ in range(STEPS):
        observations, rewards, *_ = envs.step(act(wrapped(observations)))
        rows.append((np.degrees(np.abs(wrapped(observations)[:, 0])), rewards))
    ms = 1e3 * (time.perf_counter() - begin) / STEPS / len(STARTS)
    envs.close()
    return Score(*np.swapaxes(rows, 0, 1), ms)


def plot(scores: dict[str, Score], returns: list[float]) -> Figure:
    """Draw an episode from below of each controller, and how the agent was trained."""
    figure = Figure(figsize=(7, 6), layout="constrained")
    angle, training = figure.subplots(2, 1, height_ratios=[2, 1])
    for name, score in scores.items():
        angle.plot(PERIOD * np.arange(1, STEPS + 1), score.angles[:, -1], STYLES[name], label=name)
    angle.set(ylabel="off upright [degrees]", xlabel="time [s]", xlim=(0, STEPS * PERIOD))
    angle.set_title("Controllers of a pendulum that begins hanging")
    angle.legend(loc="center right")
    training.plot(np.arange(1, len(returns) + 1), returns)
    training.set(xlabel="generation of the training", ylabel="mean return")
    return figure


def main(arguments: Sequence[str] | None = None) -> None:
    """Train, play, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--generations", type=int, default=40, metavar="N")
    parser.add_argument("--candidates", type=int, default=512, metavar="N", help="of the MPC")
    parser.add_argument("--output", type=Path, default=Path("compare_pendulum.png"))
    options = parser.parse_args(arguments)
    begin = time.perf_counter()
    weights, returns = train(options.generations)
    print(f"trained in {time.perf_counter() - begin:.1f} s")
    controllers: dict[str, Callable[[fmugym.FMUVectorEnv], Act]] = {
        "random": lambda envs: Random(0).bind(envs).act,
        "PID": lambda envs: PID("theta", 0.0, kp=8.0, ti=10.0, td=0.25).bind(envs).act,
        "LQR": lambda envs: regulator(envs).act,
        "agent": lambda envs: partial(policy, weights),
        "MPC": lambda envs: planner(options.candidates).bind(envs).act,
    }
    scores = {name: play(make) for name, make in controllers.items()}
    print("controller  upright at the end, from above  from below  mean return  ms a decision")
    for name, score in scores.items():
        above, below = score.upright[:5].mean(), score.upright[5:].mean()
        total = score.rewards.sum(axis=0).mean()
        print(f"{name:10}  {above:31.0%}  {below:10.0%}  {total:11.0f}  {score.ms:13.2f}")
    plot(scores, returns).savefig(options.output, dpi=100)
    print(f"plot: {options.output}")


if __name__ == "__main__":
    main()
