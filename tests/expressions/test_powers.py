"""Powers in expressions are those of the C library."""

import ctypes
import math

import numpy as np
import pytest
from ways import in_way

import fmugym

TASK = {
    "fmu": {"bundled": "Pendulum"},
    "time_step": 0.05,
    "parameters": {"theta_0": {"distribution": "uniform", "low": -3, "high": 3}},
    "variables": {"tau": {"min": -2, "max": 2}},
    "agent": {"actions": "tau", "observations": ["theta", "theta_dot"]},
    "reward": {
        "square": "pow(theta, 2)",
        "cube": "pow(theta_dot, 3)",
        "float32": "powf(theta, 2)",
        "product": "theta**2",
    },
}

POWF = ctypes.CDLL(None).powf
POWF.argtypes, POWF.restype = [ctypes.c_float] * 2, ctypes.c_float


def require_powers(state, terms):
    """Compare the terms of some rewards with the C library's powers of the states."""
    angle, velocity = (row.tolist() for row in np.reshape(state, (-1, 2)).T)
    found = {name: np.reshape(terms[name], -1).tolist() for name in TASK["reward"]}
    assert found == {
        "square": [math.pow(one, 2.0) for one in angle],
        "cube": [math.pow(one, 3.0) for one in velocity],
        "float32": [POWF(one, 2.0) for one in angle],
        "product": [one * one for one in angle],
    }


@pytest.mark.parametrize("hooks", ["expressions", "Python"])
def test_of_one_environment(load, hooks):
    env = load(TASK, way=hooks)
    env.reset(seed=1)
    env.action_space.seed(1)
    for _ in range(200):
        *_, info = env.step(env.action_space.sample())
        require_powers(env.state, info["reward_terms"])


@pytest.mark.parametrize("hooks", ["expressions", "arrays"])
def test_of_many_environments(make_envs, hooks):
    envs = make_envs(in_way(hooks, lambda: fmugym.load(TASK)), 64)
    envs.reset(seed=1)
    envs.action_space.seed(1)
    for _ in range(50):
        *_, infos = envs.step(envs.action_space.sample())
        require_powers(envs.get_attr("state"), infos["reward_terms"])
