"""Step sizes that follow from an estimate of the error.

The reference are closed forms of coupled masses and of a tank with a controller, and the pendulum
as one FMU.
"""

import os
import pickle
from dataclasses import replace

import numpy as np
import pytest
from system_tools import (
    COUPLING,
    DAMPING,
    LOG,
    MASS,
    POSITIONS,
    STIFFNESS,
    by_each_master,
    linear,
    linear_fmu,
    masses,
    masses_exactly,
    parted_pendulum,
    system,
    tank,
    tank_exactly,
    whole_pendulum,
)
from test_systems import pendulums

import fmugym
from fmugym import ConfigError, FMUSystem, bundled_fmu
from fmugym.fmi.status import Status
from fmugym.pool import PoolSpec
from fmugym.pool.bundle import SaveMethod
from fmugym.pool.local import local_pool
from fmugym.systems.fmu import SystemFMU
from fmugym.systems.plan import MASTERS, Control, Link, Loop

STATISTICS = ("master.steps", "master.rejected_steps", "master.step_size", "master.error")


@pytest.fixture(scope="module", name="fmus")
def compiled(tmp_path_factory):
    folder = tmp_path_factory.mktemp("linear")
    return {v: linear_fmu(folder / f"linear{v}.fmu", v) for v in (1, 2, 3)}


def run(plan, names, step, count, instances=1, stop=False):
    """The values before the first step and after each, shape (count + 1, names)."""
    fmu = SystemFMU(plan)
    outputs = tuple(map(fmu.variable, names))
    pool = local_pool(fmu, PoolSpec((), outputs, step), instances, LOG)
    try:
        rows = [pool.reset((), np.zeros((0, instances)))[0][:, 0].copy()]
        for _ in range(count):
            values, statuses = pool.step()
            rows.append(values[:, 0].copy())
            if stop and statuses[0]:
                return np.array(rows), int(statuses[0]), pool.failure(0)
            assert statuses[0] <= Status.WARNING, pool.failure(0)
    finally:
        pool.close()
    return np.array(rows)


def controlled(plan, tolerance, smallest=None):
    return replace(plan, control=Control(tolerance, smallest))


def coupled(paths, **options):
    """The masses of ``system_tools.masses``, of which each feels where the other one is.

    No output follows an input at once.
    """
    (m1, m2), (k1, k2), k, d = MASS, STIFFNESS, COUPLING, DAMPING
    parts = [
        linear(
            name,
            path,
            (x0, 0.0),
            a=[[0, 1], [-(own + k) / m, -d / m]],
            b=[[0, 0], [k / m, d / m]],
            c=np.eye(2),
        )
        for name, path, x0, own, m in zip(
            ("first", "second"), paths, POSITIONS, (k1, k2), (m1, m2), strict=True
        )
    ]
    pairs = (("first", "second"), ("second", "first"))
    links = [Link(a, f"y{i}", b, f"u{i}") for a, b in pairs for i in (1, 2)]
    return system(parts, links, **options)


NAMES = {"masses": ("first.y1", "second.y2"), "tank": ("tank.y1",)}
NAMES["coupled"] = ("first.y1", "second.y1")
MODELS = {
    "masses": (masses, masses_exactly),
    "tank": (tank, tank_exactly),
    "coupled": (coupled, masses_exactly),
}


def error_of(name, fmus, tolerance, master):
    """The largest error against the closed form within 4 s, and the number of steps."""
    make, exact = MODELS[name]
    plan = controlled(make([fmus[2], fmus[3]], master=master), tolerance)
    rows = run(plan, (*NAMES[name], "master.steps"), 0.5, 8)
    expected = exact(np.arange(9) * 0.5).T
    return np.abs(rows[:, :-1] - expected).max(), rows[-1, -1]


class TestAgainstClosedForms:
    @pytest.mark.parametrize(
        ("name", "master"), [(name, MASTERS[0]) for name in MODELS] + [("coupled", MASTERS[1])]
    )
    def test_the_error_falls_with_the_root_of_the_tolerance(self, fmus, name, master):
        """Steps are as long as the root of the tolerance, and the methods are of order 1."""
        large, few = error_of(name, fmus, 1e-4, master)
        small, many = error_of(name, fmus, 1e-6, master)
        assert 5 < large / small < 20
        assert 5 < many / few < 20

    def test_a_value_that_comes_a_step_late_counts_as_an_error(self, fmus):
        """In Jacobi steps, what follows an input at once follows it a step later."""
        few = error_of("tank", fmus, 1e-3, "gauss_seidel")[1]
        error, many = error_of("tank", fmus, 1e-3, "jacobi")
        assert many > 5 * few
        assert error < 2e-3

    @by_each_master
    def test_the_error_is_near_that_of_steps_of_one_size(self, fmus, master):
        """At the same number of steps, control is no worse where all is equally fast."""
        error, steps = error_of("coupled", fmus, 1e-4, master)
        plan = coupled([fmus[2], fmus[3]], master=master)
        fixed = run(plan, NAMES["coupled"], 4.0 / steps, int(steps))
        times = np.arange(int(steps) + 1) * 4.0 / steps
        assert error < 2 * np.abs(fixed - masses_exactly(times).T).max()

    def test_the_estimate_is_near_the_error_of_a_step(self, fmus):
        """In the first step, which begins at exact values."""
        plan = controlled(coupled([fmus[2], fmus[3]], master="jacobi"), 1.0, 0.01)
        rows = run(plan, ("first.y2", "master.error(first.y2)", "master.steps"), 0.01, 1)
        exact = masses_exactly(np.array([0.01 - 1e-6, 0.01 + 1e-6]))[0]
        velocity = (exact[1] - exact[0]) / 2e-6
        assert rows[1, 2] == 2
        assert rows[1, 1] == pytest.approx(abs(rows[1, 0] - velocity), rel=0.1)

    def test_slow_parts_take_fewer_steps(self, fmus):
        """What decays is followed by ever larger steps."""
        plan = controlled(tank([fmus[2], fmus[2]]), 1e-5)
        steps = run(plan, ("master.steps",), 1.0, 20)[:, 0]
        per_step = np.diff(steps)
        assert per_step[0] > 5 * per_step[-1]
        assert per_step[-1] >= 2

    def test_a_chain_of_pendulums_comes_near_that_of_tiny_steps(self):
        names = ("a.theta", "b.theta")
        fine = run(replace(pendulums(), master="jacobi"), names, 0.0005, 2000)[::40]
        errors = []
        for tolerance in (1e-3, 1e-5):
            plan = controlled(replace(pendulums(), master="jacobi"), tolerance)
            errors.append(np.abs(run(plan, names, 0.02, 50) - fine).max())
        assert errors[1] < errors[0] / 3

    def test_the_pendulum_in_two_parts_comes_near_the_whole(self, fmus):
        name = "pendulum.theta_dot"
        right = run(whole_pendulum(), [name], 0.0025, 400)[::40]
        plans = [controlled(parted_pendulum(fmus[2]), x) for x in (1e-3, 1e-5)]
        errors = [np.abs(run(one, [name], 0.1, 10) - right).max() for one in plans]
        assert np.abs(right).max() > 1.0
        assert 5 < errors[0] / errors[1] < 20


class TestBothEngines:
    @by_each_master
    @pytest.mark.parametrize("tolerance", [1e-3, 1e-5])
    @pytest.mark.parametrize("name", MODELS)
    def test_agree(self, fmus, master, tolerance, name):
        make, _ = MODELS[name]
        plan = controlled(make([fmus[2], fmus[3]], master=master), tolerance)
        fmu = SystemFMU(plan)
        told = [n for n in fmu.description.variables if n.startswith("master.")]
        names = (*NAMES[name], *told)
        one, other = (run(plan, names, 0.3, 12) for native in (False, True))
        assert len(told) > len(STATISTICS)
        assert one.tobytes() == other.tobytes()

    def test_with_a_loop(self, fmus):
        """The loop saves states of its own within each step."""
        loop = looped(fmus)
        names = ("a.y1", "b.y1", *STATISTICS)
        one, other = (run(loop, names, 0.2, 10) for native in (False, True))
        assert one.tobytes() == other.tobytes()
        assert one[-1, 2] > 20


def looped(fmus):
    def part(name, path, gain):
        a = [[-1.0, 0.0], [0.0, 0.0]]
        one = [[1.0, 0.0], [0.0, 0.0]]
        return linear(name, path, (1.0, 0.0), a=a, b=one, c=one, d=np.array(one) * gain)

    links = (Link("a", "y1", "b", "u1"), Link("b", "y1", "a", "u1"))
    parts = part("a", fmus[2], 0.3), part("b", fmus[3], -0.4)
    return controlled(system(parts, links, Loop()), 1e-4)


class TestStates:
    def test_episodes_begin_anew(self, fmus):
        plan = controlled(masses([fmus[2], fmus[3]]), 1e-5)
        fmu = SystemFMU(plan)
        spec = PoolSpec((), tuple(map(fmu.variable, ("first.y1", *STATISTICS))), 0.3)
        for method in ("restore", "reset", "instance"):
            own = replace(spec, reset_method=fmugym.pool.spec.ResetMethod(method))
            pool = local_pool(SystemFMU(plan), own, 2, LOG)
            try:
                rows = []
                for _ in range(4):
                    first = pool.reset((), np.zeros((0, 2)))[0].copy()
                    rows.append(np.array([first, *(pool.step()[0].copy() for _ in range(8))]))
            finally:
                pool.close()
            assert all(one.tobytes() == rows[0].tobytes() for one in rows)

    def test_return_with_the_step_size(self, fmus):
        plan = controlled(masses([fmus[2], fmus[2]]), 1e-5)
        fmu = SystemFMU(plan)
        spec = PoolSpec((), tuple(map(fmu.variable, ("first.y1", *STATISTICS))), 0.3)
        pools = [local_pool(SystemFMU(plan), spec, 2, LOG) for _ in range(2)]
        one, other = pools
        try:
            for pool in pools:
                pool.reset((), np.zeros((0, 2)))
                pool.save_by(lambda: SaveMethod.STATE)
            for _ in range(4):
                one.step()
            snapshot = one.save()
            bundle = pickle.loads(pickle.dumps(one.save_instances(np.arange(2))))
            before = [one.step()[0].copy() for _ in range(4)]
            one.restore(snapshot)
            assert [one.step()[0].tobytes() for _ in range(4)] == [b.tobytes() for b in before]
            other.restore_instances(bundle, np.arange(2), np.arange(2))
            assert [other.step()[0].tobytes() for _ in range(4)] == [b.tobytes() for b in before]
        finally:
            for pool in pools:
                pool.close()


class TestLimits:
    def test_the_smallest_step_is_taken_whatever_the_error(self, fmus):
        plan = controlled(masses([fmus[2], fmus[2]]), 1e-12, 0.05)
        rows = run(plan, STATISTICS, 0.4, 3)
        assert rows[-1, 0] == 3 * 2 * 8
        assert rows[-1, 2] == 0.05
        assert rows[-1, 3] > 1

    def test_a_large_tolerance_takes_no_more_than_two_steps(self, fmus):
        plan = controlled(masses([fmus[2], fmus[2]]), 1e6)
        rows = run(plan, STATISTICS, 0.4, 3)
        assert rows[-1].tolist()[:3] == [6.0, 0.0, 0.4]

    def test_a_discarded_step_is_repeated_as_smaller_ones(self, fmus):
        """An FMU that refuses steps beyond a limit gets shorter ones."""
        parts = masses([fmus[2], fmus[2]])
        first = replace(parts.components[0], starts=(*parts.components[0].starts, ("limit", 0.11)))
        plan = controlled(replace(parts, components=(first, parts.components[1])), 1e6)
        rows = run(plan, STATISTICS, 0.4, 3)
        assert rows[-1, 1] >= 1
        assert rows[-1, 2] <= 0.11 * 2
        assert rows[-1, 0] >= 3 * 2 * 2

    def test_who_discards_even_the_smallest_is_named(self, fmus):
        parts = masses([fmus[2], fmus[2]])
        first = replace(parts.components[0], starts=(*parts.components[0].starts, ("limit", 1e-9)))
        plan = controlled(replace(parts, components=(first, parts.components[1])), 1e6)
        _, status, text = run(plan, STATISTICS, 0.4, 3, stop=True)
        assert status == Status.DISCARD
        assert "component 'first'" in text

    def test_steps_that_the_time_would_not_show_are_not_tried(self, fmus):
        """They would go on for ever."""
        parts = masses([fmus[2], fmus[2]])
        first = replace(parts.components[0], starts=(*parts.components[0].starts, ("limit", 1e-19)))
        plan = replace(parts, components=(first, parts.components[1]))
        for smallest in (1e-20, 1e-310):
            status = run(controlled(plan, 1e6, smallest), STATISTICS, 0.4, 3, stop=True)[1]
            assert status == Status.DISCARD

    def test_who_cannot_save_its_state_is_named(self, fmus):
        system = SystemFMU(controlled(masses([fmus[2], fmus[1]]), 1e-4))
        assert not system.runs_here
        with pytest.raises(ConfigError, match=r"component 'second'.* FMU state"):
            system.extract()

    def test_who_has_the_name_of_the_master_is_refused(self):
        with pytest.raises(ConfigError, match="'master'"):
            FMUSystem({"master": bundled_fmu("House")}, error_tolerance=1e-3).as_fmu()

    @pytest.mark.parametrize(
        "wrong", [{"error_tolerance": 0}, {"error_tolerance": "x"}, {"min_step_size": 0.1}], ids=str
    )
    def test_wrong_arguments(self, wrong):
        with pytest.raises(ConfigError, match=next(iter(wrong))):
            FMUSystem({"a": bundled_fmu("House")}, **wrong)


def two_houses(**options):
    return FMUSystem(
        {"east": bundled_fmu("House"), "west": bundled_fmu("House")},
        ["outside -> east.T_out", "outside -> west.T_out", "east.Q_em -> west.Q_int"],
        step_size=600.0,
        **options,
    )


@pytest.mark.skipif(os.name == "nt", reason="they have processes of their own on Unix only")
def test_components_in_processes_of_their_own(fmus):
    """They save and restore states, too."""
    plan = controlled(masses([fmus[2], fmus[2]]), 1e-4)
    one, other = plan.components
    apart = replace(plan, components=(one, replace(other, isolate=True)))
    names = ("first.y1", *STATISTICS)
    assert run(apart, names, 0.3, 5).tobytes() == run(plan, names, 0.3, 5).tobytes()


class TestFaces:
    def test_statistics_are_variables(self):
        class Houses(fmugym.FMUEnv):
            def __init__(self):
                config = {
                    "model_input_names": ["east.u", "west.u"],
                    "model_output_names": ["east.T_air"],
                    "monitor_names": ["master.steps", "master.error(east.Q_em)"],
                    "time_step": 3600.0,
                    "max_episode_steps": 5,
                }
                super().__init__(two_houses(error_tolerance=1e-3), config)

            def _is_done(self):
                return False

        env = Houses()
        env.reset(seed=0)
        env.step(np.array([1.0, 0.0]))
        assert env.out["master.steps"] >= 2
        assert env.out["master.error(east.Q_em)"] >= 0
        env.close()

    def test_it_is_written_and_read(self, tmp_path):
        given = two_houses(error_tolerance=1e-3, min_step_size=2.0)
        again = FMUSystem.read(given.write(tmp_path / "houses.ssp"))
        assert again.control == given.control == Control(1e-3, 2.0)
        assert pickle.loads(pickle.dumps(given)).control == given.control

    def test_in_a_task_file(self, tmp_path):
        file = tmp_path / "task.toml"
        file.write_text(
            """
            time_step = "1h"
            episode_length = "1d"
            reward = "-steps"

            [system]
            connections = ["east.Q_em -> west.Q_int"]
            error_tolerance = 1e-3
            min_step_size = "10s"

            [system.components]
            east = { bundled = "House" }
            west = { bundled = "House" }

            [variables]
            T = { name = "east.T_air", unit = "degC", min = 0, max = 50 }
            u = { name = "east.u" }
            steps = { name = "master.steps" }

            [agent]
            actions = ["u"]
            observations = ["T"]
            """
        )
        env = fmugym.load(file)
        env.reset(seed=0)
        _, reward, *_ = env.step(env.action_space.sample())
        assert reward <= -2
        env.close()
