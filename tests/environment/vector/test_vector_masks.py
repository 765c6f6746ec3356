"""Resets with a mask: one call of the native pool does what the general way does.

A mask that is a list takes the general way, an array the quick one.
"""

import gc
import sys

import gymnasium as gym
import numpy as np
import pytest
from contract_cases import Nested, Pictured
from gymnasium.vector import AutoresetMode
from vector_tools import CART_POLE, Drawing, require_equal
from ways import in_way

from fmugym import SimulationError, Uniform


@pytest.fixture
def made(vector_of):
    def make(task, num_envs=5):
        envs = vector_of(task, num_envs)
        envs.reset(seed=3)
        return envs

    return make


def require_same(first, second):
    """Equal to the last bit, in the same order, with tuples and dicts of the same types."""
    assert type(first) is type(second)
    if isinstance(first, dict):
        assert list(first) == list(second)
        require_same(tuple(first.values()), tuple(second.values()))
    elif isinstance(first, tuple):
        assert len(first) == len(second)
        for mine, other in zip(first, second, strict=True):
            require_same(mine, other)
    else:
        require_equal(first, second)


def masks(rng, ended):
    """The environments that have ended, and some others now and then."""
    return ended | (rng.random(len(ended)) < 0.2)


@pytest.mark.parametrize("task", [CART_POLE, Pictured, Nested])
def test_what_the_caller_holds_does_not_change(task, made):
    """Infos are read only at the end, when their memory could have served many resets more."""
    late, early = made(task), made(task)
    rng, held, expected = np.random.default_rng(1), [], []
    for _ in range(30):
        mask = masks(rng, np.array([True, False, False, False, False]))
        held.append(late.reset(options={"reset_mask": mask}))
        result = early.reset(options={"reset_mask": mask})
        expected.append((str(result), result))
        if rng.random() < 0.5:
            del held[-1], expected[-1]
    for mine, (text, theirs) in zip(held, expected, strict=True):
        require_same(mine, theirs)
        assert str(mine) == text


def test_memory_that_nobody_holds_serves_again(made):
    envs, places = made(CART_POLE), set()
    for mask in np.tile(np.eye(5, dtype=np.bool_), (4, 1)):
        observations, infos = envs.reset(options={"reset_mask": mask})
        places.add((observations.ctypes.data, infos["_drawn"].ctypes.data))
        del observations, infos
    assert len(places) <= 2


def test_the_caller_may_go_on_with_its_mask(made):
    envs, mask = made(CART_POLE), np.array([True, False, False, False, True])
    infos = envs.reset(options={"reset_mask": mask})[1]
    mask[:] = True
    require_equal(infos["_drawn"], np.array([True, False, False, False, True]))
    assert (infos["drawn"]["x_0"][1:4] == 0).all()
    infos["_drawn"][:] = False  # it belongs to the caller, too
    again = envs.reset(options={"reset_mask": mask})[1]
    assert again["_drawn"].all()


class Own(np.ndarray):
    """An array with a class of its own."""


def read_only(mask):
    mask = mask.copy()
    mask.flags.writeable = False
    return mask


@pytest.mark.parametrize(
    "form",
    [
        lambda mask: mask.astype(object).astype(np.bool_),
        lambda mask: np.repeat(mask, 2)[::2],
        lambda mask: mask[::-1].copy()[::-1],
        lambda mask: mask.view(Own),
        lambda mask: mask.astype(np.uint8).view(np.bool_),
        lambda mask: tuple(mask.tolist()),
        read_only,
    ],
)
def test_masks_of_every_form(form, made):
    mask = np.array([True, False, False, True, False])
    first, second = made(CART_POLE), made(CART_POLE)
    quick = first.reset(options={"reset_mask": form(mask)})
    require_same(quick, second.reset(options={"reset_mask": mask.tolist()}))


def test_options_that_give_no_parameter(make_envs):
    """The FMU gets no start value at all."""
    envs = make_envs(lambda: Drawing(model_parameters={}), 2)
    usual, _ = envs.reset(seed=1)
    observations, infos = envs.reset(seed=1, options={"model_parameters": {}})
    assert observations.tolist() == usual.tolist()
    assert infos["drawn"] == {}


class Dividing(Drawing):
    """Its first observation is not finite in the second episodes."""

    def __init__(self):
        super().__init__(episode_variables={"start": Uniform(0.0, 1.0)})

    def _get_observation_space(self):
        return gym.spaces.Box(-np.inf, np.inf, (1,), np.float64)

    def _get_observation(self):
        with np.errstate(invalid="ignore"):
            return np.array([np.log(self.variables["start"] - self.bound)])

    bound = 0.0


def test_a_first_observation_that_is_not_finite(made):
    texts = []
    for form in np.array, np.ndarray.tolist:
        envs = made(in_way("arrays", Dividing))
        envs.set_attr("bound", 1.0)
        mask = np.array([False, False, True, False, True])
        refused = pytest.raises(SimulationError, match=r"environment 2.*nan")
        with np.errstate(invalid="ignore"), refused as caught:
            envs.reset(options={"reset_mask": form(mask)})
        texts.append(str(caught.value))
        envs.set_attr("bound", 0.0)
        with pytest.raises(SimulationError, match="exception"):
            envs.step(envs.action_space.sample())
        envs.reset()
    assert texts[0] == texts[1]


def test_a_first_observation_that_is_not_finite_in_the_step_that_ends_another_episode(make_envs):
    envs = make_envs(in_way("arrays", Dividing), 1, autoreset_mode=AutoresetMode.SAME_STEP)
    envs.reset(seed=4)  # draws more than a half for the first episode, and less for the second one
    envs.set_attr("bound", 0.5)
    with np.errstate(invalid="ignore"), pytest.raises(SimulationError, match="first observation"):
        list(map(envs.step, np.zeros((3, 1, 1), np.float32)))


def test_references_do_not_leak(made):
    envs, mask = made(CART_POLE), np.array([True, False, False, True, False])
    options = {"reset_mask": mask}
    watched = (
        mask,
        options,
        envs.prototype.episode_start,
        CART_POLE,
        None,
        True,
        False,
        "drawn",
        "_drawn",
    )

    def play():
        for _ in range(300):
            observations, infos = envs.reset(options=options)
        assert infos["drawn"]["x_0"].any()
        del observations, infos
        gc.collect()
        return [sys.getrefcount(value) for value in watched], len(gc.get_objects())

    play()
    (before, objects), (after, left) = play(), play()
    assert all(abs(b - a) < 50 for a, b in zip(before, after, strict=True))
    assert abs(left - objects) < 100
