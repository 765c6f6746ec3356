"""Compiled hooks of a single environment whose FMU runs in a worker process."""

import logging
import os
import re
import signal

import numpy as np
import pytest
from fmu_tools import PlainEnv, probe_config
from process_tools import FaultyEnv, faulty_fmu
from test_isolated_hooks import Sampled, TwoPendulums
from test_single_compiled import (
    TASKS,
    Counting,
    Failing,
    require_readings,
    require_same,
    require_same_snapshots,
    same,
)
from vector_tools import Drawing

import fmugym
from fmugym import ConfigError, SimulationError
from fmugym.pool.process.pool import ProcessPool
from fmugym.series import RecordSeries
from fmugym.vector.making import make_with_pool


def isolated(make_env, hooks="compiled"):
    """A new environment with a worker process."""
    env = make_with_pool(make_env, isolation="process")
    assert isinstance(env._pool, ProcessPool)
    env._way = hooks
    return env


def here(make_env):
    """The same without one, with its hooks in Python."""
    env = make_env()
    env._way = "python"
    return env


@pytest.fixture(name="cart")
def fixture_cart():
    """A cart-pole that has compiled its hooks."""
    env = fmugym.envs.CartPoleEnv(hooks="compiled", isolation="process")
    env.reset(seed=0)
    env.step(0)
    assert env._play is not None
    yield env
    env.close()


BUNDLED = [
    fmugym.envs.CartPoleEnv,
    fmugym.envs.PendulumEnv,
    fmugym.envs.ModelicaCartPoleEnv,
    fmugym.envs.CloudPendulumEnv,
]


@pytest.mark.parametrize("cls", [*BUNDLED, *TASKS, Sampled, TwoPendulums])
def test_results_are_those_of_one_process(cls):
    """To the last bit, with everything that hooks read."""

    def make(hooks):
        return isolated(cls) if hooks == "compiled" else here(cls)

    compiled, ended = require_same(make, steps=120)
    assert compiled >= 119 - ended


class Sorted(Counting):
    """One hook cannot be compiled."""

    def _reward_policy(self):
        return sorted(self.state)[0] * self.variables["sum"]


def test_one_hook_may_stay_in_python():
    def make(hooks):
        return isolated(Sorted, "auto") if hooks == "compiled" else here(Sorted)

    compiled, ended = require_same(lambda hooks: _waited(make(hooks)), steps=60)
    assert compiled >= 59 - ended


def _waited(env):
    """The environment after the steps that come before compiling."""
    env.reset(seed=1)
    for _ in range(1010):
        if any(env.step(env._no_action)[2:4]):
            env.reset()
    return env


def test_steps_before_compiling():
    env = fmugym.envs.CartPoleEnv(isolation="process")
    compiled = []
    env.reset(seed=0)
    for _ in range(1100):
        result = env.step(env.action_space.sample())
        compiled.append(env._play is not None)
        if result[2]:
            env.reset()
    env.close()
    assert not any(compiled[:990])
    assert sum(compiled[1000:]) > 80


class Stuck(Drawing):
    def _is_done(self):
        return bool(self.state[0] > 0.5)


def test_hooks_that_cannot_be_compiled():
    env = isolated(Stuck)
    env.reset(seed=0)
    with pytest.raises(ConfigError, match="_is_done"):
        env.step(env._no_action)
    env.close()
    env = isolated(Stuck, "auto")
    env.reset(seed=0)
    env.step(env._no_action)
    assert env._play is None
    env.close()


class TestFaults:
    def make(self, path, hooks, cls=FaultyEnv, **options):
        env = cls(path, **options)
        env._way = hooks
        env.logger.setLevel(logging.ERROR)
        env.reset(seed=0)
        return env

    def both(self, path, actions, *args, **options):
        """The outcomes of the same steps in both ways, without process numbers."""
        envs = [self.make(path, hooks, *args, **options) for hooks in ("compiled", "python")]
        outcomes = [[_outcome(env, action) for action in actions] for env in envs]
        require_readings(*envs)
        assert [env._player is not None for env in envs] == [True, False]
        assert envs[0].health == envs[1].health
        for env in envs:
            env.close()
        return outcomes

    @pytest.mark.parametrize("policy", ["truncate", "terminate", "raise"])
    @pytest.mark.parametrize("fault", ["crash", "exit", "hang"])
    def test_workers_that_die_or_hang(self, tmp_path, fault, policy):
        path = faulty_fmu(tmp_path)
        options = {"fault": fault, "on_fault": policy, "at": 3, "call_timeout": 0.5}
        one, other = self.both(path, [1.0] * 6, **options)
        assert all(map(same, one, other))
        texts = str(one)
        assert ("call_timeout" if fault == "hang" else "ended with") in texts

    @pytest.mark.parametrize("policy", ["truncate", "raise"])
    @pytest.mark.parametrize("big", [1e308, 1e300])
    def test_numbers_that_are_not_finite(self, probe, big, policy):
        options = {"cls": Probe, "on_fault": policy, "isolation": "process"}
        one, other = self.both(probe(), [1.0, 2.0, big, big, big], **options)
        assert all(map(same, one, other))

    def test_exceptions_of_hooks(self, probe):
        one, other = self.both(probe(), [1.0] * 4, cls=FailingProbe, isolation="process")
        assert all(map(same, one, other))
        assert "ZeroDivisionError" in str(one)

    def test_inputs_that_are_not_finite(self, probe):
        one, other = self.both(probe(), [1.0, np.inf, 2.0], cls=Probe, isolation="process")
        assert all(map(same, one, other))
        assert "ConfigError" in str(one)


class Probe(PlainEnv):
    def __init__(self, path, **changes):
        super().__init__(path, probe_config(**changes))


class FailingProbe(Probe):
    _reward_policy = Failing._reward_policy


def _outcome(env, action):
    """What a step returns or raises; the next one follows a reset after the end of an episode."""
    try:
        result = env.step(np.array([action]))
    except Exception as error:
        result = type(error).__name__, re.sub(r"\d{2,}|[\d.]+ s", "n", str(error))
    else:
        info = {key: re.sub(r"\d{2,}|[\d.]+ s", "n", str(v)) for key, v in result[4].items()}
        result = *result[:4], info
    if env._ended:
        env.reset(seed=1)
    return result


def test_a_process_that_is_killed(cart):
    """The episode is cut short; the next ones are compiled again, and as those of Python."""
    other = fmugym.envs.CartPoleEnv(hooks="python")
    other.reset(seed=0)
    before = other.step(0)
    os.kill(cart._pool.processes()[0], signal.SIGKILL)
    observation, _, terminated, truncated, info = cart.step(1)
    assert (terminated, truncated) == (False, True)
    assert "SIGKILL" in info["fault"]
    assert same(observation, before[0])
    for env in (cart, other):
        env.reset(seed=3)
    for action in (1, 0, 0, 1):
        assert same(cart.step(action), other.step(action))
        require_readings(cart, other)
    assert cart._play is not None
    assert cart.health["deaths"] == 1


@pytest.mark.parametrize("hooks", ["compiled", "python"])
def test_interrupts_in_a_step_end_the_episode(hooks):
    """A reading tells of the same moment in both ways."""
    env = fmugym.envs.CartPoleEnv(hooks=hooks, isolation="process")
    env.reset(seed=0)
    env.step(0)
    assert (env._play is not None) == (hooks == "compiled")

    def ring(*_):
        raise KeyboardInterrupt

    usual = signal.signal(signal.SIGALRM, ring)
    try:
        os.kill(env._pool.processes()[0], signal.SIGSTOP)
        signal.setitimer(signal.ITIMER_REAL, 0.2)
        with pytest.raises(KeyboardInterrupt):
            env.step(1)
    finally:
        signal.signal(signal.SIGALRM, usual)
    assert (env.step_count, env.action, env.previous_action) == (1, 1, 0)
    assert env._ended
    env.reset(seed=0)
    assert env.step(1)[1] == 1.0
    env.close()


@pytest.mark.parametrize("cls", [TASKS[0], Counting])
def test_snapshots(cls):
    one, other = isolated(cls), here(cls)
    require_same_snapshots(one, other)
    one.close()


def test_series_and_pictures():
    rows, pictures = [], []
    for hooks in ("compiled", "python"):
        env = fmugym.envs.PendulumEnv("rgb_array", hooks=hooks, isolation="process")
        recorded = RecordSeries(env)
        recorded.reset(seed=1)
        for _ in range(5):
            recorded.step(np.array([1.0], np.float32))
        assert (env._play is not None) == (hooks == "compiled")
        pictures.append(env.render())
        rows.append(recorded.series)
        recorded.close()
    assert np.array_equal(*pictures)
    assert rows[0].columns == rows[1].columns
    np.testing.assert_array_equal(rows[0].values, rows[1].values)


def test_closing(cart):
    state, worker = cart.state, cart._pool.processes()[0]
    cart.close()
    assert cart.state == state
    with pytest.raises(SimulationError, match="closed"):
        cart.step(0)
    with pytest.raises(ProcessLookupError):
        os.kill(worker, 0)


def test_refused_actions_change_nothing(cart):
    before = cart.state, cart.step_count, cart.action
    with pytest.raises(ConfigError, match="is not in Discrete"):
        cart.step(2)
    assert (cart.state, cart.step_count, cart.action) == before
    assert cart.step(1)[2] is False
