"""What steps tell of ends in the mode ``SAME_STEP``: as Gymnasium's ``SyncVectorEnv``.

The last observations are in one array of the observations' shape and type.
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
from combinations import in_turn
from contract_cases import OUTPUTS, PENDULUM, Nested, Pair, Square
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.wrappers.vector import DictInfoToList, RecordEpisodeStatistics
from vector_tools import (
    CART_POLE,
    require_equal,
    sampled_actions,
)
from ways import in_way

import fmugym
from fmugym import FMUVectorEnv, SimulationError

try:
    import _testcapi as testcapi
except ImportError:
    testcapi = None


SAME_STEP = AutoresetMode.SAME_STEP
NUM_ENVS, STEPS = 6, 60
BOX = gym.spaces.Box(-np.inf, np.inf, (2,), np.float32)


def of_expressions():
    """A task whose programs store observations and infos."""
    return fmugym.load(PENDULUM)


def of_outputs():
    """A task whose observations the pool itself makes."""
    return fmugym.load(PENDULUM | OUTPUTS)


TASKS = [CART_POLE, Square, Nested, of_expressions, of_outputs]
COMPILED = [of_expressions, of_outputs]


def made(task, num_envs=NUM_ENVS):
    way = "expressions" if task in COMPILED else "one by one" if task is Pair else "arrays"
    envs = FMUVectorEnv(in_way(way, task), num_envs, autoreset_mode=SAME_STEP)
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
        else:
            require_equal(value, other)


def require_last(last, objects, mask, space):
    """Arrays like observations that hold what Gymnasium has in an array of objects."""
    if isinstance(space, gym.spaces.Dict):
        assert list(last) == list(space)
        for name, part in space.items():
            rows = [None if one is None else one[name] for one in objects]
            require_last(last[name], rows, mask, part)
        return
    assert type(last) is np.ndarray
    assert (last.dtype, last.shape) == (space.dtype, (len(mask), *space.shape))
    for row, one, has_ended in zip(last, objects, mask, strict=True):
        if has_ended:
            require_equal(row, one)
        else:
            assert np.isnan(row).all() if last.dtype.kind == "f" else not row.any()


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
            mask = mine["_final_obs"]
            require_last(
                mine.pop("final_obs"), other.pop("final_obs"), mask, theirs.single_observation_space
            )
            require_same_form(final(mine), final(other))
            ends += int(mask.sum())
    assert ends > NUM_ENVS
    ours.close()
    theirs.close()


def test_tuples_are_in_an_array_of_objects():
    envs = made(Pair)
    for infos in infos_of(envs):
        last = infos["final_obs"]
        assert (last.dtype, last.shape) == (object, (NUM_ENVS,))
        assert [one is not None for one in last] == infos["_final_obs"].tolist()
        for box, side in last[infos["_final_obs"]]:
            assert BOX.contains(box)
            assert side == (box[0] > 0.2)
    envs.close()


def arrays_in(last):
    return (
        [one for part in last.values() for one in arrays_in(part)]
        if isinstance(last, dict)
        else [last]
    )


@pytest.mark.parametrize("task", TASKS)
def test_arrays_are_new_and_the_callers(task):
    envs, held = made(task), []
    for infos in infos_of(envs):
        for array in arrays_in(infos["final_obs"]):
            assert not any(np.shares_memory(array, one) for one, _ in held)
            assert array.base is None
            held.append((array, array.copy()))
    assert all(
        np.array_equal(array, kept, equal_nan=True)
        for array, kept in held
        if array.dtype.kind == "f"
    )
    envs.close()


@pytest.mark.parametrize("task", TASKS)
def test_wrappers_of_gymnasium(task):
    envs = made(task)
    wrapped, ended = DictInfoToList(RecordEpisodeStatistics(envs)), 0
    wrapped.reset(seed=0)
    for actions in sampled_actions(envs, STEPS):
        _, _, terminated, truncated, infos = wrapped.step(actions)
        for index, info in enumerate(infos):
            is_over = terminated[index] or truncated[index]
            assert ("final_info" in info) == ("episode" in info) == is_over
            if is_over:
                assert envs.single_observation_space.contains(info["final_obs"])
                ended += 1
    assert ended > NUM_ENVS
    wrapped.close()


@functools.cache
def told(task):
    """What a run tells, copied at once."""
    envs = made(task)
    copies = [copy.deepcopy(final(infos)) for infos in infos_of(envs)]
    envs.close()
    assert len(copies) > 5
    return copies


@pytest.mark.parametrize("task", TASKS)
def test_copies_are_plain_and_equal(task):
    envs = made(task)
    for infos in infos_of(envs):
        for copied in (copy.deepcopy(infos), pickle.loads(pickle.dumps(infos))):
            assert type(copied) is dict
            require_same_form(copied, infos)
    envs.close()


@in_turn({"task": [CART_POLE, *COMPILED], "holds": [False, True]})
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
    prepare = envs.pool.prepare_play

    def prepared(*parts):
        play = prepare(*parts)
        made_of.append(Failing(play.start_and_step))
        return play._replace(start_and_step=made_of[-1])

    monkeypatch.setattr(envs.pool, "prepare_play", prepared)
    envs.task.rebind()
    envs.reset(seed=0)
    return envs, made_of[-1]


@pytest.mark.skipif(testcapi is None, reason="this Python has no module _testcapi")
@pytest.mark.parametrize("task", COMPILED)
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
