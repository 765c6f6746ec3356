"""The native pool: threads, messages, isolation and memory."""

import functools
import gc
import logging
import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import building
import fmu_tools
import numpy as np
import pytest
from plants import ONCE

from fmugym import FMU, FMULoadError, SimulationError, _native, bundled_fmu
from fmugym.fmi import Status
from fmugym.fmi.bundled import BUNDLED_FMUS
from fmugym.pool import PoolSpec
from fmugym.pool.native_pool import NativePool
from fmugym.pool.opening import PoolOptions, open_pool
from fmugym.pool.trial.trial import compare
from fmugym.pool.trial.verdict import Neighbours

LOG = logging.getLogger("fmugym.test")
on_linux = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads /proc")

INTERFACES = {
    "CartPole": (["f"], ["x", "theta", "x_dot", "theta_dot"], ["theta_0", "m_pole", "solver"]),
    "Pendulum": (["tau"], ["theta_dot", "theta"], ["q_0", "max_step"]),
    "DoublePendulum": (["tau2", "tau1"], ["q2_dot", "q1"], ["q1_0", "P1"]),
    "House": (["u", "T_out"], ["T_air", "T_w"], ["T_w_0", "H_w"]),
}


def make(cls, path, inputs, outputs, count=1, time_step=0.05, **options):
    fmu = FMU(path)
    names = ("threads", "private_libraries")
    extra = {name: options.pop(name) for name in names if name in options}
    options.setdefault("num_observed", len(outputs))
    spec = PoolSpec(
        tuple(map(fmu.variable, inputs)), tuple(map(fmu.variable, outputs)), time_step, **options
    )
    pool = cls(fmu, spec, count, LOG, **extra)
    pool.variable = fmu.variable
    return pool


@pytest.fixture
def native(opened):
    """Make native pools that are closed after the test."""
    return lambda *args, **options: opened(make(NativePool, *args, **options))


def busy_xml(flags=""):
    rows = ["work:input", "steps:output", "total:output", "restore_work:parameter"]
    rows += ["drift:parameter", "offset:output"]
    variables = ""
    for reference, row in enumerate(rows):
        name, causality = row.split(":")
        start = "" if causality == "output" else ' start="0"'
        kind = "tunable" if causality == "parameter" else "continuous"
        variables += f'<ScalarVariable name="{name}" valueReference="{reference}" '
        variables += f'causality="{causality}" variability="{kind}"><Real{start}/></ScalarVariable>'
    return (
        '<fmiModelDescription fmiVersion="2.0" modelName="Busy" guid="{busy}">'
        f'<CoSimulation modelIdentifier="Busy" canGetAndSetFMUstate="true" {flags}/>'
        f"<ModelVariables>{variables}</ModelVariables><ModelStructure/></fmiModelDescription>"
    )


def busy_fmu(folder, *options, flags=""):
    files = {"modelDescription.xml": busy_xml(flags)}
    library = building.library("sources/busy.c", flags=("-O2", *options))
    files[fmu_tools.library_name(2, "Busy")] = library
    return fmu_tools.write_fmu(folder / "Busy.fmu", files)


@pytest.fixture(scope="session")
def busy(tmp_path_factory):
    return busy_fmu(tmp_path_factory.mktemp("busy"))


@pytest.fixture(scope="session")
def shared(tmp_path_factory):
    """An FMU whose instances count their steps together."""
    return busy_fmu(tmp_path_factory.mktemp("shared"), "-DSHARED")


# Threads


def rollout(pool, steps=20, seed=0):
    """What a pool over the cart-pole does, as bytes."""
    rng = np.random.default_rng(seed)
    count, record = pool.num_instances, []
    variables = (pool.variable("theta_0"),)
    values = rng.uniform(1.4, 1.7, (1, count))
    record.append(pool.reset(variables, values)[0].tobytes())
    for _ in range(steps):
        pool.step(rng.normal(size=(1, count)), rng.random(count) < 0.1)
        mask = rng.random(count) < 0.1
        pool.reset(variables, rng.choice(values[0], (1, count)), mask)
        record += [pool.outputs.tobytes(), pool.observations.tobytes()]
    return b"".join(record)


def cart_pole(threads=1, count=300, **options):
    outputs = ["x", "theta"]
    return make(
        NativePool, bundled_fmu("CartPole"), ["f"], outputs, count, threads=threads, **options
    )


def test_results_do_not_depend_on_the_number_of_threads():
    jobs, results = _native.statistics()["jobs"], set()
    for threads in (1, 2, 4):
        pool = cart_pole(threads)
        results.add(rollout(pool))
        pool.close()
    assert _native.statistics()["jobs"] > jobs  # there was enough to do to call helpers
    assert len(results) == 1


def test_heavy_tails(native, busy):
    """One step in a hundred takes a thousand times as long; who is done goes on with the next."""
    pools_ = [native(busy, ["work"], ["steps"], 200, threads=threads) for threads in (1, 3)]
    for pool in pools_:
        pool.reset((), np.zeros((0, 200)))
    for seed in range(5):
        work = np.where(np.random.default_rng(seed).random((1, 200)) < 0.01, 2000.0, 2.0)
        for pool in pools_:
            outputs, _ = pool.step(work)
            assert (outputs == seed + 1).all()


def printed_number(script):
    """Run a script in a process of its own."""
    command = [sys.executable, "-c", script]
    return float(subprocess.run(command, capture_output=True, text=True, check=True).stdout)


@on_linux
@pytest.mark.parametrize("threads", [1, 2, 3])
def test_threads_are_started_only_where_wanted(threads):
    script = f"""
import os, sys
sys.path[:0] = {building.FOLDERS!r}
import test_native_pool
before = len(os.listdir("/proc/self/task"))
pool = test_native_pool.cart_pole({threads})
assert before == len(os.listdir("/proc/self/task"))
test_native_pool.rollout(pool)
print(len(os.listdir("/proc/self/task")) - before)
"""
    assert printed_number(script) == threads - 1


@on_linux
@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
def test_after_a_fork():
    pool = cart_pole(2)
    expected = rollout(pool)
    child = os.fork()
    if child == 0:
        same = rollout(pool) == expected
        pool.close()
        os._exit(0 if same else 1)
    same = rollout(pool) == expected
    assert os.waitpid(child, 0)[1] == 0
    assert same
    pool.close()


def test_several_pools_on_several_threads():
    made = [cart_pole(2, count) for count in (50, 100, 200, 300)]
    expected = [rollout(pool) for pool in made]
    with ThreadPoolExecutor(4) as executor:
        for _ in range(5):
            assert list(executor.map(rollout, made)) == expected
    for pool in made:
        pool.close()


def test_one_pool_on_several_threads_takes_turns():
    pool = cart_pole(2)
    pool.reset((), np.zeros((0, 300)))
    with ThreadPoolExecutor(4) as executor:
        list(executor.map(lambda _: pool.step_own(), range(200)))
    assert pool.read((pool.variable("time"),)).tolist() == [[pytest.approx(10.0)] * 300]
    pool.close()


def test_troubled_instances_are_counted(native, probe):
    pool = native(probe(), ["a"], ["sum"], 4)
    names = ("fault", "fault_step")
    values = np.array([[0, 3, 6, 7], [1, 1, 1, 1]], float)
    pool.reset(tuple(map(pool.variable, names)), values)
    assert pool.step_own() == 3


class TestArguments:
    def test_strides_and_types(self, native):
        pool, other = (native(bundled_fmu("CartPole"), ["f"], ["x", "theta"], 6) for _ in range(2))
        theta = (pool.variable("theta_0"),), (other.variable("theta_0"),)
        values = np.linspace(1, 2, 6)[None]
        mask = np.array([True, False] * 3)
        pool.reset(theta[0], np.repeat(values, 2, axis=1)[:, ::2], np.repeat(mask, 3)[::3])
        other.reset(theta[1], values, mask)
        np.testing.assert_array_equal(pool.outputs, other.outputs)
        pool.reset(theta[0], np.broadcast_to(np.float32(1.5), (1, 6)), [1, 1, 1, 0, 0, 0])
        other.reset(theta[1], np.full((1, 6), 1.5), np.array([True] * 3 + [False] * 3))
        pool.step(np.arange(6)[None, ::-1], [False] * 6)
        other.step(np.arange(6.0)[None, ::-1])
        np.testing.assert_array_equal(pool.outputs, other.outputs)

    @pytest.mark.parametrize("shape", [(5,), (2, 6), ()])
    def test_shapes(self, native, shape):
        pool = native(bundled_fmu("CartPole"), ["f"], ["x"], 6)
        with pytest.raises(ValueError, match="the mask must have the shape"):
            pool.step(skip=np.zeros(shape, np.bool_))

    def test_after_close(self, native):
        pool = native(bundled_fmu("CartPole"), ["f"], ["x"], 2)
        pool.reset((), np.zeros((0, 2)))
        snapshot, outputs = pool.save(), pool.outputs
        pool.close()
        for call in (pool.step, pool.save, lambda: pool.reset((), np.zeros((0, 2)))):
            with pytest.raises(SimulationError, match="closed"):
                call()
        assert not outputs.any()  # still there
        del snapshot

    def test_snapshot_of_something_else(self, native):
        pool = native(bundled_fmu("CartPole"), ["f"], ["x"], 2)
        with pytest.raises(SimulationError, match="another pool"):
            pool.restore([])


# Messages


@pytest.mark.parametrize("version", [1, 2, 3])
def test_messages(native, probe, version, caplog):
    pool = native(probe(version), ["a"], ["sum"], 3)
    pool.reset((pool.variable("log_status"),), np.array([[-1.0, 1.0, 3.0]]))
    caplog.clear()
    pool.step()
    model = "Probe_"
    assert [(r.levelname, r.getMessage()) for r in caplog.records] == [
        ("WARNING", f"{model}1: [probe] step 1 of probe is 100%"),
        ("ERROR", f"{model}2: [probe] step 1 of probe is 100%"),
    ]


def test_too_many_messages_at_once(native, probe, caplog):
    pool = native(probe(), ["a"], ["sum"], 20, substeps=100, threads=2)
    pool.reset((pool.variable("log_status"),), np.ones((1, 20)))
    caplog.clear()
    pool.step()
    assert len(caplog.records) == 1001
    assert "too many" in caplog.records[-1].getMessage()


# Initial states


class TestInitialStates:
    def initializations(self, pool):
        """How many of four resets of each instance initialize it."""
        before = _native.initializations()
        for _ in range(4):
            outputs, status = pool.reset((), np.zeros((0, pool.num_instances)))
            assert not status.any()
            assert not outputs.any()
            pool.step()
        return (_native.initializations() - before) / pool.num_instances

    def test_are_restored_where_that_is_asked_for(self, native):
        pool = native(bundled_fmu("CartPole"), ["f"], ["x"], 3, reset_method="restore")
        assert self.initializations(pool) == 2

    def test_not_otherwise(self, native):
        pool = native(bundled_fmu("CartPole"), ["f"], ["x"], 3)
        assert self.initializations(pool) == 4

    def test_not_in_fmi_1(self, native):
        pool = native(bundled_fmu("CartPole", "1.0"), ["f"], ["x"], 3, reset_method="restore")
        assert self.initializations(pool) == 4


# Isolation


def disturb(fmu, outputs=()):
    """Whether two instances disturb each other; by default in any output."""
    numeric = [v for v in fmu.description.variables.values() if v.numeric]
    inputs = tuple(v for v in numeric if v.causality == "input")
    outputs = outputs or tuple(v for v in numeric if v.causality == "output")

    verdict = compare(fmu, PoolSpec(inputs, outputs, 0.1))
    return verdict.neighbours is not Neighbours.INDEPENDENT


class TestIsolation:
    def run(self, pool):
        pool.reset((), np.zeros((0, pool.num_instances)))
        for _ in range(3):
            outputs, _ = pool.step()
        return outputs[0].tolist()

    def test_private_libraries(self, native, shared, temp_root):
        assert self.run(native(shared, ["work"], ["total"], 3, threads=1)) == [7, 8, 9]
        pool = native(shared, ["work"], ["total"], 3, private_libraries=True, threads=2)
        assert self.run(pool) == [3, 3, 3]
        pool.close()

    def test_temporary_files_go(self, native, shared, temp_root):
        pool = native(shared, ["work"], ["total"], 3, private_libraries=True)
        assert len(list(temp_root.rglob("Busy*"))) == 4
        pool.close()
        assert list(temp_root.iterdir()) == []

    def test_by_the_flag(self, opened, tmp_path):
        flag = 'canBeInstantiatedOnlyOncePerProcess="true"'
        path = busy_fmu(tmp_path, "-DSHARED", flags=flag)
        cls = functools.partial(open_pool, options=PoolOptions(isolation="none"))
        assert self.run(opened(make(cls, path, ["work"], ["total"], 3))) == [3, 3, 3]

    def test_where_no_copy_can_be_made(self, native, shared, monkeypatch):
        def full(*_, **options):
            raise OSError("no space left on device")

        monkeypatch.setattr("fmugym.fmi.fmu.shutil.copytree", full)
        with pytest.raises(FMULoadError, match=r"needs a copy for each instance.*no space left"):
            native(shared, ["work"], ["total"], 3, private_libraries=True)

    def test_the_library_is_fresh_after_a_fatal_error(self, native, probe):
        pool = native(probe(), ["a"], ["instances"], 2, private_libraries=True)
        variables = tuple(map(pool.variable, ("fault", "fault_step")))
        assert pool.reset(variables, np.array([[4.0, 0.0], [1.0, 1.0]]))[0].tolist() == [[1, 1]]
        assert pool.step()[1].tolist() == [Status.FATAL, Status.OK]
        assert pool.reset((), np.zeros((0, 2)))[0].tolist() == [[1, 1]]

    @pytest.mark.parametrize(("model", "version"), BUNDLED_FMUS)
    def test_bundled_fmus_share_nothing(self, model, version):
        assert not disturb(FMU(bundled_fmu(model, version)))

    def test_probe_writes_all_types_of_inputs(self, probe):
        fmu = FMU(probe(3))
        outputs = tuple(map(fmu.variable, ("mix", "sum", "n_out", "on_out", "mode_out")))
        assert not disturb(fmu, outputs)
        assert disturb(fmu)  # it counts its instances


# Memory


@on_linux
@pytest.mark.parametrize(("model", "version"), ONCE)
def test_memory_of_an_instance(model, version):
    inputs, outputs, start = INTERFACES[model]
    script = f"""
import sys
sys.path[:0] = {building.FOLDERS!r}
import numpy as np
import test_native_pool as t
from zoo_tools import resident_bytes
path = t.bundled_fmu({model!r}, {version!r})
t.make(t.NativePool, path, {inputs!r}, {outputs!r}, 10).close()
before = resident_bytes()
pool = t.make(t.NativePool, path, {inputs!r}, {outputs!r}, 20000)
values = np.ones(({len(start)}, 20000))
for _ in range(3):
    pool.reset(tuple(map(pool.variable, {start!r})), values)
pool.step()
print((resident_bytes() - before) / 20000)
"""
    assert printed_number(script) < 8000


def test_pools_live_and_die_apart(temp_root):
    first, second = cart_pole(2), cart_pole(2)
    expected = rollout(second)
    del first
    gc.collect()
    assert len(list(temp_root.iterdir())) == 1
    assert rollout(second) == expected
    second.close()
    assert list(temp_root.iterdir()) == []


# Choice
