"""The arrays that compiled steps return belong to the caller, also where memory is used again."""

import contextlib
import functools
import gc
import weakref

import gymnasium as gym
import numpy as np
import pytest
from vector_tools import CART_POLE, Drawing, grow, protect, reshape, retype, sampled_actions

from fmugym import ConfigError, FMUVectorEnv
from fmugym.task.values import UNFILLED, LateDict

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


TASKS = [CART_POLE, Named, Telling]


def make(task):
    envs = FMUVectorEnv(task, NUM_ENVS, hooks="compiled")
    envs.reset(seed=0)
    return envs


def arrays_of(result):
    """All arrays of a result, those of dicts, too."""
    for part in result:
        yield from arrays_of(part.values()) if isinstance(part, dict) else (part,)


def copies_of(result):
    return [array.copy() for array in arrays_of(result)]


def played(task):
    """What each step returns, copied at once."""
    envs = make(task)
    copies = [copies_of(envs.step(actions)) for actions in sampled_actions(envs, STEPS)]
    envs.close()
    return copies


def require_same(first, second):
    for mine, other in zip(first, second, strict=True):
        assert (mine.dtype, mine.shape) == (other.dtype, other.shape)
        np.testing.assert_array_equal(mine, other)


def held_all(result, step):
    return list(arrays_of(result))


def held_in_turn(result, step):
    """One array of each step, so that only some of its arrays are free."""
    arrays = list(arrays_of(result))
    return arrays[step % len(arrays) :][:1]


def held_views(result, step):
    return [array[...] for array in arrays_of(result)]


def held_buffers(result, step):
    return [memoryview(array) for array in arrays_of(result)]


@pytest.mark.parametrize("task", TASKS)
@pytest.mark.parametrize("hold", [held_all, held_in_turn, held_views, held_buffers])
def test_what_the_caller_holds_does_not_change(task, hold):
    envs, kept = make(task), []
    for step, actions in enumerate(sampled_actions(envs, STEPS)):
        held = hold(envs.step(actions), step)
        kept.append((held, [np.array(array) for array in held]))
    envs.close()
    for held, copies in kept:
        require_same([np.asarray(array) for array in held], copies)


def shrink(array):
    array.resize(1, refcheck=False)


@pytest.mark.parametrize("task", TASKS)
@pytest.mark.parametrize("change", [reshape, retype, protect, shrink, grow])
@pytest.mark.filterwarnings("ignore:Setting the:DeprecationWarning")
def test_what_the_caller_changes_in_place_does_not_come_back(task, change):
    expected, envs = played(task), make(task)
    for actions, wanted in zip(sampled_actions(envs, STEPS), expected, strict=True):
        result = envs.step(actions)
        require_same(arrays_of(result), wanted)
        for array in arrays_of(result):
            assert array.flags.writeable
            assert array.flags.owndata
            change(array)
        del array, result
    envs.close()


@pytest.mark.parametrize("task", TASKS)
def test_weak_references_end(task):
    envs, references = make(task), []
    for actions in sampled_actions(envs, STEPS):
        result = envs.step(actions)
        assert all(weakref.getweakrefcount(array) == 0 for array in arrays_of(result))
        references += [weakref.ref(array) for array in arrays_of(result)]
    del result
    envs.close()
    del envs
    gc.collect()
    assert [reference() for reference in references] == [None] * len(references)


class Deep(Drawing):
    """The observation has eight dimensions."""

    def _get_observation_space(self):
        return gym.spaces.Box(-np.inf, np.inf, (1,) * 7 + (2,), np.float32)

    def _get_observation(self):
        return np.array([[[[[[[[self.state[0], self.state[1]]]]]]]]], np.float32)


def test_arrays_may_have_many_dimensions():
    for deep, flat in zip(played(Deep), played(Named), strict=True):
        assert deep[0].shape == (NUM_ENVS, *(1,) * 7, 2)
        np.testing.assert_array_equal(deep[0].reshape(NUM_ENVS, 2), flat[0])


def test_a_refused_step_and_an_error_leave_everything_in_order():
    expected, envs = played(CART_POLE), make(CART_POLE)
    for actions, wanted in zip(sampled_actions(envs, STEPS), expected, strict=True):
        for wrong in (np.full(NUM_ENVS, 7), np.zeros(NUM_ENVS + 1, np.int64), "abc"):
            with contextlib.suppress(ConfigError):
                envs.step(wrong)
        require_same(arrays_of(envs.step(actions)), wanted)
    envs.close()


SEEN, REAL, FLAGS, DRAWN = ((3, 4), np.float32), ((3,), float), ((3,), bool), ((4, 3), float)
ARRAYS = SEEN, REAL, FLAGS, FLAGS, FLAGS, DRAWN
LATE = LateDict, UNFILLED, dict


def test_results_that_fit_are_taken(monkeypatch):
    require_refused((tuple, 0, (), ARRAYS, LATE), monkeypatch, refused=False)


@pytest.mark.parametrize(
    "results",
    [
        (tuple, 0, (), (), LATE),
        (tuple, 0, (), ARRAYS[:-1], LATE),
        (tuple, 0, (), ARRAYS[:3], LATE),
        (tuple, 0, (), (((3, 5), np.float32), *ARRAYS[1:]), LATE),
        (tuple, 0, (), (SEEN, ((3,), np.float32), *ARRAYS[2:]), LATE),
        (tuple, 0, (), (*ARRAYS[:-2], ((4,), bool), DRAWN), LATE),
        (tuple, 0, (), (*ARRAYS[:-1], ((5, 3), float)), LATE),
        (tuple, (("a", 0), ("b", 1)), (), ARRAYS, LATE),
        (dict, 0, (), ARRAYS, LATE),
        (tuple, 0, (), 7, LATE),
        (tuple, 9, (), ARRAYS, LATE),
        (tuple, None, (), ARRAYS, LATE),
        (tuple, 0, 0, ARRAYS, LATE),
        (tuple, 0, (("a", 1),), ARRAYS, LATE),
        (tuple, 0, (("a",),), ARRAYS, LATE),
        (tuple, 0, ("ab",), ARRAYS, LATE),
        (
            tuple,
            functools.reduce(lambda form, _: (("a", form),), range(999), 0),
            (),
            ARRAYS,
            LATE,
        ),
        (tuple, 0, (), ARRAYS),
        (tuple, 0, (), ARRAYS, LATE[:2]),
        (tuple, 0, (), ARRAYS, dict),
    ],
)
def test_results_that_do_not_fit_are_refused(results, monkeypatch):
    require_refused(results, monkeypatch)


def require_refused(results, monkeypatch, *, refused=True):
    envs = make(CART_POLE)
    prepare = envs.inside.pool.prepare_play

    def with_others(*parts):
        return prepare(*parts[:-1], parts[-1] | {"results": results})

    monkeypatch.setattr(envs.inside.pool, "prepare_play", with_others)
    with pytest.raises((TypeError, ValueError)) if refused else contextlib.nullcontext():
        envs.inside.engine._prepare(envs.inside.engine._task)
    envs.close()
