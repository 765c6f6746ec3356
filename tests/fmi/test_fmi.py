"""What pools ask of FMUs of each FMI version: calls, statuses, values, loading."""

import os
import threading

import numpy as np
import pytest
from fmu_tools import MAJOR_VERSIONS, edited_fmu, library_name, probe_library
from pool_tools import open_pool, start, step

from fmugym import FMU, FMULoadError, SimulationError, bundled_fmu
from fmugym.fmi import Status

all_versions = pytest.mark.parametrize("version", MAJOR_VERSIONS)
with_state = pytest.mark.parametrize("version", [2, 3])


@pytest.fixture
def make(opened):
    """Make pools that are closed after the test."""

    def make(path, inputs=(), outputs=(), count=1, time_step=0.5, **spec):
        return opened(open_pool(FMU(path), inputs, outputs, time_step, count, **spec))

    return make


def reset(pool, **values):
    """Reset all instances with the same start values; the outputs of the first."""
    return start(pool, values).outputs[:, 0].tolist()


class TestCallOrder:
    @all_versions
    def test_a_whole_life_without_an_illegal_call(self, make, probe, version):
        """The probe counts every call that the standard forbids at its time."""
        pool = make(probe(version), ["a"], ["end", "step_size", "sum", "illegal"], start_time=2.0)
        reset(pool)
        pool.step(np.ones((1, 1)))
        assert reset(pool, gain=3.0)[::2] == [2.0, 0.0]
        assert pool.step(np.ones((1, 1)))[0][:, 0].tolist() == [2.5, 0.5, 1.5, 0]

    @all_versions
    def test_times_and_tolerance_reach_the_fmu(self, make, probe, version):
        names = ["end", "stop", "tolerance"]
        spec = {"start_time": 1.0, "stop_time": 5.0, "tolerance": 1e-3}
        given = reset(make(probe(version), (), names, **spec))
        assert given == [1.0, 5.0, -1.0 if version == 1 else 1e-3]
        assert reset(make(probe(version), (), names)) == [0.0, -1.0, -1.0]


class TestValues:
    @all_versions
    def test_mixed_types_keep_their_order(self, make, probe, version):
        turbo = 3 if version == 1 else 5
        names = ["n_out", "mix", "on_out", "mode_out"]
        pool = make(probe(version), ["mode", "c", "on", "n", "a"], names)
        reset(pool)
        assert step(pool, turbo, 0.25, 1, -4, 0.5)[:, 0].tolist() == [-4, 25.5, 1, turbo]

    def test_a_wrong_type_is_refused_by_the_fmu(self, make, probe):
        """The probe knows the type of every reference: nothing is read as what it is not."""
        values = {"mode": 2, "Int8_in": -3, "UInt16_in": 65535, "Int64_in": 2**40}
        values |= {"Float32_in": 0.5, "illegal": 0}
        pool = make(probe(3), (), list(values))
        given = {name: value for name, value in values.items() if name != "illegal"}
        assert reset(pool, **given) == list(values.values())


class TestStatuses:
    @all_versions
    @pytest.mark.parametrize(
        ("fault", "status"),
        [(1, Status.WARNING), (5, Status.ERROR), (-1, Status.ERROR), (99, Status.ERROR)],
    )
    def test_of_a_step(self, make, probe, version, fault, status):
        """Pending is an error, as nothing asynchronous was asked for, and so is a status that there
        is not. In FMPy, FMI 1.0, any but OK ends the process."""
        pool = make(probe(version))
        reset(pool, fault=fault, fault_step=2)
        assert [int(pool.step()[1][0]) for _ in range(2)] == [Status.OK, status]


class TestDirectionalDerivatives:
    """What they are is in ``test_linearization.py``; here is when they are."""

    @with_state
    def test_of_outputs_after_a_step(self, make, version):
        pool = make(bundled_fmu("Pendulum", version), time_step=0.1)
        q, theta, theta_dot = map(pool.variable, ["q", "theta", "theta_dot"])
        reset(pool, theta_dot_0=1.0)
        pool.step()
        found = pool.differentiate((q, theta_dot), (theta_dot, theta))
        assert found[..., 0].tolist() == [[0, 1], [1, 0]]
        assert pool.differentiate((), (theta,)).shape == (0, 1, 1)

    @all_versions
    def test_none_where_the_fmu_has_none(self, make, probe, version):
        with pytest.raises(SimulationError, match="Probe provides no derivatives"):
            make(probe(version)).differentiate((), ())


class TestLoading:
    @pytest.mark.skipif(os.name != "posix", reason="Windows keeps the working directory")
    def test_without_a_working_directory(self, probe, make, monkeypatch, tmp_path):
        path = probe()
        directory = tmp_path / "away"
        directory.mkdir()
        monkeypatch.chdir(directory)
        directory.rmdir()
        reset(make(path))

    @all_versions
    def test_a_library_of_another_fmi_version(
        self, make, probe, tmp_path, version, temp_root, same_working_directory
    ):
        other = probe_library(version % 3 + 1)
        path = edited_fmu(probe(version), tmp_path, add={library_name(version): other})
        with pytest.raises(FMULoadError, match=r"Probe\.fmu cannot be loaded"):
            make(path)
        assert list(temp_root.iterdir()) == []


class TestManyInstances:
    @all_versions
    def test_libraries_of_pools_do_not_share_memory(self, make, probe, version):
        assert reset(make(probe(version), (), ["instances"], 3)) == [3]
        assert reset(make(probe(version), (), ["instances"])) == [1]

    @all_versions
    def test_threads_load_step_and_free(self, probe, version, same_working_directory):
        failures = []

        def live():
            try:
                pool = start(open_pool(FMU(probe(version)), ["a"], ["sum"], 1.0))
                for _ in range(200):
                    outputs = step(pool, 1.0)
                assert outputs.tolist() == [[200.0]]
                pool.close()
            except BaseException as error:
                failures.append(error)

        threads = [threading.Thread(target=live) for _ in range(6)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert failures == []
