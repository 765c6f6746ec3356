"""Signals end what the caller does, although an FMU whose code is Python gets them first.

Python runs handlers between two of its instructions, also between those of the FMU, whose wrapper
catches what they raise.
"""

import _thread
import collections
import contextlib
import functools
import operator
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import makers
import numpy as np
import pool_tools
import pytest

import fmugym
from fmugym import FMU
from fmugym.environment.vector import FMUVectorEnv
from fmugym.pool.held_signals import signals_held

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="signals of POSIX")

INITIALIZATION, STEP = 1, 2
AT = 0.3


class RingError(Exception):
    """What a handler raises."""


def ring(number, frame):
    assert frame is not None
    raise RingError


@pytest.fixture(scope="module")
def fmu(tmp_path_factory):
    make = makers.by_python("pythonfmu", "foreign_signalled.py", canGetAndSetFMUstate="true")
    return make(tmp_path_factory.mktemp("fmu"))


@pytest.fixture(params=["Ctrl-C", "a handler"])
def raised(request):
    """The number of a signal, and what its handler raises."""
    if request.param == "Ctrl-C":
        number, handler, error = signal.SIGINT, signal.default_int_handler, KeyboardInterrupt
    else:
        number, handler, error = signal.SIGALRM, ring, RingError
    before = signal.signal(number, handler)
    yield number, error
    assert signal.getsignal(number) is handler
    signal.signal(number, before)


@pytest.fixture
def make(fmu, raised):
    """Makes an environment whose FMU gets the signal in a call."""

    def made(when, number=raised[0]):
        facts = {
            "fmu": str(fmu),
            "time_step": 0.1,
            "episode_length": "1s",
            "agent": {"actions": ["u"], "observations": ["y"]},
            "variables": {"u": {"min": -1, "max": 1}},
            "parameters": {"when": when, "number": int(number), "at": AT},
            "reward": "-abs(y - 1)",
        }
        return functools.partial(fmugym.load, fmugym.Task.from_dict(facts))

    return made


def play(env, steps):
    """The observations of steps with a constant action."""
    shape = (env.num_envs, 1) if hasattr(env, "num_envs") else (1,)
    return [np.ravel(env.step(np.ones(shape, np.float32))[0]) for _ in range(steps)]


@pytest.mark.parametrize("count", [None, 1, 3])
class TestCalls:
    def envs(self, make, count, when):
        task = make(when)
        return task() if count is None else FMUVectorEnv(task, count)

    def test_a_step(self, make, raised, count):
        env = self.envs(make, count, STEP)
        env.reset(seed=0)
        assert len(play(env, 3)) == 3
        with pytest.raises(raised[1]):
            play(env, 1)
        errors = np.asarray(env.unwrapped.health["errors"])
        assert errors.size == (count or 1)
        assert not errors.any()
        env.reset(seed=0)
        found = play(env, 3)
        assert found[-1] == pytest.approx([0.3] * (count or 1), rel=1e-6)
        env.close()

    def test_a_reset(self, make, raised, count):
        with pytest.raises(raised[1]):  # vector environments try a reset when they are made
            self.envs(make, count, INITIALIZATION).reset(seed=0)

    def test_the_instantiation(self, make, raised, count, monkeypatch):
        monkeypatch.setenv("FMUGYM_TEST_SIGNAL", str(int(raised[0])))
        with pytest.raises(raised[1]):
            self.envs(make, count, 0)
        monkeypatch.delenv("FMUGYM_TEST_SIGNAL")
        env = self.envs(make, count, 0)
        env.reset(seed=0)
        assert len(play(env, 5)) == 5
        env.close()


def test_a_rollout(make, raised):
    with contextlib.closing(FMUVectorEnv(make(STEP), 3)) as envs:
        envs.reset(seed=0)
        before = envs.save_state()
        actions = np.ones((3, 6, 1), np.float32)
        with pytest.raises(raised[1]):
            envs.rollout(before, actions)
        assert not envs.health["errors"].any()
        short = envs.rollout(before, actions[:, :2])
        assert short.observations[:, -1, 0] == pytest.approx([0.2] * 3, rel=1e-6)


@pytest.mark.parametrize("raised", ["Ctrl-C"], indirect=True)
def test_the_classes_of_fmpy(fmu, make, raised, monkeypatch):
    """They are in the caller's process, too; other errors of handlers are failures of the FMU."""
    with make(STEP)(backend="fmpy") as env:
        env.reset(seed=0)
        assert len(play(env, 3)) == 3
        with pytest.raises(KeyboardInterrupt):
            play(env, 1)
    with make(INITIALIZATION)(backend="fmpy") as env, pytest.raises(KeyboardInterrupt):
        env.reset(seed=0)
    monkeypatch.setenv("FMUGYM_TEST_SIGNAL", str(int(raised[0])))
    with pytest.raises(KeyboardInterrupt):
        make(0)(backend="fmpy")


def test_what_an_mpc_plans_on(make, raised):
    """Its copies get the signal while a plan is played; afterwards they are as good as new."""
    copies = []

    def model():
        copies.append(make(STEP)())
        return copies[-1]

    with make(STEP)() as env:
        plans = {"candidates": 16, "rounds": 2, "budget": None, "model": model}
        mpc = fmugym.control.MPC("0.6s", **plans).bind(env)
        observation, _ = env.reset(seed=0)
        with pytest.raises(raised[1]):
            mpc.act(observation)
        assert copies[0].pool.num_instances > 1
        assert not copies[0].pool.health()["errors"].any()
        mpc.close()


class TestAtOnce:
    """A signal has arrived, and Python runs no other instruction before the call."""

    @staticmethod
    def interrupted(call):
        """Requires that a call, or what comes within a second of it, is interrupted."""
        calls = map(operator.call, (_thread.interrupt_main, call))
        with pytest.raises(KeyboardInterrupt):  # noqa: PT012  it may come after the call
            collections.deque(calls, 0)
            time.sleep(1)

    def test_a_call(self):
        def call():
            with signals_held():
                pass

        call()
        self.interrupted(call)
        assert signal.getsignal(signal.SIGINT) is signal.default_int_handler

    def test_the_end_of_a_pool(self, fmu):
        pool = pool_tools.open_pool(FMU(fmu), ("u",), ("y",), n=2)
        pool_tools.start(pool)
        self.interrupted(pool.close)
        assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_a_handler_that_returns_lets_the_episode_go_on(make, raised):
    came = []
    before = signal.signal(signal.SIGUSR1, lambda number, frame: came.append(number))
    try:
        with make(STEP, signal.SIGUSR1)() as env:
            env.reset(seed=0)
            assert play(env, 5)[-1] == pytest.approx([0.5], rel=1e-6)
    finally:
        signal.signal(signal.SIGUSR1, before)
    assert came == [signal.SIGUSR1]


def test_other_threads_play_as_before(make, raised):
    found = []

    def work():
        with make(0)() as env:
            env.reset(seed=0)
            found.extend(play(env, 5))

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert len(found) == 5


CONTROLLER = "mpc horizon=0.8s candidates=64 rounds=4 budget=1000"
COMMANDS = {
    "evaluate": ("--controller", CONTROLLER, "--episodes", "100000"),
    "simulate": ("--action", "0.5", "--episodes", "1000000"),
    "train": ("--minutes", "100"),
}


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
@pytest.mark.parametrize("command", COMMANDS)
def test_a_command_ends(command, number, fmu, tmp_path, temp_root):
    """Whatever the FMU is doing when the signal comes."""
    text = (
        "time_step = 0.1\nepisode_length = '2s'\nreward = '-abs(y - 1)'\n"
        f"fmu = {str(fmu)!r}\n[agent]\nactions = ['u']\nobservations = ['y']\n"
        "[variables]\nu = {min = -1, max = 1}\n"
        f"[controllers]\nplanner = {CONTROLLER!r}\n"
    )
    (tmp_path / "task.toml").write_text(text)
    more = ("--output", tmp_path / "agent") if command == "train" else ()
    arguments = (command, tmp_path / "task.toml", *COMMANDS[command], *more)
    program = [sys.executable, "-m", "fmugym", *map(str, arguments)]
    default = functools.partial(signal.signal, signal.SIGINT, signal.default_int_handler)
    with subprocess.Popen(
        program, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, preexec_fn=default
    ) as process:
        deadline = time.monotonic() + 60
        while not any(Path(temp_root).glob("fmugym-*")) and time.monotonic() < deadline:
            time.sleep(0.05)
        time.sleep(1.0)
        process.send_signal(number)
        _, err = process.communicate(timeout=60)
    assert process.returncode == 128 + number, err
    assert "Traceback" not in err
    assert "needs a reset" not in err
    assert not any(Path(temp_root).glob("fmugym-*"))
