"""A vector environment is for one thread at a time, and interrupts leave it whole."""

import signal
import threading
from contextlib import closing

import numpy as np
import pytest
from test_threads import MANY, call_at_once, interrupt, run_together
from vector_tools import results_of_both

from fmugym import SimulationError
from fmugym.envs import CartPoleEnv
from fmugym.linearization import linearize_along
from fmugym.vector import FMUVectorEnv

ACTIONS = np.zeros(3, np.int64)


ENTERED, MAY_GO = threading.Event(), threading.Event()


class Lingering(CartPoleEnv):
    """Has a method that takes a while."""

    def linger(self):
        ENTERED.set()
        assert MAY_GO.wait(20)


def methods(envs, snapshot):
    return {
        "reset": envs.reset,
        "step": lambda: envs.step(ACTIONS),
        "step_around": lambda: envs.step_around(ACTIONS, np.array([True, False, False])),
        "step_async": lambda: envs.step_async(ACTIONS),
        "render": envs.render,
        "save_state": envs.save_state,
        "restore_state": lambda: envs.restore_state(snapshot),
        "rollout": lambda: envs.rollout(snapshot, np.zeros((3, 2), np.int64)),
        "get_attr": lambda: envs.get_attr("state"),
        "set_attr": lambda: envs.set_attr("force_mag", 10.0),
        "call": lambda: envs.call("linger"),
        "health": lambda: envs.health,
        "np_random_seed": lambda: envs.np_random_seed,
        "linearize_along": lambda: linearize_along(envs, snapshot[0], []),
    }


@pytest.mark.parametrize("hooks", ["compiled", "array", "per_env"])
def test_another_thread_is_refused_in_each_method(hooks):
    ENTERED.clear()
    MAY_GO.clear()
    envs = FMUVectorEnv(Lingering, 3, hooks=hooks)
    envs.reset(seed=0)
    snapshot = envs.save_state()
    worker = threading.Thread(target=envs.call, args=("linger",))
    worker.start()
    try:
        assert ENTERED.wait(20)
        for name, method in methods(envs, snapshot).items():
            with pytest.raises(SimulationError, match=f"{name} .*one thread at a time"):
                method()
        closer = threading.Thread(target=envs.close)
        closer.start()
        closer.join(0.2)
        assert closer.is_alive()
        assert not envs.closed
    finally:
        MAY_GO.set()
        worker.join(20)
    closer.join(20)
    assert envs.closed


@pytest.mark.parametrize("hooks", ["compiled", "array", "per_env"])
def test_threads_at_once_leave_it_whole(hooks):
    envs = FMUVectorEnv(CartPoleEnv, 3, hooks=hooks)
    envs.reset(seed=0)
    calls = methods(envs, envs.save_state())
    del calls["step_async"], calls["linearize_along"]
    calls["call"] = lambda: envs.call("state")
    call_at_once(list(calls.values()))
    require_whole(envs)


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
@pytest.mark.parametrize("hooks", ["compiled", "array"])
def test_interrupts_leave_it_whole(hooks):
    envs = FMUVectorEnv(CartPoleEnv, 3, hooks=hooks)
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
