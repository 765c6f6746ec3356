"""Infos and results of vector environments belong to the caller."""

import pickle
from collections.abc import Mapping

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode
from vector_tools import (
    CART_POLE,
    Remembering,
    each_way,
    in_each_mode,
    require_equal,
    sampled_actions,
)
from ways import in_way, make_vec, many

import fmugym


def arrays_of(value):
    if isinstance(value, Mapping):
        return [array for inner in value.values() for array in arrays_of(inner)]
    return [value] if isinstance(value, np.ndarray) else []


@each_way
@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP])
def test_results_belong_to_the_caller(mode, hooks):
    """Spoiling results changes nothing, and later steps do not change results."""
    keywords = {"autoreset_mode": mode, "way": hooks}
    for cls in (Remembering, fmugym.envs.CartPoleEnv):
        careful, careless = (many(cls, 3, **keywords) for _ in range(2))
        kept = [careful.reset(seed=0)]
        careless.reset(seed=0)
        copies = [pickle.dumps(kept[0])]
        for actions in sampled_actions(careful, 40):
            kept.append(careful.step(actions))
            copies.append(pickle.dumps(kept[-1]))
            given = actions.copy()
            result = careless.step(given)
            require_equal(result[0], kept[-1][0])
            require_equal(np.array(result[1:4]), np.array(kept[-1][1:4]))
            for array in [a for part in result for a in arrays_of(part)]:
                array[...] = None if array.dtype == object else 1
            given[...] = 0
        assert [pickle.dumps(result) for result in kept] == copies
        careful.close()
        careless.close()


@each_way
def test_infos_as_lists(hooks):
    vector = make_vec(hooks, "fmugym/CartPole-v0", num_envs=2)
    wrapped = gym.wrappers.vector.DictInfoToList(vector)
    _, infos = wrapped.reset(seed=0)
    assert [sorted(info["drawn"]) for info in infos] == [
        ["phi_0", "phi_dot_0", "x_0", "x_dot_0"]
    ] * 2
    drawn = []
    for actions in sampled_actions(vector, 60):
        *_, infos = wrapped.step(actions)
        drawn += [info["drawn"]["x_0"] for info in infos if "drawn" in info]
    assert len(set(drawn)) > 2
    wrapped.close()


def require_zero_outside_of_masks(infos):
    for name, mask in infos.items():
        values = infos.get(name[1:])
        if not name.startswith("_") or values is None:
            continue
        if isinstance(values, Mapping):
            require_zero_outside_of_masks(values)
        elif values.dtype == object:
            assert all(value is None for value in values[~mask]), name
        else:
            empty = np.isnan if name == "_final_obs" else np.logical_not
            assert empty(values[~mask]).all(), name


@in_each_mode({"cls": [Remembering, CART_POLE]})
def test_infos_are_zero_outside_of_their_masks(cls, mode, hooks, make_envs):
    vector = make_envs(in_way(hooks, cls), 4, autoreset_mode=mode)
    require_zero_outside_of_masks(vector.reset(seed=0)[1])
    told = 0
    for actions in sampled_actions(vector, 40):
        result = vector.step(actions)
        ended = result[2] | result[3]
        infos = result[4]
        if mode is AutoresetMode.DISABLED and ended.any():
            infos = vector.reset(options={"reset_mask": ended})[1]
        require_zero_outside_of_masks(infos)
        told += "drawn" in infos and not infos["_drawn"].all()
    assert told > 0


@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP])
def test_infos_that_are_first_read_after_later_steps(mode, make_envs):
    """The arrays of drawn values and of last observations serve only until an episode starts."""
    at_once, later = (make_envs(fmugym.envs.CartPoleEnv, 6, autoreset_mode=mode) for _ in range(2))
    at_once.reset(seed=5)
    later.reset(seed=5)
    read, kept = [], []
    for actions in sampled_actions(at_once, 60):
        read.append(pickle.dumps(dict(at_once.step(actions)[4])))
        kept.append(later.step(actions)[4])
    assert sum("drawn" in infos for infos in kept) > 5
    for one, other in zip(read, kept, strict=True):
        assert pickle.dumps(dict(other)) == one
