"""Numbers of any type give the bits of the Python floats that they are worth."""

from decimal import Decimal
from fractions import Fraction

import numpy as np
import pytest
from combinations import in_turn
from gymnasium import spaces

import fmugym
from fmugym import Choice, ConfigError, LogUniform, Normal, Uniform
from fmugym.environment.config import FOREIGN, EnvConfig

TYPES = [
    int,
    np.int64,
    np.uint8,
    np.float32,
    np.float64,
    np.longdouble,
    Fraction,
    Decimal,
    np.array,
]
types = pytest.mark.parametrize("number", TYPES, ids=lambda number: number.__name__)


class Cart(fmugym.FMUEnv):
    """A cart-pole of which hooks can be compiled; ``number`` makes all numbers of its config."""

    def __init__(self, number=float, distribution=Uniform, exact=False):
        step = 1 if number in {int, np.int64, np.uint8} else 0.1

        def typed(value):
            return float(number(value)) if exact else number(value)

        config = {
            "model_input_names": "f",
            "model_output_names": ["x", "x_dot", "theta", "theta_dot"],
            "model_parameters": {
                "m_pole": distribution(typed(1), typed(2)),
                "m_cart": Choice([typed(3), typed(4)]) if distribution is Normal else typed(3),
                "theta_0": typed(1),
            },
            "time_step": typed(step),
            "positive_reward": typed(2),
            "bounds": {"x": (typed(0), typed(5))},
        }
        super().__init__(fmugym.bundled_fmu("CartPole"), config)

    def _get_action_space(self):
        return spaces.Discrete(2)

    def _get_inputs(self):
        return 10.0 * (2.0 * self.action - 1.0)

    def _is_done(self):
        return abs(self.state[0]) > 1e9


ACTIONS = [0, 1, 1, 0, 1]


def alone(env):
    """The observations and rewards of two episodes."""
    rows = []
    for seed in (11, None):
        rows.append(env.reset(seed=seed)[0].tolist())
        for action in ACTIONS:
            observation, reward, *_ = env.step(action)
            rows.append([*observation.tolist(), reward])
    env.close()
    return rows


def together(envs):
    """The same of the first of several environments."""
    rows = []
    for seed in (11, None):
        rows.append(envs.reset(seed=seed)[0][0].tolist())
        for action in ACTIONS:
            observations, rewards, *_ = envs.step(np.full(envs.num_envs, action))
            rows.append([*observations[0].tolist(), float(rewards[0])])
    envs.close()
    return rows


@in_turn({"number": TYPES, "distribution": [Uniform, LogUniform, Normal]})
def test_a_single_environment(number, distribution):
    assert alone(Cart(number, distribution)) == alone(Cart(number, distribution, exact=True))


@types
def test_the_config_has_floats(number):
    config = Cart(number).config
    values = [config.time_step, config.positive_reward, *config.bounds["x"]]
    values += [config.model_parameters["m_pole"].low, config.model_parameters["m_pole"].high]
    assert {type(value) for value in values} == {float}


@pytest.mark.parametrize("number", [int, np.int64, np.uint8, np.array])
def test_the_config_has_integers(number):
    config = EnvConfig(
        "a", "b", substeps=number(2), max_episode_steps=number(3), fault_retries=number(1)
    )
    values = (config.substeps, config.max_episode_steps, config.fault_retries)
    assert values == (2, 3, 1)
    assert {type(value) for value in values} == {int}


def test_arguments_of_bundled_environments():
    """A force of float32 would make a hook compute in float32, alone but not on arrays."""
    force = np.float32(12.1)
    exact = fmugym.envs.ModelicaCartPoleEnv(force=float(force))
    expected = alone(exact)
    assert alone(fmugym.envs.ModelicaCartPoleEnv(force=force)) == expected
    envs = fmugym.FMUVectorEnv(lambda: fmugym.envs.ModelicaCartPoleEnv(force=force), 2)
    assert together(envs) == expected


def test_overrides_of_one_episode():
    env, twin = Cart(), Cart()
    third = np.float32(1 / 3)
    for value, same in (
        (third, float(third)),
        (Uniform(third, 1), Uniform(float(third), 1.0)),
        (Uniform(0.25, 1), {"distribution": "uniform", "low": 0.25, "high": 1}),
    ):
        first = env.reset(seed=3, options={"model_parameters": {"m_pole": value}})
        second = twin.reset(seed=3, options={"model_parameters": {"m_pole": same}})
        assert first[1]["drawn"] == second[1]["drawn"]
        assert {type(drawn) for drawn in first[1]["drawn"].values()} == {float}
    env.close()
    twin.close()


@pytest.mark.parametrize(
    "value",
    [np.complex64(1), np.datetime64("2020"), np.timedelta64(1, "s"), np.str_("1"), np.ones(1), "1"],
)
def test_no_numbers(value):
    with pytest.raises(ConfigError, match="must be a number"):
        Uniform(value, 2)
    with pytest.raises(ConfigError, match="must be a number"):
        EnvConfig("a", "b", time_step=value)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("time_step", 1e400),
        ("time_step", 10**400),
        ("warm_up", 1e308),
        ("substeps", 2**31),
        ("substeps", 10**400),
        ("fault_retries", 11),
        ("max_episode_steps", 10**400),
        ("leak_limit", 2**64),
        ("stop_time", 10**400),
    ],
)
def test_numbers_too_large_for_the_fmu(name, value):
    with pytest.raises(ConfigError, match=name):
        _brake(**({"foreign": {name: value}} if name in FOREIGN.keys else {name: value}))


def _brake(**changes):
    class Brake(fmugym.FMUEnv):
        def _is_done(self):
            return False

    config = {
        "model_input_names": "f",
        "model_output_names": ["x"],
        "time_step": 0.02,
        "bounds": {"f": (-1, 1)},
    }
    return Brake(fmugym.bundled_fmu("CartPole"), config | changes)


@pytest.mark.parametrize("changes", [{"stop_time": 1e308}, {"time_step": 1e-320}, {"time_step": 9}])
def test_extreme_numbers_that_are_fine(changes):
    env = _brake(**changes)
    env.reset()
    env.close()


@pytest.mark.parametrize(
    "make",
    [
        lambda: Uniform(-1e308, 1e308),
        lambda: Uniform(0, 10**400),
        lambda: LogUniform(1, 1e400),
        lambda: Normal(0, 10**400),
        lambda: Choice([10**400]),
        lambda: Choice([1, 2], [10**400, 0]),
    ],
)
def test_distributions_beyond_the_range_of_floats(make):
    with pytest.raises(ConfigError):
        make()


def test_extreme_distributions_draw_finite_numbers():
    rng = np.random.default_rng(0)
    for distribution in (
        Uniform(-8e307, 8e307),
        LogUniform(1e-320, 1.7e308),
        Normal(1.7e308, 1e308),
        Normal(1.0, -0.0),
    ):
        assert all(np.isfinite(distribution.sample(rng)) for _ in range(200))
