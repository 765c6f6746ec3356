"""Typical tasks are compiled: targets, integrals, histories, tables, goals, types of inputs."""

import logging

import gymnasium as gym
import numpy as np
import pytest
from fmu_tools import PlainEnv, probe_config
from test_vector_program import Task, require_bits, require_same, require_variables
from vector_tools import (
    require_equal,
    require_pair_equal,
    require_same_infos,
    sampled_actions,
)

import fmugym
from fmugym import ConfigError, Uniform
from fmugym.vector import FMUVectorEnv

each_mode = pytest.mark.parametrize("mode", ["next_step", "same_step"])


def wide(shape, dtype=np.float32):
    return gym.spaces.Box(-np.inf, np.inf, shape, dtype)


class Tracking(Task):
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


class Delayed(Task):
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


class Goal(Task):
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


class Tables(Task):
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


@each_mode
@pytest.mark.parametrize("cls", [Tracking, Delayed, Goal, Tables])
def test_tasks(cls, mode):
    for num_envs in (1, 40):
        assert require_same(cls, num_envs=num_envs, steps=30, mode=mode) >= num_envs


@pytest.mark.parametrize("cls", [Delayed, Goal])
def test_tasks_are_those_of_single_environments(cls):
    require_pair_equal(cls, steps=30, hooks="compiled", rtol=1e-12)


class Outside(Task):
    """Looks values up in a table that is too short for long episodes."""

    def __init__(self):
        super().__init__(max_episode_steps=20)

    def _is_done(self):
        return self.state[0] > 90.0

    def _reward_policy(self):
        return np.take([1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0], self.step_count)


def test_an_index_outside_of_its_table():
    envs = FMUVectorEnv(Outside, 3, hooks="compiled")
    envs.reset(seed=0)
    for _ in range(7):
        envs.step(np.zeros((3, 2), np.float32))
    with pytest.raises(IndexError, match="outside of its table"):
        envs.step(np.zeros((3, 2), np.float32))
    envs.close()


def test_the_variables_of_a_task_may_be_set_and_read():
    one, other = (FMUVectorEnv(Delayed, 2, hooks=hooks) for hooks in ("compiled", "array"))
    for envs in (one, other):
        envs.reset(seed=1)
        envs.action_space.seed(0)
        for _ in range(3):
            envs.step(envs.action_space.sample())
    for name in ("variables", "previous_state", "action", "previous_action", "inputs"):
        np.testing.assert_equal(one.get_attr(name), other.get_attr(name))
    one.close()
    other.close()


# Types of inputs

TYPED = {
    "enumeration": {"model_input_names": "mode", "model_output_names": "mix"},
    "boolean": {"model_input_names": "on", "model_output_names": ["on_out", "mix"]},
    "integer": {
        "model_input_names": "n",
        "model_output_names": ["n_out", "steps"],
        "bounds": {"n": (-2, 3)},
    },
    "mixed": {
        "model_input_names": ["a", "n", "on", "mode"],
        "model_output_names": ["n_out", "on_out", "sum"],
        "bounds": {"n": (-2, 3)},
    },
}


@pytest.mark.parametrize("kind", TYPED)
def test_inputs_that_are_not_real(kind, probe):
    class Typed(PlainEnv):
        def __init__(self):
            super().__init__(probe(), probe_config(**{"max_episode_steps": 5} | TYPED[kind]))

    require_same(Typed, num_envs=5, steps=20)


def test_inputs_outside_of_their_type(probe):
    class Typed(PlainEnv):
        def __init__(self):
            super().__init__(probe(), probe_config(**TYPED["integer"]))

        def _get_inputs(self):
            return np.where(self.action > 2, 3e9, 1.0)

    envs = FMUVectorEnv(Typed, 2, hooks="compiled")
    envs.reset(seed=0)
    with pytest.raises(ConfigError, match="expected an integer from"):
        envs.step(np.array([1, 5]))
    envs.close()


# Faults


class Growing(Task):
    """Its observation overflows a float32 when the action says so."""

    def __init__(self):
        super().__init__(episode_variables={"sum": 0.0})

    def _update(self):
        growth = np.where(self.action[0] > 0.9, 1e39, self.state[0])
        self.variables["sum"] = self.variables["sum"] + growth

    def _get_observation_space(self):
        return wide((2,))

    def _get_observation(self):
        return np.stack([self.state[0], self.variables["sum"]])


def test_observations_that_overflow_are_faults(caplog):
    one, other = (FMUVectorEnv(Growing, 3, hooks=hooks) for hooks in ("compiled", "array"))
    results = []
    for envs in (one, other):
        envs.reset(seed=2)
        envs.step(np.zeros((3, 2), np.float32))
        result = envs.step(np.array([[0.0, 0], [1, 0], [0, 0]], np.float32))
        assert result[3].tolist() == [False, True, False]
        assert np.isfinite(result[0]).all()
        assert "the observation is" in result[4]["fault"][1]
        results.append((result[0].tolist(), result[1].tolist(), result[4]["fault"].tolist()))
        results[-1] += (envs.get_attr("variables"),)
        envs.close()
    assert one.inside.engine.way == "compiled"
    assert results[0] == results[1]


def test_outputs_that_overflow_the_default_observation_are_faults(probe, caplog):
    """Compiled steps handed out infinite observations."""

    class Large(PlainEnv):
        def __init__(self):
            config = {
                "model_input_names": "a",
                "model_output_names": "sum",
                "bounds": {"a": (-1, 1)},
            }
            super().__init__(probe(), probe_config(**config))

        def _get_inputs(self):
            return np.float64(1e40) * self.action

    results = []
    for hooks in ("compiled", "array"):
        envs = FMUVectorEnv(Large, 3, hooks=hooks)
        envs.reset(seed=0)
        result = envs.step(np.array([[0.0], [1.0], [1e-3]], np.float32))
        results.append((result[0].tolist(), result[3].tolist(), result[4]["fault"].tolist()))
        envs.close()
    assert results[0] == results[1]
    assert results[0][1] == [False, True, False]


# Hooks that are left


class Partial(Tracking):
    """One hook after the other cannot be traced."""


LEFT = {
    "_get_inputs": lambda self: [0.01 * np.partition(self.action, 0, axis=0)[0]],
    "_is_truncated": lambda self: np.partition(self.state, 0, axis=0)[0] > 0.3,
    "_reward_policy": lambda self: np.partition(self.state, 0, axis=0)[0] - 1.0 * self.done,
    "_get_observation": lambda self: np.partition(
        np.array([*self.state, *self.previous_state, self.variables["integral"]]), 0, axis=0
    ),
    "_get_info": lambda self: {"rank": np.argpartition(self.state, 0, axis=0)[0]},
}


@each_mode
@pytest.mark.parametrize("hook", LEFT)
def test_only_the_hook_that_cannot_be_traced_leaves_the_pass(hook, mode, caplog):
    cls = type("Partial", (Tracking,), {hook: LEFT[hook]})
    with caplog.at_level("INFO", "fmugym"):
        assert require_same(cls, steps=20, mode=mode, ways=("auto", "array")) > 20
    (record,) = (r for r in caplog.records if "cannot be compiled" in r.getMessage())
    assert record.levelname == "INFO"
    assert f"{hook}" in record.getMessage()
    assert "the others are compiled" in record.getMessage()
    with pytest.raises(ConfigError, match=f"cannot be compiled: {hook}"):
        FMUVectorEnv(cls, 2, hooks="compiled")


@pytest.mark.parametrize("mode", ["same_step", "disabled"])
@pytest.mark.parametrize("hook", LEFT)
def test_the_pool_starts_episodes_of_tasks_with_a_hook_that_is_left(hook, mode, monkeypatch):
    """numpy started them, which took two to three times the time of a step."""
    cls = type("Partial", (Tracking,), {hook: LEFT[hook]})
    ours, theirs = (
        FMUVectorEnv(cls, 20, hooks=way, autoreset_mode=mode) for way in ("auto", "array")
    )
    monkeypatch.setattr(ours.inside.engine, "_begin", None)
    require_equal(*(one.reset(seed=3)[0] for one in (ours, theirs)))
    ended = np.zeros(20, np.bool_)
    for actions in sampled_actions(ours, 25):
        first, second = ours.step(actions), theirs.step(actions)
        for a, b in zip(first[:4], second[:4], strict=True):
            require_bits(a, b)
        require_same_infos(first[4], second[4])
        ends = first[2] | first[3]
        ended |= ends
        if mode == "disabled" and ends.any():
            first, second = (one.reset(options={"reset_mask": ends}) for one in (ours, theirs))
            require_bits(first[0], second[0])
            require_same_infos(first[1], second[1])
        for name in ("done", "step_count", "previous_state", "previous_action"):
            require_equal(ours.get_attr(name), theirs.get_attr(name))
        require_variables(ours, theirs)
    assert ended.all()
    ours.close()
    theirs.close()


def test_faults_of_hooks_that_are_left():
    class Infinite(Tracking):
        def _reward_policy(self):
            return np.where(self.action[0] > 0.9, np.inf, np.partition(self.state, 0, axis=0)[0])

    results = []
    for hooks in ("auto", "array"):
        envs = FMUVectorEnv(Infinite, 3, hooks=hooks)
        envs.reset(seed=0)
        result = envs.step(np.array([[0.0, 0], [1, 0], [0, 0]], np.float32))
        results.append((result[0].tolist(), result[1].tolist(), result[4]["fault"].tolist()))
        envs.close()
    assert results[0] == results[1]
    assert "_reward_policy returned inf" in results[0][2][1]


@each_mode
def test_failures_of_the_fmu_are_those_on_arrays(mode):
    """Variables, actions and states of the step before stay what they are on arrays."""

    one, other = (
        FMUVectorEnv(FailingCart, 50, hooks=hooks, autoreset_mode=mode)
        for hooks in ("compiled", "array")
    )
    logging.getLogger("fmugym.FailingCart").setLevel(logging.CRITICAL)
    one.reset(seed=3)
    other.reset(seed=3)
    for actions in sampled_actions(one, 30):
        first, second = one.step(actions), other.step(actions)
        for a, b in zip(first[:4], second[:4], strict=True):
            require_bits(a, b)
        require_same_infos(first[4], second[4])
        require_variables(one, other)
    assert one.health["discards"].tolist() == other.health["discards"].tolist()
    assert one.health["discards"].sum() > 50
    one.close()
    other.close()


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
        return [np.where(self.action[0] > 0.8, np.float64(1e308), 2.0 * self.previous_action[1])]

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


def test_results_do_not_depend_on_threads():
    one, other = (
        FMUVectorEnv(Tracking, 3000, hooks=hooks, threads=threads)
        for hooks, threads in (("compiled", 2), ("array", 1))
    )
    np.testing.assert_array_equal(one.reset(seed=0)[0], other.reset(seed=0)[0])
    one.action_space.seed(0)
    for _ in range(12):
        actions = one.action_space.sample()
        for a, b in zip(one.step(actions)[:4], other.step(actions)[:4], strict=True):
            np.testing.assert_array_equal(a, b)
    one.close()
    other.close()
