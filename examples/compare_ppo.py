"""How long does PPO need for the cart-pole: ppo.py beside Stable-Baselines3's.

    pip install -e ".[examples,sb3]"
    python examples/compare_ppo.py

Each trains from the same seeds on the FMU and on Gymnasium's own environment, with one thread. Now
and then 100 episodes are played without exploration; the training ends when their mean is 485 or
more. The table is of 100 other episodes, of which a mean of 475 counts as solved. The times are
those of the trainings, with these trials and without imports.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from time import perf_counter, process_time
from typing import Any

import gymnasium as gym
import numpy as np
import ppo
import torch
from rich.console import Console
from rich.table import Table
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env
from train_sb3 import STUDIES

from fmugym.sb3 import make_sb3_env

SIDES = STUDIES["ppo"].ids
TARGET, SOLVED = 485.0, 475.0
STEPS_BETWEEN_TRIALS = 10_240


@dataclass(frozen=True)
class Result:
    """What a training has come to.

    Attributes:
        mean: The mean return of 100 episodes that had no part in it.
        steps: The steps of all environments.
        cpu: The processor's time in s.
        wall: The time in s.
    """

    mean: float
    steps: int
    cpu: float
    wall: float


def train_ours(env_id: str, seed: int, most_steps: int) -> tuple[Any, int]:
    """Train ppo.py's agent; return it and its steps."""
    done = 0

    def note(steps: int, *_: Any) -> None:
        nonlocal done
        done = steps

    return ppo.train(ppo.Settings(env_id, seed, most_steps, TARGET), note), done


class Trained:
    """A model of Stable-Baselines3 as ppo.py's agents are."""

    def __init__(self, model: Any) -> None:
        self._model = model

    def act(self, observations: Any) -> Any:
        """The best actions."""
        return self._model.predict(observations, deterministic=True)[0]


def train_sb3(env_id: str, seed: int, most_steps: int) -> tuple[Any, int]:
    """Train Stable-Baselines3's, with the settings of train_sb3.py."""
    study, make = STUDIES["ppo"], make_sb3_env if env_id.startswith("fmugym") else make_vec_env
    envs, judges = make(env_id, study.num_envs, seed=seed), gym.make_vec(env_id, 100)
    model = PPO("MlpPolicy", envs, seed=seed, device="cpu", **study.settings)
    due = STEPS_BETWEEN_TRIALS

    def go_on(names: Any, _: Any) -> bool:
        nonlocal due
        if model.num_timesteps < due:
            return True
        due += STEPS_BETWEEN_TRIALS
        return bool(ppo.evaluate(Trained(model), judges, ppo.HELD_OUT_SEED).mean() < TARGET)

    model.learn(most_steps, callback=go_on)
    envs.close()
    judges.close()
    return Trained(model), model.num_timesteps


def measured(train: Callable[..., tuple[Any, int]], env_id: str, seed: int, steps: int) -> Result:
    """Train one agent, and let it play."""
    wall, cpu = perf_counter(), process_time()
    agent, steps = train(env_id, seed, steps)
    wall, cpu = perf_counter() - wall, process_time() - cpu
    envs = gym.make_vec(env_id, 100)
    mean = ppo.evaluate(agent, envs, ppo.HELD_OUT_SEED + 100).mean()
    envs.close()
    return Result(float(mean), steps, cpu, wall)


def row(results: Sequence[Result]) -> list[str]:
    """The cells of the table for all seeds."""
    means = np.array([result.mean for result in results])
    cpu, wall = ([getattr(result, name) for result in results] for name in ("cpu", "wall"))
    return [
        f"{means.mean():.1f}",
        f"{means.min():.1f}",
        f"{np.sum(means >= SOLVED)} of {len(means)}",
        f"{np.mean([result.steps for result in results]):,.0f}",
        f"{np.mean(cpu):.1f} s",
        f"{max(cpu):.1f} s",
        f"{np.mean(wall):.1f} s",
    ]


def main(arguments: Sequence[str] | None = None) -> None:
    """Train everything in turn and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--steps", type=int, default=300_000, help="at most; default 300000")
    options = parser.parse_args(arguments)
    torch.set_num_threads(1)
    table = Table("", "Trained on", "Mean", "Worst seed", "Solved", "Steps", "CPU", "Most", "Wall")
    trainers = {"ppo.py": train_ours, "Stable-Baselines3": train_sb3}
    cases = [(name, side) for name in trainers for side in SIDES]
    found: dict[Any, list[Result]] = {case: [] for case in cases}
    for seed in range(options.seeds):
        for name, side in cases:  # in turn, so that what else the machine does hits all alike
            result = measured(trainers[name], SIDES[side], seed, options.steps)
            found[name, side].append(result)
    for (name, side), results in found.items():
        table.add_row(name, side, *row(results))
    Console(width=110).print(table)


if __name__ == "__main__":
    main()
