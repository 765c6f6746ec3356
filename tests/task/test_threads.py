"""A single environment is for one thread at a time, and interrupts leave it whole."""

import contextlib
import gc
import logging
import signal
import sys
import threading
import time

import numpy as np
import pytest
from fmu_tools import PlainEnv, probe_config

from fmugym import FMUEnv, SimulationError
from fmugym.envs import CartPoleEnv
from fmugym.task import alone
from fmugym.task.readings import READINGS

ENTERED, MAY_GO = threading.Event(), threading.Event()
ACTION = np.zeros(1, np.float32)

MANY = 1000
"""Calls that take longer than an interrupt takes to come."""

WAYS = pytest.mark.parametrize("hooks", ["auto", "python"])

ATTRIBUTES = {
    *(*READINGS, "time", "config", "fmi_interface", "fmi_version", "metadata", "render_mode"),
    *("render_size", "reset_options", "spec", "steps_after_end", "unphysical_keys", "unwrapped"),
    *("action_space", "observation_space", "observation_names"),
    *("has_wrapper_attr", "get_wrapper_attr", "set_wrapper_attr"),  # of Gymnasium, for attributes
}
"""What of an environment is no method that does anything."""


pytestmark = pytest.mark.filterwarnings("ignore:.*after the end of the episode")


class Lingering(logging.Handler):
    """Receives the FMU's messages, and takes a while."""

    def emit(self, record):
        ENTERED.set()
        assert MAY_GO.wait(20)


def methods(env, snapshot, action=0):
    name = env.config.model_output_names[0]
    return {
        "reset": env.reset,
        "step": lambda: env.step(action),
        "render": env.render,
        "save_state": env.save_state,
        "restore_state": lambda: env.restore_state(snapshot),
        "read_variables": lambda: env.read_variables(name),
        "health": lambda: env.health,
        "reset_method": lambda: env.reset_method,
        "np_random": lambda: env.np_random,
        "np_random_seed": lambda: env.np_random_seed,
    }


def begin(env, hooks):
    env.reset(seed=0)
    assert (env.inside.player is None) == (hooks == "python")
    return env


def test_these_are_all_methods():
    with contextlib.closing(CartPoleEnv()) as env:
        known = {*methods(env, None), "close", "compute_reward"}
    assert {name for name in dir(FMUEnv) if not name.startswith("_")} - ATTRIBUTES == known


@contextlib.contextmanager
def in_a_step(env):
    """Let another thread be in a step: at the message of the FMU."""
    ENTERED.clear()
    MAY_GO.clear()
    handler, results = Lingering(), []
    env.logger.addHandler(handler)
    worker = threading.Thread(target=lambda: results.append(env.step(ACTION)))
    worker.start()
    try:
        assert ENTERED.wait(20)
        yield results
    finally:
        MAY_GO.set()
        worker.join(20)
        env.logger.removeHandler(handler)


@pytest.fixture(params=["auto", "python"])
def telling(request, probe):
    """An environment whose FMU has a message in each step."""
    config = probe_config(model_parameters={"log_status": 1})
    env = PlainEnv(probe(2), config, logging.INFO, hooks=request.param)
    yield begin(env, request.param)
    env.close()


def test_another_thread_is_refused_in_each_method(telling):
    snapshot = telling.save_state()
    with in_a_step(telling) as results:
        for name, method in methods(telling, snapshot, ACTION).items():
            with pytest.raises(SimulationError, match=f"^{name} .*one thread at a time"):
                method()
        closer = threading.Thread(target=telling.close)
        closer.start()
        closer.join(0.1)
        assert closer.is_alive()
        assert results == []
    closer.join(20)
    assert len(results) == 1
    with pytest.raises(SimulationError, match="closed"):
        telling.step(ACTION)


@pytest.mark.parametrize("telling", ["auto"], indirect=True)
def test_what_hooks_read_is_not_taken_out_of_the_pool_meanwhile(telling):
    """As it is for who asks for the variables, or assigns what hooks read."""
    with in_a_step(telling):
        with pytest.raises(SimulationError, match="one thread at a time"):
            telling.variables.copy()
        with pytest.raises(SimulationError, match="one thread at a time"):
            telling.done = True


@pytest.mark.parametrize("hooks", ["auto", "python"])
def test_threads_at_once_leave_it_whole(hooks):
    env = begin(CartPoleEnv(hooks=hooks), hooks)
    calls = quiet_methods(env, env.save_state())
    call_at_once([*calls.values(), *[lambda: env.step(1)] * 2])
    require_whole(env)


def call_at_once(calls):
    """Call functions at random in three threads; they return, or refuse to work."""
    stop, wrong = time.monotonic() + 0.5, []

    def play(seed):
        rng = np.random.default_rng(seed)
        while time.monotonic() < stop:
            try:
                calls[rng.integers(len(calls))]()
            except SimulationError:
                continue
            except BaseException as error:
                wrong.append(error)
                return

    run_together([lambda seed=seed: play(seed) for seed in range(3)])
    assert wrong == []


def quiet_methods(env, snapshot):
    """Without one that warns."""
    return {name: method for name, method in methods(env, snapshot).items() if name != "render"}


def run_together(functions):
    threads = [threading.Thread(target=function) for function in functions]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()


def require_whole(env):
    """It plays as a new one does, also in another thread."""
    with contextlib.closing(type(env)(hooks="python")) as other:
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
@pytest.mark.parametrize("hooks", ["auto", "python"])
def test_interrupts_leave_it_whole(hooks):
    env = begin(CartPoleEnv(hooks=hooks), hooks)
    calls = quiet_methods(env, env.save_state())
    steps = [lambda: env.reset(seed=1), *[lambda: env.step(1)] * 5]

    def play(name):
        for call in [calls[name], *steps] * MANY:
            with contextlib.suppress(SimulationError):
                call()

    names = np.random.default_rng(0).choice(list(calls), 300).tolist()
    interrupt(play, names)
    require_whole(env)


class TestGuard:
    """Both guards: the one in C, and the one where there is no C extension."""

    @pytest.fixture(params=[True, False], ids=["C", "Python"])
    def guard(self, request, monkeypatch):
        monkeypatch.setattr(alone, "has_native_pool", lambda: request.param)
        return alone.make_guard()

    def refused(self, guard):
        """The error that a thread gets."""
        errors = []

        def call():
            try:
                guard.run("look", list)
            except SimulationError as error:
                errors.append(str(error))

        run_together([call])
        return errors[0] if errors else None

    def test_a_function_gets_its_arguments(self, guard):
        assert guard.run("sum", lambda a, *b: (a, b), 1, 2, 3) == (1, (2, 3))

    def test_calls_of_the_same_thread_go_on(self, guard):
        assert guard.run("outer", guard.run, "inner", int, "7") == 7
        assert self.refused(guard) is None

    def test_another_thread_is_told(self, guard):
        assert "look" in guard.run("a method", self.refused, guard)

    def test_it_is_given_back_after_an_exception(self, guard):
        with pytest.raises(ZeroDivisionError):
            guard.run("divide", divmod, 1, 0)
        assert self.refused(guard) is None

    def test_another_thread_may_wait(self, guard):
        order, entered = [], threading.Event()

        def wait():
            entered.set()
            with guard:
                order.append("second")

        def hold():
            thread = threading.Thread(target=wait)
            thread.start()
            assert entered.wait(20)
            time.sleep(0.02)
            order.append("first")
            return thread

        guard.run("hold", hold).join(20)
        assert order == ["first", "second"]
        assert self.refused(guard) is None

    @pytest.mark.skipif(not hasattr(signal, "pthread_kill"), reason="needs signals of Unix")
    def test_waiting_can_be_interrupted(self, guard):
        may_go, entered = threading.Event(), threading.Event()

        def hold():
            entered.set()
            may_go.wait(20)

        thread = threading.Thread(target=guard.run, args=("hold", hold))
        thread.start()
        assert entered.wait(20)
        before = signal.signal(signal.SIGINT, signal.default_int_handler)
        arguments = threading.get_ident(), signal.SIGINT
        timer = threading.Timer(0.05, signal.pthread_kill, arguments)
        timer.start()
        try:
            with pytest.raises(KeyboardInterrupt), guard:
                raise AssertionError
        finally:
            signal.signal(signal.SIGINT, before)
            may_go.set()
            thread.join(20)
        assert self.refused(guard) is None

    @pytest.mark.parametrize("arguments", [(), ("name",)])
    def test_bad_arguments(self, guard, arguments):
        with pytest.raises(TypeError):
            guard.run(*arguments)
