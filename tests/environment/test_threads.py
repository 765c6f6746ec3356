"""Whatever threads and interrupts do to a single environment, its next reset is sound."""

import contextlib
import gc
import signal
import sys
import threading
import time

import numpy as np
import pytest
from ways import in_python

from fmugym import SimulationError
from fmugym.envs import CartPoleEnv

MANY = 1000
"""Calls that take longer than an interrupt takes to come."""

MADE = {"as it is": CartPoleEnv, "in Python": lambda: in_python(CartPoleEnv())}
MADE["isolated"] = lambda: CartPoleEnv(isolation="process")
each_kind = pytest.mark.parametrize("make", MADE.values(), ids=MADE)

pytestmark = pytest.mark.filterwarnings("ignore:.*after the end of the episode")


def calls_of(env, snapshot):
    """Calls of methods; the steps, which are many, are those of an agent."""
    return [
        env.reset,
        *[lambda: env.step(1)] * 3,
        lambda: env.variables.update(force_mag=10.0),
        lambda: env.variables.copy(),
        env.save_state,
        lambda: env.restore_state(snapshot),
        lambda: env.read_variables("x"),
        lambda: env.health,
        lambda: env.reset_method,
        lambda: env.np_random,
        lambda: env.np_random_seed,
    ]


@each_kind
def test_threads_at_once_leave_it_whole(make):
    env = make()
    env.reset(seed=0)
    call_at_once(calls_of(env, env.save_state()))
    require_whole(env)


@each_kind
def test_a_thread_may_close_it_meanwhile(make):
    for _ in range(10):
        env = make()
        env.reset(seed=0)
        calls = calls_of(env, env.save_state())
        closer = threading.Timer(0.01, env.close)
        closer.start()
        call_at_once(calls, 0.03)
        closer.join()
        with pytest.raises(SimulationError, match="closed"):
            env.reset()


def call_at_once(calls, seconds=0.5):
    """Call functions at random in three threads; they may fail in any way, but must return."""
    stop = time.monotonic() + seconds

    def play(seed):
        rng = np.random.default_rng(seed)
        while time.monotonic() < stop:
            with contextlib.suppress(Exception):
                calls[rng.integers(len(calls))]()

    run_together([lambda seed=seed: play(seed) for seed in range(3)])


def run_together(functions):
    threads = [threading.Thread(target=function) for function in functions]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()


def require_whole(env):
    """It plays as a new one does, also in another thread."""
    with contextlib.closing(in_python(CartPoleEnv())) as other:
        results = [[], []]
        for one, into in zip((env, other), results, strict=True):
            run_together([lambda one=one, into=into: into.extend(play_some(one))])
    assert len(results[0]) == 7
    for first, second in zip(*results, strict=True):
        np.testing.assert_allclose(first, second, rtol=1e-6)
    env.close()


def play_some(env):
    yield env.reset(seed=3)[0]
    yield from (env.step(action)[0] for action in (0, 1, 1, 0, 0, 1))


def interrupt(play, arguments):
    """Call ``play`` with each of the arguments, and interrupt each call by a signal.

    Meanwhile no coverage is measured: an interrupt could leave the lock of the tracer taken. No
    garbage is collected either: an interrupt of what others do then, such as Hypothesis, is lost.
    """

    def ring(*_):
        raise KeyboardInterrupt

    before, trace = signal.signal(signal.SIGALRM, ring), sys.gettrace()
    rng, interrupted = np.random.default_rng(0), 0
    sys.settrace(None)
    gc.disable()
    try:
        for argument in arguments:
            try:
                signal.setitimer(signal.ITIMER_REAL, float(rng.uniform(1e-6, 4e-4)))
                play(argument)
            except KeyboardInterrupt:
                interrupted += 1
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)
        gc.enable()
        sys.settrace(trace)
    assert interrupted == len(arguments)


@pytest.mark.skipif(not hasattr(signal, "setitimer"), reason="needs timers of Unix")
@pytest.mark.parametrize("make", [CartPoleEnv, MADE["in Python"]], ids=["as it is", "in Python"])
def test_interrupts_leave_it_whole(make):
    env = make()
    env.reset(seed=0)
    calls = calls_of(env, env.save_state())
    steps = [lambda: env.reset(seed=1), *[lambda: env.step(1)] * 5]

    def play(number):
        for call in [calls[number], *steps] * MANY:
            with contextlib.suppress(SimulationError):
                call()

    interrupt(play, np.random.default_rng(0).integers(len(calls), size=300))
    require_whole(env)
