"""Whatever threads and interrupts do to a vector environment, its next reset is sound."""

import signal
import threading
from contextlib import closing

import numpy as np
import pytest
from test_threads import MANY, call_at_once, interrupt, run_together
from vector_tools import results_of_both
from ways import in_way, many

from fmugym import SimulationError
from fmugym.environment.vector import FMUVectorEnv
from fmugym.envs import CartPoleEnv

ACTIONS = np.zeros(3, np.int64)


OPTIONS = [
    {"way": "arrays", "autoreset_mode": "SAME_STEP"},
    {"way": "arrays"},
    {"way": "one by one"},
    {"isolation": "process", "workers": 2},
]


def calls_of(envs, snapshot):
    def step_in_background():
        envs.step_async(ACTIONS)
        envs.step_wait()

    return [
        envs.reset,
        *[lambda: envs.step(ACTIONS)] * 3,
        step_in_background,
        lambda: envs.step_around(ACTIONS, np.array([True, False, False])),
        envs.save_state,
        lambda: envs.restore_state(snapshot),
        lambda: envs.rollout(snapshot, np.zeros((3, 2), np.int64)),
        lambda: envs.get_attr("state"),
        lambda: envs.set_attr("force_mag", 10.0),
        lambda: envs.call("time"),
        lambda: envs.health,
        lambda: envs.np_random_seed,
    ]


@pytest.mark.parametrize("options", OPTIONS)
def test_threads_at_once_leave_it_whole(options):
    envs = many(CartPoleEnv, 3, **options)
    envs.reset(seed=0)
    call_at_once(calls_of(envs, envs.save_state()))
    require_whole(envs)


@pytest.mark.parametrize("options", OPTIONS)
def test_a_thread_may_close_it_meanwhile(options):
    for _ in range(5):
        envs = many(CartPoleEnv, 3, **options)
        envs.reset(seed=0)
        calls = calls_of(envs, envs.save_state())
        closer = threading.Timer(0.01, envs.close)
        closer.start()
        call_at_once(calls, 0.03)
        closer.join()
        with pytest.raises(SimulationError, match="closed"):
            envs.step(ACTIONS)


@pytest.mark.parametrize("options", OPTIONS)
def test_a_thread_may_close_it_at_the_end_of_a_reset(options, monkeypatch):
    envs = many(CartPoleEnv, 3, **options)
    reset = envs.task.reset

    def closed_meanwhile(*args):
        result = reset(*args)
        run_together([envs.close])
        return result

    monkeypatch.setattr(envs.task, "reset", closed_meanwhile)
    envs.reset(seed=0)
    with pytest.raises(SimulationError, match="step was called on a closed FMUVectorEnv"):
        envs.step(ACTIONS)


def require_whole(envs):
    """It plays as a new one does, also in another thread."""
    played = []
    run_together([lambda: played.append(envs.set_attr("force_mag", 10.0))])
    assert played == [None]
    with closing(FMUVectorEnv(CartPoleEnv, 3)) as other:
        list(results_of_both(envs, other, [ACTIONS + action for action in (0, 1, 1, 0)]))
        assert envs.get_attr("state") == other.get_attr("state")
    envs.close()


@pytest.mark.skipif(not hasattr(signal, "setitimer"), reason="needs timers of Unix")
@pytest.mark.parametrize("hooks", ["arrays"])
def test_interrupts_leave_it_whole(hooks):
    envs = FMUVectorEnv(in_way(hooks, CartPoleEnv), 3)
    envs.reset(seed=0)
    calls = [
        lambda: envs.get_attr("state"),
        lambda: envs.call("time"),
        lambda: envs.set_attr("force_mag", [9.0, 10.0, 11.0]),
    ]

    def play(call):
        for _ in range(MANY):
            call()

    interrupt(play, calls * 100)
    require_whole(envs)
