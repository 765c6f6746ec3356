"""Attributes, parameters and methods of the single environments of a vector environment."""

import numpy as np
import pytest
from contract_cases import Summing, WithCost
from gymnasium.vector import SyncVectorEnv
from vector_tools import (
    CART_POLE,
    Drawing,
    each_way,
    require_equal,
    require_same_starts,
    results_of_both,
    run_side_by_side,
    sampled_actions,
)
from ways import WAYS, in_way

from fmugym import ConfigError, Uniform
from fmugym.environment.vector import FMUVectorEnv


def cart_pole_with(**parameters):
    return CART_POLE(model_parameters=parameters)


@each_way
def test_attributes_for_each_environment(hooks):
    forces, limits = [5.0, 10.0, 15.0], [0.1, 2.4, 0.2]
    vector = FMUVectorEnv(in_way(hooks, CART_POLE), 3)
    vector.set_attr("force_mag", forces)
    vector.set_attr("x_threshold", np.array(limits))
    assert vector.get_attr("force_mag") == tuple(forces)
    theirs = SyncVectorEnv(
        [
            lambda f=force, x=limit: cart_pole_with(force_mag=f, x_threshold=x)
            for force, limit in zip(forces, limits, strict=True)
        ],
        observation_mode="different",
    )
    assert run_side_by_side(vector, theirs, 100) > 5


@pytest.mark.parametrize("values", [[0.5, 1.5, -2.0], [1, 2, 3], [True, False, True], [2.0] * 3])
def test_hooks_read_attributes_of_each_environment(values):
    class Weighted(Drawing):
        weight = 1.0

        def _reward_policy(self):
            return self.weight * self.state[0] + (self.weight > 1)

    ways = [FMUVectorEnv(in_way(hooks, Weighted), 3) for hooks in ("arrays", "one by one")]
    for now in ([4.0, 5.0, 6.0], values):
        for vector in ways:
            vector.set_attr("weight", now)
        list(results_of_both(*ways, 5))
        for vector in ways:
            assert vector.get_attr("weight") == tuple(now)
    for vector in ways:
        vector.close()


@each_way
def test_parameters_for_each_environment(hooks, make_envs):
    """They hold from the next episode on, several at a time, and options come before them."""
    masses, frictions = [0.05, 0.1, 0.2], [0.0, 0.5, 1.0]
    vector = make_envs(in_way(hooks, CART_POLE), 3)
    vector.reset(seed=8)
    vector.set_attr("m_pole", masses)
    vector.set_attr("m_cart", 0.9)
    vector.set_attr("g", frictions)
    assert [p["m_pole"] for p in vector.get_attr("parameters")] == [0.1] * 3
    theirs = SyncVectorEnv(
        [
            lambda m=m, g=g: cart_pole_with(m_pole=m, m_cart=0.9, g=g)
            for m, g in zip(masses, frictions, strict=True)
        ]
    )
    assert any((result[2] | result[3]).any() for result in results_of_both(vector, theirs))
    assert [p["m_pole"] for p in vector.get_attr("parameters")] == masses
    options = {"model_parameters": {"m_pole": 0.3}}
    require_equal(vector.reset(options=options)[0], theirs.reset(options=dict(options))[0])
    assert [p["m_pole"] for p in vector.get_attr("parameters")] == [0.3] * 3
    theirs.close()


@each_way
def test_parameters_that_the_config_does_not_name_or_draws(hooks):
    vector = FMUVectorEnv(in_way(hooks, Drawing), 3)
    vector.reset(seed=0)
    vector.set_attr("b", [0.0, 1e-4, 2e-4])
    vector.set_attr("q_0", [0.1, 0.2, 0.3])
    theirs = SyncVectorEnv(
        [
            lambda b=b, q=q: Drawing(
                model_parameters={"q_0": q, "q_dot_0": Uniform(-0.5, 0.5), "b": b}
            )
            for b, q in ((0.0, 0.1), (1e-4, 0.2), (2e-4, 0.3))
        ]
    )
    run_side_by_side(vector, theirs, 20)


@each_way
def test_values_that_do_not_fit(hooks, make_envs):
    vector = make_envs(in_way(hooks, CART_POLE), 3)
    with pytest.raises(ConfigError, match="there are 2 values of 'force_mag', expected 3"):
        vector.set_attr("force_mag", [1.0, 2.0])
    for values in (["a", 1.0, 1.0], [1.0, [2.0, 3.0], 4.0], [{}, 1.0, 2.0], [1.0, 1.0, np.nan]):
        with pytest.raises(ConfigError, match="m_pole"):
            vector.set_attr("m_pole", values)
        with pytest.raises(ConfigError, match="'force_mag' takes numbers of shape"):
            vector.set_attr("force_mag", values)
    with pytest.raises(ConfigError, match="'force_mag' takes numbers of shape"):
        vector.set_attr("force_mag", np.ones((3, 2)))


@each_way
def test_misspelt_attributes_and_parameters(hooks, make_envs):
    vector = make_envs(in_way(hooks, CART_POLE), 3)
    for misspelt, meant in (("force_magg", "force_mag"), ("m_poles", "m_pole")):
        with pytest.raises(ConfigError, match=f"{misspelt!r}; did you mean {meant!r}"):
            vector.set_attr(misspelt, [1.0, 2.0, 3.0])
        with pytest.raises(ConfigError, match="unknown attribute or parameter"):
            vector.set_attr(misspelt, 1.0)
        with pytest.raises(AttributeError):
            vector.get_attr(misspelt)


@each_way
def test_methods_are_called_for_each_environment(hooks, make_envs):
    vector = make_envs(in_way(hooks, CART_POLE), 2)
    observations, _ = vector.reset(seed=0)
    read = vector.call("read_variables", "x")
    assert [np.float32(values["x"]) for values in read] == observations[:, 0].tolist()
    assert vector.call("force_mag") == (10.0, 10.0)
    assert vector.call("_describe_action") == ("+0.0 N", "+0.0 N")
    assert vector.get_attr("time") == (0.0, 0.0)


class Limited(CART_POLE):
    """Its methods write what its hooks read."""

    def __init__(self):
        super().__init__()
        self.limit = 2.4
        self.marks = [0.0]

    def set_limit(self, limit):
        self.limit = limit
        return self.limit

    def halve_and_stop(self):
        self.limit = self.limit / 2
        self.spec = None

    def name_it(self, name):
        self.name = name

    def scatter(self):
        self.limit = 0.01 * self.parameters["m_pole"] + abs(self.state[0])

    def _is_done(self):
        return abs(self.state[0]) >= self.limit


@each_way
def test_what_a_method_assigns_takes_effect(hooks, make_envs):
    vector = make_envs(in_way(hooks, Limited), 3)
    vector.reset(seed=0)
    assert vector.step(np.zeros(3, np.int64))[2].tolist() == [False] * 3
    assert vector.call("set_limit", 0.0) == (0.0,) * 3
    assert vector.get_attr("limit") == (0.0,) * 3
    assert vector.step(np.zeros(3, np.int64))[2].tolist() == [True] * 3
    vector.reset(seed=0)
    vector.call("set_limit", limit=2.4)
    assert vector.step(np.zeros(3, np.int64))[2].tolist() == [False] * 3
    vector.call("scatter")
    limits = vector.get_attr("limit")
    assert len(set(limits)) == 3
    expected = [abs(np.float64(state[0])) + 0.001 for state in vector.get_attr("state")]
    np.testing.assert_allclose(limits, expected)


def test_what_a_method_cannot_do_to_one_of_many_is_refused_and_changes_nothing(make_envs):
    vector = make_envs(in_way("arrays", Limited), 3)
    vector.reset(seed=0)
    vector.step(np.zeros(3, np.int64))
    with pytest.raises(ConfigError, match="'spec' cannot be set"):
        vector.call("halve_and_stop")
    assert vector.get_attr("limit") == (2.4,) * 3
    assert vector.get_attr("marks") == ([0.0],) * 3
    vector.call("name_it", "trolley")
    assert vector.get_attr("name") == ("trolley",) * 3


@each_way
def test_methods_that_no_environment_can_do_alone(hooks, make_envs):
    vector = make_envs(in_way(hooks, CART_POLE), 2)
    vector.reset(seed=0)
    for method in ("reset", "step", "close"):
        with pytest.raises(ConfigError, match=f"{method!r} cannot be called on single"):
            vector.call(method)
    assert vector.call("render") == (None, None)
    for odd in (3, None, ["x"], np.ones(2)):
        with pytest.raises(ConfigError, match="the name of an attribute must be a text"):
            vector.get_attr(odd)


@each_way
def test_what_the_environments_keep_themselves_cannot_be_set(hooks, make_envs):
    vector = make_envs(in_way(hooks, CART_POLE), 2)
    for name in ("state", "time", "action_space", "interface", "step", "_is_done", "fmu"):
        with pytest.raises(ConfigError, match=f"{name!r} cannot be set"):
            vector.set_attr(name, 1.0)


class Adding(Summing):
    """Assigns new arrays."""

    def _update(self):
        self.variables["sum"] = self.variables["sum"] + self.state[0]


def test_sums_go_on_while_an_episode_has_parameters_of_its_own(make_envs):
    ours, theirs = (
        make_envs(in_way(hooks, lambda: Adding(max_episode_steps=50)), 3, autoreset_mode="Disabled")
        for hooks in ("arrays", "one by one")
    )
    first = np.array([True, False, False])
    overriding = {"reset_mask": first, "model_parameters": {"m": 0.06}}
    for options in ({}, overriding, {"reset_mask": first}):
        for envs in ours, theirs:
            envs.reset(seed=1 if not options else None, options=options)
        for actions in sampled_actions(ours, 4):
            for mine, other in zip(ours.step(actions)[:4], theirs.step(actions)[:4], strict=True):
                require_equal(mine, other)


@each_way
def test_methods_that_were_read_before_read_the_present_values(hooks, make_envs):
    vector = make_envs(in_way(hooks, WithCost), 3)
    vector.reset(seed=2)
    methods = vector.get_attr("_reward_policy")
    vector.step(np.zeros((3, 1), np.float32))
    expected = [-state[0] * state[0] for state in vector.get_attr("state")]
    assert [method() for method in methods] == expected
    assert list(vector.call("cost")) == [-value for value in expected]


CHANGES = {
    "options": lambda vector: vector.reset(
        options={
            "model_parameters": {"m_pole": 0.3},
            "reset_mask": np.array([True, False, False]),
        }
    ),
    "parameters": lambda vector: vector.set_attr("m_pole", [0.05, 0.2, 0.3]),
    "another parameter": lambda vector: vector.set_attr("theta_dot_0", [0.01, 0.02, 0.03]),
    "an attribute": lambda vector: vector.set_attr("x_threshold", 0.05),
}


@pytest.mark.parametrize("mode", ["next_step", "same_step"])
@pytest.mark.parametrize("change", CHANGES)
def test_a_change_is_that_of_single_environments(change, mode, make_envs):
    """In the episodes that it meets, and in those after them."""
    ours, theirs = (
        make_envs(in_way(hooks, CART_POLE), 3, max_episode_steps=12, autoreset_mode=mode)
        for hooks in WAYS
    )
    for count, _ in enumerate(results_of_both(ours, theirs, 60)):
        if count == 6:
            first, second = CHANGES[change](ours), CHANGES[change](theirs)
            if first is not None:
                require_same_starts(first, second)
    assert count == 59


class Weighing(Drawing):
    """The reward is for a parameter that only some options give."""

    def _reward_policy(self):
        return self.parameters.get("b", -1.0) + 0.0 * self.state[0]


def test_hooks_read_parameters_that_options_add():
    ways = [FMUVectorEnv(in_way(way, Weighing), 3) for way in WAYS]
    for envs in ways:
        envs.reset(seed=1)
        assert envs.step(envs.action_space.sample())[1].tolist() == [-1.0] * 3
        envs.reset(options={"model_parameters": {"b": 0.25}})
        assert envs.step(envs.action_space.sample())[1].tolist() == [0.25] * 3
        envs.close()
