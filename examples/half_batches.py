"""Let the FMUs step while the learner computes, with two half batches of environments.

A policy needs observations before it can choose actions. So one vector environment cannot step
while the learner works on its latest observations. Two halves can: while the FMUs of one half step,
the learner works on the other half.

    python examples/half_batches.py

searches for a policy that swings the pendulum up: each environment tries a policy of its own from
the same start, and the next policies are drawn around the best ones (R. Y. Rubinstein, "The
Cross-Entropy Method for Combinatorial and Continuous Optimization", 1999). The result does not
depend on how fast the FMUs or the learner are.

    python examples/half_batches.py --compare --max-step 1e-4

also prints how much faster the halves are than the same steps without overlap. It pays where the
FMUs take about as long as the learner, and a second core is free. Without ``--max-step``, the FMUs
are so fast that handing a step to another thread takes longer.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np
import numpy.typing as npt

import fmugym  # noqa: F401  (registers the environment)

Array = npt.NDArray[np.float64]

STEPS = 200  # of an episode
FEATURES = 4  # cos theta, sin theta, theta_dot, and the push at the bottom


def features(observations: npt.NDArray[np.float32]) -> Array:
    """Return what a policy weighs, shape (N, 4); energy is pumped in where the rod hangs."""
    cosine, sine, velocity = observations.T.astype(np.float64)
    return np.stack([cosine, sine, velocity, np.where(cosine < 0.0, np.sign(velocity), 0.0)], 1)


class Half:
    """Half of the environments, each with the weights of a policy of its own.

    Args:
        num_envs: Their number.
        max_step: The longest internal step of the FMU in s; None for that of the environment.

    Attributes:
        overlaps: Whether the FMUs step while the other half learns.
    """

    overlaps = True

    def __init__(self, num_envs: int, max_step: float | None = None) -> None:
        options: dict[str, Any] = {"threads": 1}
        if max_step is not None:
            options["model_parameters"] = {"max_step": max_step}
        self.envs = gymnasium.make_vec("fmugym/Pendulum-v0", num_envs=num_envs, **options)

    def begin(self, weights: Array, seed: int) -> None:
        """Start an episode of each environment, all in the same state, and its first step."""
        self._weights, self.returns = weights, np.zeros(len(weights))
        observations, _ = self.envs.reset(seed=[seed] * len(weights))
        self._act(observations)

    def go_on(self) -> None:
        """Take the result of a step, and begin the next one."""
        self._act(self._taken())

    def finish(self) -> None:
        """Take the result of the last step."""
        self._taken()

    def _act(self, observations: npt.NDArray[np.float32]) -> None:
        torques = np.sum(self._weights * features(observations), axis=1, keepdims=True)
        self._actions = np.clip(torques, -2.0, 2.0).astype(np.float32)
        if self.overlaps:
            self.envs.step_async(self._actions)

    def _taken(self) -> npt.NDArray[np.float32]:
        result = self.envs.step_wait() if self.overlaps else self.envs.step(self._actions)
        observations, rewards, *_ = result
        self.returns += rewards
        taken: npt.NDArray[np.float32] = observations
        return taken


def evaluate(halves: Sequence[Half], weights: Array, seed: int) -> Array:
    """Return the return of each policy; the halves step in turn."""
    for half, part in zip(halves, np.split(weights, len(halves)), strict=True):
        half.begin(part, seed)
    for _ in range(STEPS - 1):
        for half in halves:  # while this one takes its result, the others step
            half.go_on()
    for half in halves:
        half.finish()
    return np.concatenate([half.returns for half in halves])


def compare(halves: Sequence[Half], rounds: int = 5) -> float:
    """Return how much faster the halves are with overlap than without; the best of some rounds."""
    weights = np.zeros((sum(half.envs.num_envs for half in halves), FEATURES))
    best = {True: np.inf, False: np.inf}
    for _ in range(rounds):
        for overlaps in best:
            for half in halves:
                half.overlaps = overlaps
            begin = time.perf_counter()
            evaluate(halves, weights, 0)
            best[overlaps] = min(best[overlaps], time.perf_counter() - begin)
    return best[False] / best[True]


def search(halves: Sequence[Half], rounds: int, seed: int) -> Array:
    """Search for weights, and print the mean return of the best tenth in each round."""
    num_envs = sum(half.envs.num_envs for half in halves)
    rng = np.random.default_rng(seed)
    mean, spread = np.zeros(FEATURES), np.full(FEATURES, 5.0)
    for number in range(rounds):
        weights = rng.normal(mean, spread, (num_envs, FEATURES))
        returns = evaluate(halves, weights, seed + number)
        best = np.argsort(returns)[-max(2, num_envs // 10) :]
        mean, spread = weights[best].mean(axis=0), weights[best].std(axis=0) + 0.1
        print(f"round {number + 1:2}: mean return of the best tenth {returns[best].mean():7.1f}")
    return mean


def main() -> None:
    """Search, and print the weights."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--num-envs", type=int, default=200)
    parser.add_argument("--rounds", type=int, default=10)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--max-step", type=float, help="of the FMU, in s")
    parser.add_argument("--compare", action="store_true", help="measure without overlap, too")
    arguments = parser.parse_args()
    halves = [Half(arguments.num_envs // 2, arguments.max_step) for _ in range(2)]
    weights = search(halves, arguments.rounds, arguments.seed)
    print("weights:", " ".join(f"{weight:.2f}" for weight in weights))
    if arguments.compare:
        print(f"{compare(halves):.2f} times the rate without overlap")
    for half in halves:
        half.envs.close()


if __name__ == "__main__":
    main()
