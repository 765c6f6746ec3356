"""The tasks of ``user_tasks.py`` and of the package, written by hand in numpy.

They step the same FMUs in the same pool, so that all that differs is what surrounds the pool. They
do what a task needs and nothing more: no checks, no faults, no infos.
"""

from __future__ import annotations

import logging
import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt
from gymnasium.vector.utils import batch_space

import fmugym
from fmugym.environment.interface import resolve
from fmugym.pool.native_pool import NativePool

__all__ = [
    "BuildingByHand",
    "ByHand",
    "CartPoleByHand",
    "CloudPendulumByHand",
    "GoalByHand",
    "PendulumByHand",
    "SwingUpByHand",
    "TrackingByHand",
]

Floats = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]


class ByHand(ABC):
    """N environments in the autoreset mode ``NEXT_STEP``, stepped by one thread.

    A task supplies ``_inputs``, ``_judge`` and ``_observe``.

    Args:
        env: An environment of the same task; its FMU and config are used.
        num_envs: N.
        limit: Steps after which an episode is truncated.
    """

    def __init__(self, env: fmugym.FMUEnv, num_envs: int, limit: int) -> None:
        fmu = fmugym.FMU(env.fmu.path)
        interface = resolve(env.config, fmu.description)
        spec = interface.pool_spec()
        self.env, self.num_envs, self.limit = env, num_envs, limit
        self.action_space = batch_space(env.action_space, num_envs)
        self.pool = NativePool(fmu, spec, num_envs, logging.getLogger(__name__), threads=1)
        self.outputs = self.pool.outputs
        parameters, variables = interface.parameters, env.config.episode_variables
        self.parameters = tuple(map(fmu.variable, parameters))
        self.values = np.zeros((len(parameters), num_envs))
        self.variables = {name: np.zeros(num_envs) for name in variables}
        rows = dict(zip(parameters, self.values, strict=True)) | self.variables
        self.starts = [(n, rows[n], value) for n, value in {**parameters, **variables}.items()]
        self.step_count = np.zeros(num_envs, np.int64)
        self.ended = np.ones(num_envs, np.bool_)

    def reset(self, drawn: Mapping[str, Floats] | None = None) -> Any:
        """Start all episodes, with these values instead of drawn ones where they are given."""
        self.rng = np.random.default_rng(0)
        self._start(np.ones(self.num_envs, np.bool_), drawn or {})
        self.ended = np.zeros(self.num_envs, np.bool_)
        self.step_count[:] = 0
        self._look_up()
        return self._observe()

    def step(self, action: Any) -> tuple[Any, Floats, Mask, Mask, dict[str, Any]]:
        """Step the environments whose episodes have not ended; start new episodes for the rest."""
        ended = self.ended
        self.pool.inputs[:] = self._inputs(action)
        skip = None
        if ended.any():
            self._start(ended, {})
            skip = ended
        self.pool.step(None, skip)
        self.step_count += 1
        if skip is not None:
            self.step_count[skip] = 0
        self._look_up()
        terminated, rewards = self._judge(action)
        truncated = self.step_count >= self.limit
        if skip is not None:
            rewards[skip] = 0.0
            terminated[skip] = truncated[skip] = False
        self.ended = terminated | truncated
        return self._observe(), rewards, terminated, truncated, {}

    def _start(self, mask: Mask, given: Mapping[str, Floats]) -> None:
        for name, row, value in self.starts:
            if name in given:
                row[mask] = given[name][mask]
            elif isinstance(value, fmugym.Uniform):
                row[mask] = self.rng.uniform(value.low, value.high, np.count_nonzero(mask))
            else:
                row[mask] = value
        self.pool.reset(self.parameters, self.values, mask)

    @abstractmethod
    def _inputs(self, action: Any) -> Any:
        """The inputs of the FMUs, shape (k, N)."""

    def _look_up(self) -> None:  # noqa: B027  (most tasks need nothing)
        """Look up what depends on the number of steps."""

    @abstractmethod
    def _judge(self, action: Any) -> tuple[Mask, Floats]:
        """Which episodes have ended, and the rewards."""

    @abstractmethod
    def _observe(self) -> Any:
        """The observations, with the environments on the first axis."""

    def close(self) -> None:
        """Close the pool."""
        self.pool.close()


class CartPoleByHand(ByHand):
    """``fmugym/CartPole-v0``."""

    def _inputs(self, action: Any) -> Any:
        return np.where(action == 1, 10.0, -10.0)

    def _judge(self, action: Any) -> tuple[Mask, Floats]:
        x, _, theta, _ = self.outputs
        done = (x < -2.4) | (x > 2.4) | (theta < -0.20943951) | (theta > 0.20943951)
        return done, np.ones(self.num_envs)

    def _observe(self) -> Any:
        return self.outputs.T.astype(np.float32)


class SwingUpByHand(ByHand):
    """``SwingUp``."""

    def _inputs(self, action: Any) -> Any:
        return action[:, 0]

    def _judge(self, action: Any) -> tuple[Mask, Floats]:
        q, q_dot = self.outputs
        done = (np.abs(q - np.pi) < 0.1) & (np.abs(q_dot) < 0.5)
        return done, np.where(done, -1.0, 1.0)

    def _observe(self) -> Any:
        return self.outputs.T.astype(np.float32)


class PendulumByHand(ByHand):
    """``fmugym/Pendulum-v0``."""

    def _inputs(self, action: Any) -> Any:
        self.torque = np.clip(action[:, 0], -2.0, 2.0)
        self.before = self.outputs.copy()
        return (3.0 * self.torque).astype(np.float64) / 3.0

    def _judge(self, action: Any) -> tuple[Mask, Floats]:
        theta, theta_dot = self.before
        angle = ((theta + np.pi) % (2 * np.pi)) - np.pi
        cost = angle**2 + 0.1 * theta_dot**2 + 0.001 * self.torque**2
        return np.zeros(self.num_envs, np.bool_), -cost

    def _observe(self) -> Any:
        theta, theta_dot = self.outputs
        return np.stack([np.cos(theta), np.sin(theta), theta_dot], axis=1).astype(np.float32)


class CloudPendulumByHand(ByHand):
    """``fmugym/CloudPendulum-v0``."""

    last: Any = 0.0

    def reset(self, drawn: Mapping[str, Floats] | None = None) -> Any:
        """See ``ByHand.reset``; no torque is on its way then."""
        self.last = 0.0
        return super().reset(drawn)

    def _inputs(self, action: Any) -> Any:
        last = np.where(self.ended, 0.0, self.last)
        self.torque = 0.15 * np.clip(action[:, 0], -1.0, 1.0).astype(np.float64)
        self.last = np.where(self.ended, 0.0, self.torque)
        self.before = self.outputs.copy()
        return last

    def _judge(self, action: Any) -> tuple[Mask, Floats]:
        q, q_dot = self.outputs
        done = (np.abs(q) > math.tau) | (np.abs(q_dot) > 50.0)
        theta, speed = self.before[0] % math.tau - math.pi, self.before[1]
        cost = theta**2 + 1.5 / 98.1 * speed**2 + 0.004 * (self.torque / 0.15) ** 2
        return done, -cost - 1000.0 * done

    def _observe(self) -> Any:
        q, q_dot = self.outputs
        rows = [np.cos(q), np.sin(q), np.clip(q_dot, -50.0, 50.0)]
        return np.stack(rows, axis=1).astype(np.float32)


class TrackingByHand(ByHand):
    """``Tracking``."""

    def _inputs(self, action: Any) -> Any:
        self.torque = np.clip(action[:, 0], -0.03, 0.03).astype(np.float64)
        return self.torque

    def _judge(self, action: Any) -> tuple[Mask, Floats]:
        q, q_dot = self.outputs
        error, integral = self.variables["target"] - q, self.variables["integral"]
        later = np.clip(integral + 0.02 * error, -1.0, 1.0)
        integral[:] = np.where(self.ended, integral, later)
        cost = error**2 + 0.01 * q_dot**2 + 10.0 * self.torque**2
        return np.abs(q_dot) > 30.0, -cost

    def _observe(self) -> Any:
        q, q_dot = self.outputs
        error = self.variables["target"] - q
        rows = [np.sin(q), np.cos(q), q_dot, error, self.variables["integral"]]
        return np.stack(rows, axis=1).astype(np.float32)


class GoalByHand(ByHand):
    """``Goal``."""

    def _inputs(self, action: Any) -> Any:
        return action[:, 0]

    def _judge(self, action: Any) -> tuple[Mask, Floats]:
        q, q_dot = self.outputs
        return np.abs(q_dot) > 30.0, -np.abs(q - self.variables["goal"])

    def _observe(self) -> Any:
        q, q_dot = self.outputs
        state = np.stack([np.sin(q), np.cos(q), q_dot], axis=1).astype(np.float32)
        return {
            "observation": state,
            "achieved_goal": q[:, None].astype(np.float32),
            "desired_goal": self.variables["goal"][:, None].astype(np.float32),
        }


class BuildingByHand(ByHand):
    """``Building``."""

    hours = np.array([0.0, 6.0, 8.0, 18.0, 22.0, 24.0])
    coldest = np.array([17.0, 17.0, 21.0, 21.0, 17.0, 17.0])
    prices = np.array([0.2, 0.2, 0.35, 0.3, 0.2, 0.2])

    def _inputs(self, action: Any) -> Any:
        return 500.0 * (np.clip(action.T, -1.0, 1.0) + 1.0)

    def _judge(self, action: Any) -> tuple[Mask, Floats]:
        air = self.outputs[:10]
        cold, hot = np.maximum(self.cold - air, 0.0), np.maximum(air - 26.0, 0.0)
        energy = 2.5e-4 * self.pool.inputs.sum(axis=0)
        done = (air[0] < -20.0) | (air[0] > 60.0)
        return done, -(self.price * energy + (cold + hot).sum(axis=0))

    def _look_up(self) -> None:
        self.hour = self.step_count * 0.25 % 24.0
        self.cold = np.interp(self.hour, self.hours, self.coldest)
        self.price = np.interp(self.hour, self.hours, self.prices)

    def _observe(self) -> Any:
        phase = math.tau / 24.0 * self.hour
        rows = [np.sin(phase), np.cos(phase), self.cold, self.price]
        return np.concatenate([self.outputs, rows]).T.astype(np.float32)
