"""Hooks compiled for the native pool give what they give with numpy, or are not compiled."""

import gymnasium as gym
import numpy as np
import pytest

import fmugym
from fmugym import Uniform
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


@pytest.mark.parametrize("name", ["CartPole", "ModelicaCartPole", "Pendulum", "CloudPendulum"])
def test_the_bundled_environments_are_compiled(name):
    gym.make_vec(f"fmugym/{name}-v0", num_envs=2, hooks="compiled").close()


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
