"""A single environment whose FMU runs in a worker process."""

import os
import signal
from pathlib import Path

import pytest
from process_tools import linux_only, wait_until
from test_single_expressions import (
    require_same_steps,
    same,
)
from ways import in_python

import fmugym


@pytest.fixture(name="cart")
def fixture_cart():
    env = fmugym.envs.CartPoleEnv(isolation="process")
    env.reset(seed=0)
    env.step(0)
    yield env
    env.close()


def test_a_process_that_is_killed(cart):
    """The episode is cut short; the next ones are as without a worker."""
    other = in_python(fmugym.envs.CartPoleEnv())
    other.reset(seed=0)
    before = other.step(0)
    os.kill(cart.pool.processes()[0], signal.SIGKILL)
    observation, _, terminated, truncated, info = cart.step(1)
    assert (terminated, truncated) == (False, True)
    assert "SIGKILL" in info["fault"]
    assert same(observation, before[0])
    for env in (cart, other):
        env.reset(seed=3)
    require_same_steps(cart, other, 1, 0, 0, 1)
    assert cart.health["deaths"] == 1


@linux_only
def test_a_worker_that_sleeps_is_woken(cart):
    """It watches for the next message for 40 us only."""
    (pid,) = cart.pool.processes()

    def sleeps():
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "S"

    with in_python(fmugym.envs.CartPoleEnv()) as other:
        other.reset(seed=0)
        other.step(0)
        for _ in range(3):
            wait_until(sleeps)
            require_same_steps(cart, other, 1)


def test_interrupts_in_a_step_end_the_episode(cart):
    env = cart

    def ring(*_):
        raise KeyboardInterrupt

    usual = signal.signal(signal.SIGALRM, ring)
    try:
        os.kill(env.pool.processes()[0], signal.SIGSTOP)
        signal.setitimer(signal.ITIMER_REAL, 0.2)
        with pytest.raises(KeyboardInterrupt):
            env.step(1)
    finally:
        signal.signal(signal.SIGALRM, usual)
    assert (env.step_count, env.action, env.previous_action) == (1, 1, 0)
    with pytest.warns(UserWarning, match="after the end of the episode"):
        env.step(1)
    env.reset(seed=0)
    assert env.step(1)[1] == 1.0
