"""Steps in the background: ``step_async`` and ``step_wait``."""

import os
import pickle
import signal
import sys
import threading

import gymnasium as gym
import numpy as np
import pytest
from combinations import in_turn
from gymnasium.error import AlreadyPendingCallError, NoAsyncCallError
from gymnasium.vector import AutoresetMode
from test_native_pool import busy_fmu
from vector_tools import (
    CART_POLE,
    HOOKS,
    Drawing,
    methods,
    require_equal,
    run_side_by_side,
)
from ways import in_way

import fmugym
from fmugym import ConfigError, SimulationError
from fmugym.environment.vector import FMUVectorEnv
from fmugym.environment.vector.async_step import NoStepError, PendingStepError, StepTimeoutError


@pytest.fixture
def envs():
    made = gym.make_vec("fmugym/CartPole-v0", num_envs=3)
    made.reset(seed=0)
    yield made
    made.close()


ZEROS = np.zeros(3, np.int64)


class InTheBackground(gym.vector.VectorWrapper):
    """Steps are begun and waited for."""

    def step(self, actions):
        self.env.step_async(actions)
        return self.env.step_wait()


@in_turn({"mode": list(AutoresetMode), "hooks": HOOKS})
def test_results_are_those_of_step(mode, hooks):
    first, second = (
        FMUVectorEnv(in_way(hooks, CART_POLE), 4, autoreset_mode=mode) for _ in range(2)
    )
    assert run_side_by_side(InTheBackground(first), second, 40) > 4


def test_the_actions_may_change_meanwhile(envs):
    twin = gym.make_vec("fmugym/CartPole-v0", num_envs=3)
    twin.reset(seed=0)
    actions = np.ones(3, np.int64)
    for _ in range(20):
        envs.step_async(actions)
        actions[:] = 0
        ours = envs.step_wait()
        actions[:] = 1
        require_equal(ours[0], twin.step(actions)[0])
    twin.close()


def test_other_calls_before_the_wait(envs):
    calls = methods(envs, envs.save_state())
    envs.step_async(ZEROS)
    for name, call in calls.items():
        with pytest.raises(PendingStepError, match=f"{name} was called while a step") as caught:
            call()
        assert isinstance(caught.value, AlreadyPendingCallError)
        assert caught.value.name == "step"
        assert isinstance(caught.value, SimulationError)
    envs.step_wait()
    envs.step(ZEROS)


def test_waiting_for_nothing(envs):
    for _ in range(2):
        with pytest.raises(NoStepError, match="without step_async") as caught:
            envs.step_wait()
        assert isinstance(caught.value, NoAsyncCallError)
        envs.step_async(ZEROS)
        envs.step_wait()


@pytest.mark.parametrize("error", [PendingStepError, NoStepError, StepTimeoutError])
def test_errors_can_be_pickled(error):
    copied = pickle.loads(pickle.dumps(error("a text")))
    assert type(copied) is error
    assert str(copied) == "a text"


def test_before_the_first_reset_and_after_close():
    envs = gym.make_vec("fmugym/CartPole-v0", num_envs=3)
    with pytest.raises(SimulationError, match="step_async was called before the first reset"):
        envs.step_async(ZEROS)
    envs.close()
    with pytest.raises(SimulationError, match="step_async was called on a closed"):
        envs.step_async(ZEROS)
    with pytest.raises(SimulationError, match="step_wait was called on a closed"):
        envs.step_wait()


def test_errors_of_the_step_come_with_the_wait(envs):
    envs.step_async(np.array([0, 1, 2]))
    with pytest.raises(ConfigError, match="2"):
        envs.step_wait()
    envs.step(ZEROS)  # the refused actions have changed nothing


def test_an_ended_episode_is_refused_at_once():
    envs = gym.make_vec("fmugym/CartPole-v0", num_envs=3, autoreset_mode="disabled")
    envs.reset(seed=0)
    while True:
        *_, terminated, truncated, _ = envs.step(ZEROS)
        if (terminated | truncated).any():
            break
    with pytest.raises(SimulationError, match="has ended: reset it first"):
        envs.step_async(ZEROS)
    envs.reset(options={"reset_mask": terminated | truncated})
    envs.close()


def test_close_waits_for_the_step():
    envs = gym.make_vec("fmugym/CartPole-v0", num_envs=3)
    envs.reset(seed=0)
    envs.step_async(ZEROS)
    envs.close()
    with pytest.raises(SimulationError, match="closed"):
        envs.step_wait()
    assert not any(thread.name.startswith("fmugym-step") for thread in threading.enumerate())


class Waiting(Drawing):
    """Each step waits for the test, in a hook."""

    gate = threading.Event()

    def _get_inputs(self):
        assert self.gate.wait(60)
        return self.action * 0.0


@pytest.fixture
def waiting():
    Waiting.gate.set()
    envs = FMUVectorEnv(in_way("arrays", Waiting), 2)
    envs.reset(seed=0)
    Waiting.gate.clear()
    yield envs
    Waiting.gate.set()
    envs.close()


def test_a_timeout_leaves_the_step_under_way(waiting):
    actions = np.zeros((2, 1), np.float32)
    waiting.step_async(actions)
    for _ in range(2):
        with pytest.raises(StepTimeoutError, match=r"not ended after 0\.01 s") as caught:
            waiting.step_wait(timeout=0.01)
        assert isinstance(caught.value, TimeoutError)
    Waiting.gate.set()
    assert waiting.step_wait(timeout=60)[0].shape == (2, 2)


@pytest.mark.skipif(sys.platform == "win32", reason="signals of Windows cannot be sent like this")
def test_an_interrupt_leaves_the_step_under_way(waiting, request):
    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # shells ignore it behind &
    request.addfinalizer(lambda: signal.signal(signal.SIGINT, before))
    waiting.step_async(np.zeros((2, 1), np.float32))
    timer = threading.Timer(0.2, os.kill, (os.getpid(), signal.SIGINT))
    timer.start()
    with pytest.raises(KeyboardInterrupt):
        waiting.step_wait()
    timer.join()
    Waiting.gate.set()
    assert waiting.step_wait(timeout=60)[0].shape == (2, 2)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="this system has no fork")
@pytest.mark.filterwarnings("ignore:.*multi-threaded.*:DeprecationWarning")
def test_a_fork_has_no_step_under_way(envs):
    """The child has neither the thread nor the step; its own steps work."""
    envs.step_async(ZEROS)
    envs.step_wait()
    child = os.fork()
    if child == 0:
        status = 1
        try:
            envs.step_async(ZEROS)
            envs.step_wait(timeout=30)
            status = 0
        finally:
            os._exit(status)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0


def test_the_fmus_step_while_the_caller_runs(tmp_path, make_envs):
    """The caller's own code runs before the step, which is long, has ended."""

    class Busy(fmugym.FMI2CSEnv):
        def __init__(self):
            config = {
                "model_input_names": ["work"],
                "model_output_names": ["steps"],
                "time_step": 0.1,
            }
            super().__init__(busy_fmu(tmp_path), config)

        def _get_action_space(self):
            return gym.spaces.Discrete(2)

        def _get_inputs(self):
            return self.action * 300_000.0  # us

        def _is_done(self):
            return self.state[0] < 0

    envs = make_envs(Busy, 1)
    envs.reset(seed=0)
    envs.step_async(np.ones(1, np.int64))
    with pytest.raises(StepTimeoutError):
        envs.step_wait(timeout=0.001)
    assert envs.step_wait()[0].tolist() == [[1.0]]
