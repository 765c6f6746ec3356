"""Swing the pendulum up by its energy and catch it near the top.

The torque of 2 N m cannot lift the rod directly. Away from the top, the torque drives the energy
towards that of the upright rod at rest (K. J. Astrom and K. Furuta, "Swinging up a pendulum by
energy control", Automatica 36, 2000). Near the top, the torque is strong enough and a linear
feedback takes over. Run the program with `--render` to watch.
"""

from __future__ import annotations

import argparse
import math
from dataclasses import dataclass
from typing import Any

import gymnasium
import numpy as np
import numpy.typing as npt

import fmugym  # noqa: F401  (registers the environment)

# The plant of Gymnasium's Pendulum-v1: a uniform rod that turns about its end.
MASS, LENGTH, GRAVITY = 1.0, 1.0, 10.0  # kg, m, m/s^2
LARGEST_TORQUE = 2.0  # N m
INERTIA = MASS * LENGTH**2 / 3  # kg m^2, about the end
WEIGHT_MOMENT = MASS * GRAVITY * LENGTH / 2  # N m, of the horizontal rod
UNSTABLE_RATE = math.sqrt(WEIGHT_MOMENT / INERTIA)  # 1/s, at which the upright rod falls

CATCH = 0.9 * LARGEST_TORQUE / WEIGHT_MOMENT  # rad; with a factor of 1, no torque stops the fall
CATCH_GAIN = 2.0 * WEIGHT_MOMENT  # N m/rad; one WEIGHT_MOMENT would only balance the weight
ENERGY_GAIN = 5.0  # N m/J: full torque except for the last 0.4 J
UPRIGHT = 0.05  # rad, largest angle that counts as upright


def torque(observation: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    """Return the action for an observation (cos theta, sin theta, theta_dot).

    Near the top, the rod falls along theta + theta_dot / UNSTABLE_RATE. The feedback uses this sum
    only, because the other mode of the linearized rod decays by itself.
    """
    cosine, sine, velocity = map(float, observation)
    angle = math.atan2(sine, cosine)
    unstable_mode = angle + velocity / UNSTABLE_RATE
    if abs(angle) < 1.0 and abs(unstable_mode) < CATCH:
        wanted = -CATCH_GAIN * unstable_mode
    else:
        energy = 0.5 * INERTIA * velocity**2 + WEIGHT_MOMENT * (cosine - 1.0)  # 0 at the top
        wanted = -ENERGY_GAIN * energy * math.copysign(1.0, velocity)
    return np.clip([wanted], -LARGEST_TORQUE, LARGEST_TORQUE).astype(np.float32)


@dataclass(frozen=True)
class Episode:
    """The return, the number of steps, and the number of steps at the end that were all upright."""

    total_reward: float
    steps: int
    upright_steps: int


def run_episode(env: gymnasium.Env[Any, Any], seed: int) -> Episode:
    """Run one episode with the controller."""
    observation, _ = env.reset(seed=seed)
    total_reward, steps, upright_steps, ended = 0.0, 0, 0, False
    while not ended:
        observation, reward, terminated, truncated, _ = env.step(torque(observation))
        ended = terminated or truncated
        is_upright = abs(math.atan2(observation[1], observation[0])) < UPRIGHT
        upright_steps = upright_steps + 1 if is_upright else 0
        total_reward, steps = total_reward + float(reward), steps + 1
    return Episode(total_reward, steps, upright_steps)


def main() -> None:
    """Run the episodes and print their results."""
    parser = argparse.ArgumentParser(description="Swing the pendulum up and hold it upright.")
    parser.add_argument("--seeds", type=int, default=10, metavar="N", help="number of episodes")
    parser.add_argument("--render", action="store_true", help="show a window")
    arguments = parser.parse_args()
    env = gymnasium.make("fmugym/Pendulum-v0", render_mode="human" if arguments.render else None)
    episodes = [run_episode(env, seed) for seed in range(arguments.seeds)]
    env.close()
    for seed, episode in enumerate(episodes):
        print(
            f"seed {seed:3d}: return {episode.total_reward:8.1f}, "
            f"upright for the last {episode.upright_steps} of {episode.steps} steps"
        )
    held = sum(episode.upright_steps > 0 for episode in episodes)
    mean = np.mean([episode.total_reward for episode in episodes])
    print(f"upright to the end in {held} of {len(episodes)} episodes, mean return {mean:.1f}")


if __name__ == "__main__":
    main()
