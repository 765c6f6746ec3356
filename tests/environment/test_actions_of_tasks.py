"""Actions of declared tasks that are no elements of the action space."""

import numpy as np
import pytest

import fmugym
from fmugym import ConfigError

PLAIN = {
    "fmu": {"bundled": "Pendulum"},
    "time_step": 0.02,
    "variables": {"tau": {"min": -0.01, "max": 0.01}},
    "agent": {"actions": ["tau"], "observations": ["q"]},
    "reward": "-abs(q)",
}


def with_key(**keys):
    return PLAIN | {"variables": {"tau": PLAIN["variables"]["tau"] | keys}}


LEVELS = PLAIN | {"variables": {"tau": {"levels": [-0.01, 0.01]}}}
TASKS = {
    "plain": PLAIN,
    "expression": PLAIN
    | {"variables": {"gain": {"min": 0, "max": 1}}, "inputs": {"tau": "0.01 * gain"}}
    | {"agent": {"actions": ["gain"], "observations": ["q"]}},
    "rescale": PLAIN | {"agent": PLAIN["agent"] | {"rescale": True}},
    "change": with_key(delta=0.001),
    "unit": with_key(unit="N.mm"),
    "actuator": with_key(noise=0.001, rate=1, delay="20ms"),
}
WRONG = [[1, 2, 3], np.zeros(3), [], np.zeros(0), "a", ["a"], None, {}, [[0, 0, 0]], [0.0, True]]


@pytest.fixture(params=["expressions", "Python"])
def hooks(request):
    return request.param


@pytest.fixture(params=TASKS.values(), ids=TASKS)
def env(request, hooks, load):
    env = load(request.param, way=hooks)
    env.reset(seed=0)
    return env


@pytest.mark.parametrize("action", WRONG, ids=str)
def test_a_wrong_number_of_values_is_refused(env, action):
    with pytest.raises(ConfigError):
        env.step(action)
    assert env.step_count == 0
    env.step(np.zeros(1, np.float32))


@pytest.mark.parametrize(
    "action", [0.0, [0.0], np.zeros((1, 1)), np.float64(0.0), np.zeros(1, int)]
)
def test_one_value_of_any_form_is_taken(env, action):
    expected = env.step(np.zeros(1))[:4]
    env.reset(seed=0)
    np.testing.assert_array_equal(env.step(action)[0], expected[0])


@pytest.mark.parametrize("action", [True, False, np.True_, np.False_])
def test_truths_choose_of_two_levels(action, hooks, load):
    env = load(LEVELS, way=hooks)
    env.reset(seed=0)
    expected = env.step(int(action))[0]
    env.reset(seed=0)
    np.testing.assert_array_equal(env.step(action)[0], expected)


@pytest.mark.parametrize("action", [np.array(True), np.float32(1.0), "a", [True], None, 2])
def test_other_things_choose_no_level(action, hooks, load):
    env = load(LEVELS, way=hooks)
    env.reset(seed=0)
    with pytest.raises(ConfigError, match="not in Discrete"):
        env.step(action)


def test_a_class_refuses_the_same(opened):
    class Swing(fmugym.FMI2CSEnv):
        def _is_done(self):
            return False

    config = {"model_input_names": "tau", "model_output_names": "q", "time_step": 0.02}
    bounds = {"bounds": {"tau": (-0.01, 0.01)}}
    env = opened(Swing(fmugym.bundled_fmu("Pendulum"), config | bounds))
    env.reset(seed=0)
    for action in WRONG:
        with pytest.raises(ConfigError):
            env.step(action)
