"""Surrogates for tests."""

from contextlib import closing

import numpy as np

from fmugym import FMUVectorEnv
from fmugym.control.surrogate.recorded_trajectories import Trajectories
from fmugym.control.surrogate.surrogate_fit import fit


def surrogate_of(make_env, held, steps, episodes=8):
    """A surrogate that is fitted to episodes with random actions, each held for some steps."""
    trajectories, rng = Trajectories(), np.random.default_rng(0)
    with closing(FMUVectorEnv(make_env, episodes, backend=trajectories)) as envs:
        low, high = envs.single_action_space.low, envs.single_action_space.high
        envs.reset(seed=0)
        for _ in range(steps // held):
            action = rng.uniform(low, high, (episodes, *low.shape)).astype(np.float32)
            for _ in range(held):
                envs.step(action)
    return fit(trajectories)
