"""Arguments of vector environments that do not fit are refused by name."""

import gymnasium as gym
import numpy as np
import pytest
from odd_values import Unspeakable
from vector_tools import Drawing, each_way, require_equal
from ways import in_way

import fmugym
from fmugym import ConfigError
from fmugym.environment.vector import FMUVectorEnv

SEEDS = (
    *([1, 2], [1, 2, 3, 4], 1.5, True, -1, "123", b"abc", {1, 2, 3}, {1: 1, 2: 2, 3: 3}),
    *([1, 2, 2.0], [1, 2, True], [1, 2, -3], [1, 2, "3"], [[1], [2], [3]], np.ones(3)),
    *(np.ones((3, 3), int), np.array([True] * 3), iter([1, 2, 3]), object(), Unspeakable()),
)


@pytest.mark.parametrize("seed", SEEDS, ids=lambda seed: type(seed).__name__)
def test_seeds_that_do_not_fit(seed, make_envs):
    vector = make_envs(in_way("arrays", Drawing), 3)
    with pytest.raises(ConfigError, match="seed"):
        vector.reset(seed=seed)


@pytest.mark.parametrize("seeds", [(4, 5, 6), np.array([4, 5, 6]), np.array([4, 5, 6], np.uint8)])
def test_seeds_may_be_any_sequence_of_integers(seeds, make_envs):
    vector = make_envs(Drawing, 3)
    expected = vector.reset(seed=4)[0].tolist()
    assert vector.reset(seed=seeds)[0].tolist() == expected


@pytest.mark.parametrize(
    "mask",
    [
        [True, False],
        [1, 0, 1],
        np.zeros(3, bool),
        np.ones((3, 1), bool),
        [[True], [True, False]],
        {"a": True},
        np.ones(3, object),
        True,
        Unspeakable(),
    ],
    ids=lambda mask: type(mask).__name__,
)
def test_masks_that_do_not_fit(mask, make_envs):
    vector, twin = make_envs(Drawing, 3), make_envs(Drawing, 3)
    vector.reset(seed=0)
    with pytest.raises(ConfigError, match="must be a Boolean array of shape"):
        vector.reset(options={"reset_mask": mask})
    twin.reset(seed=0)
    actions = np.zeros((3, 1), np.float32)
    require_equal(vector.step(actions)[0], twin.step(actions)[0])


@pytest.mark.parametrize("options", [5, "reset_mask", ["reset_mask"], {3: 1}, Unspeakable()])
def test_options_that_are_no_dict(options, make_envs):
    vector = make_envs(Drawing, 3)
    with pytest.raises(ConfigError, match="the options of reset must be a dict"):
        vector.reset(options=options)
    vector.reset(options=None)


@each_way
def test_unknown_options_are_named(hooks, make_envs):
    vector = make_envs(in_way(hooks, Drawing), 2)
    with pytest.raises(ConfigError, match="did you mean 'model_parameters'"):
        vector.reset(options={"model_parameter": {}})
    with pytest.raises(ConfigError, match="unknown"):
        vector.reset(options={"model_parameters": {"q_00": 1.0}})


def test_a_misspelt_mask_is_told_the_right_name(make_envs):
    with pytest.raises(ConfigError, match="'resetmask'; did you mean 'reset_mask'"):
        make_envs(Drawing, 2).reset(options={"resetmask": np.array([True, False])})


def test_unknown_ways_and_modes():
    with pytest.raises(ConfigError, match="did you mean 'next_step'"):
        FMUVectorEnv(Drawing, 2, autoreset_mode="nextstep")
    with pytest.raises(ConfigError, match="unwrapped environment of fmugym, got CartPoleEnv"):
        FMUVectorEnv(lambda: gym.make("CartPole-v1").unwrapped, 2)


@pytest.mark.parametrize("num_envs", [0, -1, 2.5, 2.0, True, None, "2", [2], Unspeakable()])
def test_numbers_of_environments_that_make_no_sense(num_envs):
    with pytest.raises(ConfigError, match="num_envs must be a positive integer"):
        FMUVectorEnv(Drawing, num_envs)


@pytest.mark.parametrize("num_envs", [10**10, 2**31 * 1000, 10**18, 10**30])
def test_numbers_of_environments_that_no_memory_holds(num_envs):
    with pytest.raises(ConfigError, match=rf"num_envs = {str(num_envs)[:9]}.*GB of memory"):
        FMUVectorEnv(Drawing, num_envs)


def test_memory_that_runs_out_is_blamed_on_the_number(temp_root):
    made = []

    class Large(Drawing):
        def __init__(self):
            made.append(self)
            if len(made) == 3:
                raise MemoryError
            super().__init__()

    with pytest.raises(ConfigError, match="not enough memory for num_envs = 3"):
        FMUVectorEnv(Large, 3)
    assert len(made) == 3
    assert not list(temp_root.iterdir())


BAD = (
    *(("threads", value) for value in (0, -1, 1.5, True, "2", [1], Unspeakable())),
    *(("workers", value) for value in (0, -1, 1.5, "2", True, Unspeakable())),
    *(("call_timeout", value) for value in (0, -1, "1", True, np.nan, np.inf, 10**400, 1j, [1])),
    ("call_timeout", Unspeakable()),
    *(("private_libraries", value) for value in (0, 1, "yes", [True], Unspeakable())),
    *(("isolation", value) for value in (1, "proces", ["process"], np.ones(2), Unspeakable())),
    *(("max_episode_steps", value) for value in (0, 1.5, Unspeakable())),
    *(("autoreset_mode", value) for value in (None, 1, ["next_step"], np.ones(2), Unspeakable())),
    *(("make_env", value) for value in (None, 1, "fmugym.envs:CartPoleEnv", [Drawing])),
)


@pytest.mark.parametrize(("name", "value"), BAD)
def test_arguments_of_other_types(name, value, temp_root):
    named = {"autoreset_mode": "autoreset mode"}.get(name, name)
    with pytest.raises(ConfigError, match=named):
        FMUVectorEnv(**{"make_env": Drawing, "num_envs": 2, name: value})
    assert not list(temp_root.iterdir())


def test_arguments_of_make_vec_are_those_of_both():
    """The class and the vector environment share the keyword arguments."""
    with pytest.raises(
        ConfigError, match=r"'autoreset'.*'render_mode'.*'autoreset_mode'.*'threads'"
    ):
        gym.make_vec("fmugym/CartPole-v0", num_envs=2, autoreset="disabled")


def test_unknown_arguments_are_type_errors_too():
    for error in (ConfigError, TypeError):
        with pytest.raises(error, match="'thread'; did you mean 'threads'"):
            FMUVectorEnv(Drawing, 2, thread=1)


@pytest.mark.parametrize("make", [FMUVectorEnv, lambda cls, _, **given: cls(**given)])
def test_the_way_of_calling_hooks_is_no_argument(make):
    """The class says it: ``vectorized``."""
    with pytest.raises(ConfigError, match=r"unexpected keyword argument 'hooks'; known are: "):
        make(fmugym.envs.CartPoleEnv, 2, hooks="auto")


@pytest.mark.parametrize("threads", [np.int64(1), 10**6])
def test_numbers_of_threads_of_any_type_and_size(threads, make_envs):
    vector = make_envs(Drawing, 2, threads=threads, max_episode_steps=np.int32(2))
    vector.reset()
    assert [vector.step(np.zeros((2, 1)))[3].tolist() for _ in range(2)][1] == [True, True]


def test_what_make_env_returns_is_closed_if_it_does_not_fit():
    closed = []

    class Other(gym.Env):
        def close(self):
            closed.append(True)

    with pytest.raises(ConfigError, match="got Other"):
        FMUVectorEnv(Other, 2)
    assert closed == [True]
