"""The arrays that compiled steps return belong to the caller, also where memory is used again."""

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
from fmugym.envs import CartPoleEnv

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
        for array in arrays:
            assert array.flags.writeable
            assert array.flags.owndata
            change(array)
        del array, arrays
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


REWARDS, FLAGS, SEEN = np.zeros(3), np.zeros(3, bool), (np.zeros((3, 4), np.float32),)
DRAWN, WRONG = np.zeros((4, 3)), np.zeros(5)
STARTS = FLAGS, DRAWN, SEEN


@pytest.fixture
def play():
    envs = make(CartPoleEnv)
    yield envs.inside.engine._play
    envs.close()


def test_arrays_that_fit_are_filled(play):
    for starts in (None, STARTS[:2], STARTS):
        assert play.step(np.zeros(3, np.int64), REWARDS, FLAGS, FLAGS, SEEN, starts)[0] == 0
        assert REWARDS.all()
        assert SEEN[0].any()
    assert play.start(~np.zeros(3, bool), DRAWN, SEEN) == (0, False)


def read_only(array):
    array.setflags(write=False)
    return array


@pytest.mark.parametrize(
    "given",
    [
        (WRONG, FLAGS, FLAGS, SEEN, None),
        (REWARDS, WRONG, FLAGS, SEEN, None),
        (REWARDS, FLAGS, WRONG, SEEN, None),
        (REWARDS, FLAGS, FLAGS, (), None),
        (REWARDS, FLAGS, FLAGS, (WRONG,), None),
        (REWARDS, FLAGS, FLAGS, SEEN * 2, None),
        (REWARDS, FLAGS, FLAGS, list(SEEN), None),
        (REWARDS, FLAGS, FLAGS, (None,), None),
        (read_only(np.zeros(3)), FLAGS, FLAGS, SEEN, None),
        (np.zeros(6)[::2], FLAGS, FLAGS, SEEN, None),
        *((REWARDS, FLAGS, FLAGS, SEEN, starts) for starts in [(), STARTS[:1], 7, STARTS * 2]),
        (REWARDS, FLAGS, FLAGS, SEEN, (WRONG, DRAWN)),
        (REWARDS, FLAGS, FLAGS, SEEN, (FLAGS, WRONG)),
        (REWARDS, FLAGS, FLAGS, SEEN, (FLAGS, DRAWN, (WRONG,))),
    ],
    ids=str,
)
def test_arrays_that_do_not_fit_are_refused(given, play):
    with pytest.raises((TypeError, ValueError, BufferError)):
        play.step(np.zeros(3, np.int64), *given)


@pytest.mark.parametrize("given", [(WRONG, DRAWN, SEEN), (FLAGS, WRONG, SEEN), (FLAGS, DRAWN, ())])
def test_arrays_of_a_start_that_do_not_fit_are_refused(given, play):
    with pytest.raises((TypeError, ValueError)):
        play.start(*given)
