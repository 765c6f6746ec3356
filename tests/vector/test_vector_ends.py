"""What compiled steps tell of ends in the mode ``SAME_STEP``: as Gymnasium's ``SyncVectorEnv``.

Arrays that nobody holds are used again, so these tests hold, change and drop what they are told.
"""

import contextlib
import copy
import functools
import gc
import pickle
import sys
import tracemalloc

import gymnasium as gym
import numpy as np
import pytest
import test_vector_results
from combinations import in_turn
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from vector_tools import (
    CART_POLE,
    Drawing,
    require_equal,
    sampled_actions,
)
from ways import in_way

from fmugym import FMUVectorEnv, SimulationError

try:
    import _testcapi as testcapi
except ImportError:
    testcapi = None


SAME_STEP = AutoresetMode.SAME_STEP
NUM_ENVS, STEPS = 6, 60
BOX = gym.spaces.Box(-np.inf, np.inf, (2,), np.float32)


class Shaped(Drawing):
    """Observations of a form of their own; the number of steps differs between environments."""

    def __init__(self):
        super().__init__(max_episode_steps=5)

    def _is_done(self):
        return self.state[0] > 0.5

    def _array(self):
        return np.array([self.state[0], self.state[1]], np.float32)


class Named(Shaped, test_vector_results.Named):
    """A dict of arrays."""


class Square(Shaped):
    """An array with two axes."""

    def _get_observation_space(self):
        return gym.spaces.Box(-np.inf, np.inf, (2, 2), np.float64)

    def _get_observation(self):
        return np.array([[self.state[0], self.state[1]], [self.previous_state[0], self.time]])


class Telling(Shaped):
    """Dicts in dicts, and infos."""

    def _get_observation_space(self):
        inner = gym.spaces.Dict({"state": BOX, "time": gym.spaces.Box(0, 99, (1,))})
        return gym.spaces.Dict({"plant": inner, "steps": gym.spaces.Box(0, 99, (1,), np.int64)})

    def _get_observation(self):
        plant = {"state": self._array(), "time": np.array([self.time], np.float32)}
        return {"plant": plant, "steps": np.array([self.step_count])}

    def _get_info(self):
        return {"angle": self.state[0], "nested": {"speed": self.state[1]}}


TASKS = [CART_POLE, Square, Telling]


def made(task, num_envs=NUM_ENVS):
    envs = FMUVectorEnv(in_way("arrays", task), num_envs, autoreset_mode=SAME_STEP)
    envs.reset(seed=0)
    return envs


def infos_of(envs, steps=STEPS):
    """The infos of the steps in which episodes end."""
    for actions in sampled_actions(envs, steps):
        infos = envs.step(actions)[4]
        if "final_obs" in infos:
            yield infos
            infos = None  # so that nobody holds them in the next step


def require_same_form(mine, theirs):
    """The same keys in the same order, types and values, also outside of the masks."""
    assert list(mine) == list(theirs)
    for name, value in mine.items():
        other = theirs[name]
        if isinstance(other, dict):
            assert isinstance(value, dict)
            require_same_form(value, other)
        elif other.dtype == object:
            assert (value.dtype, value.shape) == (other.dtype, other.shape)
            for a, b in zip(value, other, strict=True):
                assert type(a) is type(b)
                if b is not None:
                    require_equal(a, b)
        else:
            require_equal(value, other)


def final(infos):
    return {name: value for name, value in infos.items() if "final" in name}


@pytest.mark.parametrize("task", TASKS)
def test_the_form_is_that_of_gymnasium(task):
    ours = made(task)
    theirs = SyncVectorEnv([task] * NUM_ENVS, autoreset_mode=SAME_STEP)
    theirs.reset(seed=0)
    ends = 0
    for actions in sampled_actions(ours, STEPS):
        mine, other = ours.step(actions)[4], theirs.step(actions)[4]
        assert ("final_obs" in mine) == ("final_obs" in other)
        if "final_obs" in mine:
            require_same_form(final(mine), final(other))
            ends += int(mine["_final_obs"].sum())
    assert ends > NUM_ENVS
    ours.close()
    theirs.close()


def observations_in(objects):
    """The arrays in an array of objects."""
    for value in objects:
        if isinstance(value, dict):
            yield from observations_in(value.values())
        elif value is not None:
            yield value


@functools.cache
def told(task):
    """What a run tells, copied at once."""
    envs = made(task)
    copies = [copy.deepcopy(final(infos)) for infos in infos_of(envs)]
    envs.close()
    assert len(copies) > 5
    return copies


class Calling:
    """An object that lets the environments step when nobody refers to it any more."""

    def __init__(self, envs):
        self.envs = envs

    def __del__(self):
        if not self.envs.closed:
            self.envs.step(self.envs.action_space.sample())


class Own(np.ndarray):
    """Arrays of a class of the caller's."""


def locked(array):
    array.flags.writeable = False
    return array


FOREIGN = {
    "number": lambda envs: 7,
    "other type": lambda envs: np.zeros(4),
    "other size": lambda envs: np.zeros(1, np.float32),
    "view": lambda envs: np.zeros((9, 4), np.float32)[3],
    "read-only": lambda envs: locked(np.full(4, np.nan, np.float32)),
    "other byte order": lambda envs: np.full(4, np.nan, ">f4"),
    "subclass": lambda envs: np.ndarray.__new__(Own, 4, np.float32),
    "dict": lambda envs: {"state": 7, 3: np.zeros(2, np.float32)},
    "object that steps": Calling,
}


@in_turn({"make": FOREIGN, "task": [CART_POLE, Named]})
def test_objects_of_the_caller_do_not_come_back(task, make):
    envs, own = made(task), set()
    for infos in infos_of(envs):
        objects, mask = infos["final_obs"], infos["_final_obs"]
        own |= {type(value) for value in objects}
        assert [value is not None for value in objects] == mask.tolist()
        for row in observations_in(objects):
            assert row.base is None
            assert np.isfinite(row).all()
        objects[:] = [make(envs) for _ in objects]
        del infos, objects, mask, row
    assert own == {type(None), dict if task is Named else np.ndarray}
    envs.close()


@pytest.mark.parametrize("task", TASKS)
def test_copies_are_plain_and_equal(task):
    envs = made(task)
    for infos in infos_of(envs):
        for copied in (copy.deepcopy(infos), pickle.loads(pickle.dumps(infos))):
            assert type(copied) is dict
            require_same_form(copied, infos)
        assert infos["_final_obs"] is not infos["_final_info"]
    envs.close()


@in_turn({"task": [CART_POLE, Telling], "holds": [False, True]})
def test_nothing_leaks(task, holds):
    envs = made(task, 12)
    watched = (None, True, False, "final_obs", "_final_obs", "final_info", "drawn", "state")

    def play():
        kept = [infos for infos in infos_of(envs, 400) if holds]
        assert holds == bool(kept)
        del kept
        gc.collect()
        return [sys.getrefcount(value) for value in watched], len(gc.get_objects())

    play()
    play()
    tracemalloc.start()
    first, (before, objects), size = play(), play(), tracemalloc.get_traced_memory()[0]
    (after, left), later = play(), tracemalloc.get_traced_memory()[0]
    tracemalloc.stop()
    assert first
    assert all(abs(b - a) < 50 for a, b in zip(before, after, strict=True))
    assert abs(left - objects) < 50
    assert abs(later - size) < 10_000
    envs.close()


class Failing:
    """Play of which one call finds no memory for one of its allocations."""

    def __init__(self, play):
        self.play, self.calls, self.allocation = play, 0, 0

    def __call__(self, *args):
        self.calls -= 1
        if self.calls:
            return self.play(*args)
        testcapi.set_nomemory(self.allocation, self.allocation + 1)
        try:
            return self.play(*args)
        finally:
            testcapi.remove_mem_hooks()


def with_failing(task, monkeypatch):
    """Environments, and what lets their calls fail."""
    envs, made_of = made(task), []
    prepare = envs.inside.pool.prepare_play

    def prepared(*parts):
        play = prepare(*parts)
        made_of.append(Failing(play.start_and_step))
        return play._replace(start_and_step=made_of[-1])

    monkeypatch.setattr(envs.inside.pool, "prepare_play", prepared)
    envs.inside.engine._prepare(envs.inside.engine._task)
    envs.reset(seed=0)
    return envs, made_of[-1]


@pytest.mark.skipif(testcapi is None, reason="this Python has no module _testcapi")
@pytest.mark.parametrize("task", [CART_POLE, Telling])
def test_missing_memory_leaves_everything_in_order(task, monkeypatch):
    expected, failures = told(task), 0
    envs, failing = with_failing(task, monkeypatch)
    for number in range(40):
        kept, failing.calls, failing.allocation = [], 1 + number, number % 8
        with contextlib.suppress(MemoryError):
            kept.extend(infos_of(envs))
        if failing.calls <= 0 and len(kept) < len(expected):
            failures += 1
            with pytest.raises(SimulationError, match="call reset"):
                envs.step(envs.action_space.sample())
        failing.calls = 0
        for infos, wanted in zip(kept, expected, strict=False):
            require_same_form(final(infos), wanted)
        del kept
        envs.reset(seed=0)
        for infos, wanted in zip(infos_of(envs), expected, strict=True):
            require_same_form(final(infos), wanted)
        envs.reset(seed=0)
    assert failures > 7
    envs.close()
