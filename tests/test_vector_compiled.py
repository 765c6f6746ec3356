"""Compiled hooks of vector environments are those of numbers, or are not compiled."""

import contextlib
import itertools
import re
import signal

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode
from vector_tools import (
    CART_POLE,
    Drawing,
    PushedCart,
    each_mode,
    each_way,
    require_equal,
    require_pair_equal,
    require_same_infos,
    run_side_by_side,
    sampled_actions,
)

import fmugym
from fmugym import ConfigError, Uniform
from fmugym.vector import FMUVectorEnv
from fmugym.vector.engines.batch import BatchEngine
from fmugym.vector.hooks.symbols import Symbols
from fmugym.vector.hooks.trace import trace_hooks


class Branching(Drawing):
    """Python's own functions of numbers, which work on arrays too: not compiled, and no mistake."""

    def _reward_policy(self):
        q, q_dot = self.state
        ranks = np.partition(np.stack([q, q_dot]), 0, axis=0)
        return -ranks[0] + float(len(self.state)) // 2


def test_what_cannot_be_compiled_is_left_to_numpy():
    require_pair_equal(Branching, hooks="auto", rtol=1e-12)
    with pytest.raises(ConfigError, match="cannot be compiled"):
        FMUVectorEnv(Branching, 2, hooks="compiled")


@pytest.mark.skipif(not hasattr(signal, "SIGUSR1"), reason="Windows has no signals of users")
@pytest.mark.parametrize("moment", ["construction", "assignment"])
def test_the_exception_of_a_signal_handler_is_not_that_of_a_hook(moment):
    """A time limit of the caller must not pass for a hook that cannot be compiled."""

    def ring(*_):
        raise TimeoutError("it takes too long")

    class Late(PushedCart):
        weight = 1.0
        rings = moment == "construction"

        def _reward_policy(self):
            if isinstance(self.state, Symbols) and type(self).rings:
                signal.raise_signal(signal.SIGUSR1)
            return self.weight * super()._reward_policy()

    usual = signal.signal(signal.SIGUSR1, ring)
    try:
        if moment == "construction":
            with pytest.raises(TimeoutError):
                FMUVectorEnv(Late, 2)
            return
        with contextlib.closing(FMUVectorEnv(Late, 2)) as envs:
            action = np.zeros(envs.action_space.shape, envs.action_space.dtype)
            rewards = []
            for weight in (1.0, 2.0):
                envs.reset(seed=1)
                if weight != 1.0:
                    Late.rings = True
                    with pytest.raises(TimeoutError):
                        envs.set_attr("weight", weight)
                rewards.append(envs.step(action)[1])
            assert (rewards[1] == 2.0 * rewards[0]).all()
            assert rewards[0].all()
    finally:
        signal.signal(signal.SIGUSR1, usual)


def test_plain_arithmetic_is_compiled():
    for cls in (fmugym.envs.CartPoleEnv, fmugym.envs.ModelicaCartPoleEnv, PushedCart):
        FMUVectorEnv(cls, 2, hooks="compiled").close()


class Arithmetic(Drawing):
    """All that is compiled."""

    def __init__(self, **changes):
        parameters = {"q_0": Uniform(-1.0, 1.0), "q_dot_0": 0.3, "m": Uniform(0.05, 0.07)}
        super().__init__(model_parameters=parameters, max_episode_steps=20, start_time=1.0)

    def _get_action_space(self):
        return gym.spaces.Discrete(3, start=-1)

    def _get_inputs(self):
        return [np.where(self.action == 1, 0.004, 0.01) * np.minimum(self.action, 0.5)]

    def _is_done(self):
        q, q_dot = self.state
        near, slow = (abs(q) > 0.9) & np.logical_not(q_dot < -1.0), np.less_equal(q_dot, 0.2)
        return near | np.logical_and(q > 0.5, slow) | np.logical_or(q == 0.25, q_dot >= 8.0)

    def _is_truncated(self):
        return (self.time > 1.2) & (self.step_count != 12) & np.not_equal(self.step_count, 13)

    def _reward_policy(self):
        q, q_dot = self.state
        first = np.sqrt(np.abs(q)) + np.square(q_dot) / (1.0 + np.fabs(self.inputs[0]))
        second = np.maximum(2 * q, -0.1) * np.negative(self.out["q_dot"]) - self.parameters["m"]
        return first - second + np.where(self.done, -1.0, -0.0) * (0.5 - self.action)


class MoreArithmetic(Arithmetic):
    def _is_done(self):
        return self.state[0] > 0.9

    def _is_truncated(self):
        return np.equal(self.step_count, 7)

    def _reward_policy(self):
        q, q_dot = self.state
        first = np.true_divide(np.add(q, 1), 3) + np.multiply(q, np.subtract(2.0, q_dot))
        second = np.where(np.greater(q, 0.3) | np.greater_equal(q_dot, 1.0), -first, 4.0 / (5 + q))
        return first + second - 1


@each_way
@each_mode
@pytest.mark.parametrize("cls", [Arithmetic, MoreArithmetic])
def test_compiled_arithmetic_is_that_of_numbers(cls, mode, hooks):
    way = hooks if hooks != "auto" else "compiled"
    assert require_pair_equal(cls, steps=150, mode=mode, num_envs=7, hooks=way) > 20


NOT_COMPILED = {
    "it uses numpy.partition": lambda env: np.partition(env.state, 0, axis=0)[0],
    "it multiplies large matrices": lambda env: np.sum(np.ones((600, 2)) @ env.state, axis=0),
    "it computes with complex128": lambda env: np.abs(np.exp(1j * env.state[0])),
    "it uses numpy.linalg.norm without one axis": lambda env: np.linalg.norm(env.state),
}


@pytest.mark.parametrize("reason", NOT_COMPILED)
def test_reasons_against_compiling(reason):
    class Other(Arithmetic):
        def _reward_policy(self):
            return NOT_COMPILED[reason](self)

    env = Other()
    left = trace_hooks(env).left
    env.close()
    assert list(left) == ["_reward_policy"]
    assert re.match(rf"_reward_policy, line \d+: .*{reason}", left["_reward_policy"])


RARE = {
    "numpy.sort": lambda env: np.sort(env.state, axis=0)[0],
    "numpy.median": lambda env: np.median(env.state, axis=0),
    "numpy.nansum": lambda env: np.nansum(env.state, axis=0),
    "numpy.einsum": lambda env: np.einsum("i...,i...->...", env.state, env.state),
    "numpy.piecewise": lambda env: np.piecewise(env.state[0], [env.state[0] < 0], [-1.0, 1.0]),
    "numpy.cumsum": lambda env: np.cumsum(env.state, axis=0)[1],
    "numpy.modf": lambda env: np.modf(3.0 * env.state[0])[0],
    "float16": lambda env: np.asarray(env.state[0], np.float16),
    "int32": lambda env: np.asarray(10.0 * env.state[0], np.int32),
    "uint64": lambda env: np.asarray(env.step_count).astype(np.uint64) % np.uint64(3),
    "where: use numpy.where": lambda env: np.divide(
        1.0, env.state[0], out=np.zeros_like(env.state[0]), where=env.state[0] != 0.0
    ),
    "a condition selects": lambda env: env.state[0] + np.sum(env.state[0][env.state[0] > 9]),
}


@pytest.mark.parametrize("reason", RARE)
def test_hooks_with_rare_functions_run_on_arrays_beside_compiled_ones(reason, caplog):
    class Other(Arithmetic):
        def _reward_policy(self):
            return RARE[reason](self)

    with caplog.at_level("INFO", "fmugym"):
        ours, theirs = (FMUVectorEnv(Other, 5, hooks=hooks) for hooks in ("auto", "array"))
    assert list(ours.inside.engine._task.left) == ["_reward_policy"]
    assert reason in caplog.text
    run_side_by_side(ours, theirs, AutoresetMode.NEXT_STEP, 40)
    ours.close()
    theirs.close()


class Differing(Arithmetic):
    """Its truncation is another one as a program, as if it hung on the last bit of a sine."""

    def _is_truncated(self):
        return super()._is_truncated() ^ isinstance(self.state, Symbols)


def test_a_program_that_differs_leaves_only_its_own_hook_to_arrays(caplog):
    with caplog.at_level("INFO", "fmugym"):
        require_pair_equal(Differing, steps=40, hooks="auto")
        envs = FMUVectorEnv(Differing, 3)
    assert "the program gives other values than _is_truncated. It runs on arrays" in caplog.text
    assert list(envs.inside.engine._task.left) == ["_is_truncated"]
    envs.close()


def test_why_hooks_are_not_compiled_stands_in_the_log(caplog):
    with caplog.at_level("INFO", "fmugym"):
        FMUVectorEnv(Branching, 2).close()
    (record,) = (r for r in caplog.records if "cannot be compiled" in r.getMessage())
    assert record.levelname == "INFO"
    assert "_reward_policy, line" in record.getMessage()
    assert "numpy.partition" in record.getMessage()


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


@pytest.mark.parametrize("change", CHANGES)
def test_compiled_hooks_after_a_change(change, monkeypatch):
    """Once the episodes from before have ended, the pool starts the next ones as before."""
    in_python = []
    begin = BatchEngine._begin
    monkeypatch.setattr(
        BatchEngine, "_begin", lambda engine, *given: in_python.append(1) or begin(engine, *given)
    )
    ours, theirs = (
        FMUVectorEnv(CART_POLE, 3, hooks=hooks, max_episode_steps=12)
        for hooks in ("compiled", "per_env")
    )
    run_side_by_side(ours, theirs, AutoresetMode.NEXT_STEP, 7)
    assert not in_python
    first, second = CHANGES[change](ours), CHANGES[change](theirs)
    if first is not None:
        require_equal(first[0], second[0])
    for actions in sampled_actions(ours, 60):
        already = len(in_python)
        first, second = ours.step(actions), theirs.step(actions)
        for ours_said, theirs_said in zip(first[:4], second[:4], strict=True):
            require_equal(ours_said, theirs_said)
        require_same_infos(first[4], second[4])
    assert len(in_python) == already < 30
    ours.close()
    theirs.close()


class NotANumber(Arithmetic):
    """Its reward is NaN where the pendulum swings one way."""

    def _reward_policy(self):
        return np.sqrt(self.state[1])


def test_programs_whose_results_are_nan_are_the_hooks():
    FMUVectorEnv(NotANumber, 2, hooks="compiled").close()


class Unattended(Arithmetic):
    """It has no inputs."""

    def __init__(self):
        fmugym.FMUEnv.__init__(
            self,
            fmugym.bundled_fmu("Pendulum"),
            {"model_input_names": [], "model_output_names": ["q", "q_dot"], "time_step": 0.02},
        )

    def _get_inputs(self):
        return []

    def _is_done(self):
        return self.state[0] > 0.9

    def _is_truncated(self):
        return self.step_count > 8

    def _reward_policy(self):
        return -self.state[0]


@pytest.mark.parametrize("hooks", ["auto", "array", "per_env"])
def test_an_environment_without_inputs(hooks):
    require_pair_equal(Unattended, steps=20, hooks=hooks)


@pytest.mark.skipif(not hasattr(signal, "SIGALRM"), reason="needs a signal of Unix")
@pytest.mark.parametrize("call", range(1, 5))
def test_what_a_signal_handler_raises_in_a_hook_comes_out(call):
    """Wherever the hook is called: alone, on arrays or on symbols."""

    class RingError(Exception):
        pass

    calls = itertools.count(1)  # a list would be as before when the constructor has failed

    class Ringing(Drawing):
        def _is_done(self):
            if next(calls) == call:
                signal.raise_signal(signal.SIGALRM)
            return super()._is_done()

    def ring(*_):
        raise RingError

    before = signal.signal(signal.SIGALRM, ring)
    try:
        with pytest.raises(RingError):
            FMUVectorEnv(Ringing, 3)
    finally:
        signal.signal(signal.SIGALRM, before)
    assert next(calls) == call + 1


class TestReadingTheLastStep:
    """No hook of the cart-pole reads its actions or the state before."""

    NAMES = ("action", "previous_action", "inputs", "state", "previous_state")
    ACTIONS = np.array([[0, 1], [1, 1], [1, 0], [0, 0]])

    @staticmethod
    def singles(steps):
        envs = [gym.make("fmugym/CartPole-v0").unwrapped for _ in range(2)]
        for index, env in enumerate(envs):
            env.reset(seed=index)
            for actions in steps:
                env.step(actions[index])
        return envs

    def test_it_equals_single_environments(self):
        env = gym.make_vec("fmugym/CartPole-v0", num_envs=2)
        env.reset(seed=0)
        for count, actions in enumerate(self.ACTIONS, 1):
            env.step(actions)
            for name in self.NAMES:
                expected = tuple(getattr(one, name) for one in self.singles(self.ACTIONS[:count]))
                assert env.get_attr(name) == expected, name
        env.close()


class Weighing(Drawing):
    """The reward is for a parameter that only some options give."""

    def _reward_policy(self):
        return self.parameters.get("b", -1.0) + 0.0 * self.state[0]


def test_programs_know_parameters_that_options_add():
    """They were compiled when there was no such parameter."""
    ways = [FMUVectorEnv(Weighing, 3, hooks=hooks) for hooks in ("compiled", "array", "per_env")]
    for envs in ways:
        envs.reset(seed=1)
        assert envs.step(envs.action_space.sample()).rewards.tolist() == [-1.0] * 3
        envs.reset(options={"model_parameters": {"b": 0.25}})
        assert envs.step(envs.action_space.sample()).rewards.tolist() == [0.25] * 3
        envs.close()
