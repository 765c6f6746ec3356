"""Components of a system in processes of their own: isolated ones, and those for Windows in Wine.

What a system computes does not depend on where its components run.
"""

import contextlib
import logging
import os
import pickle
import shutil
import signal
import subprocess
import sys
import textwrap
import time
from dataclasses import replace
from pathlib import Path

import building
import clocks_tools
import exchange_tools
import fmu_tools
import numpy as np
import pytest
import values_tools
import wine_tools
from process_tools import faulty_fmu, start_values
from system_tools import linear, linear_fmu, masses, system

import fmugym
from fmugym import (
    Component,
    ConfigError,
    Connection,
    FMULoadError,
    FMUSystem,
    SimulationError,
    bundled_fmu,
)
from fmugym.pool import PoolSpec, has_native_pool
from fmugym.pool.bundle import SaveMethod
from fmugym.pool.local import local_pool
from fmugym.pool.spec import ResetMethod
from fmugym.systems.fmu import SystemFMU
from fmugym.systems.plan import Component as Planned
from fmugym.systems.plan import Connector, End, Link, Loop
from fmugym.tools import cli
from fmugym.trial import opening

LOG = logging.getLogger("fmugym.test")

pytestmark = [
    pytest.mark.skipif(not has_native_pool(), reason="the C extension runs these components"),
    pytest.mark.skipif(os.name == "nt", reason="they have processes of their own on Unix only"),
]


@pytest.fixture(scope="module", name="fmus")
def compiled(tmp_path_factory):
    """The FMU of linear equations by FMI version."""
    folder = tmp_path_factory.mktemp("linear")
    return {v: linear_fmu(folder / f"linear{v}.fmu", v) for v in (1, 2, 3)}


@pytest.fixture(scope="module", name="faulty")
def compiled_faulty(tmp_path_factory):
    return faulty_fmu(tmp_path_factory.mktemp("faulty"))


@pytest.fixture(name="make")
def closing_pools():
    """Make pools of plans that are closed after the test."""
    with contextlib.ExitStack() as stack:

        def make(plan, outputs, count=2, inputs=(), time_step=0.1, threads=2, **options):
            private = options.pop("private_libraries", False)
            fmu = SystemFMU(plan)
            variables = tuple(map(fmu.variable, inputs)), tuple(map(fmu.variable, outputs))
            spec = PoolSpec(*variables, time_step, **options)
            pool = local_pool(
                fmu, spec, count, LOG, native=True, threads=threads, private_libraries=private
            )
            pool.variable = fmu.variable
            return stack.enter_context(contextlib.closing(pool))

        yield make


def apart(plan, *names):
    """The same plan with these components in processes of their own."""
    components = tuple(replace(c, isolate=c.name in names) for c in plan.components)
    return replace(plan, components=components)


def reset(pool, names=(), values=None):
    variables = tuple(map(pool.variable, names))
    values = np.zeros((0, pool.num_instances)) if values is None else np.array(values, float)
    return pool.reset(variables, values)[1]


def play(pool, steps=10):
    """Reset and step; the outputs, shape (steps + 1, k, N)."""
    assert not reset(pool).any(), pool.failure(0)
    rows = [pool.outputs.copy()]
    for _ in range(steps):
        outputs, statuses = pool.step()
        assert not statuses.any(), pool.failure(0)
        rows.append(outputs.copy())
    return np.array(rows)


MASSES = ["first.y1", "second.y2"]


class TestResults:
    """Those of an isolated component equal the others' to the last bit."""

    @pytest.mark.parametrize("versions", [(1, 2), (2, 3), (3, 1)], ids=str)
    @pytest.mark.parametrize("names", [("first",), ("second",), ("first", "second")], ids=str)
    def test_each_version(self, make, fmus, versions, names):
        plan = masses([fmus[v] for v in versions], (2, 1))
        rows = play(make(plan, MASSES))
        assert np.abs(rows).max() > 0.5
        pool = make(apart(plan, *names), MASSES)
        assert play(pool).tobytes() == rows.tobytes()
        assert play(pool).tobytes() == rows.tobytes()

    @pytest.mark.parametrize("master", ["gauss_seidel", "jacobi"])
    def test_an_algebraic_loop(self, make, fmus, master):
        """It is solved at the start, and in each step from saved states."""
        direct = {"a": [[-1, 0], [0, 0]], "c": [[1, 0], [0, 0]], "d": [[0.5, 0], [0, 0]]}
        parts = (
            linear("p", fmus[2], (1.0, 0.0), **direct),
            linear("q", fmus[3], (-0.4, 0.0), **direct),
        )
        links = (Link("p", "y1", "q", "u1"), Link("q", "y1", "p", "u1"))
        plan = system(parts, links, Loop(), master=master)
        rows = play(make(plan, ["p.y1", "q.y1"]))
        assert play(make(apart(plan, "p"), ["p.y1", "q.y1"])).tobytes() == rows.tobytes()

    @pytest.mark.parametrize("solver", ["dormand_prince", "rk4"])
    @pytest.mark.parametrize("version", [1, 2, 3])
    def test_model_exchange(self, make, tmp_path, solver, version):
        """The solver runs where the component does, with events."""
        path = exchange_tools.exchange_fmu(tmp_path / "Ball.fmu", "ball", version)
        plan = system([Planned("ball", path, "model_exchange")], ())
        outputs = [f"ball.{v}" for v in ("h", "v")]
        rows = play(make(plan, outputs, solver=solver), 30)
        assert play(make(apart(plan, "ball"), outputs, solver=solver), 30).tobytes() == (
            rows.tobytes()
        )

    def test_inputs_and_parameters_of_the_system(self, make, fmus):
        """What is set between steps reaches the component before it steps."""
        plan = masses([fmus[2], fmus[3]])
        connector = Connector("push", (End("first", "u2", 2.0), End("second", "u2")), "input")
        plan = replace(plan, connectors=(connector,), links=plan.links[::2])
        plan = replace(plan, initialization=plan.initialization[:2])
        rows = []
        for one in (plan, apart(plan, "first", "second")):
            pool = make(one, MASSES, inputs=["push"])
            assert not reset(pool, ["second.x1_0"], [[0.3, -0.2]]).any()
            for k in range(6):
                pool.step(np.array([[0.1 * k, -0.2]]))
                rows.append(pool.outputs.tobytes())
            pool.write((pool.variable("first.a21"),), np.array([[-9.0, -8.0]]))
            read = pool.read(tuple(map(pool.variable, ["first.a21", "second.x1_0", "first.t"])))
            rows.append(read.tobytes())
            pool.step(np.array([[0.5, 0.5]]))
            rows.append(pool.outputs.tobytes())
        assert rows[:8] == rows[8:]

    @pytest.mark.parametrize("method", list(ResetMethod)[:4])
    def test_episodes_begin_by_each_method(self, make, fmus, method):
        plan = masses([fmus[2], fmus[3]])
        rows = play(make(plan, MASSES))
        private = method is ResetMethod.LIBRARY
        pool = make(apart(plan, "second"), MASSES, reset_method=method, private_libraries=private)
        for _ in range(4):
            assert play(pool).tobytes() == rows.tobytes()

    def test_states(self, make, fmus):
        """Snapshots, and states that go to another pool as bytes."""
        plan = masses([fmus[2], fmus[2]])
        here, there = make(plan, MASSES), make(apart(plan, "first"), MASSES)
        later = []
        for pool in (here, there):
            play(pool, 3)
            snapshot = pool.save()
            first = [pool.step()[0].copy() for _ in range(3)]
            pool.restore(snapshot, np.array([True, False]))
            again = [pool.step()[0].copy() for _ in range(3)]
            assert all(
                a[:, 0].tobytes() == b[:, 0].tobytes() for a, b in zip(first, again, strict=True)
            )
            later.append(pool.outputs.tobytes())
        assert later[0] == later[1]
        for pool in (here, there):
            pool.save_by(lambda: SaveMethod.STATE)
            play(pool, 2)
        bundle = pickle.loads(pickle.dumps(there.save_instances(np.arange(2))))
        here.restore_instances(bundle, np.array([1, 0]), np.arange(2))
        for _ in range(3):
            assert np.array_equal(here.step()[0], there.step()[0][:, ::-1])

    def test_a_discarded_step_is_repeated_in_parts(self, make, fmus):
        plan = masses([fmus[2], fmus[2]])
        first = replace(plan.components[0], starts=(*plan.components[0].starts, ("limit", 0.06)))
        plan = replace(plan, components=(first, plan.components[1]))
        rows = play(make(plan, MASSES, fault_retries=2))
        pool = make(apart(plan, "first"), MASSES, fault_retries=2)
        assert play(pool).tobytes() == rows.tobytes()
        assert pool.health()["retries"].sum() > 0

    @pytest.mark.parametrize("interface", ["co_simulation", "model_exchange"])
    def test_arrays_with_sizes_of_their_own(self, make, tmp_path, interface):
        path = values_tools.state_space_fmu(tmp_path / "S.fmu")
        sizes = {"n": 3, "m": 2, "r": 2}
        starts = {
            "A": (-np.eye(3) + 0.1).tolist(),
            "B": np.full((3, 2), 0.3).tolist(),
            "C": np.arange(6.0).reshape(2, 3).tolist(),
            "D": np.zeros((2, 2)).tolist(),
            "x_0": [1.0, -0.5, 0.25],
        }
        results = []
        for isolate in (False, True):
            one = Component(path, sizes | starts, interface, feedthrough=False, isolate=isolate)
            both = FMUSystem({"p": one, "q": one}, ["p.y -> q.u", "q.y -> p.u"])
            outputs = [f"{name}.y[{i}]" for name in "pq" for i in (1, 2)]
            pool = make(both.plan, outputs)
            results.append(play(pool))
        assert np.ptp(results[0]) > 1.0
        assert results[0].tobytes() == results[1].tobytes()

    @pytest.mark.parametrize("version", [1, 2, 3])
    def test_numbers_of_every_type(self, make, tmp_path, version):
        path = values_tools.feedthrough_fmu(tmp_path / "F.fmu", version)
        plan = system([Planned("f", path)], ())
        fmu = SystemFMU(plan)
        names = [v.name for v in fmu.description.variables.values() if v.is_number]
        inputs = [n for n in names if fmu.variable(n).causality == "input"]
        outputs = [n for n in names if fmu.variable(n).causality == "output"]
        rows = []
        for one in (plan, apart(plan, "f")):
            pool = make(one, outputs, inputs=inputs)
            assert not reset(pool).any(), pool.failure(0)
            for k in range(3):
                values = np.full((len(inputs), 2), float(k)) + np.array([0.0, 1.0])
                outs, statuses = pool.step(values)
                assert not statuses.any(), pool.failure(0)
                rows.append(outs.tobytes())
        assert len(set(rows)) == 3
        assert rows[:3] == rows[3:]

    @pytest.mark.parametrize("interface", ["CoSimulation", "ModelExchange"])
    def test_clocks(self, make, tmp_path, interface):
        """Those that tick by themselves, that the system lets tick, and that the FMU does."""
        path = clocks_tools.clocks_fmu(tmp_path / "Clocks.fmu", interface)
        plan = system([Planned("c", path)], ())
        outputs = [f"c.count of {name}" for name in clocks_tools.CLOCKS]
        outputs += ["c.x", "c.sample", "c.bell", "c.strike", "c.countdown"]
        results = []
        for one in (plan, apart(plan, "c")):
            pool = make(one, outputs, inputs=["c.strike", "c.command", "c.pace"])
            rng = np.random.default_rng(0)
            assert not reset(pool).any(), pool.failure(0)
            for _ in range(20):
                inputs = rng.integers(0, 2, 2), rng.normal(size=2), rng.uniform(0.05, 0.6, 2)
                assert not pool.step(np.array(inputs))[1].any(), pool.failure(0)
                results.append(pool.outputs.copy())
        assert all(np.ptp(row) > 0 for row in np.array(results[:20]).max(axis=2).T[:8])
        assert np.array(results[:20]).tobytes() == np.array(results[20:]).tobytes()

    @pytest.mark.parametrize("version", [1, 2, 3])
    def test_strings_and_messages(self, make, tmp_path, caplog, version):
        """The FMU logs its String; the message names the system and the component."""
        probe = fmu_tools.probe_fmu(tmp_path, version)
        told = []
        for isolate in (False, True):
            parts = Planned("loud", probe, starts=(("label", "Ümlaut"),), isolate=isolate)
            pool = make(system([parts], ()), ["loud.sum"])
            caplog.clear()
            assert not reset(pool, ["loud.log_status"], [[-1.0, 1.0]]).any(), pool.failure(0)
            pool.step()
            told.append([r.getMessage() for r in caplog.records if "loud" in r.getMessage()])
        assert any("system_1.loud" in text and "Ümlaut is 100%" in text for text in told[0])
        assert told[0] == told[1]

    def test_many_threads(self, make, fmus):
        plan = masses([fmus[2], fmus[3]])
        one = play(make(plan, MASSES, 300, threads=1), 5)
        pool = make(apart(plan, "first"), MASSES, 300, threads=3)
        assert play(pool, 5).tobytes() == one.tobytes()
        assert len(children()) >= 3


def children():
    """The processes that this one has started and that run workers of components."""
    found = []
    for process in Path("/proc").iterdir():
        with contextlib.suppress(OSError):
            if process.name.isdigit():
                status = (process / "status").read_text()
                command = (process / "cmdline").read_bytes()
                if f"PPid:\t{os.getpid()}\n" in status and b"serve_component" in command:
                    found.append(int(process.name))
    return found


def is_running(process):
    """Whether there is such a process, and it is more than a note that it has ended."""
    try:
        return "\nState:\tZ" not in Path(f"/proc/{process}/status").read_text()
    except OSError:
        return False


on_linux = pytest.mark.skipif(not Path("/proc/self").exists(), reason="/proc lists processes")


def with_fault(fmus, faulty, *, isolate=True):
    """A component of which every fault can be asked for, after a sound one."""
    parts = (
        linear("sound", fmus[2], (1.0, 0.0), a=[[-1, 0], [0, 0]], c=np.eye(2)),
        Planned("bad", faulty, isolate=isolate),
    )
    return system(parts, [Link("sound", "y1", "bad", "u")])


NAMES = [f"bad.{name}" for name in start_values()]


def asking_for(*faults, stage="step"):
    """One column of start values for each instance."""
    return np.array([list(start_values(one, stage).values()) for one in faults], float).T


class TestFaults:
    OUTPUTS = ("bad.y", "sound.y1")

    @pytest.mark.parametrize(
        ("fault", "cause"),
        [
            ("crash", "signal SIGSEGV"),
            ("abort", "signal SIGABRT"),
            ("exit", "exit status 0"),
            ("hang", "call_timeout"),
        ],
    )
    def test_one_ends_the_systems_of_its_worker(self, make, fmus, faulty, fault, cause):
        timeout = 1.0 if fault == "hang" else 60.0
        plan = with_fault(fmus, faulty)
        pool = make(plan, self.OUTPUTS, 4, time_step=0.5, call_timeout=timeout)
        assert not reset(pool, NAMES, asking_for(fault, "none", "none", "none")).any()
        pool.step()
        before = pool.outputs.copy()
        _, statuses = pool.step()
        assert statuses.tolist() == [4, 4, 0, 0]
        assert pool.outputs[:, :2].tobytes() == before[:, :2].tobytes()
        for text in ("component 'bad'", cause, "this is fault"):
            assert text in pool.failure(0)
        assert cause in pool.failure(1)
        assert "this is fault" not in pool.failure(1)
        mask = np.array([True, True, False, False])
        pool.reset(tuple(map(pool.variable, NAMES)), asking_for(*["none"] * 4), mask)
        assert not pool.step()[1].any()
        assert pool.outputs[0, 0] == pool.outputs[0, 1] == before[0, 0]

    def test_a_crash_in_an_initialization_harms_no_other_system(self, make, fmus, faulty):
        pool = make(with_fault(fmus, faulty), self.OUTPUTS, 3, time_step=0.5, threads=1)
        statuses = reset(pool, NAMES, asking_for("crash", "none", "none", stage="initialize"))
        assert statuses.tolist() == [4, 0, 0]
        assert "signal SIGSEGV" in pool.failure(0)
        assert not pool.step()[1][1:].any()

    def test_a_reset_without_the_fault_begins_anew(self, make, fmus, faulty):
        """The others of its worker get a new worker, too, and begin where they should."""
        pool = make(with_fault(fmus, faulty), self.OUTPUTS, 2, time_step=0.5, threads=1)
        reset(pool, NAMES, asking_for("none", "none"))
        expected = [pool.step()[0].copy() for _ in range(3)]
        reset(pool, NAMES, asking_for("crash", "none"))
        for _ in range(2):
            pool.step()
        assert not reset(pool, NAMES, asking_for("none", "none")).any()
        for row in expected:
            assert pool.step()[0].tobytes() == row.tobytes()

    def test_it_is_given_up_after_five_deaths_in_a_row(self, make, fmus, faulty):
        pool = make(with_fault(fmus, faulty), self.OUTPUTS, 1, time_step=0.5)
        for _ in range(5):
            assert reset(pool, NAMES, asking_for("crash", stage="initialize")).all()
        assert reset(pool, NAMES, asking_for("none")).all()
        assert "5 deaths in a row" in pool.failure(0)

    @on_linux
    def test_a_snapshot_is_lost_with_its_process(self, make, fmus):
        pool = make(apart(masses([fmus[2], fmus[2]]), "first"), MASSES, 1)
        play(pool, 2)
        snapshot = pool.save()
        (worker,) = set(children()) - self.others
        os.kill(worker, signal.SIGKILL)
        assert pool.step()[1].tolist() == [4]
        assert "signal SIGKILL" in pool.failure(0)
        play(pool, 2)
        with pytest.raises(SimulationError, match="another instance"):
            pool.restore(snapshot)

    @on_linux
    def test_a_library_that_is_gone_for_a_while(self, fmus, tmp_path):
        fmu = SystemFMU(apart(masses([fmus[2], fmus[2]]), "first"))
        spec = PoolSpec((), (fmu.variable("first.y1"),), 0.1)
        pool = local_pool(fmu, spec, 1, LOG, native=True)
        pool.variable = fmu.variable
        with contextlib.closing(pool):
            rows = play(pool, 3)
            library = fmu.parts[0].extract() / fmu.parts[0].library
            library.rename(tmp_path / "away")
            (worker,) = set(children()) - self.others
            os.kill(worker, signal.SIGKILL)
            assert pool.step()[1].tolist() == [4]
            assert pool.reset((), np.zeros((0, 1)))[1].tolist() == [4]
            assert library.name in pool.failure(0)
            (tmp_path / "away").rename(library)
            assert play(pool, 3).tobytes() == rows.tobytes()

    @pytest.fixture(autouse=True)
    def note_others(self):
        self.others = set(children()) if Path("/proc/self").exists() else set()

    @on_linux
    def test_workers_end_with_their_pool(self, make, fmus):
        pool = make(apart(masses([fmus[2], fmus[2]]), "first"), MASSES, 4, threads=2)
        play(pool, 2)
        assert len(set(children()) - self.others) == 2
        pool.close()
        assert not set(children()) - self.others

    @on_linux
    @pytest.mark.parametrize("stage", ["nowhere", "step"])
    def test_workers_end_with_a_process_that_is_killed(self, fmus, faulty, stage):
        """Also if the FMU hangs."""
        script = f"""
            import numpy as np
            from test_systems_apart import *
            plan = with_fault({dict(fmus)!r}, {str(faulty)!r})
            fmu = SystemFMU(plan)
            spec = PoolSpec((), (fmu.variable("bad.y"),), 0.5)
            pool = local_pool(fmu, spec, 1, LOG, native=True)
            names = tuple(map(fmu.variable, NAMES))
            pool.reset(names, asking_for("hang", stage={stage!r}))
            print(*children(), flush=True)
            for _ in range(10**9):
                pool.step()
        """
        script = textwrap.dedent(script).replace("PosixPath", "Path")
        environment = os.environ | {"PYTHONPATH": str(Path(__file__).parent)}
        with subprocess.Popen(
            [sys.executable, "-c", script], stdout=subprocess.PIPE, env=environment
        ) as parent:
            worker = int(parent.stdout.readline())
            time.sleep(0.3)
            parent.kill()
        deadline = time.monotonic() + 20
        while is_running(worker):
            assert time.monotonic() < deadline
            time.sleep(0.05)

    @on_linux
    @pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
    def test_a_fork_gets_workers_of_its_own(self, make, fmus):
        pool = make(apart(masses([fmus[2], fmus[2]]), "first"), MASSES, 1)
        rows = play(pool, 5)
        child = os.fork()
        if child == 0:
            try:
                lost = pool.step()[1].tolist() == [4] and "forked" in pool.failure(0)
                os._exit(0 if lost and play(pool, 5).tobytes() == rows.tobytes() else 1)
            finally:
                os._exit(2)
        assert os.waitpid(child, 0)[1] == 0
        assert not pool.step()[1].any()

    def test_a_library_that_cannot_be_loaded(self, fmus):
        from fmugym import _native

        fmu = SystemFMU(apart(masses([fmus[2], fmus[2]]), "second"))
        part = fmu.parts[1]
        shutil.copy(_native.__file__, part.extract() / part.library)
        with pytest.raises(FMULoadError, match="'second': it does not export fmi2"):
            local_pool(fmu, PoolSpec((), (), 0.1), 1, LOG, native=True)


class Chain(fmugym.FMUEnv):
    """Pushes the first pendulum of a chain."""

    def __init__(self, source, **options):
        config = {
            "model_input_names": ["a.tau"],
            "model_output_names": ["a.theta", "b.theta"],
            "model_parameters": {"b.q_0": fmugym.Uniform(-0.2, 0.2)},
            "time_step": 0.02,
            "bounds": {"a.tau": (-1, 1)},
            "max_episode_steps": 20,
        }
        super().__init__(source, config, **options)

    def _is_done(self):
        return abs(self.out["b.theta"]) > 10


def chain(first, second=None, **options):
    """Two pendulums, of which the first drives the second."""
    components = {"a": Component(first, **options), "b": second or bundled_fmu("Pendulum")}
    connection = Connection("a.theta", "b.tau", gain=0.5, convert_units=False)
    return FMUSystem(components, [connection], step_size=0.02)


def episodes(env, seed=3):
    """The observations of a vector environment over the end of its episodes."""
    env.action_space.seed(seed)
    first, _ = env.reset(seed=seed)
    return np.array([first, *(env.step(env.action_space.sample())[0] for _ in range(30))])


class Telling(fmugym.FMUEnv):
    """Reads a text that an FMU gives."""

    def __init__(self, source):
        config = {
            "model_input_names": ["f.Float64_in"],
            "model_output_names": ["f.Float64_out"],
            "model_parameters": {
                "f.String_parameter": fmugym.Choice(["short", "", "a longer one"])
            },
            "monitor_names": ["f.String_told"],
            "time_step": 0.1,
            "bounds": {"f.Float64_in": (-1, 1), "f.Float64_out": (-1, 1)},
        }
        super().__init__(source, config)

    def _is_done(self):
        return False


class TestWhereAnFMUStands:
    def test_hooks_read_texts(self, tmp_path):
        path = values_tools.feedthrough_fmu(tmp_path / "F.fmu", 3)
        told = []
        for isolate in (False, True):
            source = FMUSystem({"f": Component(path, isolate=isolate)})
            with contextlib.closing(Telling(source)) as env:
                for seed in range(4):
                    env.reset(seed=seed)
                    env.step(env.action_space.sample())
                    told.append(env.out["f.String_told"])
        assert len(set(told)) > 1
        assert told[:4] == told[4:]

    @pytest.mark.parametrize("isolation", [None, "process"])
    def test_a_vector_environment(self, isolation):
        results = []
        for isolate in (False, True):
            source = chain(bundled_fmu("Pendulum"), isolate=isolate)
            env = fmugym.FMUVectorEnv(lambda s=source: Chain(s, isolation=isolation), 3)
            with contextlib.closing(env):
                results.append(episodes(env))
        assert results[0].tobytes() == results[1].tobytes()

    def test_a_trial_plays_it(self, fmus, tmp_path, monkeypatch):
        monkeypatch.setenv("FMUGYM_CACHE_DIR", str(tmp_path))
        monkeypatch.setenv("FMUGYM_PROBE", "on")
        fmu = SystemFMU(apart(masses([fmus[2], fmus[3]]), "first"))
        spec = PoolSpec((), (fmu.variable("first.y1"),), 0.1)
        pool = opening.make_pool(fmu, spec, 2, LOG)
        with contextlib.closing(pool):
            assert not pool.reset((), np.zeros((0, 2)))[1].any()

    def test_python_refuses_it_by_name(self):
        with pytest.raises(FMULoadError, match="component 'a'"):
            Chain(chain(bundled_fmu("Pendulum"), isolate=True), backend="python")

    @pytest.mark.parametrize("value", [2, "yes", None])
    def test_the_argument_is_a_flag(self, value):
        with pytest.raises(ConfigError, match="isolate"):
            Component(bundled_fmu("Pendulum"), isolate=value)

    def test_an_archive_keeps_it(self, tmp_path):
        archive = chain(bundled_fmu("Pendulum"), isolate=True).write(tmp_path / "chain.ssp")
        plan = FMUSystem.read(archive).plan
        assert [component.isolate for component in plan.components] == [True, False]

    def test_a_pickled_system_keeps_it(self):
        plan = pickle.loads(pickle.dumps(chain(bundled_fmu("Pendulum"), isolate=True))).plan
        assert [component.isolate for component in plan.components] == [True, False]

    def test_info_says_where_each_runs(self, tmp_path, capsys):
        archive = chain(bundled_fmu("Pendulum"), isolate=True).write(tmp_path / "chain.ssp")
        assert cli.main(["info", str(archive)]) == 0
        lines = [line for line in capsys.readouterr().out.splitlines() if "Pendulum.fmu" in line]
        assert [("process of its own" in line) for line in lines] == [True, False]

    def test_a_task_file_says_so(self, tmp_path, capsys):
        task = tmp_path / "task.toml"
        task.write_text(
            """
            time_step = 0.02
            episode_length = 0.2
            reward = "-abs(theta)"
            [system]
            connections = [{ source = "a.theta", target = "b.tau", convert_units = false }]
            [system.components]
            a = { fmu = { bundled = "Pendulum" }, isolate = true }
            b = { bundled = "Pendulum" }
            [variables]
            theta = { name = "b.theta", min = -10, max = 10 }
            tau = { name = "a.tau", min = -1, max = 1 }
            [agent]
            actions = ["tau"]
            observations = ["theta"]
            """
        )
        cli.main(["validate", str(task)])
        told = capsys.readouterr().out
        assert "'a' runs in a process of its own" in told


@pytest.fixture(name="wine", scope="module")
def fixture_wine():
    if reason := wine_tools.why_not():
        pytest.skip(reason)


@pytest.mark.usefixtures("wine")
class TestInWine:
    def test_linear_equations_are_equal_to_the_last_bit(self, make, fmus, tmp_path):
        """The same source, compiled for Windows."""
        path = linear_for_windows(fmus[2], tmp_path)
        plan = masses([fmus[2], fmus[3]])
        rows = play(make(plan, MASSES))
        mixed = masses([path, fmus[3]])
        assert SystemFMU(mixed).whereabouts_by_name == {"first": "wine", "second": "here"}
        assert play(make(mixed, MASSES)).tobytes() == rows.tobytes()

    @pytest.mark.parametrize("version", [1, 2, 3])
    def test_model_exchange(self, make, tmp_path, version):
        """x' = -k x from 1: the closed form."""
        path = wine_tools.exchange_fmu(tmp_path / "Model.fmu", "dahlquist", version)
        pool = make(system([Planned("d", path)], ()), ["d.x"], tolerance=1e-8)
        assert not reset(pool, ["d.k"], [[1.0, 2.0]]).any(), pool.failure(0)
        for _ in range(10):
            assert not pool.step()[1].any()
        np.testing.assert_allclose(pool.outputs[0], np.exp([-1.0, -2.0]), rtol=1e-6)

    def test_a_pendulum_beside_a_native_one(self, tmp_path):
        """The libraries differ in their sine and cosine by rounding."""
        windows = wine_tools.for_windows(bundled_fmu("Pendulum"), tmp_path)
        results = []
        for source in map(chain, (bundled_fmu("Pendulum"), windows)):
            env = fmugym.FMUVectorEnv(lambda s=source: Chain(s), 2)
            with contextlib.closing(env):
                results.append(episodes(env))
        np.testing.assert_allclose(*results, rtol=1e-6, atol=1e-9)

    @pytest.mark.parametrize(
        ("fault", "cause"), [("crash", "Windows error 0xc0000005"), ("hang", "call_timeout")]
    )
    def test_a_death_is_told_with_last_words(self, make, fmus, faulty, tmp_path, fault, cause):
        path = wine_tools.for_windows(faulty, tmp_path)
        plan = with_fault(fmus, path, isolate=False)
        timeout = 2.0 if fault == "hang" else 60.0
        pool = make(plan, ["bad.y"], 2, time_step=0.5, call_timeout=timeout)
        assert not reset(pool, NAMES, asking_for(fault, "none")).any()
        pool.step()
        assert pool.step()[1].tolist() == [4, 0]
        for text in ("component 'bad'", cause, "this is fault"):
            assert text in pool.failure(0)
        assert not reset(pool, NAMES, asking_for("none", "none")).any()

    def test_preload_is_refused_by_name(self, tmp_path):
        windows = wine_tools.for_windows(bundled_fmu("Pendulum"), tmp_path)
        first = fmugym.FMU(windows, preload=["libm.so.6"])
        with pytest.raises(FMULoadError, match=r"component 'a'.*libm"):
            Chain(chain(first))

    def test_info_says_so(self, tmp_path, capsys):
        windows = wine_tools.for_windows(bundled_fmu("Pendulum"), tmp_path)
        archive = chain(windows).write(tmp_path / "chain.ssp")
        assert cli.main(["info", str(archive)]) == 0
        assert "in Wine" in capsys.readouterr().out


def linear_for_windows(path, folder):
    """Copy the FMU of linear equations, of FMI 2.0, with a library for Windows only."""
    shim = "zoo/fmi2.c"
    library = wine_tools.windows_library(
        *("zoo/linear.c", "zoo/usual.c", shim),
        flags=("-DFMI_VERSION=2",),
        stubs=fmu_tools.stubs(2, "fmi2", building.HERE / shim),
    )
    description = fmu_tools.read_fmu(path)["modelDescription.xml"]
    files = {"modelDescription.xml": description, "binaries/win64/Zoo.dll": library}
    return fmu_tools.write_fmu(folder / "linear.fmu", files)
