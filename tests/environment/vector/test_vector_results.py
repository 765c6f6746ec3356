"""The arrays that compiled steps return belong to the caller, also where memory is used again."""

import contextlib
import gc
import pickle
import weakref
from itertools import product

import gymnasium as gym
import numpy as np
import pytest
from combinations import in_turn
from vector_tools import CART_POLE, Drawing, grow, protect, reshape, retype, sampled_actions
from ways import in_way

from fmugym import FMUVectorEnv

NUM_ENVS, STEPS = 3, 40


class Named(Drawing):
    """The observation is a dict of two arrays."""

    def _get_observation_space(self):
        box = gym.spaces.Box(-np.inf, np.inf, (2,), np.float32)
        return gym.spaces.Dict({"state": box, "steps": gym.spaces.Box(0, 99, (1,), np.int64)})

    def _get_observation(self):
        state = np.array([self.state[0], self.state[1]], np.float32)
        return {"state": state, "steps": np.array([self.step_count])}


class Telling(Named):
    """Infos are compiled, too."""

    def _get_info(self):
        return {"angle": self.state[0]}


TASKS = (CART_POLE, Named, Telling)
MODES = ("next_step", "same_step")


def make(task, mode="next_step"):
    envs = FMUVectorEnv(in_way("arrays", task), NUM_ENVS, autoreset_mode=mode)
    envs.reset(seed=0)
    return envs


def arrays_of(result):
    """All arrays of a result, those of dicts and those in arrays of objects, too."""
    for part in result:
        if isinstance(part, dict):
            yield from arrays_of(part.values())
        elif part is not None:
            yield part
            yield from arrays_of(part if part.dtype == object else ())


def numbers_of(result):
    return [array for array in arrays_of(result) if array.dtype != object]


def played(task, mode="next_step"):
    """The numbers that each step returns, copied at once."""
    envs = make(task, mode)
    results = map(envs.step, sampled_actions(envs, STEPS))
    copies = [[array.copy() for array in numbers_of(result)] for result in results]
    envs.close()
    return copies


def require_same(first, second):
    for mine, other in zip(first, second, strict=True):
        assert (mine.dtype, mine.shape) == (other.dtype, other.shape)
        np.testing.assert_array_equal(mine, other)


def held_in_turn(arrays, step):
    """One array of each step, so that only some of its arrays are free."""
    return arrays[step % len(arrays) :][:1]


def held_views(arrays, step):
    return [array[...] for array in arrays]


def held_buffers(arrays, step):
    return list(map(memoryview, arrays))


@in_turn(
    {"mode,hold": list(product(MODES, [held_in_turn, held_views, held_buffers])), "task": TASKS}
)
def test_what_the_caller_holds_does_not_change(task, mode, hold):
    """Nor do whole results, as test_vector_infos.py shows."""
    envs, kept = make(task, mode), []
    for step, actions in enumerate(sampled_actions(envs, STEPS)):
        held = hold(list(arrays_of(envs.step(actions))), step)
        kept.append((held, contents(held)))
    envs.close()
    for held, then in kept:
        assert contents(held) == then


def contents(held):
    return pickle.dumps(list(map(np.asarray, held)))


def shrink(array):
    array.resize(1, refcheck=False)


@in_turn(
    {"mode,change": list(product(MODES, [reshape, retype, protect, shrink, grow])), "task": TASKS}
)
@pytest.mark.filterwarnings("ignore:Setting the:DeprecationWarning")
def test_what_the_caller_changes_in_place_does_not_come_back(task, mode, change):
    expected, envs = played(task, mode), make(task, mode)
    for actions, wanted in zip(sampled_actions(envs, STEPS), expected, strict=True):
        arrays = numbers_of(envs.step(actions))
        require_same(arrays, wanted)
        assert all(array.flags.writeable and array.flags.owndata for array in arrays)
        while arrays:
            array = arrays.pop()
            if not any(array is other for other in arrays):  # names may share a mask
                change(array)
        del array
    envs.close()


@in_turn({"task": TASKS, "mode": MODES})
def test_weak_references_end(task, mode):
    envs, references = make(task, mode), []
    for actions in sampled_actions(envs, STEPS):
        result = envs.step(actions)
        assert all(weakref.getweakrefcount(array) == 0 for array in arrays_of(result))
        references += [weakref.ref(array) for array in arrays_of(result)]
    del result
    envs.close()
    del envs
    gc.collect()
    assert [reference() for reference in references] == [None] * len(references)


SEEN, REAL, FLAGS = np.empty((3, 4), np.float32), np.empty(3), np.empty(3, bool)
DRAWN = np.empty((4, 3))
ARRAYS = SEEN, REAL, FLAGS, FLAGS, FLAGS, DRAWN


FITTING = {"are_of_one": False, "arrays": ARRAYS}


def test_results_that_fit_are_taken(monkeypatch):
    require_refused(tuple(FITTING.values()), monkeypatch, refused=False)


@pytest.mark.parametrize(
    "changes",
    [
        {"arrays": ()},
        {"arrays": ARRAYS[:-1]},
        {"arrays": ARRAYS[:3]},
        {"arrays": (np.empty((3, 5), np.float32), *ARRAYS[1:])},
        {"arrays": (SEEN, np.empty(3, np.float32), *ARRAYS[2:])},
        {"arrays": (*ARRAYS[:-2], np.empty(4, bool), DRAWN)},
        {"arrays": (*ARRAYS[:-1], np.empty((5, 3)))},
        {"arrays": 7},
        {"are_of_one": True},
    ],
)
def test_results_that_do_not_fit_are_refused(changes, monkeypatch):
    require_refused(tuple((FITTING | changes).values()), monkeypatch)


def test_results_that_are_incomplete_are_refused(monkeypatch):
    require_refused(tuple(FITTING.values())[:-1], monkeypatch)


def require_refused(results, monkeypatch, *, refused=True):
    envs = make(CART_POLE)
    prepare = envs.pool.prepare_play

    def with_others(*parts):
        return prepare(*parts[:-1], parts[-1] | {"results": results})

    monkeypatch.setattr(envs.pool, "prepare_play", with_others)
    with pytest.raises((TypeError, ValueError)) if refused else contextlib.nullcontext():
        envs.task.rebind()
    envs.close()
