"""A single environment of expressions: programs give what Python gives, and hooks stay Python."""

import logging

import gymnasium as gym
import numpy as np
import pytest
from contract_cases import PENDULUM
from example_tools import EXAMPLES
from fmu_tools import PlainEnv, probe_config
from vector_tools import Drawing
from ways import in_python

from fmugym import ConfigError, SimulationError
from fmugym.environment.episode import READABLE
from fmugym.task.task_env import TaskEnv

READ = (*READABLE, "time")


def same(first, second):
    """Whether two values are the same to the last bits of a float32; NaNs are equal."""
    if isinstance(first, dict):
        return first.keys() == second.keys() and all(same(first[k], second[k]) for k in first)
    if isinstance(first, tuple):
        return len(first) == len(second) and all(map(same, first, second))
    if isinstance(first, np.ndarray):
        like = first.dtype.kind == second.dtype.kind and first.shape == second.shape
        return like and np.allclose(first, second, rtol=1e-6, atol=1e-6, equal_nan=True)
    if isinstance(first, (float, int, np.generic)):
        return np.isclose(first, second, rtol=1e-6, atol=1e-6, equal_nan=True)
    return first == second


def require_readings(one, other):
    for name in READ:
        first, second = getattr(one, name), getattr(other, name)
        if name in ("out", "parameters", "variables"):
            first, second = dict(first), dict(second)
        assert same(first, second), (name, first, second)


def require_same_steps(one, other, *actions):
    """Step both; what they return and what hooks read is the same."""
    for action in actions:
        assert same(one.step(action), other.step(action)), action
        require_readings(one, other)


@pytest.fixture
def both(load):
    """Make an environment that is compiled, and one in Python, after a reset."""

    def make(task, **options):
        envs = load(task, **options), load(task, way="Python", **options)
        for env in envs:
            env.reset(seed=0)
        assert [env.is_compiled for env in envs] == [True, False]
        return envs

    return make


def test_overridden_parameters(both):
    one, other = both(PENDULUM)
    for index, chosen in enumerate(2 * ({}, {"model_parameters": {"q_0": 0.1}})):
        assert same(one.reset(seed=index, options=chosen), other.reset(seed=index, options=chosen))
        require_same_steps(one, other, *np.linspace(-0.01, 0.01, 4, dtype=np.float32)[:, None])


def test_readings_may_be_set(both):
    envs, action = both(PENDULUM), np.zeros(1, np.float32)
    for env in envs:
        env.step(action)
        env.variables["target"] = 0.25
        env.step_count = 3
    require_same_steps(*envs, action, action, action)


def test_what_was_read_is_kept_by_nobody(load):
    env = load(PENDULUM)
    env.reset(seed=0)
    env.step([0.01])
    state, before = env.state, env.previous_state
    env.step(np.float32([0.01]))
    assert env.previous_state == state != before


class TestActions:
    def test_integers_of_other_types(self, both):
        one, other = both(EXAMPLES / "cart_pole.toml")
        numbers = (1, np.int64(0), np.int32(1), np.array(1), 0, np.uint8(1), 1)
        require_same_steps(one, other, *numbers)

    def test_arrays_of_other_types(self, both):
        one, other = both(EXAMPLES / "pendulum.toml")
        actions = [
            *(np.array([0.3], np.float32), np.array([0.3]), [0.3], np.array([1], np.int8)),
            *(np.array([0.3, 0.2], np.float32)[::2], np.float32([0.1])),
        ]
        require_same_steps(one, other, *actions)
        with pytest.raises(ConfigError, match="NaN"):
            one.step(np.array([np.nan], np.float32))
        require_same_steps(one, other, actions[0])


class TestFaults:
    @pytest.mark.parametrize("policy", ["truncate", "terminate", "raise"])
    def test_numbers_that_are_not_finite(self, both, policy):
        root = "sqrt(0.3 - abs(q - 0.1))"
        envs = both({**PENDULUM, "reward": root, "config": {"on_fault": policy}})
        results = []
        for env in envs:
            outcome = []
            for _ in range(40):
                try:
                    outcome.append(env.step(np.float32([0.01])))
                except SimulationError as error:
                    outcome.append(str(error))
                if isinstance(outcome[-1], str) or any(outcome[-1][2:4]):
                    break
            results.append(outcome)
        require_readings(*envs)
        assert len(results[0]) == len(results[1])
        assert all(map(same, *results))

    def test_inputs_that_are_not_finite(self, both):
        texts = []
        for env in both(PENDULUM):
            with pytest.raises(ConfigError) as error:
                env.step(np.float32([np.inf]))
            texts.append(str(error.value))
        assert texts[0] == texts[1]


class TestHooksOfClasses:
    """They are called as they are, once a step."""

    def test_one_hook_keeps_all_in_python(self):
        class Own(TaskEnv):
            def _get_info(self):
                return {"seen": self.state[0]}

        with Own(PENDULUM) as env:
            env.reset(seed=0)
            *_, info = env.step(np.zeros(1, np.float32))
            assert info == {"seen": env.state[0]}
            assert not env.is_compiled

    def test_they_may_do_anything(self):
        seen = []

        class Recording(Drawing):
            def _reward_policy(self):
                seen.append(self.state[0])
                return float(len(seen))

        with Recording() as env:
            env.reset(seed=0)
            assert [env.step(0 * env.action_space.sample())[1] for _ in range(3)] == [1.0, 2.0, 3.0]
        assert len(seen) == 3

    def test_exceptions_reach_the_caller(self, probe):
        class Failing(PlainEnv):
            def _reward_policy(self):
                return self.state[0] / (self.step_count - 2)

        with Failing(probe(), probe_config(), log_level=logging.ERROR) as env:
            env.reset(seed=0)
            env.step(np.array([1.0]))
            with pytest.raises(ZeroDivisionError):
                env.step(np.array([1.0]))

    @pytest.mark.parametrize("hook", ["_is_done", "_get_info", "_goal_reward"])
    def test_attributes_are_refused(self, hook):
        class Assigning(Drawing):
            def __init__(self):
                super().__init__()
                setattr(self, hook, lambda *_: False)

        with (
            Assigning() as env,
            pytest.raises(ConfigError, match=f"{hook} was assigned .*Assigning; .*of the class"),
        ):
            env.reset(seed=0)

    def test_attributes_of_a_task_are_refused(self, load):
        env = load(PENDULUM)
        env._reward_policy = lambda: 7.0
        with pytest.raises(ConfigError, match="_reward_policy was assigned"):
            env.reset(seed=0)


def test_the_first_reset_compiles(load):
    env = load(PENDULUM)
    assert not env.is_compiled
    env.reset(seed=0)
    assert env.is_compiled


def test_close(load):
    env = load(PENDULUM)
    env.reset(seed=0)
    env.step([0.01])
    state = env.state
    env.close()
    assert env.state == state
    with pytest.raises(SimulationError, match="closed"):
        env.step([0.01])


def test_pictures_are_those_of_python():
    made = [gym.make("fmugym/Pendulum-v0", render_mode="rgb_array") for _ in range(2)]
    in_python(made[1].unwrapped)
    for env in made:
        env.reset(seed=1)
        for _ in range(3):
            env.step(np.array([1.0], np.float32))
    assert np.array_equal(*(env.render() for env in made))
    for env in made:
        env.close()
