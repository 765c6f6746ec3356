"""Systems in worker processes: what they compute, how these die, and which systems go there.

What a system computes does not depend on where it runs.
"""

import pickle
from dataclasses import replace

import clocks_tools
import exchange_tools
import fmu_tools
import numpy as np
import pytest
import quirk_table
import source_tools
import ssp_tools
import values_tools
from pool_tools import open_pool, reset, start, step
from process_tools import (
    faulty_fmu,
    fixture_faulty,  # noqa: F401  # the fixture "faulty"
    start_values,
)
from system_tools import (
    compiled,  # noqa: F401  # the fixture "fmus"
    linear,
    masses,
    system,
)

import fmugym
from fmugym import Component, ConfigError, Connection, FMULoadError, FMUSystem, bundled_fmu
from fmugym.fmi.systems.system import SystemFMU
from fmugym.fmi.systems.system_plan import ComponentPlan as Planned
from fmugym.fmi.systems.system_plan import Connector, End, Link, Loop
from fmugym.fmi.wine import can_run_windows
from fmugym.pool.native_pool import NativePool
from fmugym.pool.pool_spec import ResetMethod
from fmugym.pool.processes.process_pool import ProcessPool

MASSES = ["first.y1", "second.y2"]


@pytest.fixture(name="make")
def closing_pools(opened):
    """Make pools of plans as environments do; they are closed after the test."""

    def make(plan, outputs, inputs=(), count=2, time_step=0.1, spec=None, **options):
        fmu = SystemFMU(plan)
        return opened(open_pool(fmu, inputs, outputs, time_step, count, options, **(spec or {})))

    return make


def isolated(plan):
    """The same plan with ``isolate=True`` for one component, the last one."""
    *others, last = plan.components
    return replace(plan, components=(*others, replace(last, isolate=True)))


def play(pool, steps=10, inputs=None):
    """Reset and step; the outputs, shape (steps + 1, k, N)."""
    rows = [start(pool).outputs.copy()]
    given = [()] * steps if inputs is None else inputs
    return np.array(rows + [step(pool, *given[k]) for k in range(steps)])


# The plan of a system, the names of its outputs and inputs, and what the pool does, each a function
# of the FMUs of linear equations and of a folder.


def coupled(versions):
    return lambda fmus, _: (masses([fmus[v] for v in versions], (2, 1)), MASSES, (), {})


def loop(master):
    def make(fmus, _):
        direct = {"a": [[-1, 0], [0, 0]], "c": [[1, 0], [0, 0]], "d": [[0.5, 0], [0, 0]]}
        parts = (
            linear("p", fmus[2], (1.0, 0.0), **direct),
            linear("q", fmus[3], (-0.4, 0.0), **direct),
        )
        links = (Link("p", "y1", "q", "u1"), Link("q", "y1", "p", "u1"))
        return system(parts, links, Loop(), master=master), ["p.y1", "q.y1"], (), {}

    return make


def ball(version):
    def make(_, folder):
        path = exchange_tools.exchange_fmu(folder / "Ball.fmu", "ball", version)
        plan = system([Planned("ball", path, "model_exchange")], ())
        return plan, ["ball.h", "ball.v"], (), {"solver": "rk4"}

    return make


def discarding(fmus, _):
    """Steps that are too long are repeated in parts."""
    plan = masses([fmus[2], fmus[2]])
    first = replace(plan.components[0], starts=(*plan.components[0].starts, ("limit", 0.06)))
    return replace(plan, components=(first, plan.components[1])), MASSES, (), {"fault_retries": 2}


def arrays(_, folder):
    """Their sizes differ from those that the FMU has by itself."""
    path = values_tools.state_space_fmu(folder / "S.fmu")
    sizes = {"n": 3, "m": 2, "r": 2}
    starts = {
        "A": (-np.eye(3) + 0.1).tolist(),
        "B": np.full((3, 2), 0.3).tolist(),
        "C": np.arange(6.0).reshape(2, 3).tolist(),
        "D": np.zeros((2, 2)).tolist(),
        "x_0": [1.0, -0.5, 0.25],
    }
    one = Component(path, sizes | starts, feedthrough=False)
    both = FMUSystem({"p": one, "q": one}, ["p.y -> q.u", "q.y -> p.u"])
    return both.plan, [f"{name}.y[{i}]" for name in "pq" for i in (1, 2)], (), {}


def types(version):
    def make(_, folder):
        plan = system([Planned("f", values_tools.feedthrough_fmu(folder / "F.fmu", version))], ())
        variables = SystemFMU(plan).description.variables.values()
        inputs, outputs = (
            [
                one.name
                for v in variables
                if v.is_number and v.causality == causality
                for one in v.elements
            ]
            for causality in ("input", "output")
        )
        return plan, outputs, inputs, {}

    return make


def clocks(_, folder):
    plan = system([Planned("c", clocks_tools.clocks_fmu(folder / "C.fmu", "CoSimulation"))], ())
    outputs = [f"c.count of {name}" for name in clocks_tools.CLOCKS]
    outputs += ["c.x", "c.sample", "c.bell", "c.strike", "c.countdown"]
    return plan, outputs, ["c.strike", "c.command", "c.pace"], {}


KINDS = {
    "FMI 1 and 2": coupled((1, 2)),
    "FMI 3 and 1": coupled((3, 1)),
    "loop": loop("gauss_seidel"),
    "loop of jacobi": loop("jacobi"),
    "model exchange of FMI 1": ball(1),
    "model exchange of FMI 3": ball(3),
    "discarded steps": discarding,
    "arrays": arrays,
    "types of FMI 2": types(2),
    "types of FMI 3": types(3),
    "clocks": clocks,
}


class TestResults:
    """They equal those of systems in this process to the last bit."""

    @pytest.mark.parametrize("kind", KINDS)
    def test_of_each_kind(self, make, fmus, tmp_path, kind):
        plan, outputs, inputs, spec = KINDS[kind](fmus, tmp_path)
        given = np.random.default_rng(0).integers(0, 2, (20, len(inputs), 2)) / 1.0
        if "c.pace" in inputs:
            given[:, 2] += 0.3
        here = make(plan, outputs, inputs, spec=spec)
        there = make(isolated(plan), outputs, inputs, spec=spec, workers=2)
        assert (type(here), type(there)) == (NativePool, ProcessPool)
        rows = play(here, 20, given)
        assert np.ptp(rows, axis=0).max() > 0
        for _ in range(2):
            assert play(there, 20, given).tobytes() == rows.tobytes()
        assert there.health()["retries"].sum() == 2 * here.health()["retries"].sum()
        assert (here.health()["retries"].sum() > 0) == (kind == "discarded steps")

    @pytest.mark.parametrize("method", ResetMethod)
    def test_episodes_begin_by_each_method(self, make, fmus, method):
        plan = masses([fmus[2], fmus[3]])
        rows = play(make(plan, MASSES))
        pool = make(isolated(plan), MASSES, reset_method=method)
        for _ in range(4):
            assert play(pool).tobytes() == rows.tobytes()

    def test_values_that_are_set_and_read_between_steps(self, make, fmus):
        plan = masses([fmus[2], fmus[3]])
        connector = Connector("push", (End("first", "u2", 2.0), End("second", "u2")), "input")
        plan = replace(plan, connectors=(connector,), links=plan.links[::2])
        plan = replace(plan, initialization=plan.initialization[:2])
        rows = []
        for one in (plan, isolated(plan)):
            pool = make(one, MASSES, ["push"])
            start(pool, {"second.x1_0": [0.3, -0.2]})
            for k in range(6):
                pool.step(np.array([[0.1 * k, -0.2]]))
                rows.append(pool.outputs.tobytes())
            pool.write((pool.variable("first.a21"),), np.array([[-9.0, -8.0]]))
            read = pool.read(tuple(map(pool.variable, ["first.a21", "second.x1_0", "first.t"])))
            rows.append(read.tobytes())
            pool.step(np.array([[0.5, 0.5]]))
            rows.append(pool.outputs.tobytes())
        assert rows[:8] == rows[8:]

    @pytest.mark.parametrize("version", [1, 2, 3])
    def test_strings_and_messages(self, make, tmp_path, caplog, version):
        """The FMU logs its String; the message names the system and the component."""
        probe = fmu_tools.probe_fmu(tmp_path, version)
        plan = system([Planned("loud", probe, starts=(("label", "Ümlaut"),))], ())
        told = []
        for one in (plan, isolated(plan)):
            pool = make(one, ["loud.sum"])
            caplog.clear()
            start(pool, {"loud.log_status": [-1.0, 1.0]})
            pool.step()
            told.append([r.getMessage() for r in caplog.records if "loud" in r.getMessage()])
        assert any("system_1.loud" in text and "Ümlaut is 100%" in text for text in told[0])
        assert sorted(told[0]) == sorted(told[1])


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


def chain(first=None, **options):
    """Two pendulums, of which the first drives the second."""
    pendulum = bundled_fmu("Pendulum")
    components = {"a": Component(first or pendulum, **options), "b": pendulum}
    connection = Connection("a.theta", "b.tau", gain=0.5, convert_units=False)
    return FMUSystem(components, [connection], step_size=0.02)


class TestFaults:
    NAMES = tuple(f"bad.{name}" for name in start_values())

    @pytest.mark.parametrize(
        ("fault", "cause"),
        [("crash", "signal SIGSEGV"), ("exit", "exit status 0"), ("hang", "call_timeout")],
    )
    def test_one_ends_the_episodes_of_its_worker(self, make, fmus, faulty, fault, cause):
        parts = (
            linear("sound", fmus[2], (1.0, 0.0), a=[[-1, 0], [0, 0]], c=np.eye(2)),
            Planned("bad", faulty),
        )
        plan = isolated(system(parts, [Link("sound", "y1", "bad", "u")]))
        options = {"workers": 2, "call_timeout": 1.0 if fault == "hang" else 60.0}
        pool = make(plan, ("bad.y", "sound.y1"), count=4, time_step=0.5, **options)

        def values(*faults):
            given = np.array([list(start_values(one).values()) for one in faults], float).T
            return dict(zip(self.NAMES, given, strict=True))

        start(pool, values(fault, "none", "none", "none"))
        pool.step()
        before = pool.outputs.copy()
        _, statuses = pool.step()
        assert statuses.tolist() == [4, 4, 0, 0]
        assert pool.outputs[:, :2].tobytes() == before[:, :2].tobytes()
        for text in (cause, "this is fault"):
            assert text in pool.failure(0)
        mask = np.array([True, True, False, False])
        reset(pool, values(*["none"] * 4), mask)
        assert not pool.step()[1].any()
        assert pool.outputs[0, 0] == pool.outputs[0, 1] == before[0, 0]

    def test_a_library_that_cannot_be_loaded_is_named(self, make, fmus, tmp_path):
        from fmugym import _native

        files = fmu_tools.read_fmu(fmus[2])
        library = next(name for name in files if name.startswith("binaries/"))
        with open(_native.__file__, "rb") as file:
            files[library] = file.read()
        broken = fmu_tools.write_fmu(tmp_path / "Broken.fmu", files)
        plan = isolated(masses([fmus[2], broken]))
        with pytest.raises(FMULoadError, match="'second': it does not export fmi2"):
            make(plan, MASSES)


class TestChoice:
    def test_an_environment_wins(self, make, fmus):
        plan = isolated(masses([fmus[2], fmus[2]]))
        assert isinstance(make(plan, MASSES, isolation="none"), NativePool)

    @pytest.mark.parametrize("value", [2, "yes", None])
    def test_the_argument_is_a_flag(self, value):
        with pytest.raises(ConfigError, match="isolate"):
            Component(bundled_fmu("Pendulum"), isolate=value)

    def test_a_trial_moves_the_whole_system(self, make, fmus, tmp_path, monkeypatch, caplog):
        """It finds a component of which a process can have one instance only."""
        monkeypatch.setenv("FMUGYM_CACHE_DIR", str(tmp_path))
        monkeypatch.setenv("FMUGYM_PROBE", "on")
        alone = Planned("bad", faulty_fmu(tmp_path, "{lonely}"))
        plan = system([linear("sound", fmus[2]), alone], [Link("sound", "y1", "bad", "u")])
        pool = make(plan, ["bad.y"], count=3)
        assert len(pool.processes()) == 3
        assert "each gets a process" in caplog.text
        play(pool)

    def test_two_components_of_an_fmu_that_can_be_there_once(self, make, tmp_path):
        """Each has a copy of its library: the two share a process."""
        rows = []
        for token in ("well behaved", "globals"):
            quirk = quirk_table.quirk_fmu(tmp_path / token, 2, token)
            flag = {"<CoSimulation ": '<CoSimulation canBeInstantiatedOnlyOncePerProcess="true" '}
            path = fmu_tools.edited_fmu(quirk, tmp_path / token, flag)
            both = FMUSystem({"a": Component(path, {"gain": 2.0}), "b": path}, ["a.y -> b.u"])
            pool = make(both.plan, ["a.y", "b.y"], ["a.u"])
            assert len(pool.processes()) == 2
            rows.append(play(pool, 10, np.random.default_rng(0).normal(size=(10, 1, 2))))
        assert np.ptp(rows[0]) > 0
        assert rows[0].tobytes() == rows[1].tobytes()

    def test_a_copy_keeps_it(self):
        plan = pickle.loads(pickle.dumps(chain(isolate=True))).plan
        assert [component.isolate for component in plan.components] == [True, False]

    def test_info_says_so(self, tmp_path, ran):
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
        told = ran("info", task)
        lines = [line for line in told.splitlines() if "Pendulum.fmu" in line]
        assert [("isolated" in line) for line in lines] == [True, False]
        assert "runs here, in worker processes" in told


@pytest.mark.skipif(not can_run_windows(), reason="Wine runs on Linux on x86_64 only")
class TestLibrariesForWindows:
    """A system runs in one process, in Wine or outside."""

    @pytest.fixture(name="windows")
    def for_windows(self, tmp_path):
        others = ["binaries/linux64/", "binaries/darwin64/"]
        return fmu_tools.edited_fmu("Pendulum", tmp_path, drop=others)

    def test_a_mix_is_refused_by_name(self, windows):
        with pytest.raises(FMULoadError, match=r"Windows only are 'a', .*'b'.*'a' for Linux"):
            Chain(chain(windows))

    def test_a_system_of_them_alone_runs_in_wine(self, windows, monkeypatch):
        monkeypatch.setattr("fmugym.fmi.fmu.obstacle_to_wine", lambda: "")
        fmu = FMUSystem({"a": windows, "b": windows}).as_fmu()
        assert fmu.in_wine
        assert not fmu.obstacles

    def test_what_wine_lacks_is_told_for_each(self, windows, monkeypatch):
        monkeypatch.setattr("fmugym.fmi.fmu.obstacle_to_wine", lambda: "install Wine")
        obstacles = FMUSystem({"a": windows, "b": windows}).as_fmu().obstacles
        assert ["'a'" in obstacles[0], "'b'" in obstacles[1]] == [True, True]
        assert all("install Wine" in text for text in obstacles)

    def test_info_says_so(self, windows, tmp_path, ran):
        archive = ssp_tools.write(chain(windows), tmp_path / "chain.ssp")
        told = ran("info", archive)
        assert "does NOT run here" in told
        assert "Windows only are 'a'" in told
        assert "install Wine" not in told

    def test_source_code_is_a_cure(self, tmp_path):
        library = {"binaries/win64/Model.dll": b"MZ"}
        source = source_tools.write_source_fmu(tmp_path / "of code.fmu", 2, library)
        mixed = FMUSystem({"a": source, "b": bundled_fmu("Pendulum")})
        (obstacle,) = mixed.as_fmu().obstacles
        assert "fmugym info --repair 'of code.fmu'" in obstacle
