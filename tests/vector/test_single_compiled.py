"""A single environment with compiled hooks equals the same one with its hooks in Python."""

import gc
import logging
import math
import random
import sys
import weakref
from types import MethodType

import gymnasium as gym
import numpy as np
import pytest
from combinations import in_turn
from fmu_tools import PlainEnv, probe_config
from test_vector_tasks import Delayed, Goal, Tables, Tracking
from vector_tools import (
    Drawing,
)

import fmugym
from fmugym import ConfigError, SimulationError, Uniform
from fmugym.task.readings import READINGS
from fmugym.vector import one as compiler

READ = (*READINGS, "time")


def same(first, second):
    """Whether two values are the same to the last bits of a float32; NaNs are equal.

    Compiled hooks follow the rules of arrays: a number of Python does not adapt to a float32, and
    an observation has the type of its space.
    """
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


def with_hooks(cls, hooks, *args, **keywords):
    """An environment of a class whose constructor does not pass arguments on."""
    env = cls(*args, **keywords)
    env.inside.way = hooks
    return env


def require_same(make, steps=250):
    """Play episodes side by side; return how many steps were compiled, and how many ended."""
    one, other = make("compiled"), make("python")
    compiled = ended = 0
    assert same(one.reset(seed=5), other.reset(seed=5))
    one.action_space.seed(1)
    for index in range(steps):
        action = one.action_space.sample()
        with np.errstate(all="ignore"):
            first, second = one.step(action), other.step(action)
        assert same(first, second), (index, first, second)
        compiled += one.inside.player is not None
        if index % 5 == 0:
            require_readings(one, other)
        if first[2] or first[3]:
            require_readings(one, other)
            ended += 1
            assert same(one.reset(), other.reset())
            require_readings(one, other)
    one.close()
    other.close()
    return compiled, ended


@pytest.mark.parametrize("name", ["CartPole", "Pendulum", "ModelicaCartPole", "CloudPendulum"])
def test_bundled_environments(name):
    def make(hooks):
        env_id = f"fmugym/{name}-v0"
        return gym.make(
            env_id, max_episode_steps=-1, hooks=hooks, disable_env_checker=True
        ).unwrapped

    compiled, _ = require_same(make)
    assert compiled > 180


class Acting(Drawing):
    """Actions of float32 meet floats of Python, which adapt to them."""

    def _get_action_space(self):
        return gym.spaces.Box(-1.0, 1.0, (2,), np.float32)

    def _get_inputs(self):
        return 0.01 * self.action[0] + 0.003 * self.state[0]

    def _is_done(self):
        return (self.state[0] > 0.5) | (self.step_count > 30)

    def _reward_policy(self):
        return self.action[1] * self.state[0] - self.state[1] ** 2 + self.action[0] ** 3


class Counting(Drawing):
    """Episode variables that count, and truths that are added."""

    def __init__(self):
        super().__init__(
            episode_variables={"count": 0, "high": 0, "target": Uniform(-1.0, 1.0), "sum": 0.0},
            max_episode_steps=12,
        )

    def _update(self):
        is_high = self.state[0] > self.variables["target"]
        self.variables["count"] += 1
        self.variables["high"] = 1.0 * is_high
        self.variables["sum"] = self.variables["sum"] / 2 + self.state[1] // 0.1

    def _is_done(self):
        return (self.variables["high"] > 0) & (self.variables["count"] > 5)

    def _reward_policy(self):
        return 1.0 * (self.state[0] > 0) + (self.state[1] > 0) - self.variables["count"] % 3


class Telling(Counting):
    """Has infos, and reads everything in them."""

    def _get_info(self):
        return {"count": self.variables["count"], "action": self.action, "time": self.time}


TASKS = [Tracking, Delayed, Goal, Tables, Acting, Counting, Telling]


@pytest.mark.parametrize("cls", TASKS)
def test_tasks_of_users(cls):
    compiled, ended = require_same(lambda hooks: with_hooks(cls, hooks), steps=120)
    assert ended > 1
    assert compiled > 60


@pytest.mark.parametrize("cls", TASKS)
def test_it_is_a_batch_of_one(cls, make_envs):
    """To the last bit."""
    one, many = with_hooks(cls, "compiled"), make_envs(cls, 1, hooks="compiled")
    one.reset(seed=5)
    many.reset(seed=5)
    many.action_space.seed(1)
    for _ in range(60):
        actions = many.action_space.sample()
        observations, rewards, terminated, truncated, _ = many.step(actions)
        result = one.step(actions[0])
        for observation, row in zip(parts_of(result[0]), parts_of(observations), strict=True):
            assert observation.tobytes() == row[0].tobytes()
        assert result[1:4] == (rewards[0], terminated[0], truncated[0])
        if terminated[0] or truncated[0]:
            one.reset()
            many.step(actions)  # which begins the next episode
    one.close()


def parts_of(observation):
    return (
        [observation[name] for name in sorted(observation)]
        if isinstance(observation, dict)
        else [observation]
    )


class Side(Drawing):
    def __init__(self):
        super().__init__(max_episode_steps=40)

    def _get_observation_space(self):
        return gym.spaces.Discrete(2)

    def _get_observation(self):
        return np.int64(self.state[0] > 0.2)

    def _is_done(self):
        return self.state[0] > np.inf

    def _get_info(self):
        return {"q": self.state[0]}


def test_observations_that_are_numbers():
    env, seen = with_hooks(Side, "compiled"), []
    env.reset(seed=1)
    for number in range(40):
        observation, _, _, _, info = env.step(np.full(1, 0.9 if number < 20 else -0.9, np.float32))
        assert observation == (info["q"] > 0.2)
        seen.append(observation)
    assert set(seen) == {0, 1}
    env.close()


def test_a_pool_steps_one_environment_only_with_what_that_takes(make_envs):
    env, envs = with_hooks(Side, "compiled"), make_envs(Side, 2, hooks="compiled")
    action = np.zeros(1, np.float32)
    good = [int, None, (), action, env]
    env.reset(seed=1)
    envs.reset(seed=1)
    with pytest.raises(TypeError, match="needs a tuple"):
        env.inside.pool.step_one(int, None, [], action, env)
    with pytest.raises(TypeError, match="one instance"):
        envs.inside.pool.step_one(*good)
    assert env.inside.pool.step_one(*good) is None  # the environment keeps the episode itself
    assert len(env.step(action)) == 5
    env.close()


def test_overridden_parameters():
    options = ({}, {"model_parameters": {"theta_0": 0.1}}, {"x_init": 0.2}, {"y_init": 0.3})

    def make(hooks):
        return gym.make("fmugym/Pendulum-v0", max_episode_steps=-1, hooks=hooks).unwrapped

    one, other = make("compiled"), make("python")
    for index, chosen in enumerate(2 * options):
        assert same(one.reset(seed=index, options=chosen), other.reset(seed=index, options=chosen))
        require_same_steps(one, other, *np.linspace(-3.0, 3.0, 7, dtype=np.float32)[:, None])
    one.close()
    other.close()


def compiled_cart(**options):
    env = fmugym.envs.CartPoleEnv(**{"hooks": "compiled"} | options)
    env.reset(seed=0)
    env.step(0)
    assert (env.inside.player is not None) == (options.get("hooks") != "python")
    return env


def carts():
    """One that is compiled, and one in Python, after a step."""
    return compiled_cart(), compiled_cart(hooks="python")


class TestAttributes:
    def test_values_set_in_an_episode_are_noticed(self):
        one, other = carts()
        one.force_mag = other.force_mag = 3.0
        require_same_steps(one, other, *[1] * 5)
        one.x_threshold = other.x_threshold = 1e-9
        require_same_steps(one, other, 1)
        assert one.done

    def test_a_number_that_is_assigned_again_needs_no_compilation(self, monkeypatch):
        one, other = carts()
        one.force_mag = other.force_mag = 4.0
        one.step(0)
        other.step(0)
        monkeypatch.setattr(compiler, "compile_hooks", None)
        for force in (5.0, 6.0, 10.0):
            one.force_mag = other.force_mag = force
            require_same_steps(one, other, 1, 0)
        assert one.inside.player is not None

    def test_several_numbers_may_be_assigned_between_two_steps(self):
        one, other = carts()
        one.x_threshold = other.x_threshold = 2.3
        assert same(one.step(1), other.step(1))
        for env in (one, other):
            env.force_mag, env.x_threshold = 4.0, 1e-9  # a new one, and one that was assigned
        result = one.step(1)
        assert same(result, other.step(1))
        assert result[2]

    def test_hooks_set_in_an_episode_are_noticed(self):
        env = compiled_cart()
        env._reward_policy = lambda: 7.0
        assert env.step(0)[1] == 7.0
        assert env.step(0)[1] == 7.0

    def test_methods_that_are_attributes(self):
        class Bound(Drawing):
            def __init__(self):
                self._reward_policy = MethodType(lambda env: 2.0 * env.state[0], self)
                super().__init__()

        env = with_hooks(Bound, "compiled")
        env.reset(seed=0)
        assert env.step(env.inside.no_action)[1] == 2.0 * env.state[0]
        assert env.inside.player is not None
        env._reward_policy = MethodType(lambda env: 3.0 * env.state[0], env)
        env.reset()
        assert env.step(env.inside.no_action)[1] == 3.0 * env.state[0]
        reference = weakref.ref(env)
        env.close()
        del env
        gc.collect()
        assert reference() is None

    def test_changes_inside_of_arrays_and_lists_are_noticed(self):
        class Weighted(Drawing):
            def __init__(self):
                self.weights, self.gains = np.array([1.0, 2.0]), [3.0]
                super().__init__(max_episode_steps=50)

            def _is_done(self):
                return self.state[0] > 5.0

            def _reward_policy(self):
                q, q_dot = self.state
                return (self.weights[0] * q + self.weights[1] * q_dot) * self.gains[0]

        def make(hooks):
            env = with_hooks(Weighted, hooks)
            env.reset(seed=1)
            env.step(env.action_space.sample() * 0)
            return env

        one, other = make("compiled"), make("python")
        assert one.inside.player is not None
        for change in ("weights", "gains", "weights"):
            for env in (one, other):
                getattr(env, change)[0] += 1.5
                env.reset()  # where changes inside are noticed
            require_same_steps(one, other, *[one.inside.no_action] * 3)

    def test_readings_may_be_set(self):
        one, other = (with_hooks(Counting, hooks) for hooks in ("compiled", "python"))
        action = np.zeros(1, np.float32)
        for env in (one, other):
            env.reset(seed=2)
            env.step(action)
            env.variables["target"] = 0.25
            env.step_count = 3
        require_same_steps(one, other, action, action, action)

    def test_what_was_read_is_kept_by_nobody(self):
        env = compiled_cart()
        state, before = env.state, env.previous_state
        env.step(1)
        assert env.previous_state == state != before

    def test_without_a_reset_there_are_no_readings(self):
        class Early(fmugym.envs.CartPoleEnv):
            def __init__(self):
                assert not hasattr(self, "state")
                super().__init__()

        Early().close()


class TestActions:
    def test_actions_of_other_types_are_taken_as_in_python(self):
        one, other = carts()
        numbers = (1, np.int64(0), np.int32(1), np.array(1), 0, np.uint8(1), 1)
        require_same_steps(one, other, *numbers)

    def test_arrays_of_other_types(self):
        one, other = (fmugym.envs.PendulumEnv(hooks=way) for way in ("compiled", "python"))
        actions = [
            *(np.array([0.3], np.float32), np.array([0.3]), [0.3], np.array([1], np.int8)),
            *(np.array([0.3, 0.2], np.float32)[::2], np.float32([np.inf]), np.float32([0.1])),
        ]
        for env in (one, other):
            env.reset(seed=4)
        require_same_steps(one, other, *actions)
        with pytest.raises(ConfigError, match="NaN"):
            one.step(np.array([np.nan], np.float32))
        require_same_steps(one, other, actions[0])


class Failing(PlainEnv):
    """Divides by zero at a certain sum, and may make what is not finite."""

    def _reward_policy(self):
        return self.state[0] / (self.step_count - 3)


class TestFaults:
    def make(self, probe, hooks, cls=PlainEnv, **changes):
        env = cls(probe(), probe_config(**changes), log_level=logging.ERROR, hooks=hooks)
        env.reset(seed=0)
        return env

    def both(self, probe, actions, cls=PlainEnv, **changes):
        envs = [self.make(probe, hooks, cls, **changes) for hooks in ("compiled", "python")]
        results = []
        for env in envs:
            outcome = []
            for action in actions:
                try:
                    outcome.append(env.step(np.array([action])))
                except Exception as error:
                    outcome.append((type(error).__name__, str(error)))
                    break
            results.append(outcome)
        require_readings(*envs)
        for env in envs:
            env.close()
        return results

    @in_turn({"policy": ["truncate", "terminate", "raise"], "big": [1e308, 1e300]})
    def test_numbers_that_are_not_finite(self, probe, policy, big):
        one, other = self.both(probe, [1.0, 2.0, big, big, big], on_fault=policy)
        assert all(map(same, one, other))
        assert len(one) == len(other)

    def test_exceptions_of_hooks(self, probe):
        one, other = self.both(probe, [1.0, 1.0, 1.0, 1.0], Failing)
        assert all(map(same, one, other))
        assert one[-1][0] == "ZeroDivisionError"

    def test_inputs_that_are_not_finite(self, probe):
        one, other = self.both(probe, [1.0, np.inf])
        assert all(map(same, one, other))
        assert one[-1][0] == "ConfigError"


def branching(hook, name):
    """The same hook with an ``if``, which no program has."""

    def branched(self):
        return hook(self) if self.state[0] < 99.0 else None

    branched.__name__ = name
    return branched


class TestWays:
    def test_the_first_reset_compiles(self):
        env = fmugym.envs.CartPoleEnv()
        assert env.inside.player is None
        env.reset(seed=0)
        assert env.inside.player is not None
        player = env.inside.player
        env.reset(seed=1)
        assert env.inside.player is player
        env.close()

    @pytest.mark.parametrize("hooks", [["_is_done"], ["_reward_policy", "_get_observation"]])
    def test_one_hook_that_cannot_be_compiled_keeps_all_in_python(self, caplog, hooks):
        class Branching(Drawing):
            def _is_done(self):
                return abs(self.state[0]) > 0.5

        for name in hooks:
            plain = getattr(Branching, name)
            setattr(Branching, name, branching(plain, name))
        env = Branching()
        with caplog.at_level(logging.INFO, logger="fmugym.vector"):
            for _ in range(3):
                env.reset(seed=0)
                env.step(env.action_space.sample())
        assert env.inside.player is None
        (text,) = [record.getMessage() for record in caplog.records]
        assert "Branching" in text
        for name in hooks:
            line = getattr(Branching, name).__code__.co_firstlineno + 1
            assert f"{name}, line {line}" in text
        env.close()

    def test_compiled_is_an_error_where_it_is_not_possible(self):
        class Overriding(fmugym.envs.CartPoleEnv):
            def step(self, action):
                return super().step(action)

        env = Overriding(hooks="compiled")
        with pytest.raises(ConfigError, match="step is overridden"):
            env.reset(seed=0)
        env.close()

    def test_with_a_debugger_hooks_run_in_python(self):
        usual = sys.gettrace()
        env = fmugym.envs.CartPoleEnv()
        sys.settrace(lambda *_: None)
        try:
            env.reset(seed=0)
        finally:
            sys.settrace(usual)
        assert env.inside.player is None
        env.close()

    @pytest.mark.parametrize(
        "text", ["math.sin(self.state[0])", "max(self.state)", "self.filter(self.state[0])"]
    )
    def test_hooks_of_other_kinds_stay_in_python(self, text):
        class Other(Drawing):
            def __init__(self):
                self.filter = float
                super().__init__()

            def _is_done(self):
                return self.state[0] > 0.5

            _reward_policy = eval(f"lambda self: {text}", {"math": math})

        require_same(lambda hooks: with_hooks(Other, "auto"), steps=30)
        env = with_hooks(Other, "auto")
        env.reset(seed=0)
        assert env.inside.player is None
        env = with_hooks(Other, "compiled")
        with pytest.raises(ConfigError, match=r"cannot be compiled.*_reward_policy, line"):
            env.reset(seed=0)
        env.close()


class TestLife:
    def test_close(self):
        env = compiled_cart()
        state = env.state
        env.close()
        assert env.state == state
        with pytest.raises(SimulationError, match="closed"):
            env.step(0)

    def test_rendering(self):
        one, other = (
            fmugym.envs.PendulumEnv("rgb_array", hooks=hooks) for hooks in ("compiled", "python")
        )
        for env in (one, other):
            env.reset(seed=1)
            for _ in range(3):
                env.step(np.array([1.0], np.float32))
        assert one.inside.player is not None
        assert np.array_equal(one.render(), other.render())


class Meter:
    def __init__(self):
        self.count = 0

    def add(self, value):
        self.count += 1
        return value


METER, SEEN, TABLE = Meter(), [], [1.0, 2.0]


class TestSideEffects:
    """Hooks that do more than compute are called once a step, as ever."""

    def play(self, expression, attributes=None):
        names = {"METER": METER, "SEEN": SEEN, "TABLE": TABLE, "np": np, "random": random}
        reward = eval(f"lambda self: {expression}", names)
        members = {"_reward_policy": reward, "meter": Meter(), **(attributes or {})}
        cls = type("Acting", (Drawing,), members)
        env = with_hooks(cls, "auto", max_episode_steps=5000)
        env.reset(seed=0)
        for _ in range(20):
            env.step(env.inside.no_action)
        return env

    @pytest.mark.parametrize(
        ("expression", "count"),
        [
            ("METER.add(self.state[0])", lambda env: METER.count),
            ("self.meter.add(self.state[0])", lambda env: env.meter.count),
            ("SEEN.append(1) or self.state[0]", lambda env: len(SEEN)),
        ],
    )
    def test_objects_are_used_once_a_step(self, expression, count):
        METER.count = 0
        SEEN.clear()
        env = self.play(expression)
        assert count(env) == 20
        assert env.inside.player is None

    def test_output(self, capsys):
        self.play("print('once') or self.state[0]")
        assert capsys.readouterr().out == "once\n" * 20

    @pytest.mark.parametrize("draw", ["random.random()", "np.random.random()"])
    def test_the_user_s_own_random_numbers(self, draw):
        random.seed(1)
        np.random.seed(1)  # noqa: NPY002  (that is what the user's hook does)
        self.play(f"self.state[0] + {draw}")
        after = random.random(), np.random.random()  # noqa: NPY002
        random.seed(1)
        np.random.seed(1)  # noqa: NPY002
        for _ in range(20):
            eval(draw)
        assert after == (random.random(), np.random.random())  # noqa: NPY002

    def test_constants_may_be_global(self):
        assert self.play("TABLE[1] * self.state[0]").inside.player is not None

    def test_another_environment(self):
        other = fmugym.envs.CartPoleEnv(hooks="python")
        other.reset(seed=0)
        env = self.play("self.other.state[0] + self.state[0]", {"other": other})
        assert env.inside.player is None
        other.close()
