"""Compiled, on arrays and one environment at a time: arithmetic gives the same to the last bit."""

import gymnasium as gym
import numpy as np
import pytest
from combinations import in_turn
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from vector_tools import (
    Drawing,
    require_equal,
    require_pair_equal,
    results_of_both,
    sampled_actions,
)

from fmugym import Uniform
from fmugym.expressions.program import UntraceableError
from fmugym.task.construction import prepare_hooks
from fmugym.task.readings import reading
from fmugym.vector import FMUVectorEnv
from fmugym.vector.contents import borrowed
from fmugym.vector.hooks.check import sample_states
from fmugym.vector.hooks.compare import require_same as require_same_programs
from fmugym.vector.hooks.trace import trace_hooks
from fmugym.vector.views import some


def require_same(cls, num_envs=40, steps=25, mode="next_step", ways=("compiled", "array")):
    """Step two vector environments with the same actions; return the ended episodes."""
    first, second = (FMUVectorEnv(cls, num_envs, hooks=way, autoreset_mode=mode) for way in ways)
    ended = 0
    with np.errstate(all="ignore"):  # hooks on arrays may warn
        for result in results_of_both(first, second, steps, same=require_bits):
            require_variables(first, second)
            ended += int((result[2] | result[3]).sum())
    assert first.inside.engine.way == "compiled"
    first.close()
    second.close()
    return ended


def require_bits(first, second):
    require_equal(first, second)
    for a, b in zip(*map(leaves, (first, second)), strict=True):
        assert np.signbit(a).tolist() == np.signbit(b).tolist()


def leaves(value):
    return [value] if isinstance(value, np.ndarray) else list(value.values())


def require_variables(first, second):
    pairs = zip(first.get_attr("variables"), second.get_attr("variables"), strict=True)
    for one, other in pairs:
        require_equal(dict(one), dict(other))


class Task(Drawing):
    """Its hooks are expressions."""

    space = gym.spaces.Box(-1.0, 1.0, (2,), np.float32)

    def __init__(self, **changes):
        parameters = {"q_0": Uniform(-1.0, 1.0), "q_dot_0": Uniform(-0.5, 0.5)}
        config = {"model_parameters": parameters, "max_episode_steps": 7}
        super().__init__(**(config | {"monitor_names": ["theta_ddot"]} | changes))

    def _get_action_space(self):
        return self.space

    def _get_inputs(self):
        return [0.01 * np.sum(self.action, axis=0, dtype=np.float64)]

    def _is_done(self):
        return self.state[0] > 0.8


# Expressions

LEAVES = (
    *("self.state[0]", "self.state[1]", "self.previous_state[0]", "self.out['theta_ddot']"),
    *("self.inputs[0]", "self.action[0]", "self.action[1]", "self.previous_action[0]"),
    *("self.step_count", "self.time", "self.parameters['q_0']", "self.done", "self.after_end"),
    *("0.3", "-2", "1", "np.float32(0.7)", "np.int64(3)", "True", "-0.0", "np.nan"),
)
UNARY = (
    *("-({})", "abs({})", "+({})", "({}) ** 2", "np.sqrt({})", "np.square({})"),
    *("np.floor({})", "np.rint({})", "np.trunc({})", "np.sign({})", "np.isnan({})"),
    *("np.isinf({})", "np.logical_not({})", "np.float64({})", "np.asarray({}, np.float32)"),
    *("np.reciprocal(1.5 + {})", "np.deg2rad({})", "np.round(1.0 * ({}), 2)"),
    *("np.clip({}, -0.5, 0.0)", "np.interp({}, [-1.0, 0.0, 2.0], [3.0, -1.0, 1.0])"),
    *("np.sum([1.0 * ({}), self.state[1]], axis=0)",),
    *("np.linalg.norm(np.array([1.0 * ({}), self.state[0]]), axis=0)",),
)
BINARY = (
    *("({}) + ({})", "({}) - ({})", "({}) * ({})", "({}) / ({})", "({}) % ({})", "({}) // ({})"),
    *("np.minimum({}, {})", "np.maximum({}, {})", "np.fmod({}, {})"),
    *("np.copysign({}, {})", "np.logical_and({}, {})"),
    *("({}) < ({})", "({}) >= ({})", "({}) == ({})", "({}) != ({})", "np.logical_xor({}, {})"),
    *("np.where(self.state[0] > 0, {}, {})",),
    *("np.mean([1.0 * ({}), 1.0 * ({}) + self.state[1]], axis=0)",),
    *("np.select([self.state[0] > 0.2, self.state[1] > 0], [{}, {}], -1.0)",),
)
"""Arithmetic, which is equal to the last bit; see test_vector_functions for functions."""

NUMBERS_IN_LISTS = (
    "self.state[0]",
    "np.sqrt(np.select([self.state[0] > 0.2, True], [self.state[0], self.action[0]], -1.0))",
    "np.sqrt(np.where(self.state[0] > 0.2, 0.1, self.action[0]))",
)
"""Numbers of Python in lists, which adapt to the types of other numbers as they do elsewhere."""


def combined(children):
    return st.one_of(
        st.tuples(st.sampled_from(UNARY), children).map(lambda t: t[0].format(t[1])),
        st.tuples(st.sampled_from(BINARY), children, children).map(lambda t: t[0].format(*t[1:])),
    )


EXPRESSIONS = st.recursive(st.sampled_from(LEAVES), combined, max_leaves=8)


def hook_of(expression):
    return eval(f"lambda self: {expression}", {"np": np})


def task_of(reward, observed, variable):
    """A class whose hooks are expressions; what is not finite becomes 0."""
    rewarded, seen, updated = map(hook_of, (reward, observed, variable))

    class Generated(Task):
        def _update(self):
            new = updated(self) + 0.5 * self.variables["memory"]
            self.variables["memory"] = np.where(np.isfinite(new), 1.0 * new, 0.25)

        def _get_observation(self):
            value = np.clip(seen(self), -1e6, 1e6) + 0.0 * self.state[0]
            finite = np.where(np.isfinite(value), value, -0.0)
            return np.array([finite, self.variables["memory"] / 3.0], np.float32)

        def _reward_policy(self):
            value = rewarded(self) + 0.0 * self.state[0]
            return np.where(np.abs(value) < 1e100, value, -1.0)

    return Generated


NOT_TRACED = ("self.done before there is one", "it computes with", "it uses numpy.", "boolean")
"""The only reasons that generated expressions may have. They are documented."""


@pytest.fixture(scope="module")
def prototype():
    env = Task(episode_variables={"memory": Uniform(-1.0, 1.0)})
    yield env, sample_states(env, (1.0, -0.3, 10.0, -1e5))
    env.close()


@settings(
    max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(EXPRESSIONS, EXPRESSIONS, EXPRESSIONS)
@example(*NUMBERS_IN_LISTS)
def test_generated_expressions(prototype, reward, observed, variable):
    """Whatever can be traced gives what numpy gives on arrays."""
    env, batch = prototype
    cls = task_of(reward, observed, variable)
    for name in ("_update", "_get_observation", "_reward_policy"):
        setattr(env, name, getattr(cls, name).__get__(env))
    prepare_hooks(env)
    try:
        with np.errstate(all="ignore"), borrowed(env), reading(env, some(batch)):
            env._update(), env._get_observation(), env._reward_policy()
    except (TypeError, ValueError, ArithmeticError, np.exceptions.ComplexWarning):
        return  # numpy refuses these types
    try:
        task = trace_hooks(env)
    except UntraceableError as error:
        task, reason = None, str(error)
    if task is None:
        assert any(known in reason for known in NOT_TRACED)
    else:
        assert task.tolerance == 0.0
        require_same_programs(env, batch, task)


def test_no_warnings_of_numpy_come_from_compiled_code(make_envs):
    class Dividing(Task):
        def _reward_policy(self):
            quotient = np.log(self.state[0] - 5.0) + 1.0 / (self.state[0] - self.state[0])
            return np.where(
                np.isfinite(quotient), quotient, np.exp(1e4 * np.abs(self.state[1])) > 2
            )

    envs = make_envs(Dividing, 3, hooks="compiled")
    envs.reset(seed=0)
    for actions in sampled_actions(envs, 5):
        envs.step(actions)  # warnings are errors in tests
        assert np.sqrt(np.ones(2)).tolist() == [1.0, 1.0]


# Actions

SPACES = {
    "float64": gym.spaces.Box(-1.0, 1.0, (2, 3), np.float64),
    "float32": gym.spaces.Box(-1.0, 1.0, (2,), np.float32),
    "int64": gym.spaces.Box(-5, 5, (2,), np.int64),
    "discrete": gym.spaces.Discrete(4, start=-1),
    "multi": gym.spaces.MultiDiscrete([3, 5]),
    "binary": gym.spaces.MultiBinary(3),
}
OTHERS = {
    "float16": gym.spaces.Box(-1.0, 1.0, (2,), np.float16),
    "int32": gym.spaces.Box(-5, 5, (2,), np.int32),
    "uint8": gym.spaces.Box(0, 255, (2,), np.uint8),
    "int16": gym.spaces.Box(-5, 5, (2,), np.int16),
}


class Acting(Task):
    def _get_inputs(self):
        return [0.001 * np.sum(np.reshape(self.action, (-1, *np.shape(self.state[0]))), axis=0)]

    def _get_observation_space(self):
        return gym.spaces.Box(-np.inf, np.inf, (3,), np.float64)

    def _get_observation(self):
        flat = np.reshape(self.action, (-1, *np.shape(self.state[0])))
        before = np.reshape(self.previous_action, (-1, *np.shape(self.state[0])))
        return np.array([0.25 * flat[0], 0.5 * before[-1], self.inputs[0]])


@in_turn({"name": list(SPACES), "mode": ["next_step", "same_step"]})
def test_actions_of_compiled_types(name, mode):
    assert require_same(type("Own", (Acting,), {"space": SPACES[name]}), mode=mode) > 40


@pytest.mark.parametrize("name", OTHERS)
def test_actions_of_other_types_run_on_arrays(name, caplog):
    own = type("Own", (Acting,), {"space": OTHERS[name]})
    with caplog.at_level("INFO", "fmugym"):
        require_pair_equal(own, steps=20, hooks="auto", rtol=1e-6)
    assert f"its actions are {name}" in caplog.text


def test_minus_zero_is_zero_for_integers(make_envs):
    """It was -0.0, because programs computed with floats only."""

    class Negating(Task):
        space = gym.spaces.Discrete(2)

        def _get_inputs(self):
            return [0.001 * self.action]

        def _reward_policy(self):
            return -self.action

    envs = make_envs(Negating, 2, hooks="compiled")
    envs.reset(seed=0)
    rewards = envs.step(np.array([0, 1]))[1]
    assert rewards.tolist() == [0.0, -1.0]
    assert np.signbit(rewards).tolist() == [False, True]
