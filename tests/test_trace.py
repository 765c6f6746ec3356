"""Hooks compiled for the native pool give what they give with numpy, or are not compiled."""

import gymnasium as gym
import numpy as np
import pytest

import fmugym
from fmugym import ConfigError, Uniform
from fmugym.vector.hooks.program import UntraceableError
from fmugym.vector.hooks.trace import trace_hooks

START = {name: Uniform(-0.5, 0.5) for name in ("x_0", "x_dot_0", "phi_0", "phi_dot_0")}


class Plain(fmugym.FMUEnv):
    """A cart-pole whose hooks the tests replace."""

    def __init__(self, **config):
        defaults = {
            "model_input_names": "f",
            "model_output_names": ["x", "x_dot", "phi", "phi_dot"],
            "model_parameters": START | {"theta_0": np.pi / 2, "m_pole": Uniform(0.5, 2.0)},
            "monitor_names": ["theta"],
            "time_step": 0.05,
            "max_episode_steps": 30,
        }
        super().__init__(fmugym.bundled_fmu("CartPole"), defaults | config)

    def _get_action_space(self):
        return gym.spaces.Discrete(5, start=-2)

    def _get_inputs(self):
        return 10.0 * self.action

    def _is_done(self):
        return abs(self.state[0]) > 1.0


class Rich(Plain):
    """All that can be compiled, at once."""

    def _get_inputs(self):
        push = np.where(self.action == 0, 0.5, self.action / 2.0)
        return [np.maximum(np.minimum(12.0 * push, 11.0), -11.0) - (-1.0)]

    def _is_done(self):
        x, _, phi, phi_dot = self.state
        gone = (np.abs(x) >= 1.0) | np.logical_and(phi < -0.6, np.float64(0.0) >= phi_dot)
        return gone | ~(phi <= 0.6) & np.logical_not(x == 0.25) & (x != 0.125)

    def _is_truncated(self):
        return self.step_count > 25

    def _reward_policy(self):
        x, x_dot, phi, _ = self.state
        cost = np.sqrt(np.square(x) + x_dot * x_dot) + abs(self.inputs[0]) / 20.0
        bonus = np.where(self.done, -5.0, 1.0 - cost) + 0.1 * self.parameters["m_pole"]
        weight = np.float64(0.01)
        return bonus - weight * (self.out["theta"] - np.pi / 2) * self.time - phi * phi


@pytest.mark.parametrize("num_envs", [1, 31, 33, 200])
@pytest.mark.parametrize("mode", ["next_step", "same_step"])
def test_compiled_hooks_are_identical_to_those_on_arrays(num_envs, mode):
    compiled, arrays = (
        fmugym.FMUVectorEnv(Rich, num_envs, hooks=hooks, autoreset_mode=mode)
        for hooks in ("compiled", "array")
    )
    first, second = compiled.reset(seed=3)[0], arrays.reset(seed=3)[0]
    ends = 0
    for step in range(120):
        assert first.tolist() == second.tolist()
        rng = np.random.default_rng(step)
        actions = rng.integers(-2, 3, num_envs)
        one, other = compiled.step(actions), arrays.step(actions)
        for a, b in zip(one[1:4], other[1:4], strict=True):
            assert a.dtype == b.dtype
            assert a.tolist() == b.tolist()
        assert one[4].keys() == other[4].keys()
        ends += int((one[2] | one[3]).sum())
        first, second = one[0], other[0]
    assert ends >= num_envs
    compiled.close()
    arrays.close()


@pytest.mark.parametrize("name", ["CartPole", "ModelicaCartPole", "Pendulum", "CloudPendulum"])
def test_the_bundled_environments_are_compiled(name):
    gym.make_vec(f"fmugym/{name}-v0", num_envs=2, hooks="compiled").close()


def test_bad_actions_are_refused_before_anything_is_stepped():
    envs = fmugym.FMUVectorEnv(Plain, 3, hooks="compiled")
    twin = fmugym.FMUVectorEnv(Plain, 3, hooks="compiled")
    envs.reset(seed=1)
    twin.reset(seed=1)
    with pytest.raises(ConfigError, match="action 3 of environment 1 is not in Discrete"):
        envs.step(np.array([0, 3, 0]))
    with pytest.raises(ConfigError, match="expected integers"):
        envs.step(np.array([0.0, 0.5, 0.0]))
    with pytest.raises(ConfigError, match="have shape"):
        envs.step(np.array([0, 1]))
    for actions in (np.array([1, -2, 2]), [1, -2, 2], np.array([1, -2, 2], np.int32)):
        expected = twin.step(np.array([1, -2, 2]))
        assert envs.step(actions)[0].tolist() == expected[0].tolist()
    envs.close()
    twin.close()


def branch(self):
    return self.state[0] > 1.0 if self.state[0] > 0 else False


def solved(self):
    return np.linalg.solve(np.eye(4), self.state)[0] > 1.0


def remembered(self):
    self.worst = self.state[0]
    return self.worst > 1.0


def number(self):
    return self.state[0]


def array(self):
    return self.state[0] > np.array([1.0, 2.0])


def sorted_(self):
    return np.sort(self.state, axis=0)[0] > 1.0


def mixed(self):
    return self.state[0] > np.mean(self.state[0])


def indexed(self):
    return TABLES["levels"][self.action] > 1.0


TABLES = {"levels": np.arange(3.0)}


def selected(self):
    return self.state[0][self.state[0] > 0] > 1.0


@pytest.mark.parametrize(
    ("hook", "reason"),
    [
        (branch, "branches on a value"),
        (solved, "uses numpy.linalg.solve"),
        (remembered, "changes self.worst"),
        (number, "a flag is no Boolean"),
        (array, "operands could not be broadcast|shape mismatch"),
        (sorted_, r"uses numpy\.sort"),
        (mixed, "mixes the values of several environments"),
        (indexed, "needs numpy.take"),
        (selected, "that a condition selects: use numpy.where"),
    ],
)
def test_what_cannot_be_compiled_says_what_and_where(hook, reason):
    class Other(Plain):
        _is_done = hook

    env = Other()
    line = hook.__code__.co_firstlineno
    with pytest.raises(UntraceableError, match=f"_is_done.*({reason})") as caught:
        trace_hooks(env)
    if "line" in str(caught.value):
        assert any(f"line {line + i}:" in str(caught.value) for i in range(1, 4))
    env.close()
