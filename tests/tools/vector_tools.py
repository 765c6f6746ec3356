"""What the tests of vector environments share: comparisons with Gymnasium's own, and classes."""

import contextlib
from collections.abc import Mapping

import gymnasium as gym
import numpy as np
import pytest
from combinations import in_turn
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from ways import in_way

import fmugym
from fmugym import Uniform
from fmugym.control.linearization import linearize_along
from fmugym.environment.vector import FMUVectorEnv

IDS = (
    "fmugym/CartPole-v0",
    "fmugym/Pendulum-v0",
    "fmugym/ModelicaCartPole-v0",
    "fmugym/CloudPendulum-v0",
)
ABSURD = 1e308
HOOKS = ("arrays", "one by one")
each_way = pytest.mark.parametrize("hooks", HOOKS)
each_mode = pytest.mark.parametrize("mode", AutoresetMode, ids=lambda mode: mode.name)
CART_POLE = fmugym.envs.CartPoleEnv


def in_each_mode(axes, hooks=HOOKS):
    """Each way of calling hooks in each mode of autoreset, with values of others in turn."""
    cells = {f"{way}-{mode.name}": (way, mode) for way in hooks for mode in AutoresetMode}
    return in_turn({"hooks,mode": cells} | axes)


def require_equal(first, second, rtol=0.0):
    """Same types, shapes and values; dicts, tuples and arrays of objects element by element."""
    if isinstance(first, tuple):
        assert len(first) == len(second)
        for one, other in zip(first, second, strict=True):
            require_equal(one, other, rtol)
        return
    if isinstance(first, Mapping):
        assert first.keys() == second.keys()
        for key in first:
            require_equal(first[key], second[key], rtol)
        return
    first, second = np.asarray(first), np.asarray(second)
    assert (first.dtype, first.shape) == (second.dtype, second.shape)
    if rtol and first.dtype.kind == "f":
        np.testing.assert_allclose(first, second, rtol=rtol, atol=rtol)
    else:
        np.testing.assert_array_equal(first, second)


def methods(envs, snapshot):
    """Calls of the methods that need an open environment and no step that goes on, by their names.

    ``envs`` are three cart-poles, and ``snapshot`` is of them.
    """
    actions = np.zeros(3, np.int64)
    return {
        "reset": envs.reset,
        "step": lambda: envs.step(actions),
        "step_around": lambda: envs.step_around(actions, np.array([True, False, False])),
        "step_async": lambda: envs.step_async(actions),
        "render": envs.render,
        "save_state": envs.save_state,
        "restore_state": lambda: envs.restore_state(snapshot),
        "rollout": lambda: envs.rollout(snapshot, np.zeros((3, 2), np.int64)),
        "get_attr": lambda: envs.get_attr("state"),
        "set_attr": lambda: envs.set_attr("force_mag", 10.0),
        "call": lambda: envs.call("_get_info"),
        "health": lambda: envs.health,
        "linearize_along": lambda: linearize_along(envs, snapshot[0], []),
    }


def of_one(value, index):
    """The part of results that belongs to one of many environments."""
    if isinstance(value, Mapping):
        masks = {name: value.get(f"_{name}") for name in value if not name.startswith("_")}
        told = (name for name, mask in masks.items() if mask is None or mask[index])
        return {name: of_one(value[name], index) for name in told}
    if isinstance(value, tuple):
        return tuple(of_one(part, index) for part in value)
    return value[index]


def require_same_infos(first, second, rtol=0.0):
    """What counts of an entry is only what its mask says."""
    assert first.keys() == second.keys()
    for key in first:
        if f"_{key}" not in first:
            continue
        mask = first[f"_{key}"]
        assert mask.dtype == second[f"_{key}"].dtype == np.bool_
        assert mask.tolist() == second[f"_{key}"].tolist(), key
        if isinstance(first[key], Mapping) and isinstance(second[key], Mapping):
            require_same_infos(first[key], second[key], rtol)
            continue
        if isinstance(first[key], Mapping):  # the last observations, which Gymnasium has as objects
            for index in np.flatnonzero(mask):
                require_equal(of_one(first[key], index), second[key][index], rtol)
            continue
        for left, right in zip(first[key][mask], second[key][mask], strict=True):
            require_equal(left, right, rtol)


def sampled_actions(env, count, seed=0):
    env.action_space.seed(seed)
    return [env.action_space.sample() for _ in range(count)]


def results_of_both(
    ours, theirs, steps=40, seed=3, rtol=0.0, same=require_equal, same_infos=require_same_infos
):
    """Reset both and step them with the same actions, after which they must tell the same.

    Episodes that do not start by themselves are started again.

    Args:
        steps: How many steps, or the actions of each.
        rtol: How far rewards may differ.
        same: Compares observations, rewards and flags.
        same_infos: Compares the infos of steps.

    Yields:
        The result of each step.
    """
    require_same_starts(ours.reset(seed=seed), theirs.reset(seed=seed))
    for actions in sampled_actions(ours, steps) if isinstance(steps, int) else steps:
        a, b = ours.step(actions), theirs.step(actions)
        same(a[0], b[0])
        require_equal(a[1], b[1], rtol) if rtol else same(a[1], b[1])
        same(a[2], b[2])
        same(a[3], b[3])
        same_infos(a[4], b[4])
        yield a
        ended = a[2] | a[3]
        if ours.metadata["autoreset_mode"] is AutoresetMode.DISABLED and ended.any():
            starts = (envs.reset(options={"reset_mask": ended.copy()}) for envs in (ours, theirs))
            require_same_starts(*starts)


def require_same_starts(first, second):
    """The same observations and infos of two resets."""
    require_equal(first[0], second[0])
    require_same_infos(first[1], second[1])


def run_side_by_side(ours, theirs, steps=60, method=None, **options):
    """Compare all results of both and close them; returns how many episodes have ended.

    A method is called after each step.
    """
    ends = 0
    with contextlib.closing(ours), contextlib.closing(theirs):
        for result in results_of_both(ours, theirs, steps, **options):
            ends += int((result[2] | result[3]).sum())
            if method is not None:
                require_equal(ours.call(method), theirs.call(method))
    return ends


def make_pair(cls, mode=AutoresetMode.NEXT_STEP, num_envs=4, way="arrays", **kw):
    ours = FMUVectorEnv(in_way(way, lambda: cls(**kw)), num_envs, autoreset_mode=mode)
    theirs = SyncVectorEnv([lambda: cls(**kw)] * num_envs, autoreset_mode=mode)
    return ours, theirs


def require_same_alone(make, steps, mode="next_step", method=None, way=None, **options):
    """Three environments give what single ones give, to the last bit; returns how many ends.

    Their hooks are called in a way; None stands for that of the class. A method is called after
    each step.
    """
    mode = AutoresetMode[mode.upper()]
    ours = FMUVectorEnv(in_way(way, make), 3, autoreset_mode=mode, **options)
    assert way in (None, ours.task.way)
    theirs = SyncVectorEnv([make] * 3, autoreset_mode=mode)
    return run_side_by_side(ours, theirs, steps, method)


class Drawing(fmugym.FMUEnv):
    """All start values drawn; what is drawn is up to the config."""

    def __init__(self, **changes):
        config = {
            "model_input_names": ["tau"],
            "model_output_names": ["q", "q_dot"],
            "model_parameters": {"q_0": Uniform(-1.0, 1.0), "q_dot_0": Uniform(-0.5, 0.5)},
            "bounds": {"tau": (-0.01, 0.01)},
            "time_step": 0.02,
            "max_episode_steps": 3,
        }
        super().__init__(fmugym.bundled_fmu("Pendulum"), config | changes)

    def _is_done(self):
        return self.state[0] != self.state[0]


class Pushed(Drawing):
    """Two actions and a monitored variable, for hooks of all kinds."""

    space = gym.spaces.Box(-1.0, 1.0, (2,), np.float32)

    def __init__(self, **changes):
        parameters = {"q_0": Uniform(-1.0, 1.0), "q_dot_0": Uniform(-0.5, 0.5)}
        config = {"model_parameters": parameters, "max_episode_steps": 7}
        super().__init__(**(config | {"monitor_names": ["theta_ddot"]} | changes))

    def _get_action_space(self):
        return self.space

    def _get_inputs(self):
        return [0.01 * np.sum(self.action, axis=0, dtype=np.float64)]

    def _is_done(self):
        return self.state[0] > 0.8


class Remembering(Drawing):
    """Reads everything that a hook may read, with arithmetic that is exact in numpy."""

    def __init__(self, **changes):
        config = {
            "model_parameters": {"q_0": Uniform(-1.0, 1.0), "m": Uniform(0.05, 0.07)},
            "episode_variables": {"target": Uniform(-1.0, 1.0), "sum": 0.0, "last": 5.0, "pace": 0},
            "monitor_names": ["theta_ddot"],
            "max_episode_steps": 7,
        }
        super().__init__(**(config | changes))

    def _update(self):
        self.variables["pace"] = self.out["q"] - self.variables["last"]
        self.variables["last"] = self.out["q"]
        self.variables["sum"] += self.variables["target"] - self.out["q"]

    def _is_done(self):
        return abs(self.variables["sum"]) > 4.0

    def _is_truncated(self):
        return (self.time > 0.11) & (self.out["theta_ddot"] > 0)

    def _reward_policy(self):
        q, q_dot = self.previous_state
        effort = self.action[0] - 0.5 * self.previous_action[0]
        reward = -abs(q) - q_dot * q_dot - np.float64(effort) - self.parameters["m"]
        return np.where(self.done, -10.0, reward)

    def _get_observation_space(self):
        box = gym.spaces.Box(-np.inf, np.inf, (3,), np.float32)
        return gym.spaces.Dict({"plant": box, "task": gym.spaces.Box(-np.inf, np.inf, (2,))})

    def _get_observation(self):
        q, q_dot = self.state
        plant = np.array([q, q_dot, self.previous_state[0]], np.float32)
        task = np.array([self.variables["sum"], self.variables["pace"]], np.float32)
        return {"plant": plant, "task": task}

    def _get_info(self):
        return {
            "acceleration": self.out["theta_ddot"],
            "input": self.inputs[0],
            "before": self.previous_action,
            "time": self.time,
            "steps": self.step_count,
            "last": self.variables["last"],
            "done": self.done,
            "kind": "brake",
            "nested": {"target": self.variables["target"]},
        }


class Cart(fmugym.FMUEnv):
    """A cart-pole that fails (Discard) under an absurd force."""

    def __init__(self, **config):
        defaults = {
            "model_input_names": "f",
            "model_output_names": ["x", "x_dot"],
            "model_parameters": {"x_0": Uniform(-1.0, 1.0)},
            "time_step": 0.02,
            "fault_reward": -7.0,
            "episode_variables": {"steps": 0.0},
            "max_episode_steps": 9,
        }
        super().__init__(fmugym.bundled_fmu("CartPole"), defaults | config)

    def _update(self):
        self.variables["steps"] = self.variables["steps"] + 1.0

    def _get_action_space(self):
        return gym.spaces.Box(-np.inf, np.inf, (1,), np.float64)

    def _get_info(self):
        return {"steps": self.variables["steps"]}

    def _is_done(self):
        return abs(self.state[0]) > 5.0


class PushedCart(Cart):
    """The same with two actions and plain hooks, which can be compiled."""

    _update = fmugym.FMUEnv._update
    _get_info = fmugym.FMUEnv._get_info

    def __init__(self, **config):
        super().__init__(episode_variables={}, **config)

    def _get_action_space(self):
        return gym.spaces.Discrete(2)

    def _get_inputs(self):
        return self.action * ABSURD


class Reaching(Drawing):
    """A goal task."""

    def __init__(self, **changes):
        super().__init__(episode_variables={"goal": Uniform(-1.0, 1.0)}, **changes)

    def _get_observation_space(self):
        box = gym.spaces.Box(-np.inf, np.inf, (1,), np.float64)
        return gym.spaces.Dict({"achieved_goal": box, "desired_goal": box, "observation": box})

    def _get_observation(self):
        q, q_dot = self.state
        goal = self.variables["goal"]
        parts = {"achieved_goal": q, "desired_goal": goal, "observation": q_dot}
        return {name: np.array([part]) for name, part in parts.items()}

    def _goal_reward(self, achieved_goal, desired_goal):
        return -(np.abs(achieved_goal - desired_goal)[..., 0] > 0.5).astype(np.float64)


class Historic(Drawing):
    """Keeps several numbers in one episode variable."""

    def __init__(self):
        super().__init__(episode_variables={"history": 0.0})

    def _update(self):
        q, q_dot = self.state
        self.variables["history"] = np.array([q, q_dot]) + 0.5 * self.variables["history"]

    def _reward_policy(self):
        return self.variables["history"][0] + self.variables["history"][1]


class Shifted(Drawing):
    """A ``Discrete`` that does not begin with 0; what was before the first action is its start."""

    def _get_action_space(self):
        return gym.spaces.Discrete(3, start=-1)

    def _get_inputs(self):
        return 0.01 * self.action

    def _reward_policy(self):
        return self.action + 10 * self.previous_action

    def _get_info(self):
        return {"action": self.action, "before": self.previous_action}


# What callers may do to an array of results in place.


def reshape(array):
    array.shape = (array.size, 1, 1)


def retype(array):
    array.dtype = np.uint8


def protect(array):
    array.flags.writeable = False


def grow(array):
    array.resize(1000, refcheck=False)
