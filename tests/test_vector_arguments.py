"""Arguments of vector environments that do not fit are refused by name."""

import gymnasium as gym
import numpy as np
import pytest
from vector_tools import Drawing, each_way

from fmugym import ConfigError
from fmugym.vector import FMUVectorEnv


@pytest.mark.parametrize("seed", [[1, 2], [1, 2, 3, 4], 1.5])
def test_seeds_that_do_not_fit(seed):
    vector = FMUVectorEnv(Drawing, 3)
    with pytest.raises(ConfigError, match="seed"):
        vector.reset(seed=seed)
    vector.close()


@pytest.mark.parametrize(
    "mask",
    [
        [True, False],
        [1, 0, 1],
        np.zeros(3, bool),
        np.ones((3, 1), bool),
        np.ones(3),
        "all",
    ],
)
def test_masks_that_do_not_fit(mask):
    vector = FMUVectorEnv(Drawing, 3)
    vector.reset(seed=0)
    with pytest.raises(ConfigError, match="must be a Boolean array of shape"):
        vector.reset(options={"reset_mask": mask})
    vector.close()


@each_way
def test_unknown_options_are_named(backend, hooks):
    vector = FMUVectorEnv(Drawing, 2, hooks=hooks, backend=backend)
    with pytest.raises(ConfigError, match="did you mean 'model_parameters'"):
        vector.reset(options={"model_parameter": {}})
    with pytest.raises(ConfigError, match="unknown"):
        vector.reset(options={"model_parameters": {"q_00": 1.0}})
    vector.close()


def test_unknown_ways_and_modes():
    with pytest.raises(ConfigError, match="did you mean 'array'"):
        FMUVectorEnv(Drawing, 2, hooks="arrays")
    with pytest.raises(ConfigError, match="did you mean 'next_step'"):
        FMUVectorEnv(Drawing, 2, autoreset_mode="nextstep")
    with pytest.raises(ConfigError, match="unwrapped environment of fmugym, got CartPoleEnv"):
        FMUVectorEnv(lambda: gym.make("CartPole-v1").unwrapped, 2)


@pytest.mark.parametrize("num_envs", [0, -1, 2.5])
def test_numbers_of_environments_that_make_no_sense(num_envs):
    with pytest.raises(ConfigError, match="num_envs must be a positive integer"):
        FMUVectorEnv(Drawing, num_envs)
