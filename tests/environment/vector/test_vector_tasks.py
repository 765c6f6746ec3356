"""Typical tasks on arrays: targets, integrals, histories, tables, goals, types of inputs."""

import contextlib
import logging

import gymnasium as gym
import numpy as np
import pytest
from combinations import in_turn
from fmu_tools import PlainEnv, probe_config
from vector_tools import Pushed, require_equal, results_of_both
from ways import WAYS, in_way

import fmugym
from fmugym import ConfigError, Uniform
from fmugym.environment.vector import FMUVectorEnv

each_mode = pytest.mark.parametrize("mode", ["next_step", "same_step"])


def require_bits(first, second):
    require_equal(first, second)
    for a, b in zip(*map(leaves, (first, second)), strict=True):
        assert np.signbit(a).tolist() == np.signbit(b).tolist()


def leaves(value):
    return [value] if isinstance(value, np.ndarray) else list(value.values())


def require_close(first, second):
    for a, b in zip(*map(leaves, (first, second)), strict=True):
        assert (a.dtype, a.shape) == (b.dtype, b.shape)
        np.testing.assert_allclose(a, b, rtol=ROUNDED)


def require_variables(first, second):
    pairs = zip(first.get_attr("variables"), second.get_attr("variables"), strict=True)
    for one, other in pairs:
        require_equal(dict(one), dict(other))


def wide(shape, dtype=np.float32):
    return gym.spaces.Box(-np.inf, np.inf, shape, dtype)


class Tracking(Pushed):
    """Follow a target that is drawn; the integral of the error is observed."""

    def __init__(self):
        super().__init__(episode_variables={"target": Uniform(-0.5, 0.5), "integral": 0.0})

    def _update(self):
        error = self.variables["target"] - self.state[0]
        self.variables["integral"] = 0.99 * self.variables["integral"] + 0.02 * error

    def _is_done(self):
        return np.abs(self.variables["integral"]) > 0.03

    def _reward_policy(self):
        error = self.variables["target"] - self.state[0]
        effort = np.sum(np.square(self.action), axis=0)
        change = np.linalg.norm(np.asarray(self.state) - np.asarray(self.previous_state), axis=0)
        return -(error**2) - 0.1 * effort - change

    def _get_observation_space(self):
        return wide((5,))

    def _get_observation(self):
        q, q_dot = self.state
        names = self.variables["target"], self.variables["integral"]
        return np.array([np.sin(q), np.cos(q), q_dot, *names], np.float32)


class Delayed(Pushed):
    """Acts on a history of actions, observes one of angles, and counts."""

    def __init__(self):
        history = np.zeros((3, 2))
        super().__init__(
            episode_variables={"queue": [0.1, 0.2, 0.3], "seen": history, "count": 0, "near": 0}
        )

    def _get_inputs(self):
        return [0.01 * self.variables["queue"][0]]

    def _update(self):
        queue, seen = self.variables["queue"], self.variables["seen"]
        newest = np.stack([1.0 * self.action[0]])
        self.variables["queue"] = np.concatenate([queue[1:], newest])
        self.variables["seen"] = np.concatenate([seen[1:], np.asarray(self.state)[None]])
        self.variables["near"] = np.abs(self.state[0]) < 0.1
        self.variables["count"] = self.variables["count"] + self.variables["near"]

    def _is_truncated(self):
        return self.variables["count"] > 3

    def _get_observation_space(self):
        return gym.spaces.Dict({"angles": wide((3, 2), np.float64), "queue": wide((3,))})

    def _get_observation(self):
        return {"angles": self.variables["seen"], "queue": self.variables["queue"]}


class Goal(Pushed):
    """A goal task, whose observations are dicts."""

    def __init__(self):
        super().__init__(episode_variables={"goal": Uniform(-0.5, 0.5)})

    def _get_observation_space(self):
        part = wide((1,))
        names = ("observation", "achieved_goal", "desired_goal")
        return gym.spaces.Dict(dict.fromkeys(names, part) | {"observation": wide((2,))})

    def _get_observation(self):
        return {
            "observation": np.asarray(self.state),
            "achieved_goal": np.stack([self.state[0]]),
            "desired_goal": np.stack([self.variables["goal"]]),
        }

    def _goal_reward(self, achieved_goal, desired_goal):
        distance = np.linalg.norm(achieved_goal - desired_goal, axis=-1)
        return -(distance > 0.1).astype(np.float32)


class Tables(Pushed):
    """Looks values up, and has an info."""

    space = gym.spaces.MultiDiscrete([3, 4])
    angles, comfort = np.array([-0.5, 0.0, 0.5]), np.array([0.0, 1.0, 0.0])

    def __init__(self):
        super().__init__()
        self.levels = np.array([-0.5, 0.0, 0.25])

    def _get_inputs(self):
        level = self.levels[self.action[0]] + np.take([0.1, 0.2, 0.3, 0.4], self.action[1] - 4)
        return [0.01 * level]

    def _reward_policy(self):
        q, q_dot = self.state
        comfort = np.interp(q, self.angles, self.comfort, left=-1.0)
        band = np.select([q_dot > 0.3, q_dot < -0.3], [q_dot - 0.3, -0.3 - q_dot], 0.0)
        return comfort - np.clip(band, None, 1.0)

    def _get_info(self):
        return {"angle": self.state[0], "nested": {"level": self.action[0]}, "kind": 3}


ROUNDED = 1e-6
"""Numbers of Python adapt to a float32, of which arrays do not."""


@in_turn({"cls": [Tracking, Delayed, Goal, Tables], "mode": ["next_step", "same_step", "disabled"]})
def test_the_pool_starts_episodes(cls, mode, monkeypatch, make_envs):
    """numpy started them, which took two to three times the time of a step."""
    ours, theirs = (
        make_envs(in_way(way, cls), 20, autoreset_mode=mode) for way in ("arrays", "one by one")
    )
    monkeypatch.setattr(ours.episodes, "begin", None)
    ended = np.zeros(20, np.bool_)
    for result in results_of_both(ours, theirs, 25, rtol=ROUNDED, same=require_close):
        ended |= result[2] | result[3]
        for name in ("done", "step_count", "previous_state", "previous_action"):
            require_equal(ours.get_attr(name), theirs.get_attr(name))
        pairs = zip(ours.get_attr("variables"), theirs.get_attr("variables"), strict=True)
        for one, other in pairs:
            for name, value in one.items():
                np.testing.assert_allclose(value, other[name], rtol=ROUNDED, atol=ROUNDED)
    assert ended.all()


def test_inputs_outside_of_their_type(probe, make_envs):
    class Typed(PlainEnv):
        def __init__(self):
            names = {"model_input_names": "n", "model_output_names": ["n_out", "steps"]}
            super().__init__(probe(), probe_config(**names))

        def _get_inputs(self):
            return np.where(self.action > 2, 3e9, 1.0)

    envs = make_envs(in_way("arrays", Typed), 2)
    envs.reset(seed=0)
    with pytest.raises(ConfigError, match="expected an integer from"):
        envs.step(np.array([1, 5]))


# Faults


def test_outputs_that_overflow_the_default_observation_are_faults(probe):

    class Large(PlainEnv):
        def __init__(self):
            config = {"model_input_names": "a", "model_output_names": "sum"}
            super().__init__(probe(), probe_config(**config, bounds={"a": (-1, 1)}))

        def _get_inputs(self):
            return np.float64(1e40) * self.action

    require_faults_of_the_second(Large, [[0.0], [1.0], [1e-3]])


def require_faults_of_the_second(cls, actions):
    """In the first step of three environments, on both ways; returns the reason."""
    with contextlib.ExitStack() as stack:
        ours, theirs = (
            stack.enter_context(contextlib.closing(FMUVectorEnv(in_way(hooks, cls), 3)))
            for hooks in WAYS
        )
        (result,) = results_of_both(ours, theirs, [np.array(actions, np.float32)])
        assert result[3].tolist() == [False, True, False]
        return result[4]["fault"][1]


def test_rewards_that_are_not_finite_are_faults():
    class Infinite(Tracking):
        def _reward_policy(self):
            return np.where(self.action[0] > 0.9, np.inf, 1.0 * self.state[0])

    reason = require_faults_of_the_second(Infinite, [[0.0, 0], [1, 0], [0, 0]])
    assert "_reward_policy returned inf" in reason


@each_mode
def test_failures_of_the_fmu_are_those_of_each(mode, make_envs):
    """Variables, actions and states of the step before stay what they are on arrays."""
    one, other = (
        make_envs(in_way(hooks, FailingCart), 50, autoreset_mode=mode)
        for hooks in ("arrays", "one by one")
    )
    logging.getLogger("fmugym.FailingCart").setLevel(logging.CRITICAL)
    for _ in results_of_both(one, other, 30, same=require_bits):
        require_variables(one, other)
    assert one.health["discards"].tolist() == other.health["discards"].tolist()
    assert one.health["discards"].sum() > 50


class FailingCart(fmugym.FMUEnv):
    """Its FMU fails where the push is absurd."""

    def __init__(self):
        config = {
            "model_input_names": "f",
            "model_output_names": ["x", "x_dot"],
            "model_parameters": {"x_0": Uniform(-0.5, 0.5)},
            "episode_variables": {"integral": 0.0},
            "time_step": 0.05,
            "max_episode_steps": 9,
        }
        super().__init__(fmugym.bundled_fmu("CartPole"), config)

    def _get_action_space(self):
        return gym.spaces.Box(-1.0, 1.0, (2,), np.float32)

    def _get_inputs(self):
        return [np.where(self.action[0] > 0.8, 1e308, np.float64(self.previous_action[1]))]

    def _update(self):
        self.variables["integral"] = self.variables["integral"] + self.state[0]

    def _is_done(self):
        return np.abs(self.state[0]) > 1.0

    def _get_observation_space(self):
        return wide((4,))

    def _get_observation(self):
        before = self.previous_state[0], self.action[1]
        return np.array([self.state[0], self.variables["integral"], *before], np.float32)

    def _get_info(self):
        return {"integral": self.variables["integral"], "before": self.previous_state[0]}
