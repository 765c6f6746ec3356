"""Odd values in configs and calls: an environment works with them or refuses them.

Then it works as before.
"""

import contextlib
import functools
import math

import gymnasium
import numpy as np
import pytest
from fmu_tools import PlainEnv
from hypothesis import given
from hypothesis import strategies as st
from odd_values import (
    USUAL,
    Unspeakable,
    hostile,
    odd_calls,
    perhaps_refused,
    quiet,
    working_or_refused,
)
from ways import in_way

import fmugym
from fmugym import Choice, FMUVectorEnv, LogUniform, Normal, Uniform
from fmugym.checks import integer_of
from fmugym.environment import env_checker
from fmugym.environment.config import EnvConfig
from fmugym.fmi import ArchiveLimits
from fmugym.pool import Paced

PENDULUM = fmugym.bundled_fmu("Pendulum")
CONFIG = {
    "model_input_names": ["tau"],
    "model_output_names": ["q", "q_dot"],
    "model_parameters": {"q_0": 1.0, "max_step": 1.0},
    "time_step": 0.02,
    "bounds": {"tau": (-1.0, 1.0)},
}
HOOKS = (None, "arrays", "one by one")


class Sampled:
    """A distribution that draws an odd value."""

    def __init__(self, value):
        self.value = value

    def sample(self, rng):
        return self.value


class Frozen:
    """The same in the form of ``scipy.stats``."""

    def __init__(self, value):
        self.value = value

    def rvs(self, random_state=None):
        return self.value


DRAWN = st.sampled_from(
    (None, "q", math.nan, 1, 0.5, [1.0], np.ones(2), np.array([1.0]), 10**400, np.float32(0.5))
)
KNOWN = st.one_of(
    st.sampled_from(
        (
            *({"q": 1}, {"q_0": None}, {"q_0": [1.0]}, {"q_0": 10**400}, {"q_0": {}}),
            *({"distribution": "uniform"}, {"distribution": []}, {"distribution": "choice"}),
            {"distribution": "normal", "mean": "q"},
            {"distribution": "uniform", "low": 0, "high": 1},
            *(Uniform(0, 1), Normal(0, 1), Choice([1, 2]), Choice(["q"]), np.array([0.1])),
            *(np.array([1e39]), np.ones(3, bool), np.array([True, False]), np.array([1, 0])),
        )
    ),
    st.builds(Sampled, DRAWN),
    st.builds(Frozen, DRAWN),
    st.builds(hostile, st.sampled_from((["sample"], ["rvs"]))),
)
VALUES = USUAL | KNOWN


def arguments_of(names):
    """A strategy of one to three odd values by name."""
    odd = st.dictionaries(st.sampled_from(names), VALUES, min_size=1, max_size=3)
    return odd.map(lambda values: {n: v for n, v in values.items() if not is_left_out(n, v)})


def is_left_out(name, value):
    """Whether a sound value would take too much of the machine, or is a function of the caller's.

    What such a function raises is the caller's own.
    """
    if name == "backend" and callable(value):
        return True
    if name == "num_envs":
        return 100 < (integer_of(value) or 0) < 2**62
    return type(value) is str and value in {"process", "human"}


class Swing(fmugym.FMUEnv):
    """A pendulum whose config may be changed at will."""

    def __init__(self, changes=None, fmu_path=PENDULUM, **options):
        super().__init__(fmu_path, CONFIG | (changes or {}), **options)

    def _is_done(self):
        return abs(self.state[0]) > 50.0


class Tracking(Swing):
    """One with episode variables, and an attribute that a hook reads."""

    def __init__(self, changes=None):
        self.weight = 1.0
        variables = {"target": Uniform(-1.0, 1.0), "integral": 0.0}
        super().__init__({"episode_variables": variables} | (changes or {}))

    def _update(self):
        error = self.state[0] - self.variables["target"]
        self.variables["integral"] = self.variables["integral"] + 0.02 * error

    def _reward_policy(self):
        return -self.weight * abs(self.variables["integral"])


CLASSES = (Tracking, fmugym.envs.CartPoleEnv, fmugym.envs.PendulumEnv)
KEYS = (
    *("model_input_names", "model_output_names", "model_parameters", "time_step"),
    *("positive_reward", "negative_reward", "max_episode_steps", "start_time", "stop_time"),
    *("tolerance", "substeps", "warm_up", "monitor_names", "episode_variables", "bounds"),
    *("on_fault", "fault_retries", "fault_reward", "leak_limit", "archive_limits", "preload"),
    *("probe_timeout", "isolation", "call_timeout"),
)
BUNDLED = {
    "CartPole": ("sutton_barto_reward", "fmi_version", "model_parameters", "render_mode", "lo"),
    "Pendulum": ("g", "fmi_version", "model_parameters", "log_level", "gg"),
    "ModelicaCartPole": (
        *("m_cart", "m_pole", "theta_0", "theta_dot_0", "time_step", "positive_reward"),
        *("negative_reward", "force", "log_level", "fmu_path", "fmi_version", "x"),
    ),
    "CloudPendulum": (
        *("torque_limit", "backend", "model_parameters", "user_token", "gym_token", "gym_time"),
        *("session_time", "fmi_version", "render_mode"),
    ),
}


def play(make):
    """Make an environment and play it, unless an odd config makes that slow."""
    with contextlib.closing(make()) as env:
        config = env.config
        many = 1000 < config.warm_up / (config.time_step or 0.02) < math.inf
        if config.substeps < 1000 and not many and config.isolation is None:
            play_some_steps(env)


def play_some_steps(env):
    env.reset(seed=0)
    env.action_space.seed(0)
    for _ in range(3):
        *_, terminated, truncated, _ = env.step(env.action_space.sample())
        if np.any(terminated) or np.any(truncated):
            env.reset()


# What environments are made of


@pytest.mark.parametrize("key", ["timestep", 1, None, "", ("a",), Unspeakable], ids=str)
def test_an_unknown_key_is_refused(key):
    with pytest.raises(fmugym.ConfigError):
        Swing({key: 1})


@pytest.mark.parametrize("key", ["time_step", "bounds", "substeps", "model_parameters"])
@pytest.mark.parametrize("odd", [10**5000, "\x1b[31m", [[]], 1j, Unspeakable()], ids=type)
def test_an_odd_value_of_a_key_is_refused(key, odd):
    with pytest.raises(fmugym.ConfigError):
        Swing({key: odd})


@given(arguments_of(KEYS))
def test_an_odd_config_is_played_or_refused(changes):
    with working_or_refused():
        play(lambda: Swing(changes))


@given(
    st.sampled_from(("model_parameters", "episode_variables", "bounds")),
    st.sampled_from(("q_0", "m", "solver", "max_step", "tau", "target", "q")),
    VALUES | st.tuples(VALUES, st.just(1.0)) | st.tuples(st.just(0.0), VALUES),
)
def test_an_odd_value_of_a_variable_is_played_or_refused(key, name, odd):
    with working_or_refused():
        play(lambda: Tracking({key: {"max_step": 1.0, name: odd}}))


@given(arguments_of(("log_level", "render_mode", "backend", "isolation", "fmu_path", "isolatoin")))
def test_an_environment_with_odd_arguments_is_played_or_refused(arguments):
    with working_or_refused():
        play(lambda: Swing(**arguments))


@given(
    st.sampled_from(sorted(BUNDLED)).flatmap(
        lambda name: st.tuples(st.just(name), arguments_of(BUNDLED[name]))
    )
)
def test_a_bundled_environment_with_odd_arguments_is_played_or_refused(drawn):
    name, arguments = drawn
    with working_or_refused():
        play(lambda: getattr(fmugym.envs, f"{name}Env")(**arguments))


@given(
    st.just(Swing)
    | VALUES.filter(lambda make: not callable(make)),  # errors of functions are the caller's
    arguments_of(
        (
            *("num_envs", "max_episode_steps", "autoreset_mode", "backend", "threads"),
            *("private_libraries", "isolation", "workers", "call_timeout", "thread"),
        )
    ),
)
def test_many_environments_with_odd_arguments_are_played_or_refused(make, arguments):
    arguments = {"num_envs": 2} | arguments
    with working_or_refused(), contextlib.closing(FMUVectorEnv(make, **arguments)) as envs:
        play_some_steps(envs)


# Functions and classes beside them


def drawn_from(distribution):
    """A function that plays with a distribution."""

    def play_with(**arguments):
        value = distribution(**arguments)
        parameters = {"q_0": value, "max_step": 1.0}
        play(lambda: Swing({"model_parameters": parameters, "episode_variables": {"x": value}}))

    return play_with


def register(env_id, env):
    try:
        fmugym.register(env_id, env)
    finally:
        gymnasium.registry.pop("odd/Odd-v0", None)


CALLS = {
    "Uniform": (drawn_from(Uniform), {"low": 0.5, "high": 1}),
    "LogUniform": (drawn_from(LogUniform), {"low": 0.5, "high": 1}),
    "Normal": (drawn_from(Normal), {"mean": 0.5, "std": 1, "low": 0.0, "high": 2.0}),
    "Choice": (drawn_from(Choice), {"values": [1.0, 2], "probabilities": [0.5, 0.5]}),
    "FMU": (
        lambda **arguments: fmugym.FMU(**arguments).close(),
        {"path": PENDULUM, "limits": None, "preload": (), "probe_timeout": 60.0},
    ),
    "bundled_fmu": (fmugym.bundled_fmu, {"model": "Pendulum", "fmi_version": "2.0"}),
    "PlainEnv": (lambda config: play(lambda: PlainEnv(PENDULUM, config)), {"config": CONFIG}),
    "EnvConfig": (lambda config: EnvConfig.from_dict(config), {"config": CONFIG}),
    "ArchiveLimits": (ArchiveLimits, {"max_ratio": 200}),
    "Paced": (Paced, {"backend": "fmu", "hold_after": 1.0}),
    "register": (register, {"env_id": "odd/Odd-v0", "env": Swing}),
}


@pytest.mark.parametrize("name", CALLS)
def test_a_call_with_sound_arguments_works(name):
    call, arguments = CALLS[name]
    call(**arguments)


@given(odd_calls(CALLS, VALUES))
def test_a_call_with_odd_arguments_works_or_is_refused(drawn):
    call, arguments = drawn
    with working_or_refused():
        call(**arguments)


@given(VALUES)
def test_what_is_no_environment_is_refused_by_the_checks(odd):
    with working_or_refused():
        env_checker.check_fmu_env(odd)
    if not callable(odd):
        with working_or_refused():
            env_checker.check_hooks(odd)


# Calls of environments


@pytest.fixture(name="made", scope="module")
def fixture_made():
    """Make environments that serve all tests: what was refused leaves them as good as new."""
    with contextlib.ExitStack() as stack:

        @functools.cache
        def make(cls, hooks="single"):
            env = cls() if hooks == "single" else FMUVectorEnv(in_way(hooks, cls), 3)
            return stack.enter_context(contextlib.closing(env))

        yield make


def require_alive_after(env, call, *arguments):
    """Call in an episode; the next one can be played."""
    env.reset(seed=1)
    with perhaps_refused():
        call(env, *arguments)
    with quiet():
        play_some_steps(env)


SINGLE = {
    "seed": lambda env, odd: env.reset(seed=odd),
    "options": lambda env, odd: env.reset(options=odd),
    "option": lambda env, odd: env.reset(options=dict.fromkeys(env.reset_options, odd)),
    "parameter": lambda env, odd: env.reset(options={"model_parameters": {"q_0": odd}}),
    "solver": lambda env, odd: env.reset(options={"model_parameters": {"solver": odd}}),
    "action": lambda env, odd: env.step(odd),
    "read_variables": lambda env, odd: env.read_variables(odd),
    "out": lambda env, odd: env.out[odd],
    "out.get": lambda env, odd: env.out.get(odd),
    "in out": lambda env, odd: odd in env.out,
    "variable": lambda env, odd: env.variables.__setitem__("target", odd),
    "variables": lambda env, odd: env.variables.update(odd),
    "fmu.variable": lambda env, odd: env.fmu.variable(odd),
}
MANY = {
    "seed": lambda envs, odd: envs.reset(seed=odd),
    "seeds": lambda envs, odd: envs.reset(seed=[odd, 1, 2]),
    "mask": lambda envs, odd: envs.reset(options={"reset_mask": odd}),
    "options": lambda envs, odd: envs.reset(options=odd),
    "parameters": lambda envs, odd: envs.reset(options={"model_parameters": {"m": odd}}),
    "actions": lambda envs, odd: envs.step(odd),
    "action": lambda envs, odd: envs.step([odd, odd, odd]),
    "get_attr": lambda envs, odd: envs.get_attr(odd),
    "call": lambda envs, odd: envs.call(odd),
}


def test_an_action_of_texts_is_refused(made):
    env = made(fmugym.envs.PendulumEnv)
    env.reset()
    with pytest.raises(fmugym.ConfigError, match="numbers"):
        env.step(np.array(["a"]))


@given(st.sampled_from(CLASSES), st.sampled_from(sorted(SINGLE)), VALUES)
def test_an_environment_lives_on_after_an_odd_call(made, cls, name, odd):
    require_alive_after(made(cls), SINGLE[name], odd)


@given(st.sampled_from(CLASSES[:2]), st.sampled_from(HOOKS), st.sampled_from(sorted(MANY)), VALUES)
def test_many_environments_live_on_after_an_odd_call(made, cls, hooks, name, odd):
    require_alive_after(made(cls, hooks), MANY[name], odd)


@given(
    st.sampled_from(HOOKS),
    st.sampled_from(("weight", "q_0", "m", "weigth")) | VALUES,
    VALUES | st.lists(VALUES, min_size=1, max_size=3),
)
def test_an_odd_attribute_is_set_or_refused(hooks, name, values):
    with working_or_refused(), contextlib.closing(FMUVectorEnv(in_way(hooks, Tracking), 3)) as envs:
        envs.reset(seed=1)
        envs.set_attr(name, values)
        if name != "weight":  # what the hook of the caller makes of it
            play_some_steps(envs)
