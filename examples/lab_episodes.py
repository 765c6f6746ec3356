"""Learn on one cell of the simulated lab, episode after episode under one lease.

A torque of 0.03 N m cannot lift the pendulum, so it has to swing up. The policy pushes along with
the motion, and the program looks for the best gain: it keeps a change only if the pendulum swings
higher. The cell stays reserved between two episodes. This takes 45 s in real time; with `--fast`,
the program advances the lab's clock itself.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from typing import Any

import numpy as np

from fmugym.lab import CellType, Client, Lab, ManualClock

EPISODES = 10
EPISODE_TIME = 3.0  # s
PERIOD = 0.02  # s
TORQUE = 0.03  # N m


def run_episode(client: Client, token: str, gain: float, clock: Any) -> float:
    """Push for an episode with a torque of `gain` N m s/rad; return the mean height in rods."""
    heights = []
    client.set_torque(TORQUE, token)  # the first push
    start = clock.time()
    for tick in range(1, round(EPISODE_TIME / PERIOD) - 1):
        clock.sleep(max(0.0, start + tick * PERIOD - clock.time()))
        position, velocity = client.get_position(token), client.get_velocity(token)
        heights.append(1.0 - np.cos(position))
        if tick > 5:
            client.set_torque(float(np.clip(gain * velocity, -TORQUE, TORQUE)), token)
    return float(np.mean(heights))


def learn(user_token: str, seed: int, clock: Any = time) -> list[float]:
    """Search for the best gain.

    Args:
        user_token: Your token.
        seed: Seed of the changes to try.
        clock: Gives the time and sleeps: `time`, or the lab's clock.

    Returns:
        The mean height of each episode, in rods.
    """
    client, rng = Client(), np.random.default_rng(seed)
    gym_token = client.start_gym(user_token, 120, [CellType.SINGLE])
    gain, best, heights = 0.001, -np.inf, []
    for episode in range(EPISODES):
        candidate = gain * np.exp(0.5 * rng.standard_normal()) if episode else gain
        token, _ = client.start_episode(gym_token, "SimplePendulum", EPISODE_TIME)
        try:
            heights.append(run_episode(client, token, candidate, clock))
        except RuntimeError as error:  # it went over the top, and the lab ended the episode
            print(str(error).partition(";")[0])
            heights.append(0.0)
        client.stop_episode(token)
        if heights[-1] > best:
            gain, best = candidate, heights[-1]
        print(f"episode {episode}: gain {1e3 * candidate:.2f} mN m s/rad, {heights[-1]:.3f} rods")
    client.stop_gym(gym_token)
    return heights


def main(arguments: Sequence[str] | None = None) -> None:
    """Learn, and print the result."""
    parser = argparse.ArgumentParser(description="Learn to swing the lab's pendulum up.")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--fast", action="store_true", help="do not wait for real time")
    options = parser.parse_args(arguments)
    clock = ManualClock() if options.fast else None
    with Lab(clock=clock, seed=options.seed):
        heights = learn("my token", options.seed, clock or time)
    print(f"mean height {heights[0]:.3f} rods at first, {max(heights):.3f} at best")


if __name__ == "__main__":
    main()
