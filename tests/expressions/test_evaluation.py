"""Expressions have the values that Python gives their texts, in hooks and in programs."""

import contextlib
from types import SimpleNamespace

import numpy as np
import pytest
from ways import in_python

import fmugym
from fmugym.expressions.functions import chance, noise
from fmugym.expressions.graph import Graph, Value
from fmugym.expressions.numpy_evaluation import function_of
from fmugym.fmi.bundled import bundled_fmu

TEXTS = {
    "a range": "-1 < theta < 1",
    "a choice between conditions": "theta > 0 if theta_dot > 0 else tau > 0",
    "a choice between numbers": "theta if theta_dot > tau else -theta",
    "neither of two": "not theta > 0 and not tau > 0",
    "conditions": "theta > 0 and tau > 0 or theta_dot > tau",
    "differences": "1 - theta - (tau - 2)",
    "remainders": "theta % 2 + tau % -0.7",
    "a square beside others": "theta * theta + (theta_dot - tau)",
    "powers": "theta**2 - theta_dot**3 + 2**tau",
    "quotients": "3 / (theta / tau)",
    "signs and angles": "sign(theta) * radians(theta_dot) + degrees(tau)",
    "functions": "min(theta, tau, 0.5) + abs(max(theta_dot, -1))",
}

FUNCTIONS = {name: getattr(np, name) for name in ("degrees", "radians", "sign")}
"""The functions that Python itself lacks."""


def pendulum(**config):
    """An environment that starts anywhere, and its actions."""
    start = {"theta_0": fmugym.Uniform(-3.0, 3.0), "theta_dot_0": fmugym.Uniform(-3.0, 3.0)}
    given = {
        "model_input_names": "tau",
        "model_output_names": ["theta", "theta_dot"],
        "model_parameters": start,
        "bounds": {"tau": (-2, 2)},
        "time_step": 0.05,
        "terminated": False,
    }
    env = fmugym.FMI2CSEnv(bundled_fmu("Pendulum"), given | config)
    env.action_space.seed(1)
    return env


@pytest.fixture(params=["programs", "Python"])
def played(request):
    """The observations, infos and environments of some steps, each of another episode."""

    def play(**config):
        env = pendulum(**config)
        with contextlib.closing(in_python(env) if request.param == "Python" else env):
            for seed in range(40):
                env.reset(seed=seed)
                observation, *_, info = env.step(env.action_space.sample())
                yield observation, info, env
            assert env.is_compiled == (request.param == "programs")

    return play


@pytest.mark.parametrize("name", TEXTS)
def test_a_text_has_the_value_of_python(name, played):
    seen = set()
    for _, info, env in played(info={"found": TEXTS[name]}):
        values = {"theta": env.state[0], "theta_dot": env.state[1], "tau": env.inputs[0]}
        wanted = eval(TEXTS[name], FUNCTIONS | values)
        assert info["found"] == wanted
        seen.add(wanted)
    assert len(seen) > 1


def test_outputs_are_observed_in_any_order_and_twice(played):
    """Those that are neighbours are stored at once."""
    names = ["theta_dot", "theta", "theta_dot", "theta", "theta"]
    for observation, _, env in played(observations=names):
        wanted = [env.out[name] for name in names]
        assert observation.tolist() == np.array(wanted, np.float32).tolist()


def test_a_curve_has_a_value_for_each_side():
    graph = Graph()
    graph.tables["curve"] = np.array([1.0, 2.0, 4.0, 10.0, 20.0, 0.0, -1.0, -2.0])
    curve = function_of(Value.read(graph, "x", dtype=np.float64).interpolated("curve"))
    places = [0.0, 1.0, 1.5, 3.0, 4.0, 5.0]
    wanted = [-1.0, 10.0, 15.0, 10.0, 0.0, -2.0]
    assert [curve(SimpleNamespace(x=place)) for place in places] == wanted
    assert curve(SimpleNamespace(x=np.array(places))).tolist() == wanted


@pytest.mark.parametrize("draw", [noise, chance])
def test_random_numbers_of_episodes_steps_and_sensors_have_nothing_in_common(draw):
    graph = Graph()
    key, count = (Value.read(graph, name, dtype=np.float64) for name in ("key", "count"))
    keys, counts = np.meshgrid(np.arange(50.0), np.arange(50.0))
    env = SimpleNamespace(key=keys.ravel(), count=counts.ravel())
    drawn = np.array(function_of([draw(key, count, channel) for channel in range(4)])(env))
    assert len(np.unique(drawn)) == drawn.size
    mean, deviation = {noise: (0.0, 1.0), chance: (0.5, 12**-0.5)}[draw]
    assert abs(drawn.mean() - mean) < 4 * deviation / drawn.size**0.5
    assert abs(drawn.std() / deviation - 1) < 0.03
