"""Odd hooks: environments work with them or refuse them, and errors of hooks reach the caller.

Hooks return wrong shapes and types, NaN, or objects whose own methods fail, from the first call on
or from a later one; or they raise. Nothing but finite numbers of the promised shapes and types may
come of them.
"""

import contextlib
import itertools

import gymnasium
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from odd_values import ODD, working_or_refused
from vector_tools import Drawing
from ways import in_way

from fmugym import FMUGymError, FMUVectorEnv, Normal
from fmugym.environment.vector import array_faults

WAYS = ("single", "arrays", "one by one")
NUM_ENVS = 3
STEPS = 4


class HookError(Exception):
    """Raised by hooks themselves."""


ROWS = st.sampled_from(
    (
        *((1.0,), (1.0, 2.0), [0.5], [0.5, 0.5], {"x": 1.0}, [1.0, [2.0, 3.0]]),
        np.ma.masked_all(3),
        *map(np.zeros, (3, 4, (2, 3), (3, 2), (3, 3), (1, 3), (0, 3), (3, 0))),
        *(np.full(3, value) for value in (np.nan, np.inf, "x", 1j, None)),
        *(np.zeros(3, dtype) for dtype in (np.float16, np.uint64, [("a", "f8")])),
    )
)
DISTORTIONS = st.sampled_from(
    (
        lambda good: np.asarray(good).T,
        lambda good: np.asarray(good)[..., None],
        lambda good: np.asarray(good)[None],
        lambda good: np.ravel(good)[:-1],
        lambda good: np.append(np.ravel(good), 1.0),
        lambda good: np.asarray(good, object),
        lambda good: np.asarray(good).astype(str),
        lambda good: np.asarray(good, np.complex128),
        lambda good: np.asarray(good, np.float64) * np.nan,
        lambda good: np.asarray(good, np.float64) * 1e300 * 1e300,
        lambda good: np.asarray(good).tolist(),
        lambda good: [good, good],
        lambda good: (good,),
        lambda good: {"value": good},
        lambda good: {1: good, "x": None},
        lambda good: {"a": {"b": {"c": good}}, "_a": good},
        lambda good: str(good),
        lambda good: np.any(good),
        lambda good: np.sum(good),
    )
)
ERRORS = st.sampled_from(
    (
        *(HookError, FMUGymError, ValueError, TypeError, KeyError, ZeroDivisionError, OSError),
        *(AttributeError, IndexError, AssertionError, StopIteration, MemoryError, RecursionError),
    )
)
HOOKS = (
    *("_get_inputs", "_update", "_is_done", "_is_truncated", "_reward_policy"),
    *("_get_observation", "_get_info", "_goal_reward", "_get_episode_parameters"),
    *("_get_action_space", "_get_observation_space"),
)


def returning(value):
    """A function from the good result of a hook to another one."""
    return lambda good: value


def raising(error):
    def fail(good):
        raise error("raised by a hook")

    return fail


RESULTS = st.one_of(
    st.builds(returning, ROWS), st.builds(returning, ODD), DISTORTIONS, st.builds(raising, ERRORS)
)


class Swing(Drawing):
    """A pendulum whose hooks are element-wise arithmetic."""

    def _is_done(self):
        return self.state[0] > 100.0

    def _reward_policy(self):
        return 1.0 - abs(self.state[0])


class Pushed(Swing):
    """The same with two actions."""

    def _get_action_space(self):
        return gymnasium.spaces.Discrete(2)

    def _get_inputs(self):
        return 0.01 * self.action


class Integrating(Swing):
    """The same with an episode variable."""

    def __init__(self):
        super().__init__(episode_variables={"sum": 0.0, "target": Normal(0.0, 1.0)})

    def _update(self):
        self.variables["sum"] = self.variables["sum"] + self.state[0]

    def _get_info(self):
        return {"sum": self.variables["sum"], "q": self.state[0]}


class Nested(Swing):
    """The same with observations of two parts."""

    def _get_observation_space(self):
        box = gymnasium.spaces.Box(-np.inf, np.inf, (2,), np.float32)
        return gymnasium.spaces.Dict({"state": box, "speed": gymnasium.spaces.Box(-9.0, 9.0, ())})

    def _get_observation(self):
        q, q_dot = self.state
        speed = np.asarray(q_dot, np.float32)
        return {"state": np.array([q, q_dot], np.float32), "speed": speed}


BASES = (Swing, Pushed, Integrating, Nested)


def odd_hook(name, base, distort, first, in_variable):
    """A hook that is odd from its call number ``first`` on."""
    good = getattr(base, name)
    calls = itertools.count()

    def hook(self, *arguments):
        value = good(self, *arguments)
        if next(calls) < first:
            return value
        if in_variable:
            self.variables["sum"] = distort(self.state[0])  # its own value would grow without end
            return value
        return distort(value)

    hook.__name__ = name
    return hook


def odd_class(base, results, first=0, in_variable=False):
    """A class of which some hooks are odd, or store odd values in an episode variable."""
    in_variable = in_variable and base is Integrating
    hooks = {n: odd_hook(n, base, odd, first, in_variable) for n, odd in results.items()}
    return type("Odd", (base,), hooks)


ODD_CLASSES = st.builds(
    odd_class,
    st.sampled_from(BASES),
    st.dictionaries(st.sampled_from(HOOKS), RESULTS, min_size=1, max_size=3),
    st.sampled_from((0, 0, 0, 1, 30, 90, 200)),
    st.booleans(),
)


def play(way, cls):
    if way == "single":
        with contextlib.closing(cls()) as env:
            play_single(env)
        return
    with contextlib.closing(FMUVectorEnv(in_way(way, cls), NUM_ENVS)) as envs:
        play_many(envs)


def play_single(env):
    env.action_space.seed(0)
    for seed in (1, None):
        observation, _ = env.reset(seed=seed)
        require_element(env.observation_space, observation, exact=False)
        for _ in range(STEPS):
            observation, reward, terminated, truncated, _ = env.step(env.action_space.sample())
            require_element(env.observation_space, observation, exact=False)
            assert type(reward) is float
            assert np.isfinite(reward)
            assert type(terminated) is type(truncated) is bool
            if terminated or truncated:
                break


def play_many(envs):
    envs.action_space.seed(0)
    for seed in (1, None):
        observations, _ = envs.reset(seed=seed)
        require_element(envs.observation_space, observations)
        for _ in range(2 * STEPS):
            observations, *judged, infos = envs.step(envs.action_space.sample())
            require_element(envs.observation_space, observations)
            assert np.isfinite(judged[0]).all(), "a reward"
            types = [(array.dtype, array.shape) for array in judged]
            shape = (NUM_ENVS,)
            assert types == [(np.float64, shape), (bool, shape), (bool, shape)]
            assert isinstance(infos, dict)


def require_element(space, value, exact=True):
    """Shapes are those of the space, and types in vector environments; limits are the user's."""
    if isinstance(space, gymnasium.spaces.Dict):
        assert value.keys() == space.spaces.keys()
        for name, part in space.spaces.items():
            require_element(part, value[name], exact)
        return
    array = np.asarray(value)
    assert not exact or isinstance(value, np.ndarray)
    assert not exact or array.dtype == space.dtype
    assert array.shape == space.shape
    assert np.isfinite(array).all()


def is_of_a_hook(error):
    """Whether an exception has passed a hook."""
    trace = error.__traceback__
    while trace is not None:
        code = trace.tb_frame.f_code
        if code.co_filename == __file__ and code.co_name in {"hook", "fail", *HOOKS}:
            return True
        trace = trace.tb_next
    return False


@pytest.mark.parametrize("base", BASES)
@pytest.mark.parametrize("way", WAYS)
def test_sound_hooks_are_played(base, way):
    play(way, base)


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("name", ["_get_observation", "_reward_policy", "_is_done", "_get_inputs"])
@pytest.mark.parametrize("odd", [np.zeros((4, 4)), "x", 1j, object()], ids=type)
def test_an_odd_result_is_refused(way, name, odd):
    with pytest.raises(FMUGymError):
        play(way, odd_class(Swing, {name: returning(odd)}))


@pytest.mark.parametrize("way", WAYS)
def test_an_array_is_no_dict(way):
    with pytest.raises(FMUGymError, match="_get_observation returned"):
        play(way, odd_class(Nested, {"_get_observation": returning(np.zeros(NUM_ENVS))}))


@pytest.mark.parametrize("way", WAYS)
def test_an_error_of_a_hook_reaches_the_caller(way):
    with pytest.raises(HookError):
        play(way, odd_class(Swing, {"_is_done": raising(HookError)}, first=1))


def test_a_reward_that_is_not_finite_is_found(monkeypatch):
    monkeypatch.setattr(array_faults, "_handle", lambda *given: None)
    with pytest.raises(AssertionError, match="a reward"):
        play("arrays", odd_class(Swing, {"_reward_policy": lambda good: good * np.nan}))


@given(st.sampled_from(WAYS), ODD_CLASSES)
def test_odd_hooks_are_played_or_refused(way, cls):
    with working_or_refused():
        try:
            play(way, cls)
        except FMUGymError:
            raise
        except Exception as error:
            if not is_of_a_hook(error):
                raise
