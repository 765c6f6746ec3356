"""Equations that a solver cannot manage end in faults, at a signal, or with advice."""

import functools
import os
import signal
import threading
from contextlib import closing, contextmanager

import exchange_tools
import fmu_tools
import numpy as np
import pytest
from gymnasium.spaces import Box
from pool_tools import open_pool, reset, start, step

import fmugym
from fmugym import FMU, FMULoadError
from fmugym.fmi import Status

TAME, STIFF, RANDOM, GROWING, FALLING, FAILING_BELOW_0, FAILING_LATER, WITHOUT_SIGN = range(8)
STEP = 0.1
SLOW = {"kind": STIFF, "delay": 1000.0}
"""Parameters by which a derivative takes a millisecond, and a step a million of them."""
all_versions = pytest.mark.parametrize("version", [1, 2, 3])


@pytest.fixture(scope="module")
def wild(tmp_path_factory):
    """Write FMUs of ``wild.c`` by FMI version."""
    folder = tmp_path_factory.mktemp("wild")
    return functools.cache(
        lambda version=2: exchange_tools.exchange_fmu(
            folder / f"wild{version}.fmu", "wild", version
        )
    )


@pytest.fixture
def make_pool(wild, opened):
    def make(version=2, n=1, step=STEP, threads=1, **spec):
        fmu = FMU(wild(version), probe_timeout=None)
        options = {"backend": "native", "threads": threads}
        return opened(open_pool(fmu, (), ["x", "calls"], step, n, options, **spec))

    return make


def failure(pool, kind, steps=3):
    """Play until a step fails; why it has."""
    reset(pool, {"kind": kind})
    for _ in range(steps):
        _, statuses = pool.step()
        if statuses[0]:
            assert statuses[0] == Status.ERROR
            return pool.failure(0)
    return ""


class TestSteps:
    @all_versions
    @pytest.mark.parametrize("kind", [STIFF, RANDOM])
    def test_are_limited_in_number(self, make_pool, version, kind):
        pool = make_pool(version)
        text = failure(pool, kind)
        assert "dormand_prince needs more than 1000000 steps" in text
        assert 'solver = "rosenbrock"' in text
        assert failure(pool, TAME) == ""  # and the instance goes on after a reset

    @pytest.mark.parametrize("solver", ["euler", "rk4"])
    def test_of_a_fixed_length_are_limited(self, make_pool, solver):
        text = failure(make_pool(solver=solver, max_step=1e-12), TAME)
        assert f"{solver} needs more than 1000000 steps" in text
        assert "rosenbrock" not in text

    def test_are_limited_in_each_step_and_not_in_all(self, make_pool):
        pool = make_pool(step=1e-3, solver="rk4", max_step=1e-3 / 600_000)
        assert failure(pool, TAME, 4) == ""

    def test_do_not_begin_where_time_stands_still(self, make_pool):
        assert "needs steps below" in failure(make_pool(), FALLING)
        assert failure(make_pool(), GROWING) == ""  # whose solution is a line


class TestErrors:
    """An Error of the FMU in a try of a step is no fault yet, as in CVode."""

    @all_versions
    def test_make_steps_shorter(self, make_pool, version):
        pool = make_pool(version, step=0.19, tolerance=0.01)
        start(pool, {"kind": FAILING_BELOW_0})
        assert step(pool)[0, 0] == pytest.approx(0.005**2, abs=2e-5)

    def test_of_methods_without_an_estimate_are_faults(self, make_pool):
        pool = make_pool(solver="rk4", max_step=STEP)
        assert "the step at t = 0.1 s returned Error" in failure(pool, FAILING_BELOW_0)

    @pytest.mark.parametrize("solver", ["dormand_prince", "rosenbrock"])
    def test_that_stay_are_faults(self, make_pool, solver):
        assert "the step at t = 0 s returned Error" in failure(
            make_pool(solver=solver), FAILING_LATER
        )

    @all_versions
    @pytest.mark.parametrize("solver", ["dormand_prince", "rosenbrock", "rk4", "euler"])
    def test_an_indicator_without_a_sign(self, make_pool, version, solver):
        pool = make_pool(version, solver=solver, max_step=STEP)
        assert "event indicator 1 of 1 is NaN" in failure(pool, WITHOUT_SIGN)
        assert failure(pool, TAME) == ""


class TestAdvice:
    def test_names_a_solver_where_the_equations_are_stiff(self, make_pool, caplog):
        pool = make_pool(n=3)
        failure(pool, STIFF)
        told = [r.getMessage() for r in caplog.records if "equations are stiff" in r.getMessage()]
        assert len(told) == 1  # of three instances
        assert 'solver = "rosenbrock"' in told[0]

    @pytest.mark.parametrize("kind", [TAME, RANDOM, GROWING])
    def test_is_not_given_elsewhere(self, make_pool, caplog, kind):
        failure(make_pool(), kind)
        assert not any("equations are stiff" in r.getMessage() for r in caplog.records)

    @pytest.mark.usefixtures("trials")
    def test_of_a_trial(self, wild):
        """A model that is slow only because it is stiff is refused with the name of the solver."""
        config = {"model_input_names": (), "model_output_names": "x", "time_step": STEP}
        config |= {"model_parameters": {"kind": STIFF, "delay": 500.0}}
        config |= {"probe_timeout": 1.5}
        with pytest.raises(FMULoadError, match='solver = "rosenbrock"'):
            StillEnv(wild(), fmu_tools.grouped(config))


class StillEnv(fmugym.FMUEnv):
    """Without an action on the FMU."""

    def _get_action_space(self):
        return Box(-1, 1)

    def _get_inputs(self):
        return []

    def _is_done(self):
        return False


@contextmanager
def interrupted_soon(number=signal.SIGINT, after=0.3):
    """A signal comes in the block, which raises KeyboardInterrupt."""
    before = signal.signal(number, signal.default_int_handler)  # it may have been ignored
    timer = threading.Timer(after, os.kill, (os.getpid(), number))
    timer.start()
    try:
        with pytest.raises(KeyboardInterrupt):
            yield
    finally:
        timer.cancel()
        signal.signal(number, before)


class TestSignals:
    """Those of ``SLOW`` take hours otherwise."""

    def test_end_a_step(self, make_pool):
        pool = make_pool()
        start(pool, SLOW)
        with interrupted_soon():
            pool.step()
        assert pool.statuses[0] == Status.ERROR
        assert "interrupted" in pool.failure(0)
        assert failure(pool, TAME) == ""

    @pytest.mark.parametrize("threads", [1, 2])
    def test_end_the_steps_of_all(self, make_pool, threads):
        pool = make_pool(n=5, threads=threads)
        start(pool, SLOW)
        with interrupted_soon():
            pool.step()
        assert (pool.statuses == Status.ERROR).all()

    @pytest.mark.parametrize("slow", [0, 1, 2])
    def test_reach_the_thread_that_works(self, make_pool, slow):
        """The caller has done its part and waits for helpers, or it is the other way round."""
        pool = make_pool(n=3, threads=3)
        kinds, delays = np.zeros(3), np.zeros(3)
        kinds[slow], delays[slow] = STIFF, 1000.0
        start(pool, {"kind": kinds, "delay": delays})
        with interrupted_soon():
            pool.step()
        assert pool.statuses[slow] == Status.ERROR

    def test_whose_handlers_return_change_nothing(self, make_pool):
        seen = []
        before = signal.signal(signal.SIGUSR1, lambda *_: seen.append(1))
        try:
            pool = make_pool(solver="rk4", max_step=1e-3)
            start(pool, {"delay": 1000.0})
            timer = threading.Timer(0.1, os.kill, (os.getpid(), signal.SIGUSR1))
            timer.start()
            step(pool)
        finally:
            signal.signal(signal.SIGUSR1, before)
        assert seen == [1]
        assert pool.outputs[0, 0] == pytest.approx(0.01 + STEP)

    @pytest.mark.parametrize("isolation", ["none", "process"])
    def test_of_an_environment(self, wild, isolation):
        config = {"model_input_names": (), "model_output_names": "x", "time_step": STEP}
        config |= {"model_parameters": {"kind": 0.0, "delay": 0.0}}
        config = fmu_tools.grouped(config | {"probe_timeout": None})
        with closing(StillEnv(wild(), config, isolation=isolation)) as env:
            env.reset(options={"model_parameters": SLOW})
            with interrupted_soon():
                env.step([0.0])
            env.reset()
            observation, *_ = env.step([0.0])
            assert observation[0] == pytest.approx(0.01 + STEP)
