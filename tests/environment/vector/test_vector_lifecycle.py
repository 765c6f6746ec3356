"""Vector environments are copied, pickled, sent to other processes, and closed."""

import copy
import functools
import multiprocessing
import pickle
import threading

import cloudpickle
import gymnasium as gym
import numpy as np
import pytest
from combinations import in_turn
from gymnasium.vector import AutoresetMode
from vector_tools import (
    CART_POLE,
    Drawing,
    each_mode,
    each_way,
    methods,
    require_equal,
    sampled_actions,
)
from ways import in_way

from fmugym import ConfigError, SimulationError
from fmugym.environment.vector import FMUVectorEnv, vectorized


def play(env, steps=30):
    """The observations, rewards and ends of some episodes."""
    played = [env.reset(seed=4)[0]]
    for actions in sampled_actions(env, steps):
        played += env.step(actions)[:4]
    return played


COPIES = {
    "copy": copy.copy,
    "deepcopy": copy.deepcopy,
    "pickle": lambda env: pickle.loads(pickle.dumps(env)),
    "cloudpickle": lambda env: pickle.loads(cloudpickle.dumps(env)),
}
MAKERS = {
    "class": lambda: FMUVectorEnv(CART_POLE, 3, autoreset_mode="same_step", max_episode_steps=9),
    "partial": lambda: FMUVectorEnv(
        in_way("arrays", functools.partial(CART_POLE, fmi_version="3.0")), 3
    ),
    "function": lambda: FMUVectorEnv(in_way("one by one", lambda: CART_POLE()), 3),
    "entry point": lambda: vectorized("fmugym.envs:CartPoleEnv")(3, threads=1),
    "id": lambda: gym.make_vec("fmugym/CartPole-v0", 3, max_episode_steps=7),
    "wrapped": lambda: gym.wrappers.vector.RecordEpisodeStatistics(
        gym.make_vec("fmugym/CartPole-v0", 3)
    ),
}


@in_turn({"maker": list(MAKERS), "how": list(COPIES)})
def test_a_copy_is_the_same_construction(maker, how):
    original = MAKERS[maker]()
    original.reset(seed=1)
    copied = COPIES[how](original)
    assert type(copied) is type(original)
    assert repr(copied) == repr(original)
    assert copied.unwrapped.autoreset_mode is original.unwrapped.autoreset_mode
    assert copied.spec == original.spec
    require_equal_lists(play(copied), play(original))
    original.close()
    if (maker, how) != ("wrapped", "copy"):  # a shallow copy of a wrapper wraps the same
        copied.step(sampled_actions(copied, 1)[0])
    copied.close()


def require_equal_lists(first, second):
    assert len(first) == len(second)
    for one, other in zip(first, second, strict=True):
        require_equal(one, other)


def test_what_is_loaded_is_no_copy_of_the_episode():
    original = FMUVectorEnv(CART_POLE, 2)
    original.reset(seed=1)
    loaded = pickle.loads(pickle.dumps(original))
    with pytest.raises(SimulationError, match="step was called before the first reset"):
        loaded.step(np.array([0, 1]))
    original.close()
    assert loaded.reset(seed=1)[0].shape == (2, 4)
    loaded.close()


def test_a_closed_one_makes_a_new_one():
    env = FMUVectorEnv(CART_POLE, 2)
    env.close()
    again = copy.copy(env)
    again.reset()
    again.close()


def in_another_process(env, connection):
    connection.send(play(env))
    env.close()


def test_a_vector_environment_is_sent_to_a_spawned_process():
    env = gym.make_vec("fmugym/CartPole-v0", 3, threads=1)
    context = multiprocessing.get_context("spawn")
    here, there = context.Pipe()
    process = context.Process(target=in_another_process, args=(env, there))
    process.start()
    assert here.poll(60)
    require_equal_lists(here.recv(), play(env))
    process.join(30)
    assert process.exitcode == 0
    env.close()


class Locked(CART_POLE):
    """Its argument cannot be pickled."""

    def __init__(self, lock):
        super().__init__()
        self.lock = lock


def test_what_cannot_be_pickled_is_named(make_envs):
    env = make_envs(functools.partial(Locked, threading.Lock()), 2)
    with pytest.raises(ConfigError, match=r"cannot be pickled: .*lock.*make_env"):
        pickle.dumps(env)
    copy.copy(env).close()


def test_vector_entry_points_pickle():
    entry = pickle.loads(pickle.dumps(vectorized(Drawing)))
    env = entry(2, time_step=0.05)
    env.reset()
    env.step(np.zeros((2, 1), np.float32))
    assert env.get_attr("time") == (0.05, 0.05)
    env.close()


@each_mode
def test_the_mode_is_where_callers_look_for_it(mode):
    """TorchRL reads the attribute, Gymnasium's wrappers read the metadata."""
    for given in (mode, mode.name.lower(), mode.value):
        env = FMUVectorEnv(CART_POLE, 2, autoreset_mode=given)
        assert env.autoreset_mode is env.metadata["autoreset_mode"] is mode
        env.close()
    assert FMUVectorEnv.metadata["autoreset_mode"] is AutoresetMode.NEXT_STEP


@each_way
def test_calls_out_of_order(hooks):
    vector = FMUVectorEnv(in_way(hooks, CART_POLE), 3)
    with pytest.raises(SimulationError, match="step was called before the first reset"):
        vector.step(np.zeros(3, np.int64))
    vector.reset(seed=0)
    calls = methods(vector, vector.save_state())
    vector.close()
    vector.close()
    for name, call in calls.items():
        with pytest.raises(SimulationError, match=f"{name} was called on a closed FMUVectorEnv"):
            call()
