"""The FMI versions behind one interface: call order, statuses, states, loading and freeing."""

import gc
import logging
import os
import random
import threading

import numpy as np
import pytest
from fmu_tools import MAJOR_VERSIONS, edited_fmu, library_name, probe_library

from fmugym import FMU, FMULoadError, SimulationError, bundled_fmu
from fmugym.fmi.access import Access
from fmugym.fmi.library import Library
from fmugym.fmi.status import Phase, Status

LOG = logging.getLogger("fmugym.test")
all_versions = pytest.mark.parametrize("version", MAJOR_VERSIONS)
with_state = pytest.mark.parametrize("version", [2, 3])


@pytest.fixture
def library(probe):
    """Make loaded libraries that are closed after the test."""
    made = []

    def make(version=2, path=None):
        made.append(Library(FMU(path or probe(version)), LOG))
        return made[-1]

    yield make
    for each in made:
        each.close()


@pytest.fixture
def instance(library):
    """Make an initialized instance with parameters."""

    def make(version=2, library_=None, start=0.0, stop=None, tolerance=None, **parameters):
        made = (library_ or library(version)).instantiate()
        made.initialize(start, stop, tolerance, lambda: write(made, **parameters))
        return made

    return make


def access(instance, *names):
    return Access(instance, [instance._description.variable(name) for name in names])


def write(instance, **values):
    setter = access(instance, *values)
    setter.values[:] = list(values.values())
    instance.check("setting", setter.set())


def read(instance, *names):
    getter = access(instance, *names)
    assert getter.get() == Status.OK
    return getter.values.tolist()


class TestCallOrder:
    @all_versions
    def test_a_whole_life_without_an_illegal_call(self, instance, version):
        """The probe counts every call that the standard forbids at its time."""
        first = instance(version, a=1.0)
        assert first.step(0.0, 0.5) == Status.OK
        first.reset()
        first.initialize(2.0, None, None, lambda: write(first, gain=3.0))
        assert read(first, "end", "sum") == [2.0, 0.0]
        write(first, a=1.0)
        assert first.step(2.0, 0.5) == Status.OK
        assert read(first, "end", "step_size", "sum", "illegal") == [2.5, 0.5, 1.5, 0]

    @all_versions
    def test_times_and_tolerance_reach_the_fmu(self, instance, version):
        given = instance(version, start=1.0, stop=5.0, tolerance=1e-3)
        assert read(given, "end", "stop") == [1.0, 5.0]
        assert read(given, "tolerance") == [-1.0 if version == 1 else 1e-3]
        left = instance(version)
        assert read(left, "end", "stop", "tolerance") == [0.0, -1.0, -1.0]

    @all_versions
    def test_initializing_twice_is_refused_before_the_call(self, instance, version):
        made = instance(version)
        with pytest.raises(SimulationError, match=r"Probe_\d+: cannot initialize while stepping"):
            made.initialize(0.0, None, None, lambda: None)
        assert made.step(0.0, 1.0) == Status.OK

    @all_versions
    def test_strings(self, library, version, caplog):
        made = library(version).instantiate()
        label = made._description.variable("label")

        def set_start_values():
            made.set_string(label, "Grün")
            write(made, log_status=1)

        made.initialize(0.0, None, None, set_start_values)
        made.step(0.0, 1.0)
        assert "step 1 of Grün is 100%" in caplog.text


class TestValues:
    @all_versions
    def test_mixed_types_keep_their_order(self, instance, version):
        made = instance(version)
        turbo = 3 if version == 1 else 5
        write(made, mode=turbo, c=0.25, on=1, n=-4, a=0.5)
        made.step(0.0, 1.0)
        assert read(made, "n_out", "mix", "on_out", "mode_out") == [-4, 25.5, 1, turbo]

    @all_versions
    def test_reals_alone_share_the_memory(self, instance, version):
        made = instance(version)
        values = np.zeros(2)
        variables = [made._description.variable(name) for name in ("a", "b")]
        shared = Access(made, variables, values)
        values[:] = 0.5, 0.25
        assert shared.set() == Status.OK
        made.step(0.0, 1.0)
        assert read(made, "mix") == [3.0]

    @all_versions
    def test_no_variables(self, instance, version):
        nothing = access(instance(version))
        assert (nothing.get(), nothing.set()) == (0, 0)

    @all_versions
    @pytest.mark.parametrize("status", [1, 3])
    def test_a_bad_status_of_a_setter(self, instance, version, status):
        for names in (["a"], ["a", "on"]):
            made = instance(version, set_status=status)
            assert access(made, *names).set() == status

    def test_a_wrong_type_is_refused_by_the_fmu(self, instance):
        """The probe knows the type of every reference: nothing is read as what it is not."""
        made = instance(3, mode=2, Int8_in=-3, UInt16_in=65535, Int64_in=2**40, Float32_in=0.5)
        names = ("mode", "Int8_in", "UInt16_in", "Int64_in", "Float32_in", "illegal")
        assert read(made, *names) == [2, -3, 65535, 2**40, 0.5, 0]


class TestStatuses:
    @all_versions
    @pytest.mark.parametrize(
        ("fault", "status", "phase"),
        [
            (1, Status.WARNING, Phase.STEPPING),
            (2, Status.DISCARD, Phase.ENDED),
            (3, Status.ERROR, Phase.FAILED),
            (4, Status.FATAL, Phase.DEAD),
            (5, Status.ERROR, Phase.FAILED),  # Pending, though nothing asynchronous was asked for
            (-1, Status.ERROR, Phase.FAILED),
            (99, Status.ERROR, Phase.FAILED),
        ],
    )
    def test_of_a_step(self, instance, version, fault, status, phase):
        """In FMPy, FMI 1.0, any status but OK ends the process with a segmentation fault."""
        made = instance(version, fault=fault, fault_step=2)
        assert made.step(0.0, 1.0) == Status.OK
        assert made.step(1.0, 1.0) == status
        assert made.phase is phase

    @pytest.mark.parametrize(("version", "status"), [(1, 2), (2, 6), (3, 6)])
    def test_asked_to_stop(self, instance, version, status):
        """FMI 2.0 says so by Discard, FMI 3.0 by a flag; FMI 1.0 cannot."""
        made = instance(version, fault=6, fault_step=1, a=1.0)
        assert made.step(0.0, 1.0) == status
        assert made.phase is Phase.ENDED
        assert read(made, "sum") == [1.0]

    @all_versions
    def test_reset_after_an_error(self, instance, version):
        made = instance(version, fault=3, fault_step=1)
        made.step(0.0, 1.0)
        made.reset()
        made.initialize(0.0, None, None, lambda: None)
        assert made.step(0.0, 1.0) == Status.OK

    @all_versions
    def test_no_call_after_a_fatal_error(self, instance, library, version):
        shared = library(version)
        made = instance(version, shared, fault=4, fault_step=1)
        made.step(0.0, 1.0)
        with pytest.raises(SimulationError, match="no reset is legal after a fatal error"):
            made.reset()
        made.free()
        made.free()
        assert read(instance(version, shared), "illegal") == [0]

    @all_versions
    @pytest.mark.parametrize("status", [2, 3, 4])
    def test_initialization_that_fails(self, library, version, status):
        made = library(version).instantiate()
        label = Status(status).name.capitalize()
        match = rf"initialization returned {label}; the FMU said: step 0 of probe is 100%"
        with pytest.raises(SimulationError, match=match):
            made.initialize(0.0, None, None, lambda: write(made, init_status=status))

    @all_versions
    def test_reset_that_fails(self, instance, version):
        made = instance(version, reset_status=3)
        with pytest.raises(SimulationError, match="reset returned Error"):
            made.reset()
        assert made.phase is Phase.FAILED


class TestFMUState:
    @with_state
    def test_restored_is_as_it_was(self, instance, version):
        made = instance(version, a=1.0)
        made.step(0.0, 1.0)
        state = made.save_state()
        made.step(1.0, 1.0)
        assert read(made, "sum", "steps", "end") == [2.0, 2, 2.0]
        made.restore_state(state)
        assert read(made, "sum", "steps", "end") == [1.0, 1, 1.0]

    @with_state
    def test_states_are_freed_once(self, instance, version):
        made = instance(version)
        states = [made.save_state() for _ in range(3)]
        made.step(0.0, 1.0)
        assert read(made, "live") == [3]
        states.pop()
        states[0].release()
        states[0].release()
        made.step(1.0, 1.0)
        assert read(made, "live") == [1]

    @with_state
    def test_states_go_with_their_instance(self, instance, library, version):
        shared = library(version)
        made = instance(version, shared)
        state = made.save_state()
        made.free()
        assert read(instance(version, shared), "live") == [0]
        state.release()
        del state
        gc.collect()

    @with_state
    def test_a_restore_that_fails(self, instance, version):
        made = instance(version, restore_status=3)
        state = made.save_state()
        with pytest.raises(SimulationError, match="restoring the FMU state returned Error"):
            made.restore_state(state)

    @with_state
    def test_none_after_a_fatal_error(self, instance, version):
        made = instance(version, fault=4, fault_step=1)
        state = made.save_state()
        made.step(0.0, 1.0)
        with pytest.raises(SimulationError, match="no restore after a fatal error"):
            made.restore_state(state)
        with pytest.raises(SimulationError, match="cannot save the FMU state while dead"):
            made.save_state()

    def test_fmi_1_has_none(self, instance):
        with pytest.raises(SimulationError, match="Probe cannot get and set its state"):
            instance(1).save_state()


class TestDirectionalDerivatives:
    """What they are is in ``test_linearization.py``; here is when they are."""

    @with_state
    def test_of_outputs_after_a_step(self, library, version):
        shared = library(path=bundled_fmu("Pendulum", version))
        made = shared.instantiate()
        q, theta, theta_dot = map(made._description.variable, ["q", "theta", "theta_dot"])
        with pytest.raises(SimulationError, match="cannot differentiate while instantiated"):
            made.jacobian([q], [theta])
        made.initialize(0.0, None, None, lambda: write(made, theta_dot_0=1.0))
        made.step(0.0, 0.1)
        assert made.jacobian([q, theta_dot], [theta_dot, theta]).tolist() == [[0, 1], [1, 0]]
        assert made.jacobian([], [theta]).shape == (0, 1)

    @all_versions
    def test_none_where_the_fmu_has_none(self, instance, version):
        with pytest.raises(SimulationError, match="Probe provides no derivatives"):
            instance(version).jacobian([], [])


class TestLoading:
    @pytest.mark.skipif(os.name != "posix", reason="Windows keeps the working directory")
    def test_without_a_working_directory(self, probe, library, monkeypatch, tmp_path):
        path = probe()
        directory = tmp_path / "away"
        directory.mkdir()
        monkeypatch.chdir(directory)
        directory.rmdir()
        with pytest.raises(FMULoadError, match=r"Probe.fmu .* working directory"):
            library(path=path)

    @all_versions
    def test_wrong_token(self, probe, tmp_path, library, version):
        """In FMPy, FMI 1.0, this passes and the next call ends the process."""
        path = edited_fmu(probe(version), tmp_path, {"{probe-": "{other-"})
        with pytest.raises(FMULoadError, match="Probe refused to be instantiated"):
            library(version, path).instantiate()

    @all_versions
    def test_a_library_of_another_fmi_version(
        self, probe, tmp_path, version, temp_root, same_working_directory
    ):
        other = probe_library(version % 3 + 1)
        path = edited_fmu(probe(version), tmp_path, add={library_name(version): other})
        with pytest.raises(FMULoadError, match=r"Probe\.fmu cannot be loaded"):
            Library(FMU(path), LOG)
        assert list(temp_root.iterdir()) == []

    def test_working_directory_is_untouched_by_a_good_load(
        self, library, same_working_directory, tmp_path, monkeypatch
    ):
        monkeypatch.chdir(tmp_path)
        library(2)
        assert os.getcwd() == str(tmp_path)

    def test_a_closed_library_makes_no_instances(self, library):
        closed = library(2)
        closed.close()
        closed.close()
        with pytest.raises(SimulationError, match=r"Probe\.fmu is closed"):
            closed.instantiate()


class TestManyInstances:
    @all_versions
    def test_freed_in_any_order(self, library, instance, version):
        shared = library(version)
        instances = [instance(version, shared, gain=float(i), a=1.0) for i in range(10)]
        random.Random(version).shuffle(instances)
        while instances:
            for made in instances:
                gain = read(made, "gain")[0]
                before = read(made, "sum")[0]
                assert made.step(0.0, 1.0) == Status.OK
                assert read(made, "sum")[0] == before + gain
            shared.discard(instances.pop())

    @all_versions
    def test_closing_the_library_frees_all(self, library, instance, version):
        shared = library(version)
        instances = [instance(version, shared) for _ in range(3)]
        shared.close()
        assert {made.phase for made in instances} == {Phase.DEAD}
        for made in instances:
            made.free()

    @all_versions
    def test_libraries_do_not_share_memory(self, library, instance, version):
        one, other = library(version), library(version)
        for _ in range(3):
            last = instance(version, one)
        assert read(last, "instances") == [3]
        assert read(instance(version, other), "instances") == [1]

    @all_versions
    def test_threads_load_step_and_free(self, probe, version, same_working_directory):
        failures = []

        def live():
            try:
                own = Library(FMU(probe(version)), LOG)
                made = own.instantiate()
                made.initialize(0.0, None, None, lambda: write(made, a=1.0))
                for step in range(200):
                    assert made.step(float(step), 1.0) == Status.OK
                assert read(made, "sum") == [200.0]
                own.close()
            except BaseException as error:
                failures.append(error)

        threads = [threading.Thread(target=live) for _ in range(6)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert failures == []
