"""Tasks as users write them: continuous actions, sines, targets, integrals, tables, goals."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium import spaces

import fmugym

__all__ = ["Building", "Goal", "SwingUp", "Tracking", "Uncompiled"]

_LIMIT = 0.03
"""The largest torque in N m."""


class SwingUp(fmugym.FMI2CSEnv):
    """The README's task: turn a pendulum up to a stop."""

    vectorized = True

    def __init__(self) -> None:
        config = {
            "model_input_names": ["tau"],
            "model_output_names": ["q", "q_dot"],
            "model_parameters": {"q_0": 0.1, "m": fmugym.Uniform(0.05, 0.07)},
            "time_step": 0.02,
            "max_episode_steps": 500,
            "bounds": {"tau": (-_LIMIT, _LIMIT)},
        }
        super().__init__(fmugym.bundled_fmu("Pendulum"), config)

    def _is_done(self) -> Any:
        q, q_dot = self.state
        return (abs(q - np.pi) < 0.1) & (abs(q_dot) < 0.5)


class Tracking(fmugym.FMI2CSEnv):
    """Follow a target angle, with an integral of the error and a quadratic reward."""

    vectorized = True

    def __init__(self) -> None:
        config = {
            "model_input_names": ["tau"],
            "model_output_names": ["q", "q_dot"],
            "model_parameters": {"q_0": fmugym.Uniform(-0.5, 0.5), "max_step": 0.02},
            "episode_variables": {"target": fmugym.Uniform(-1.0, 1.0), "integral": 0.0},
            "time_step": 0.02,
            "max_episode_steps": 250,
            "bounds": {"tau": (-_LIMIT, _LIMIT)},
        }
        super().__init__(fmugym.bundled_fmu("Pendulum"), config)

    def _get_observation_space(self) -> spaces.Space[Any]:
        return spaces.Box(-np.inf, np.inf, (5,), np.float32)

    def _get_inputs(self) -> Any:
        return np.clip(self.action[0], -_LIMIT, _LIMIT)

    def _update(self) -> None:
        error = self.variables["target"] - self.out["q"]
        integral = self.variables["integral"] + 0.02 * error
        self.variables["integral"] = np.clip(integral, -1.0, 1.0)

    def _is_done(self) -> Any:
        return np.abs(self.out["q_dot"]) > 30.0

    def _reward_policy(self) -> Any:
        error, torque = self.variables["target"] - self.out["q"], self.inputs[0]
        return -(error**2 + 0.01 * self.out["q_dot"] ** 2 + 10.0 * torque**2)

    def _get_observation(self) -> Any:
        q, q_dot = self.state
        variables = self.variables
        rows = [np.sin(q), np.cos(q), q_dot, variables["target"] - q, variables["integral"]]
        return np.array(rows, dtype=np.float32)


class Uncompiled(Tracking):
    """``Tracking`` with an observation of which numpy must find the middle value."""

    vectorized = True

    def _get_observation(self) -> Any:
        observation = super()._get_observation()
        return np.concatenate([observation[:4], np.partition(observation, 2, axis=0)[2:3]])


class Goal(fmugym.FMI2CSEnv):
    """Reach a goal angle and stay; a goal task in Gymnasium-Robotics' form."""

    vectorized = True

    def __init__(self) -> None:
        config = {
            "model_input_names": ["tau"],
            "model_output_names": ["q", "q_dot"],
            "model_parameters": {"max_step": 0.02},
            "episode_variables": {"goal": fmugym.Uniform(-1.5, 1.5)},
            "time_step": 0.02,
            "max_episode_steps": 200,
            "bounds": {"tau": (-_LIMIT, _LIMIT)},
        }
        super().__init__(fmugym.bundled_fmu("Pendulum"), config)

    def _get_observation_space(self) -> spaces.Space[Any]:
        names = {"observation": 3, "achieved_goal": 1, "desired_goal": 1}
        return spaces.Dict({n: spaces.Box(-np.inf, np.inf, (k,)) for n, k in names.items()})

    def _is_done(self) -> Any:
        return np.abs(self.out["q_dot"]) > 30.0

    def _goal_reward(self, achieved_goal: Any, desired_goal: Any) -> Any:
        return -np.abs(achieved_goal[..., 0] - desired_goal[..., 0])

    def _get_observation(self) -> Any:
        q, q_dot = self.state
        rows = {
            "observation": [np.sin(q), np.cos(q), q_dot],
            "achieved_goal": [q],
            "desired_goal": [self.variables["goal"]],
        }
        return {name: np.array(values, dtype=np.float32) for name, values in rows.items()}


class Building(fmugym.FMI2CSEnv):
    """Heat ten zones within comfort bands that a timetable sets, at a price that changes.

    Args:
        path: The FMU of ``building.c``.
    """

    vectorized = True

    hours = np.array([0.0, 6.0, 8.0, 18.0, 22.0, 24.0])
    coldest = np.array([17.0, 17.0, 21.0, 21.0, 17.0, 17.0])
    prices = np.array([0.2, 0.2, 0.35, 0.3, 0.2, 0.2])

    def __init__(self, path: Path) -> None:
        zones = range(1, 11)
        config = {
            "model_input_names": [f"P{zone}" for zone in zones],
            "model_output_names": [
                f"{name}{zone}" for name in ("T", "T_wall", "error") for zone in zones
            ],
            "model_parameters": {"T_outside": fmugym.Uniform(-10.0, 10.0), "T_0": 20.0},
            "time_step": 900.0,
            "max_episode_steps": 96,
        }
        super().__init__(path, config)

    def _get_action_space(self) -> spaces.Space[Any]:
        return spaces.Box(-1.0, 1.0, (10,), np.float32)

    def _get_observation_space(self) -> spaces.Space[Any]:
        return spaces.Box(-np.inf, np.inf, (34,), np.float32)

    def _hour(self) -> Any:
        return self.time / 3600.0 % 24.0

    def _get_inputs(self) -> Any:
        return 500.0 * (np.clip(self.action, -1.0, 1.0) + 1.0)

    def _is_done(self) -> Any:
        return (self.state[0] < -20.0) | (self.state[0] > 60.0)

    def _reward_policy(self) -> Any:
        hour, air, power = self._hour(), np.asarray(self.state[:10]), np.asarray(self.inputs)
        cold = np.maximum(np.interp(hour, self.hours, self.coldest) - air, 0.0)
        hot = np.maximum(air - 26.0, 0.0)
        energy = 2.5e-4 * np.sum(power, axis=0)
        return -(np.interp(hour, self.hours, self.prices) * energy + np.sum(cold + hot, axis=0))

    def _get_observation(self) -> Any:
        phase = math.tau / 24.0 * self._hour()
        hour = self._hour()
        tables = np.interp(hour, self.hours, self.coldest), np.interp(hour, self.hours, self.prices)
        rows = [*self.state, np.sin(phase), np.cos(phase), *tables]
        return np.array(rows, dtype=np.float32)
