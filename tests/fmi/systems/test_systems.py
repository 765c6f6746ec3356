"""Systems: what the masters compute, and that a system does what an FMU does."""

from dataclasses import replace
from itertools import product

import container_tools
import exchange_tools
import fmpy
import fmpy_master
import fmu_tools
import numpy as np
import pytest
import system_tools
from combinations import in_turn
from system_tools import (
    by_each_master,
    closing_pools,  # noqa: F401  # the fixture "make"
    compiled,  # noqa: F401  # the fixture "fmus"
    linear,
    masses,
    play,
    system,
    tank,
)

import fmugym
from fmugym import ConfigError, FMULoadError, bundled_fmu
from fmugym.fmi import Status
from fmugym.fmi.systems.system import SystemFMU
from fmugym.fmi.systems.system_plan import MASTERS, ComponentPlan, Connector, End, Group, Link, Loop
from fmugym.pool import PoolSpec

NO_START = ((), np.zeros((0, 1)))


# Correctness

ORDERS = {
    "masses": (masses, system_tools.masses_exactly, ["first.y1", "second.y2"]),
    "tank": (tank, system_tools.tank_exactly, ["tank.y1"]),
}


class TestAgainstClosedForms:
    @in_turn({"name,master": list(product(ORDERS, MASTERS)), "steps": [(1, 1), (1, 4), (3, 2)]})
    def test_errors_are_of_the_first_order_in_the_step_size(self, make, fmus, master, name, steps):
        """Inputs are constant over a step, so half the step size gives half the error."""
        build, exact, outputs = ORDERS[name]
        plan = build([fmus[2], fmus[3]], steps, master=master)
        errors = []
        for count in (24, 48, 96):
            rows = play(make(plan, (), outputs, time_step=2.0 / count), count)
            expected = exact(np.arange(count + 1) * 2.0 / count).T
            errors.append(np.abs(rows - expected).max())
        assert errors[0] / errors[1] == pytest.approx(2.0, rel=0.2)
        assert errors[1] / errors[2] == pytest.approx(2.0, rel=0.1)

    @by_each_master
    def test_the_start_is_exact(self, make, fmus, master):
        """All components exchange values before the first step, in the order of the links."""
        pool = make(masses([fmus[3], fmus[2]], master=master), (), ["second.y1", "first.u1"])
        force = play(pool, 0)[0]
        distance = system_tools.POSITIONS[1] - system_tools.POSITIONS[0]
        assert force.tolist() == [system_tools.COUPLING * distance] * 2

    def test_gauss_seidel_follows_without_delay(self, make, fmus):
        """A chain of gains carries the newest value through in one step, a Jacobi step carries it
        by one component."""
        gain = {"d": [[2, 0], [0, 0]]}
        parts = [linear(name, fmus[2], **gain) for name in "abc"]
        links = (Link("a", "y1", "b", "u1"), Link("b", "y1", "c", "u1"))
        found = {}
        for master in MASTERS:
            pool = make(system(parts, links, master=master), ["a.u1"], ["c.y1"])
            found[master] = play(pool, 3, np.array([1.0, 2.0, 3.0]).reshape(3, 1, 1))[:, 0]
        assert found["gauss_seidel"].tolist() == [0.0, 8.0, 16.0, 24.0]
        assert found["jacobi"].tolist() == [0.0, 0.0, 0.0, 8.0]


def pendulums(master="gauss_seidel", versions=("2.0", "3.0", "2.0"), steps=(1, 2, 3)):
    """Three bundled pendulums in a chain."""
    names = ("a", "b", "c")
    components = tuple(
        ComponentPlan(n, bundled_fmu("Pendulum", v), steps=m, starts=(("q_0", 0.3 * m),))
        for n, v, m in zip(names, versions, steps, strict=True)
    )
    links = (
        Link("a", "theta_dot", "b", "tau", 0.02),
        Link("b", "theta", "c", "tau", -0.03, 0.01),
        Link("c", "theta", "a", "tau", 0.01),
    )
    return system(components, links, master=master)


PENDULUM_OUTPUTS = ["a.theta", "b.theta_dot", "c.q", "c.tau"]


@in_turn(
    {
        "master,versions": list(product(MASTERS, [("2.0", "3.0", "2.0"), ("1.0", "2.0", "1.0")])),
        "substeps": [1, 3],
        "warm_up": [0, 2],
    }
)
def test_steps_are_those_of_a_loop_over_fmpy(make, master, versions, substeps, warm_up):
    plan = pendulums(master, versions)
    options = {"substeps": substeps, "start_time": 0.5, "warm_up_steps": warm_up}
    rows = play(make(plan, (), PENDULUM_OUTPUTS, time_step=0.02, **options), 50)
    steps = [{}] * substeps * (50 + warm_up)
    expected = fmpy_master.play(plan, PENDULUM_OUTPUTS, steps, 0.02 / substeps, 0.5)
    expected = expected[::substeps][warm_up:]
    assert np.abs(rows).max() > 0.1
    np.testing.assert_allclose(rows, expected, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("versions", [(1, 2), (2, 1), (3, 3), (1, 1)])
def test_model_exchange_and_co_simulation_go_together(make, fmus, tmp_path, versions):
    """x' = 0.5 x - x with its solver beside a gain; two episodes of the same instance."""
    pool = make(
        decay_with_gain(tmp_path, fmus, versions), (), ["decay.x", "gain.y1"], time_step=0.02
    )
    rows = play(pool, 50)
    assert play(pool, 50).tobytes() == rows.tobytes()
    assert np.allclose(rows[:, 0], np.exp(-0.5 * np.arange(51) * 0.02), atol=0.01)


def decay_with_gain(folder, fmus, versions=(2, 1)):
    path = exchange_tools.exchange_fmu(folder / "decay.fmu", "dahlquist", versions[0])
    decay = ComponentPlan("decay", path, starts=(("k", 1.0), ("x", 1.0)))
    gain = linear("gain", fmus[versions[1]], d=[[0.5, 0], [0, 0]])
    links = (Link("decay", "x", "gain", "u1"), Link("gain", "y1", "decay", "u"))
    return system((decay, gain), links)


# Algebraic loops


def loop_of_gains(fmus, loop, gains=(0.5, -0.6), **options):
    """a = 0.5 b + u, b = -0.6 a: both follow at once."""
    a = linear("a", fmus[2], d=[[gains[0], 1], [0, 0]])
    b = linear("b", fmus[3], d=[[gains[1], 0], [0, 0]])
    links = (Link("a", "y1", "b", "u1"), Link("b", "y1", "a", "u1"))
    return system((a, b), links, loop, **options)


class TestLoops:
    def test_are_solved_within_the_tolerance(self, make, fmus):
        plan = loop_of_gains(fmus, Loop(1e-10))
        pool = make(plan, ["a.u2"], ["a.y1", "b.y1"])
        rows = play(pool, 3, np.array([1.0, -2.0, 5.0]).reshape(3, 1, 1))
        expected = np.array([0.0, 1.0, -2.0, 5.0]) / (1 + 0.3)
        assert np.allclose(rows[:, 0], expected, rtol=1e-9, atol=1e-12)
        assert np.allclose(rows[:, 1], -0.6 * expected, rtol=1e-9, atol=1e-12)

    def test_are_solved_only_before_the_first_step_by_jacobi(self, make, fmus):
        pool = make(loop_of_gains(fmus, Loop(), master="jacobi"), ["a.u2"], ["a.y1", "b.y1"])
        pool.reset((pool.variable("a.u2"),), np.array([[2.6]]))
        rows = [pool.outputs[:, 0].copy(), *(pool.step([[2.6]])[0][:, 0].copy() for _ in range(3))]
        a, b = np.array(rows).T
        assert (a[0], b[0]) == pytest.approx((2.0, -1.2))
        assert a[1:] == pytest.approx(0.5 * b[:-1] + 2.6)
        assert b[1:] == pytest.approx(-0.6 * a[:-1])

    @by_each_master
    def test_of_components_that_cannot_repeat_a_step_are_not_solved(self, make, fmus, master):
        """FMI 1.0 knows neither saved states nor an Initialization Mode."""
        parts = loop_of_gains(fmus | {2: fmus[1]}, None).components
        loop = fmugym.FMUSystem(
            {one.name: fmugym.Component(one.path, dict(one.starts)) for one in parts},
            ["a.y1 -> b.u1", "b.y1 -> a.u1"],
            master=master,
        )
        rows = play(make(loop, ["a.u2"], ["a.y1", "b.y1"]), 3, np.full((3, 1, 1), 2.6))
        a, b = rows.T
        assert (a[0], b[0]) == (0.0, 0.0)
        assert a[1:] == pytest.approx(0.5 * b[:-1] + 2.6, rel=1e-12)
        newest = a[1:] if master == "gauss_seidel" else a[:-1]
        assert b[1:] == pytest.approx(-0.6 * newest, rel=1e-12)

    def test_through_fmi_1_begins_with_its_start_values(self, make, fmus):
        a = linear("a", fmus[1], d=[[0.5, 1], [0, 0]])
        values = dict(a.starts) | {"u1": 4.0, "u2": 1.0}
        b = fmugym.Component(fmus[3], dict(linear("b", fmus[3], d=[[2, 0], [0, 0]]).starts))
        loop = fmugym.FMUSystem(
            {"a": fmugym.Component(a.path, values), "b": b}, ["a.y1 -> b.u1", "b.y1 -> a.u1"]
        )
        outputs, statuses = make(loop, (), ["b.u1", "b.y1"]).reset(*NO_START)
        assert not statuses.any()
        assert outputs[:, 0].tolist() == [3.0, 6.0]

    def test_that_are_not_solved_are_told(self, fmus):
        parts = {"a": fmus[1], "b": fmus[2], "c": fmus[3]}
        links = ["a.y1 -> b.u1", "b.y1 -> a.u1", "b.y2 -> c.u1", "c.y1 -> b.u2"]
        loop = fmugym.FMUSystem(parts, links)
        groups = [(group.components, group.loop is not None) for group in loop.plan.groups]
        assert groups == [(("a",), False), (("b", "c"), True)]
        for fact in ("a cannot save its FMU state", "a is an FMU of FMI 1.0"):
            assert any(finding.startswith(fact) for finding in loop.findings)
        assert not any(
            "cannot save" in finding
            for finding in fmugym.FMUSystem(parts, links, master="jacobi").findings
        )
        with pytest.raises(ConfigError, match="algebraic loop"):
            fmugym.FMUSystem(parts, links, loops="refuse")

    def test_a_gain_above_one_is_solved(self, make, fmus):
        pool = make(loop_of_gains(fmus, Loop(), (2.0, 3.0)), ["a.u2"], ["a.y1"])
        pool.reset(*NO_START)
        outputs, statuses = pool.step(np.array([[1.0]]))
        assert statuses.tolist() == [Status.OK]
        assert outputs[0, 0] == pytest.approx(1 / (1 - 6))

    def test_without_a_solution_names_its_components(self, make, fmus):
        """a = b + u, b = a."""
        pool = make(loop_of_gains(fmus, Loop(), (1.0, 1.0)), ["a.u2"], ["a.y1"])
        pool.reset(*NO_START)
        assert pool.step(np.array([[1.0]]))[1].tolist() == [Status.DISCARD]
        for word in ("loop", "'a'", "'b'"):
            assert word in pool.failure(0)

    def test_repeat_the_dynamics_from_the_beginning_of_the_step(self, make, fmus):
        """The coupled masses as a loop: what both compute agrees with what both got."""
        plan = masses([fmus[2], fmus[3]])
        loop = Loop(1e-12)
        plan = replace(plan, groups=(Group(("first", "second"), loop),))
        outputs = ["first.y1", "first.y2", "second.u1", "second.u2", "second.y1", "first.u1"]
        rows = play(make(plan, (), outputs, time_step=0.05), 20)
        assert np.allclose(rows[1:, :2], rows[1:, 2:4], rtol=0, atol=1e-11)
        assert np.allclose(rows[1:, 4], rows[1:, 5], rtol=0, atol=1e-11)


def test_jacobi_steps_are_those_of_the_container_of_fmpy(make, tmp_path):
    links = (("a", "theta_dot", "b", "tau"), ("b", "theta", "c", "tau"))
    starts = {"a": 0.3, "b": 0.6, "c": 0.9}
    path = bundled_fmu("Pendulum", "3.0")
    names = {f"{name}.{v}": (name, v) for v in ("theta", "q_0") for name in starts}
    file = container_tools.container(tmp_path, path, list(starts), links, names, 0.02)
    found = fmpy.simulate_fmu(
        str(file),
        stop_time=1.0,
        step_size=0.02,
        output_interval=0.02,
        start_values={f"{name}.q_0": value for name, value in starts.items()},
        output=[f"{name}.theta" for name in starts],
        validate=False,
    )
    components = [ComponentPlan(n, path, starts=(("q_0", q),)) for n, q in starts.items()]
    plan = system(components, [Link(*link) for link in links], master="jacobi")
    rows = play(make(plan, (), [f"{n}.theta" for n in starts], time_step=0.02), 50)
    expected = np.array([found[f"{name}.theta"] for name in starts]).T
    assert np.allclose(rows, expected, rtol=0, atol=1e-9)


# Names, values and faults


class TestValues:
    def test_connectors_stand_for_variables_in_other_units(self, make, fmus):
        """One input for two components; an output and a parameter in other units."""
        parts = [
            linear(n, fmus[v], b=[[1, 0], [0, 0]], c=np.eye(2)) for n, v in (("a", 2), ("b", 3))
        ]
        connectors = (
            Connector("push", (End("a", "u1", 2.0), End("b", "u1", 1.0, 0.5)), "input"),
            Connector("level", (End("b", "y1", 100.0, -1.0),), "output", "cm"),
            Connector("start", (End("b", "x1_0", 0.01),), "parameter"),
        )
        plan = system(parts, (), connectors=connectors)
        pool = make(plan, ["push"], ["a.y1", "level"])
        outputs, _ = pool.reset((pool.variable("start"),), np.array([[30.0]]))
        assert outputs[:, 0] == pytest.approx([0.0, 29.0])
        outputs, _ = pool.step(np.array([[3.0]]))
        assert outputs[:, 0] == pytest.approx([0.6, 29.0 + 35.0])

    def test_types_are_converted_by_each_component(self, make, tmp_path):
        """A Real drives an Integer and a Boolean; Enumerations of FMI 2.0 and 3.0 are read."""
        probes = [fmu_tools.probe_fmu(tmp_path, v) for v in (2, 3)]
        parts = tuple(ComponentPlan(n, p) for n, p in zip("ab", probes, strict=True))
        links = (Link("a", "steps", "b", "n"), Link("b", "on_out", "a", "free"))
        names = ["b.n_out", "a.free_out", "a.mode_out", "b.mode_out"]
        pool = make(system(parts, links), ["b.on", "a.mode", "b.mode"], names)
        rows = play(pool, 2, np.array([[[1.0], [2.0], [5.0]]] * 2))
        assert rows[-1, 2:].tolist() == [2.0, 5.0]
        assert rows[-1, 1] == 1.0

    def test_capabilities_are_those_of_all(self, fmus):
        able = SystemFMU(masses([fmus[2], fmus[2]])).description.capabilities
        less = SystemFMU(masses([fmus[2], fmus[3]])).description.capabilities
        least = SystemFMU(masses([fmus[1], fmus[2]])).description.capabilities
        assert (able.can_get_and_set_fmu_state, able.can_serialize_fmu_state) == (True, True)
        assert (less.can_get_and_set_fmu_state, less.can_serialize_fmu_state) == (True, False)
        assert not least.can_get_and_set_fmu_state
        assert least.can_handle_variable_communication_step_size


class TestFaults:
    @by_each_master
    def test_end_one_system_and_name_the_component(self, make, fmus, master):
        plan = masses([fmus[2], fmus[2]], master=master)
        pool = make(plan, (), ["first.y1"], 3)
        start = tuple(map(pool.variable, ("second.fails", "second.status")))
        pool.reset(start, np.array([[0.25] * 3, [0.0, 3.0, 0.0]]))
        for expected in (0, 0, Status.ERROR):
            _, statuses = pool.step()
            assert statuses.tolist() == [0, expected, 0]
        assert "component 'second'" in pool.failure(1)
        assert "t = 0.2" in pool.failure(1)
        mask = np.array([False, True, False])
        outputs, statuses = pool.reset(start, np.zeros((2, 3)), mask)
        assert not statuses.any()
        assert outputs[0, 1] == system_tools.POSITIONS[0]

    def test_a_component_that_asks_to_stop_stops_the_system(self, make, fmus):
        plan = masses([fmus[2], fmus[3]])
        pool = make(plan, (), ["first.t", "second.t"])
        start = tuple(map(pool.variable, ("first.fails", "first.status")))
        pool.reset(start, np.array([[0.15], [1.0]]))
        pool.step()
        outputs, statuses = pool.step()
        assert statuses.tolist() == [Status.TERMINATED]
        assert outputs[:, 0] == pytest.approx([0.2, 0.2])

    def test_no_component_gets_what_is_no_number(self, make, fmus):
        big = linear("big", fmus[2], (1e200, 0.0), c=[[1e200, 0], [0, 0]])
        plan = system((linear("a", fmus[3]), big), (Link("big", "y1", "a", "u1"),))
        pool = make(plan, (), ["a.y1"])
        _, statuses = pool.reset(*NO_START)
        assert statuses[0] > Status.WARNING
        assert "component 'big'" in pool.failure(0)
        assert "not finite" in pool.failure(0)

    def test_discarded_steps_are_repeated_as_smaller_ones_of_all(self, make, fmus):
        """One component accepts only steps of at most 0.03 s, so the system does four of 0.025."""
        plan = masses([fmus[2], fmus[2]])
        limited = make(plan, (), ["first.y1", "second.y2"], time_step=0.1, fault_retries=3)
        fine = make(plan, (), ["first.y1", "second.y2"], time_step=0.025)
        outputs, _ = limited.reset((limited.variable("second.limit"),), np.array([[0.03]]))
        fine.reset(*NO_START)
        for _ in range(5):
            outputs, statuses = limited.step()
            assert not statuses.any()
            for _ in range(4):
                expected, _ = fine.step()
            assert np.allclose(outputs, expected, rtol=0, atol=1e-13)

    def test_an_fmu_that_cannot_be_loaded_is_named(self, make, fmus, tmp_path):
        files = fmu_tools.read_fmu(fmus[2])
        name = next(name for name in files if name.startswith("binaries"))
        files[name] = files[name][:-9000]
        broken = fmu_tools.write_fmu(tmp_path / "broken.fmu", files)
        with pytest.raises(FMULoadError, match=r"component 'second'.*broken\.fmu"):
            make(masses([fmus[2], broken]))


# States


# Where an FMU stands


def test_the_house_of_trials_takes_a_system(fmus, tmp_path, monkeypatch):
    """A trial plays it in a process of its own, and its verdict is kept by content."""
    monkeypatch.setenv("FMUGYM_CACHE", str(tmp_path))
    from fmugym.pool.trial.trial import examine
    from fmugym.pool.trial.verdict import known_verdict

    fmu = SystemFMU(masses([fmus[2], fmus[3]]))
    spec = PoolSpec((), (fmu.variable("first.y1"),), 0.1)
    verdict = examine(fmu, spec, num_instances=2, length=100)
    assert verdict.complete
    assert verdict.deterministic
    assert str(verdict.reset_method) == "restore"
    assert verdict.neighbours == "independent"
    assert known_verdict(SystemFMU(masses([fmus[2], fmus[3]]))) is not None
    other = masses([fmus[2], fmus[3]], steps=(2, 1))
    assert known_verdict(SystemFMU(other)) is None
