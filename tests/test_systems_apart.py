"""Components of a system in processes of their own, isolated ones: what they compute.

What a system computes does not depend on where its components run.
"""

import contextlib
import pickle
from dataclasses import replace

import clocks_tools
import exchange_tools
import fmu_tools
import numpy as np
import pytest
import ssp_tools
import values_tools
from apart_tools import (  # noqa: F401  # some are fixtures
    LOG,
    MASSES,
    Chain,
    apart,
    chain,
    children,
    closing_pools,
    compiled,
    episodes,
    play,
    reset,
    where_they_run,
)
from system_tools import linear, masses, system

import fmugym
from fmugym import (
    Component,
    ConfigError,
    FMUSystem,
    bundled_fmu,
)
from fmugym.pool import PoolSpec
from fmugym.pool.bundle import SaveMethod
from fmugym.pool.spec import ResetMethod
from fmugym.systems.fmu import SystemFMU
from fmugym.systems.plan import Component as Planned
from fmugym.systems.plan import Connector, End, Link, Loop
from fmugym.tools import cli
from fmugym.trial import opening

pytestmark = where_they_run


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

    @pytest.mark.parametrize("value", [2, "yes", None])
    def test_the_argument_is_a_flag(self, value):
        with pytest.raises(ConfigError, match="isolate"):
            Component(bundled_fmu("Pendulum"), isolate=value)

    def test_an_archive_keeps_it(self, tmp_path):
        archive = ssp_tools.write(
            chain(bundled_fmu("Pendulum"), isolate=True), tmp_path / "chain.ssp"
        )
        plan = FMUSystem.read(archive).plan
        assert [component.isolate for component in plan.components] == [True, False]

    def test_a_pickled_system_keeps_it(self):
        plan = pickle.loads(pickle.dumps(chain(bundled_fmu("Pendulum"), isolate=True))).plan
        assert [component.isolate for component in plan.components] == [True, False]

    def test_info_says_where_each_runs(self, tmp_path, capsys):
        archive = ssp_tools.write(
            chain(bundled_fmu("Pendulum"), isolate=True), tmp_path / "chain.ssp"
        )
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
