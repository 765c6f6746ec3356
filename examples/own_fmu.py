"""An environment for your own FMU: a file to copy.

The FMU is the bundled pendulum, 60 g on a rod of 10 cm. The task is to bring it to rest with a
torque that is too weak to hold it sideways. For your FMU, change the path, the names and the
hooks; `fmugym info your.fmu` lists the names.
"""

from __future__ import annotations

import logging
from typing import Any

import gymnasium
import numpy as np

import fmugym
from fmugym import FMI2CSEnv, Uniform
from fmugym.environment.env_checker import check_fmu_env

FMU_PATH = fmugym.bundled_fmu("Pendulum")  # a relative path is relative to this file


class BrakeEnv(FMI2CSEnv):
    """Bring a swinging pendulum to rest; q is its angle from hanging down."""

    vectorized = True

    def __init__(self, largest_torque: float = 0.01, log_level: int = logging.WARNING) -> None:
        config = {
            "model_input_names": "tau",
            "model_output_names": ["q", "q_dot"],
            "model_parameters": {
                "m": Uniform(0.05, 0.07),  # kg, drawn for each episode
                "q_0": Uniform(-1.0, 1.0),  # rad, the start angle
                "b": 1e-5,  # N m s/rad, hardly any friction
            },
            "bounds": {
                "tau": (-largest_torque, largest_torque),  # N m, limits of the action space
                "q": (-4.0, 4.0),  # rad, limits of the observation space
                "q_dot": (-50.0, 50.0),  # rad/s
            },
            "time_step": 0.02,  # s
            "max_episode_steps": 300,
        }
        super().__init__(FMU_PATH, config, log_level)

    def _is_at_rest(self) -> Any:
        q, q_dot = self.state
        return (abs(q) < 0.05) & (abs(q_dot) < 0.3)

    def _is_done(self) -> Any:
        return self._is_at_rest() | (abs(self.state[0]) > 3.0)

    def _reward_policy(self) -> Any:
        """Swinging costs, and being at rest pays."""
        q, q_dot = self.state
        return 10.0 * self._is_at_rest() - q**2 - 0.01 * q_dot**2


fmugym.register("own/Brake-v0", BrakeEnv)


def main() -> None:
    """Check the environment, then run one episode with a torque against the motion."""
    env = gymnasium.make("own/Brake-v0", largest_torque=0.01)
    check_fmu_env(env)
    observation, info = env.reset(seed=1)
    rewards, ended = [], False
    while not ended:
        action = np.clip([-0.002 * observation[1]], -0.01, 0.01).astype(np.float32)
        observation, reward, terminated, truncated, _ = env.step(action)
        rewards.append(float(reward))
        ended = terminated or truncated
    print(f"drawn: {info['drawn']}")
    print(f"{len(rewards)} steps, return {sum(rewards):.2f}, at rest: {terminated}")
    env.close()


if __name__ == "__main__":
    main()
