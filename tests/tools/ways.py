"""Ways of calling hooks that a class does not choose itself: to compare them with each other."""

import functools

import gymnasium
from gymnasium.envs.registration import load_env_creator

from fmugym.task.hooks import Hooks
from fmugym.task.step import ORDER
from fmugym.vector import FMUVectorEnv, vectorized

ARRAYS, EACH, EXPRESSIONS = "arrays", "one by one", "expressions"
WAYS = (ARRAYS, EACH)
ALL_WAYS = (EXPRESSIONS, *WAYS)


@functools.cache
def declared(cls, way):
    """A subclass whose hooks call those of the class, and say in which way they work."""
    hooks = (*ORDER, "_goal_reward")
    owners = {name: next(one for one in cls.__mro__ if name in vars(one)) for name in hooks}
    own = [name for name, owner in owners.items() if owner is not Hooks] or ["_is_done"]

    def calling(name):
        return lambda self, *given: getattr(super(made, self), name)(*given)

    body = {name: calling(name) for name in own} | {"vectorized": way == ARRAYS}
    made = type(cls.__name__, (cls,), body | {"__module__": cls.__module__})
    return made


def in_way(way, make):
    """A function like another one, whose hooks are called in a way; None for that of the class."""
    return functools.partial(_made, way, make)


def _made(way, make, *given, **options):
    env = make(*given, **options)
    assert way != EXPRESSIONS or env.inside.formulas is not None
    if way not in (None, EXPRESSIONS):
        env.__class__ = declared(type(env), way)
    return env


def in_python(env):
    """Evaluate the expressions of an environment in Python; for the time before its first reset."""
    env.inside.formulas = None
    return env


def many(make, num_envs=1, *, way=None, **options):
    """A vector environment whose hooks are called in a way."""
    return FMUVectorEnv(in_way(way, make), num_envs, **options)


def make_vec(way, env_id, num_envs, **options):
    """The vector environment of a registered environment whose hooks are called in a way."""
    spec = gymnasium.spec(env_id)
    make = functools.partial(load_env_creator(spec.entry_point), **spec.kwargs)
    options = {"max_episode_steps": spec.max_episode_steps} | options
    return vectorized(in_way(way, make))(num_envs, **options)
