"""FMUs that make only so many instances with a library, or in a process: a fresh one goes on."""

import logging

import fmu_tools
import model_tools
import numpy as np
import pytest
from process_tools import posix_only

from fmugym import FMU, FMULoadError, FMUSystem
from fmugym.pool import PoolSpec
from fmugym.pool.opening import PoolOptions, open_pool
from fmugym.pool.pool_spec import ResetMethod

LOG = logging.getLogger("fmugym.test")
VARIABLES = (("u", "input", 'start="0"'), ("y", "output", ""))
LIMIT = 20  # of limited.c


def limited_fmu(folder, limited_by="library", version=2):
    path = folder / "Limited.fmu"
    return model_tools.model_fmu(path, "limited", version, limited_by, VARIABLES)


@pytest.fixture(name="make")
def fixture_make(opened):
    def make(fmu, num_instances, method="instance", **options):
        fmu = FMU(fmu) if not isinstance(fmu, FMU) else fmu
        spec = PoolSpec((fmu.variable("u"),), (fmu.variable("y"),), time_step=0.5)
        spec = spec.beginning_by(ResetMethod(method))
        return opened(
            open_pool(fmu, spec, num_instances, LOG, PoolOptions(reset_method=method, **options))
        )

    return make


def play(pool, episodes):
    """Play episodes of two steps, of which those of some instances begin by turns."""
    n = pool.num_instances
    for episode in range(episodes):
        mask = np.arange(n) % 2 == episode % 2 if episode else np.ones(n, np.bool_)
        mask |= n == 1
        _, statuses = pool.reset((), np.zeros((0, n)), mask)
        assert not statuses.any(), (episode, [pool.failure(index) for index in range(n)])
        before = pool.outputs.copy()
        assert not before[:, mask].any()
        pool.step(np.ones((1, n)))
        outputs, statuses = pool.step(np.ones((1, n)))
        assert not statuses.any()
        np.testing.assert_array_equal(outputs, before + 1.0)


@pytest.mark.parametrize("version", [1, 2, 3])
@pytest.mark.parametrize("private", [False, True])
@pytest.mark.parametrize("num_instances", [1, 3])
def test_a_fresh_copy_of_the_library_goes_on(
    make, tmp_path, temp_root, caplog, version, private, num_instances
):
    path = limited_fmu(tmp_path, version=version)
    pool = make(path, num_instances, private_libraries=private or None)
    play(pool, 3 * LIMIT)
    assert caplog.text.count("a fresh copy of its library") == 1
    (folder,) = temp_root.iterdir()
    assert len(list(folder.glob("**/copy-*"))) <= num_instances
    pool.close()
    assert list(temp_root.iterdir()) == []


@pytest.mark.parametrize("workers", [1, 3])
def test_in_workers(make, tmp_path, workers):
    play(make(limited_fmu(tmp_path), 3, isolation="process", workers=workers), 3 * LIMIT)


@posix_only
@pytest.mark.parametrize("num_instances", [1, 3])
def test_a_fresh_worker_goes_on(make, tmp_path, caplog, num_instances):
    path = limited_fmu(tmp_path, "process")
    pool = make(path, num_instances, isolation="process", workers=num_instances)
    play(pool, 2 * LIMIT + 5)
    assert caplog.text.count("its FMU made no further instance") == 1
    assert pool.health()["deaths"].tolist() == [0] * num_instances


@posix_only
def test_a_limit_of_the_process_of_the_caller(make, tmp_path, monkeypatch):
    """Nothing helps there but workers, and the message says so."""
    monkeypatch.setenv("MADE_BY_LIMITED", "0")  # which is restored afterwards
    pool = make(limited_fmu(tmp_path, "process"), 1)
    words = 'refused to be instantiated anew.*isolation="process".*vector environment.*workers'
    with pytest.raises(AssertionError, match=words):
        play(pool, 2 * LIMIT)
    with pytest.raises(FMULoadError, match=r'refused to be instantiated; .*isolation="process"'):
        make(limited_fmu(tmp_path, "process"), 1)  # the next one in this process


@posix_only
def test_more_instances_than_a_process_can_have(make, tmp_path, monkeypatch):
    """Each message names what helps there, and it does."""
    monkeypatch.setenv("MADE_BY_LIMITED", "0")
    path, number = limited_fmu(tmp_path, "process"), f"number {LIMIT + 1} of {LIMIT + 1}"
    with pytest.raises(FMULoadError, match=f'{number}.*isolation="process"'):
        make(path, LIMIT + 1)
    monkeypatch.setenv("MADE_BY_LIMITED", "0")
    with pytest.raises(FMULoadError, match=f"{number}.*give more workers"):
        make(path, LIMIT + 1, isolation="process", workers=1)
    play(make(path, LIMIT + 1, isolation="process", workers=2), 2)


def test_of_a_system(make, tmp_path):
    path = limited_fmu(tmp_path)
    system = FMUSystem(
        components={"first": path, "second": path}, connections=["first.y -> second.u"]
    ).as_fmu()
    spec = PoolSpec((system.variable("first.u"),), (system.variable("second.y"),), time_step=0.5)
    spec, options = spec.beginning_by(ResetMethod.INSTANCE), PoolOptions(reset_method="instance")
    pool = open_pool(system, spec, 1, LOG, options)
    for _ in range(2 * LIMIT):
        _, statuses = pool.reset((), np.zeros((0, 1)))
        assert not statuses.any(), pool.failure(0)
        pool.step(np.ones((1, 1)))
        assert pool.step(np.ones((1, 1)))[0].tolist() == [[0.75]]
    pool.close()


def test_episodes_of_environments(tmp_path, make_envs, opened):
    """A step begins them, in the extension."""
    config = {"model_input_names": "u", "model_output_names": "y", "time_step": 0.5}
    config |= {"bounds": {"u": (-1, 1)}, "max_episode_steps": 2, "reset_method": "instance"}
    path = limited_fmu(tmp_path)
    envs = make_envs(lambda: fmu_tools.PlainEnv(path, fmu_tools.grouped(config)), 3)
    envs.reset()
    for _ in range(2 * LIMIT):
        rows = [envs.step(np.ones((3, 1), np.float32))[0][:, 0].tolist() for _ in range(3)]
        assert rows == [[0.5] * 3, [1.0] * 3, [0.0] * 3]
