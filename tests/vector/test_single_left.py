"""A single environment in which some hooks are compiled and the others stay in Python."""

import logging
import math

import gymnasium as gym
import numpy as np
import pytest
from test_single_compiled import (
    require_same,
    require_same_snapshots,
    with_hooks,
)
from vector_tools import Drawing

import fmugym
from fmugym import Uniform


class Task(Drawing):
    """All hooks can be compiled; those that read the most are replaced in turn."""

    def __init__(self):
        super().__init__(
            episode_variables={"target": Uniform(-1.0, 1.0), "sum": 0.0, "last": np.zeros(2)},
            max_episode_steps=9,
            monitor_names=["theta_ddot"],
        )

    def _get_observation_space(self):
        return gym.spaces.Box(-np.inf, np.inf, (4,), np.float32)

    def _get_inputs(self):
        return 0.5 * self.action[0] + 0.1 * self.previous_action[0]

    def _update(self):
        self.variables["sum"] += self.variables["target"] - self.state[0]
        self.variables["last"] = np.array([self.state[0], self.variables["last"][0]])

    def _is_done(self):
        return abs(self.variables["sum"]) > 6.0

    def _is_truncated(self):
        return self.state[1] > 0.9

    def _reward_policy(self):
        return -abs(self.variables["target"] - self.out["q"]) - self.inputs[0] ** 2

    def _get_observation(self):
        rows = [*self.state, self.variables["sum"], self.variables["last"][1]]
        return np.array(rows, np.float32)


class Truncated(Task):
    def _is_truncated(self):
        if self.done:
            return False
        return bool(self.time > 0.1 and self.out["theta_ddot"] > 0)


class Reward(Task):
    def _reward_policy(self):
        if self.done:
            return -10.0
        previous = math.hypot(*self.previous_state)
        return math.sin(self.state[0]) - previous + float(self.previous_action[0])


class Observation(Task):
    def _get_observation(self):
        least = sorted([*self.state, float(self.inputs[0]), self.variables["sum"]])
        return np.array(least, np.float32)


class Both(Reward, Observation):
    pass


class Flags(Truncated, Observation):
    pass


class Inputs(Task):
    """``_get_inputs`` would have to read what the pool keeps before the FMU steps."""

    def _get_inputs(self):
        push = float(self.action[0]) + 0.1 * float(self.previous_action[0])
        return -push if self.state[0] > self.previous_state[0] else push


class Everything(Truncated, Reward, Observation):
    """Three hooks are not compiled."""


class Goal(Task):
    def _get_observation_space(self):
        box = gym.spaces.Box(-np.inf, np.inf, (1,), np.float32)
        return gym.spaces.Dict(dict.fromkeys(["observation", "achieved_goal", "desired_goal"], box))

    def _get_observation(self):
        names = {"observation": self.state[1], "achieved_goal": self.state[0]}
        names["desired_goal"] = self.variables["target"]
        return {name: np.array([value], np.float32) for name, value in names.items()}

    _reward_policy = fmugym.FMUEnv._reward_policy

    def _goal_reward(self, achieved_goal, desired_goal):
        distance = abs(float(achieved_goal[0]) - float(desired_goal[0]))
        return 1.0 if distance < 0.2 else -distance


class GoalSeen(Goal):
    def _get_observation(self):
        seen = super()._get_observation()
        return seen if self.state[0] > 0 else {name: 2 * part for name, part in seen.items()}


class WithInfo(Observation):
    def _get_info(self):
        return {"sum": self.variables["sum"], "seen": self.state[0]}


LEFT = {
    Truncated: {"_is_truncated"},
    Reward: {"_reward_policy"},
    Observation: {"_get_observation"},
    Both: {"_reward_policy", "_get_observation"},
    Flags: {"_is_truncated", "_get_observation"},
    Goal: {"_reward_policy"},
    GoalSeen: {"_reward_policy", "_get_observation"},
    WithInfo: {"_get_observation"},
    Everything: {"_is_truncated", "_reward_policy", "_get_observation"},
}


def pair(cls):
    one, other = cls(), with_hooks(cls, "python")
    one.reset(seed=5)
    other.reset(seed=5)
    return one, other


def where_possible(cls):
    return lambda hooks: with_hooks(cls, "auto" if hooks == "compiled" else hooks)


@pytest.mark.parametrize("cls", LEFT)
def test_it_equals_python(cls):
    compiled, ends = require_same(where_possible(cls), 120, reads=4)
    assert ends > 5
    assert compiled > 80


@pytest.mark.parametrize("cls", LEFT)
def test_each_hook_is_called_once_in_its_order(cls, monkeypatch):
    env = cls()
    env.reset(seed=5)
    env.step(env.action_space.sample())
    assert set(env.inside.player.left) == LEFT[cls]
    calls = []
    for name in LEFT[cls]:
        hook = getattr(cls, name)

        def counted(self, hook=hook, name=name):
            calls.append(name)
            return hook(self)

        monkeypatch.setattr(cls, name, counted)
    env.step(env.action_space.sample())
    assert env.inside.player is not None
    order = ["_is_truncated", "_reward_policy", "_get_observation"]
    expected = [name for name in order if name in LEFT[cls]]
    if cls is GoalSeen:
        expected = ["_get_observation"]  # ``_goal_reward`` gets the same one
    assert calls == expected
    env.close()


ACTION = np.float32([0.004])


def test_each_hook_is_named_once(caplog):
    env = Both()
    with caplog.at_level(logging.INFO, logger="fmugym.vector"):
        for _ in range(3):
            env.reset(seed=5)
            env.step(env.action_space.sample())
    texts = [record.getMessage() for record in caplog.records]
    assert len(texts) == 2
    for name in LEFT[Both]:
        assert sum(f"{name}, line" in text for text in texts) == 1
    env.close()


class Noting(Reward):
    """Sets an attribute that a compiled hook may read."""

    def _is_truncated(self):
        self.seen = self.state[0]
        return bool(self.seen > 0.99)


class Filling(Observation):
    """Returns an attribute that it fills."""

    def __init__(self):
        super().__init__()
        self.array = np.zeros(4, np.float32)

    def _get_observation(self):
        self.array[:] = super()._get_observation()
        return self.array.copy()


class Writing(Truncated):
    def _is_truncated(self):
        if self.state[0] > -10.0:
            self.variables["sum"] = 0.5
        return False


class Unsteady(Task):
    """``_is_done``, on which others depend, cannot be compiled."""

    def _is_done(self):
        return bool(self.state[0] > 0.5 and self.state[1] > 0)


@pytest.mark.parametrize("cls", [Noting, Filling, Writing, Unsteady, Inputs])
def test_other_hooks_keep_all_in_python(cls):
    """Above all, hooks that change something: compiled hooks may read it."""
    assert require_same(where_possible(cls), 30)[0] == 0


def test_snapshots_and_attributes():
    require_same_snapshots(*pair(Both))
