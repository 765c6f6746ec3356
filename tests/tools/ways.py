"""Ways of calling hooks that a class does not choose itself: to compare them with each other."""

import functools
import sys
from pathlib import Path

import gymnasium
from gymnasium.envs.registration import load_env_creator

sys.path.append(str(Path(__file__).parents[2] / "benchmarks"))  # for programs in this folder
from calling import ARRAYS, EACH, EXPRESSIONS, in_python, in_way

from fmugym.environment.vector import FMUVectorEnv, vectorized

__all__ = ["ALL_WAYS", "WAYS", "in_python", "in_way", "make_vec", "many"]

WAYS = (ARRAYS, EACH)
ALL_WAYS = (EXPRESSIONS, *WAYS)


def many(make, num_envs=1, *, way=None, **options):
    """A vector environment whose hooks are called in a way."""
    return FMUVectorEnv(in_way(way, make), num_envs, **options)


def make_vec(way, env_id, num_envs, **options):
    """The vector environment of a registered environment whose hooks are called in a way."""
    spec = gymnasium.spec(env_id)
    make = functools.partial(load_env_creator(spec.entry_point), **spec.kwargs)
    options = {"max_episode_steps": spec.max_episode_steps} | options
    return vectorized(in_way(way, make))(num_envs, **options)
