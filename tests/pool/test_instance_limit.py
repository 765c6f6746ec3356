"""Environments of one FMU in one process keep to its limits together."""

import contextlib
import functools
import gc
import os
import threading
import time

import pytest
from fmu_tools import grouped

import fmugym
from fmugym.errors import LicenceError
from fmugym.pool.instance_limit import claim_instances
from fmugym.pool.pool_spec import PoolSpec


class LimitedEnv(fmugym.FMI2CSEnv):
    def __init__(self, backend=None, isolation=None, **config):
        config = {"model_input_names": "tau", "model_output_names": ["q", "q_dot"]} | config
        path = fmugym.bundled_fmu("Pendulum")
        super().__init__(path, grouped(config), backend=backend, isolation=isolation)

    def _is_done(self):
        return abs(self.out["q"]) > 1e9


def take_one(**config):
    env = LimitedEnv(max_instances=1, **config)
    env.reset(seed=0)
    env.close()


@pytest.mark.parametrize("options", [{}, {"isolation": "process"}])
def test_of_two_environments(options):
    first = LimitedEnv(max_instances=2, **options)
    second = LimitedEnv(max_instances=2, **options)
    with pytest.raises(LicenceError) as caught:
        LimitedEnv(max_instances=2, **options)
    text = str(caught.value)
    assert "Pendulum.fmu needs 1 more instance(s)" in text
    assert "'max_instances' of 'foreign' allows 2 at once in this process" in text
    assert text.count("1 for an environment") == 2
    assert "close environments" in text
    assert "licence_wait" in text
    first.reset(seed=0)
    first.close()
    third = LimitedEnv(max_instances=2, **options)
    third.close()
    third.close()
    second.close()


def test_of_a_vector_environment_beside_a_single_one():
    make = functools.partial(LimitedEnv, max_instances=4)
    envs = fmugym.FMUVectorEnv(make, 3)
    single = make()
    with pytest.raises(LicenceError, match=r"in use: .*3 for an environment"):
        make()
    envs.close()
    fmugym.FMUVectorEnv(make, 3, isolation="process", workers=2).close()
    with pytest.raises(LicenceError, match="needs 4 more"):
        fmugym.FMUVectorEnv(make, 4)
    single.close()


def test_are_waited_for(caplog):
    other, over = LimitedEnv(max_instances=1), threading.Event()

    def end():
        while not over.wait(0.05) and "waiting for" not in caplog.text:
            pass
        other.close()

    thread = threading.Thread(target=end)
    thread.start()
    try:
        take_one(licence_wait=60.0)
    finally:
        over.set()
        thread.join()
    assert "in use: 1 for an environment" in caplog.text


def test_waiting_ends():
    env = LimitedEnv(max_instances=1)
    with pytest.raises(LicenceError, match=r"no licence came within 0\.2 s"):
        take_one(licence_wait=0.2)
    env.close()


def test_environments_that_nobody_uses_have_none():
    class Knot(LimitedEnv):
        def __init__(self, **config):
            super().__init__(**config)
            self.knot = self

    gc.disable()
    try:
        Knot(max_instances=1)
        take_one()
    finally:
        gc.enable()


@pytest.mark.skipif(not hasattr(os, "fork"), reason="there are no forks")
@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
def test_a_fork_has_its_own():
    env = LimitedEnv(max_instances=1)
    child = os.fork()
    if child == 0:
        with contextlib.suppress(BaseException):
            LimitedEnv(max_instances=1)
            os._exit(0)
        os._exit(1)
    assert os.waitpid(child, 0)[1] == 0
    with pytest.raises(LicenceError):
        take_one()
    env.close()
    take_one()


def test_other_fmus_and_environments_without_the_key_do_not_count():
    free = [LimitedEnv() for _ in range(3)]
    other = fmugym.envs.CartPoleEnv()
    take_one()
    for env in (*free, other):
        env.close()


def test_a_constructor_that_fails_returns_them():
    with pytest.raises(fmugym.FMUGymError):
        LimitedEnv(max_instances=1, model_parameters={"m": -1.0}, time_step=-1.0)
    take_one()


def test_threads_never_get_more_than_there_are():
    fmu = fmugym.FMU(fmugym.bundled_fmu("Pendulum"))
    spec = PoolSpec((), (), 0.1, max_instances=3)
    most, taken, lock = [0], [0], threading.Lock()

    def work():
        for _ in range(20):
            claim = functools.partial(claim_instances, fmu, spec, 2, "a test")
            with contextlib.suppress(LicenceError), contextlib.closing(claim()):
                with lock:
                    taken[0] += 2
                    most[0] = max(most[0], taken[0])
                time.sleep(1e-3)
                with lock:
                    taken[0] -= 2

    threads = [threading.Thread(target=work) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert most == [2]
