"""The contract of ``fmugym.pool.pool``, for every implementation of it."""

import pickle
from functools import partial

import fmpy
import numpy as np
import pytest
import zoo_tools
from combinations import in_turn
from fmu_tools import edited_fmu
from plants import PLANTS
from pool_tools import open_pool, reset
from system_tools import system
from wine_tools import for_windows

from fmugym import FMU, FMULoadError, SimulationError, bundled_fmu
from fmugym.fmi import Status
from fmugym.fmi.bundled import BUNDLED_FMUS, FMI_VERSIONS, MODELS, is_bundled
from fmugym.fmi.systems.system import SystemFMU
from fmugym.fmi.systems.system_plan import ComponentPlan
from fmugym.fmi.variable import with_texts

OPTIONS = {
    "fmpy": {"backend": "fmpy"},
    "native": {"backend": "native"},
    "process": {"backend": "auto", "isolation": "process", "workers": 2},
    "wine": {"backend": "auto", "workers": 2},
}
"""``PoolOptions``, by implementation."""

OPTIONS |= {f"system in {name}": OPTIONS[name] for name in ("native", "process")}
"""With the FMU as a component of a system."""

PAIRS = [
    *(("native", 2), ("system in native", 3), ("native", 3), ("system in process", 2)),
    *(("native", 1), ("process", 3), ("wine", 1), ("fmpy", 2), ("fmpy", 1), ("fmpy", 3)),
]
"""Implementations with versions of FMI, which differ in the native one above all."""


def all_plants():
    """Each implementation with each version of FMI, whose models take turns."""
    for shift, version in enumerate(FMI_VERSIONS):
        models = [one for one in BUNDLED_FMUS if one[1] == version]
        for index, name in enumerate(OPTIONS):
            yield name, *models[(index + shift) % len(models)]


def of_pairs(pairs, others=None):
    """Pools with versions, and values of other parameters in turn."""
    return in_turn({"make_pool,version": pairs} | (others or {}), indirect=["make_pool"])


ENGINES = [pair for pair in PAIRS if pair[0] != "fmpy"]
engines = pytest.mark.parametrize("make_pool", list(OPTIONS)[1:], indirect=True)
each_pool = of_pairs(PAIRS)
each_engine = of_pairs(ENGINES)
with_state = of_pairs([pair for pair in PAIRS if pair[1] > 1])
engine_with_state = of_pairs([pair for pair in ENGINES if pair[1] > 1])


@pytest.fixture
def pools_of(request, tmp_path, opened):
    """Make pools of an implementation that are closed after the test."""

    def make(name, path, inputs, outputs, n=1, time_step=0.1, reset_method=None, **spec):
        if name == "wine":
            request.getfixturevalue("wine")
            monkeypatch = request.getfixturevalue("monkeypatch")
            monkeypatch.setattr("fmugym.fmi.fmu.is_bundled", is_bundled_or_copy)
            path = for_windows(path, tmp_path)
        is_system = "system" in name
        options = OPTIONS[name] | {"reset_method": reset_method, "private_libraries": False}
        fmu = system_of(path) if is_system else FMU(path)
        pool = open_pool(fmu, inputs, outputs, time_step, n, options, **spec)
        pool.is_system = is_system
        return opened(pool)

    return make


@pytest.fixture(params=OPTIONS)
def make_pool(request, pools_of):
    """Make pools of each implementation."""
    return partial(pools_of, request.param)


def system_of(path):
    """A system of an FMU and a pendulum, whose variables can be looked up by the FMU's names."""
    components = ComponentPlan("plant", path), ComponentPlan("other", bundled_fmu("Pendulum"))
    both = SystemFMU(system(components, ()))
    both.variable = lambda name: both.description.variable(f"plant.{name}")
    return both


def is_bundled_or_copy(path):
    """Whether it is a bundled FMU, or its copy for Windows."""
    return is_bundled(path) or path.stem.removeprefix("Windows") in MODELS


def plants_where(condition):
    """Some of the plants."""
    some = [one for one in all_plants() if condition(*one)]
    return pytest.mark.parametrize("plant", some, ids="-".join, indirect=True)


plants_in_engines = plants_where(lambda name, *_: name != "fmpy")
plants_with_state = plants_where(lambda name, _, version: name != "fmpy" and version != "1.0")


@pytest.fixture(params=list(all_plants()), ids="-".join)
def plant(request, pools_of):
    """Make pools of an implementation over a bundled FMU."""
    name, model, version = request.param
    return Plant(model, version, partial(pools_of, name))


class Plant:
    def __init__(self, model, version, make_pool):
        self.model, self.version = model, version
        self.path = bundled_fmu(model, version)
        self.input, self.outputs, self.start, self.strength = PLANTS[model]
        self._make_pool = make_pool

    def pool(self, num_instances=1, time_step=0.05, **spec):
        return self._make_pool(
            self.path, [self.input], self.outputs, num_instances, time_step, **spec
        )

    def start_values(self, seed, num_instances):
        return np.random.default_rng(seed).uniform(1.4, 1.7, (1, num_instances))

    def inputs(self, seed, steps, num_instances):
        rng = np.random.default_rng(seed)
        return self.strength * rng.uniform(-1, 1, (steps, 1, num_instances))

    def rollout(self, pool, values, inputs):
        """The outputs after the reset and after each step, shape (steps + 1, k, N)."""
        outputs, status = pool.reset((pool.variable(self.start),), values)
        assert not status.any()
        trajectory = [outputs.copy()]
        for row in inputs:
            outputs, status = pool.step(row)
            assert not status.any()
            trajectory.append(outputs.copy())
        return np.array(trajectory)


def set_up(pool, mask=None, **values):
    """Reset with start values, numbers or one for each instance."""
    return reset(pool, values, mask)


def step(pool, value=0.0, **options):
    return pool.step(np.full((1, pool.num_instances), value), **options)


def held_constant(signal):
    """A signal for FMPy, which would interpolate between the points."""
    held = np.repeat(signal, 2)[:-1]
    held["time"][1::2] = signal["time"][1:]
    return held


class TestDynamics:
    def test_as_fmpy_simulates(self, plant):
        """FMPy's own co-simulation loop is the reference."""
        pool = plant.pool(start_time=0.0)
        inputs = plant.inputs(0, 20, 1)
        ours = plant.rollout(pool, np.array([[1.5]]), inputs)[:, :, 0]
        times = np.arange(21) * 0.05
        signal = np.array(
            [(t, u) for t, u in zip(times, [*inputs[:, 0, 0], 0.0], strict=True)],
            dtype=[("time", float), (plant.input, float)],
        )
        theirs = fmpy.simulate_fmu(
            str(plant.path),
            fmi_type="CoSimulation",
            validate=False,
            stop_time=1.0,
            output_interval=0.05,
            start_values={plant.start: 1.5},
            input=held_constant(signal),
            output=plant.outputs,
        )
        for index, name in enumerate(plant.outputs):
            np.testing.assert_allclose(ours[:, index], theirs[name], rtol=1e-9, atol=1e-12)

    def test_reset_restores_everything(self, plant):
        """By initialization, and from the third time on, where the FMU can, from a saved state."""
        pool = plant.pool(3)
        values, inputs = plant.start_values(1, 3), plant.inputs(1, 15, 3)
        fresh = plant.rollout(pool, values, inputs)
        plant.rollout(pool, plant.start_values(2, 3), plant.inputs(2, 7, 3))
        for _ in range(4):
            np.testing.assert_array_equal(plant.rollout(pool, values, inputs), fresh)
        other = plant.rollout(pool, plant.start_values(2, 3), inputs)
        assert (other[0] != fresh[0]).any()

    def test_n_instances_equal_n_single_ones(self, plant):
        values, inputs = plant.start_values(3, 5), plant.inputs(3, 15, 5)
        together = plant.rollout(plant.pool(5), values, inputs)
        for i in range(5):
            alone = plant.rollout(plant.pool(), values[:, i : i + 1], inputs[:, :, i : i + 1])
            np.testing.assert_array_equal(together[:, :, i : i + 1], alone)

    def test_masked_reset_leaves_the_others(self, plant):
        pool = plant.pool(4)
        values, inputs = plant.start_values(4, 4), plant.inputs(4, 20, 4)
        undisturbed = plant.rollout(pool, values, inputs)
        plant.rollout(pool, values, inputs[:10])
        mask = np.array([False, True, False, True])
        outputs, _ = pool.reset((pool.variable(plant.start),), values, mask)
        np.testing.assert_array_equal(outputs[:, mask], undisturbed[0][:, mask])
        np.testing.assert_array_equal(outputs[:, ~mask], undisturbed[10][:, ~mask])
        for index in range(10):
            row = np.where(mask, inputs[index], inputs[10 + index])
            outputs, _ = pool.step(row)
        np.testing.assert_array_equal(outputs[:, mask], undisturbed[10][:, mask])
        np.testing.assert_array_equal(outputs[:, ~mask], undisturbed[20][:, ~mask])

    def test_skipped_instances_stay(self, plant):
        pool = plant.pool(3)
        values, inputs = plant.start_values(5, 3), plant.inputs(5, 6, 3)
        undisturbed = plant.rollout(pool, values, inputs)
        plant.rollout(pool, values, inputs[:4])
        skip = np.array([False, True, False])
        outputs, status = pool.step(inputs[4], skip)
        np.testing.assert_array_equal(outputs[:, ~skip], undisturbed[5][:, ~skip])
        np.testing.assert_array_equal(outputs[:, skip], undisturbed[4][:, skip])
        assert not status.any()
        outputs, _ = pool.step(inputs[4], ~skip)
        np.testing.assert_array_equal(outputs, undisturbed[5])

    def test_substeps(self, plant):
        inputs = plant.inputs(6, 5, 1)
        coarse = plant.rollout(plant.pool(time_step=0.04, substeps=4), np.array([[1.5]]), inputs)
        fine = plant.pool(time_step=0.01)
        trajectory = plant.rollout(fine, np.array([[1.5]]), np.repeat(inputs, 4, axis=0))
        np.testing.assert_array_equal(coarse, trajectory[::4])

    def test_warm_up(self, plant):
        """The inputs have their start values, also where a saved state is restored."""
        inputs = plant.inputs(7, 5, 1)
        warm = plant.pool(warm_up_steps=3)
        rest = np.zeros((3, 1, 1))
        expected = plant.rollout(plant.pool(), np.array([[1.5]]), np.concatenate([rest, inputs]))
        for _ in range(4):
            np.testing.assert_array_equal(
                plant.rollout(warm, np.array([[1.5]]), inputs), expected[3:]
            )

    @each_pool
    def test_inputs_have_given_start_values_in_the_warm_up(self, make_pool, probe, version):
        pool = make_pool(probe(version), ["a"], ["sum"], warm_up_steps=2)
        assert set_up(pool, a=0.5)[0].tolist() == [[0.1]]

    @each_pool
    def test_time_begins_at_the_start_time(self, make_pool, probe, version):
        pool = make_pool(probe(version), ["a"], ["end"], start_time=2.0)
        for _ in range(2):
            set_up(pool)
            assert step(pool)[0].tolist() == [[2.1]]

    def test_observations(self, plant):
        pool = plant.pool(3, num_observed=2)
        plant.rollout(pool, plant.start_values(8, 3), [])
        skip = np.array([False, True, False])
        for skipped in (None, skip):
            outputs, _ = pool.step(plant.inputs(8, 1, 3)[0], skipped)
            expected = outputs[:2].T.astype(np.float32)
            np.testing.assert_array_equal(pool.observations, expected)

    @plants_in_engines
    def test_read(self, plant):
        pool = plant.pool(3)
        values = plant.start_values(9, 3)
        outputs = plant.rollout(pool, values, plant.inputs(9, 4, 3))[-1]
        names = [plant.outputs[1], plant.start]
        read = pool.read(tuple(map(pool.variable, names)))
        np.testing.assert_array_equal(read, np.concatenate([outputs[1:2], values]))

    def test_closing_twice(self, plant):
        pool = plant.pool(2)
        plant.rollout(pool, plant.start_values(0, 2), [])
        pool.close()
        pool.close()
        with pytest.raises(SimulationError, match="closed"):
            pool.step()


class TestArrays:
    @each_pool
    def test_inputs_may_be_written_in_place(self, make_pool, probe, version):
        pool = make_pool(probe(version), ["b", "a"], ["mix", "sum"], 3)
        set_up(pool)
        pool.inputs[0], pool.inputs[1] = 0.5, [0.0, 0.25, 1.0]
        outputs, status = pool.step()
        assert outputs[0].tolist() == [5.0, 5.25, 6.0]
        assert outputs is pool.outputs
        assert status is pool.statuses
        pool.inputs[0] = 0.0
        assert pool.step()[0] is outputs
        assert outputs[0].tolist() == [0.0, 0.25, 1.0]

    def test_an_argument_is_copied(self, make_pool, probe):
        pool = make_pool(probe(2), ["a"], ["mix"])
        set_up(pool)
        given = np.array([[0.5]])
        pool.step(given)
        given[:] = 9.0
        assert pool.step()[0].tolist() == [[0.5]]

    @each_pool
    def test_counts_of_health_are_those_of_their_moment(self, make_pool, probe, version):
        pool = make_pool(probe(version), ["a"], ["mix"])
        set_up(pool)
        before = pool.health()
        set_up(pool)
        step(pool)
        for counts, expected in ((before, [[1], [0]]), (pool.health(), [[2], [1]])):
            assert [counts[name].tolist() for name in ("resets", "steps")] == expected


class TestConstruction:
    @each_pool
    def test_that_fails_leaves_nothing(self, make_pool, probe, tmp_path, temp_root, version):
        path = edited_fmu(probe(version), tmp_path, {"{probe-": "{other-"})
        with pytest.raises(FMULoadError, match=r"refused to be instantiated.*the FMU said: step 0"):
            make_pool(path, ["a"], ["mix"], 2)
        assert list(temp_root.iterdir()) == []


class TestSnapshots:
    @plants_with_state
    def test_restored_instances_go_on_as_before(self, plant):
        pool = plant.pool(3)
        values, inputs = plant.start_values(1, 3), plant.inputs(1, 10, 3)
        expected = plant.rollout(pool, values, inputs)
        plant.rollout(pool, values, inputs[:5])
        snapshot = pool.save()
        mask = np.array([True, False, True])
        for _ in range(2):
            pool.step(inputs[7])
            outputs, status = pool.restore(snapshot, mask)
            np.testing.assert_array_equal(outputs[:, mask], expected[5][:, mask])
            assert not status.any()
        pool.restore(snapshot)
        for row in inputs[5:]:
            outputs, _ = pool.step(row)
        np.testing.assert_array_equal(outputs, expected[-1])

    @engine_with_state
    def test_time_is_part_of_it(self, make_pool, probe, version):
        pool = make_pool(probe(version), ["a"], ["end"])
        set_up(pool)
        step(pool)
        snapshot = pool.save()
        step(pool)
        pool.restore(snapshot)
        outputs, _ = step(pool)
        assert outputs[0, 0] == pytest.approx(0.2, abs=1e-15)

    @engine_with_state
    def test_snapshots_are_freed(self, make_pool, probe, version):
        pool = make_pool(probe(version), ["a"], ["live"])
        set_up(pool)
        snapshots = [pool.save() for _ in range(3)]
        assert step(pool)[0].tolist() == [[3]]
        del snapshots[1:]
        snapshots.append(pool.save())
        assert step(pool)[0].tolist() == [[2]]

    @engine_with_state
    def test_only_into_the_same_instances(self, make_pool, probe, version):
        pool, twin = (make_pool(probe(version), ["a"], ["sum"], 2) for _ in range(2))
        alone = make_pool(probe(version), ["a"], ["sum"])
        for each in (pool, twin, alone):
            set_up(each)
        for other in (twin.save(), alone.save()):
            with pytest.raises(SimulationError, match="snapshot"):
                pool.restore(other)

    @engines
    def test_not_in_fmi_1(self, make_pool, probe):
        pool = make_pool(probe(1), ["a"], ["sum"])
        set_up(pool)
        with pytest.raises(SimulationError, match="cannot get and set its state"):
            pool.save()


@plants_in_engines
class TestSavedInstances:
    """``save_instances`` and ``restore_instances``, whether states are serialized or replayed."""

    STEPS = 6

    def halfway(self, plant, num_instances=3):
        pool = plant.pool(num_instances)
        inputs = plant.inputs(2, 2 * self.STEPS, num_instances)
        values = plant.start_values(3, num_instances)
        plant.rollout(pool, values, inputs[: self.STEPS])
        return pool, inputs[self.STEPS :]

    def go_on(self, pool, inputs):
        return np.array([pool.step(row)[0].copy() for row in inputs])

    def test_go_on_as_before(self, plant):
        pool, inputs = self.halfway(plant)
        saved = pool.save_instances(np.arange(3))
        assert saved.method == ("replay" if plant.version.startswith("1") else "state")
        expected = self.go_on(pool, inputs)
        for _ in range(2):
            statuses = pool.restore_instances(saved, np.arange(3), np.arange(3))
            assert not statuses.any()
            assert np.array_equal(self.go_on(pool, inputs), expected)

    def test_go_on_in_other_instances_of_another_pool(self, plant):
        pool, inputs = self.halfway(plant)
        saved = pickle.loads(pickle.dumps(pool.save_instances(np.array([2, 0]))))
        expected = self.go_on(pool, inputs)
        pool.close()
        other = plant.pool(4)  # its instances were never initialized
        set_up(other, np.array([True, False, False, False]))
        first = other.outputs[:, 0].copy()
        other.restore_instances(saved, np.array([0, 1, 0]), np.array([1, 2, 3]))
        assert np.array_equal(other.outputs[:, 0], first)
        given = inputs[:, :, [0, 2, 0, 2]]
        assert np.array_equal(self.go_on(other, given)[:, :, 1:], expected[:, :, [2, 0, 2]])

    def test_of_different_lengths_change_places(self, plant):
        pool, inputs = self.halfway(plant)
        mask, places = np.array([False, True, False]), np.array([2, 0, 1])
        pool.reset((pool.variable(plant.start),), plant.start_values(6, 3), mask)
        self.go_on(pool, inputs[:2])
        saved = pool.save_instances(np.arange(3))
        expected = self.go_on(pool, inputs[2:])
        pool.restore_instances(saved, places, np.arange(3))
        found = self.go_on(pool, inputs[2:, :, places])
        assert np.array_equal(found, expected[:, :, places])

    def test_leave_inputs_as_they_were_written(self, plant):
        pool, inputs = self.halfway(plant)
        saved = pool.save_instances(np.arange(3))
        pool.inputs[:] = inputs[0]
        pool.restore_instances(saved, np.arange(3), np.arange(3))
        assert np.array_equal(pool.inputs, inputs[0])

    def test_after_a_reset_that_follows_all_is_as_ever(self, plant):
        pool, inputs = self.halfway(plant, 1)
        saved = pool.save_instances(np.zeros(1, int))
        values = plant.start_values(5, 1)
        expected = plant.rollout(pool, values, inputs)
        pool.restore_instances(saved, np.zeros(1, int), np.zeros(1, int))
        assert np.array_equal(plant.rollout(pool, values, inputs), expected)


STATUSES = [
    *((2, Status.DISCARD), (3, Status.ERROR), (4, Status.FATAL), (5, Status.ERROR)),
    (7, Status.NOT_FINITE),
]
"""Faults of the probe, and what is told."""


class TestFaults:
    """What goes wrong with one instance is told by its status and mended by the next reset."""

    OUTPUTS = ("sum", "steps", "instances", "illegal")

    @pytest.fixture
    def pool(self, make_pool, probe):
        def make(version, num_instances=1, **spec):
            return make_pool(probe(version), ["a"], self.OUTPUTS, num_instances, 0.5, **spec)

        return make

    @staticmethod
    def assert_sound(pool):
        """After a good reset every instance works, and the FMU saw no illegal call."""
        outputs, status = set_up(pool)
        assert not status.any()
        assert (outputs[1] == 0).all()
        outputs, status = step(pool, 1.0)
        assert not status.any()
        assert (outputs[0] == 0.5).all()
        assert (outputs[3] == 0).all()

    @of_pairs(PAIRS, {"fault,expected": STATUSES})
    def test_of_one_instance_in_a_step(self, pool, version, fault, expected):
        pool = pool(version, 3)
        set_up(pool, fault=[0, fault, 0], fault_step=2)
        before = step(pool, 1.0)[0].copy()
        outputs, status = step(pool, 1.0)
        assert status.tolist() == [Status.OK, expected, Status.OK]
        assert outputs[0].tolist() == [1.0, 0.5, 1.0]
        np.testing.assert_array_equal(outputs[:, 1], before[:, 1])
        said = "sum = nan" if fault == 7 else f"t = 0.5 s returned {expected.name.capitalize()}"
        assert said in pool.failure(1)
        self.assert_sound(pool)

    @of_pairs(ENGINES, {"fault": [3, 4]})
    def test_stepping_on_does_not_reach_a_failed_instance(self, pool, version, fault):
        pool = pool(version, 2)
        set_up(pool, fault=[fault, 0], fault_step=1)
        for _ in range(3):
            outputs, status = step(pool, 1.0)
            assert status.tolist() == [fault, Status.OK]
        assert outputs[0].tolist() == [0.0, 1.5]
        self.assert_sound(pool)

    @with_state
    def test_an_fmu_that_asks_to_stop(self, pool, version):
        pool = pool(version)
        set_up(pool, fault=6, fault_step=2)
        assert step(pool, 1.0)[1].tolist() == [Status.OK]
        outputs, status = step(pool, 1.0)
        assert status.tolist() == [Status.TERMINATED]
        assert outputs[0].tolist() == [1.0]  # its outputs are valid
        self.assert_sound(pool)

    @of_pairs(PAIRS, {"name": ["set_status", "get_status"]})
    def test_in_setting_and_getting(self, pool, version, name):
        pool = pool(version)
        set_up(pool, **{name: 3})
        doing = {"set_status": "setting the inputs", "get_status": "reading the outputs"}[name]
        assert step(pool)[1].tolist() == [Status.ERROR]
        if pool.is_system:  # its step sets and reads
            assert "the step at t = 0 s returned Error in component 'plant'" in pool.failure(0)
        else:
            assert f"{doing} returned Error" in pool.failure(0)
        self.assert_sound(pool)

    @of_pairs(PAIRS, {"status": [2, 3, 4]})
    def test_in_a_reset(self, pool, version, status):
        pool = pool(version, 2)
        _, statuses = set_up(pool, init_status=[0, status])
        assert statuses[0] == Status.OK
        assert statuses[1] > Status.WARNING
        assert "initialization returned" in pool.failure(1)
        self.assert_sound(pool)

    @each_pool
    def test_in_a_substep(self, pool, version):
        pool = pool(version, substeps=5)
        set_up(pool, fault=3, fault_step=3)
        assert step(pool, 1.0)[1].tolist() == [Status.ERROR]
        assert "t = 0.2 s" in pool.failure(0)

    @each_pool
    def test_in_the_warm_up(self, pool, version):
        pool = pool(version, warm_up_steps=2)
        _, status = set_up(pool, fault=3, fault_step=2)
        assert status.tolist() == [Status.ERROR]
        assert "the warm-up failed: " in pool.failure(0)
        assert set_up(pool)[1].tolist() == [Status.OK]

    @of_pairs(ENGINES, {"parameters": [{"reset_status": 3}, {"fault": 4, "fault_step": 1}]})
    def test_an_instance_past_mending_is_replaced(self, pool, version, parameters):
        pool = pool(version)
        set_up(pool, **parameters)
        step(pool)
        assert set_up(pool)[0][2, 0] == 2  # instances made so far
        self.assert_sound(pool)
        assert set_up(pool)[0][2, 0] == 2

    @each_engine
    def test_where_a_library_makes_no_further_instance_a_copy_of_it_does(self, pool, version):
        """Each refusal without a message is repeated once, to hear a reason."""
        pool = pool(version)
        set_up(pool, fault=4, fault_step=1, refusals=4)
        step(pool)
        assert set_up(pool)[1].tolist() == [Status.OK]
        self.assert_sound(pool)

    @engine_with_state
    def test_a_state_that_cannot_be_restored(self, pool, version):
        pool = pool(version, reset_method="restore")
        for _ in range(4):
            outputs, status = set_up(pool, restore_status=3)
            assert status.tolist() == [Status.OK]
            assert outputs[1].tolist() == [0.0]
            step(pool)
        self.assert_sound(pool)

    @of_pairs(
        [("native", 2), ("native", 3), ("process", 2), ("system in native", 3)],
        {"status": [Status.DISCARD, Status.ERROR, Status.FATAL]},
    )
    def test_a_state_that_cannot_be_saved(self, make_pool, tmp_path, version, status):
        path = zoo_tools.zoo_fmu(tmp_path, version)
        values = zoo_tools.parameters("status", "get_state", at=0, status=status)
        pool = make_pool(path, ["u"], ["y"], 1, 0.5, reset_method="restore")
        for _ in range(4):
            outputs, statuses = set_up(pool, **values)
            assert statuses.tolist() == [Status.OK]
            assert outputs.tolist() == [[0.0]]
            outputs, statuses = step(pool, 1.0)
            assert statuses.tolist() == [Status.OK]
            assert outputs.tolist() == [[0.5]]

    @engine_with_state
    def test_a_snapshot_that_cannot_be_restored(self, pool, version):
        pool = pool(version)
        set_up(pool, restore_status=3)
        _, status = pool.restore(pool.save())
        assert status.tolist() == [Status.ERROR]
        assert "restoring the FMU state returned Error" in pool.failure(0)
        assert step(pool)[1].tolist() == [Status.ERROR]
        assert "needs a reset" in pool.failure(0)
        self.assert_sound(pool)

    @engine_with_state
    def test_a_snapshot_of_a_replaced_instance(self, pool, version):
        pool = pool(version)
        set_up(pool, fault=4, fault_step=1)
        snapshot = pool.save()
        step(pool)
        set_up(pool)
        with pytest.raises(SimulationError, match="snapshot"):
            pool.restore(snapshot)

    @each_pool
    def test_a_step_before_the_first_reset(self, pool, version):
        pool = pool(version, 2)
        assert step(pool)[1].tolist() == [Status.ERROR] * 2
        assert "reset" in pool.failure(0)
        self.assert_sound(pool)


class TestStartValues:
    @each_pool
    def test_other_variables_at_each_reset(self, make_pool, probe, version):
        """What is not given is at the FMU's own start value again."""
        pool = make_pool(probe(version), ["a"], ["sum", "mix"])
        set_up(pool, gain=2.0, b=0.5)
        assert step(pool, 1.0)[0].tolist() == [[0.2], [6.0]]
        set_up(pool, b=0.25)
        assert step(pool, 1.0)[0].tolist() == [[0.1], [3.5]]
        set_up(pool)
        assert step(pool, 1.0)[0].tolist() == [[0.1], [1.0]]

    @each_pool
    def test_strings_and_integers(self, make_pool, probe, version, caplog):
        pool = make_pool(probe(version), ["a"], ["steps"], 2)
        label = with_texts(pool.variable("label"), ["here", "there", "nowhere"])
        for _ in range(4):
            variables = pool.variable("log_status"), label
            pool.reset(variables, np.array([[1.0, 1.0], [0.0, 1.0]]))
            caplog.clear()
            step(pool)
            for text in ("here", "there"):
                assert caplog.text.count(f"step 1 of {text} is 100%") == 1

    @each_pool
    def test_only_the_columns_in_the_mask_are_used(self, make_pool, probe, version):
        pool = make_pool(probe(version), ["a"], ["sum"], 2)
        set_up(pool, gain=[1.0, 2.0])
        set_up(pool, np.array([True, False]), gain=[3.0, np.nan])
        assert step(pool, 1.0)[0].tolist() == [[pytest.approx(0.3), 0.2]]

    @each_pool
    def test_inputs_do_not_survive_a_reset(self, make_pool, probe, version):
        pool = make_pool(probe(version), ["a"], ["mix"])
        for _ in range(4):
            assert set_up(pool)[0].tolist() == [[0.0]]
            step(pool, 1.0)
