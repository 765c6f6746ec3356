"""What the native pool survives: wrong arrays, unsound programs, too little memory, bad FMUs."""

import json
import struct
import sys
from itertools import product
from pathlib import Path

import numpy as np
import pytest
import zoo_tools
from combinations import in_turn
from process_tools import run_python
from program_tools import (
    DISCRETE,
    RESULT_ROWS,
    code,
    constants,
    kept_actions,
    no_observation,
    results_of,
    stored_results,
    uniform_draws,
)
from test_native_pool import LOG, make, on_linux
from ways import in_way

from fmugym import FMU, SimulationError, _native, bundled_fmu
from fmugym.envs import CartPoleEnv
from fmugym.expressions.program import CONSTANT, TYPES
from fmugym.fmi import Status
from fmugym.pool import PoolSpec
from fmugym.pool.health import no_counts
from fmugym.pool.native_pool import NativePool
from fmugym.pool.play_form import ArrayElement
from fmugym.pool.pool_form import form_of_listing, form_of_program, form_of_programs
from fmugym.pool.saving_pool import inputs_in


@pytest.fixture
def cart_poles():
    pool = make(NativePool, bundled_fmu("CartPole"), ["f"], ["x", "theta"], 6)
    pool.reset((), np.zeros((0, 6)))
    yield pool
    pool.close()


# Arrays


def misaligned(shape, dtype):
    """Zeros that begin in the middle of an item."""
    size = int(np.prod(shape)) * np.dtype(dtype).itemsize
    return np.frombuffer(bytearray(size + 1), dtype, offset=1).reshape(shape)


def counting_in(counts):
    """A pool of one instance, which is elsewhere."""
    form = form_of_programs(PoolSpec((), (), 0.1), 1, 1)
    arrays = np.zeros((0, 1)), np.zeros((0, 1)), np.zeros(1, np.int8), np.zeros((1, 0), np.float32)
    return _native.Pool(form, (*arrays, counts), print)


class TestArrays:
    def test_start_values_at_any_address(self, cart_poles):
        theta = (cart_poles.variable("theta_0"),)
        values = misaligned((1, 6), np.float64)
        values[:] = 1.5
        outputs, statuses = cart_poles.reset(theta, values)
        assert outputs[1].tolist() == [1.5] * 6
        assert not statuses.any()

    def test_health_that_is_not_aligned(self):
        counts = misaligned(no_counts(1).shape, np.int64)
        with pytest.raises(ValueError, match="health must be C-contiguous, aligned"):
            counting_in(counts)

    @pytest.mark.parametrize("dtype", ["i4", "u8", ">i8"])
    def test_another_type(self, dtype):
        with pytest.raises(TypeError, match="health must be an array of int64, not of "):
            counting_in(no_counts(1).astype(dtype))

    def test_a_list(self):
        with pytest.raises(TypeError, match="health must be an array of numpy"):
            counting_in(no_counts(1).tolist())

    def test_a_list_of_variables_that_is_none(self):
        with pytest.raises(TypeError, match="must be bytes"):
            _native.access("form")
        other = _native.access(form_of_listing((), 1))
        for start, error in ((other, "another FMI version"), (None, "PyCapsule")):
            with pytest.raises(ValueError, match=error):
                counting_in(no_counts(1)).reset(start, np.zeros((0, 1)), None)

    def test_actions_that_are_not_aligned(self, make_envs):
        with_these, with_others = (make_envs(in_way("arrays", CartPoleEnv), 6) for _ in range(2))
        actions = misaligned(6, np.int64)
        actions[:] = [0, 1, 0, 1, 1, 0]
        for envs in (with_these, with_others):
            envs.reset(seed=0)
        expected = with_others.step(actions.copy())[0]
        np.testing.assert_array_equal(with_these.step(actions)[0], expected)


@pytest.fixture
def recorded():
    """The FMU of a cart-pole, and the settings of a pool that records its inputs."""
    fmu = FMU(bundled_fmu("CartPole"))
    return fmu, PoolSpec((fmu.variable("f"),), (fmu.variable("x"),), 0.05, records=True)


@pytest.fixture
def read(recorded):
    """The function that reads the inputs of a state."""
    fmu, spec = recorded
    return lambda state: inputs_in(fmu.description, spec, state)


@pytest.fixture(name="pool")
def fixture_pool(recorded):
    """Two cart-poles after a step, whose inputs are recorded."""
    fmu, spec = recorded
    pool = NativePool(fmu, spec, 2, LOG)
    pool.reset((fmu.variable("x_0"),), np.full((1, 2), 0.25))
    pool.step(np.ones((1, 2)))
    yield pool
    pool.close()


class TestRecords:
    def test_are_given_to_another_instance(self, pool, read):
        for step in range(40):
            pool.step(np.array([[0.0, step]]), np.array([True, False]))
        (state,) = pool.save_states(np.array([1]), True)
        pool.restore_states([state], np.array([0]), np.array([0]))
        pool.step(np.full((1, 2), 9.0))
        found = list(map(read, pool.save_states(np.arange(2), True)))
        for record in found:
            assert [variable.name for variable in record.variables] == ["x_0"]
            assert record.starts.tolist() == [0.25]
            assert record.inputs[:, 0].tolist() == [1.0, *range(40), 9.0]

    def test_are_each_of_their_own_episode(self, recorded, read):
        """However the steps of neighbours are shifted against each other."""
        n, rng, (fmu, spec) = 300, np.random.default_rng(0), recorded
        many = NativePool(fmu, spec, n, LOG, threads=2)
        starting, given = np.ones(n, np.bool_), [[] for _ in range(n)]
        for step in range(100):
            many.reset((fmu.variable("x_0"),), np.full((1, n), 0.001 * step), starting)
            given = [[] if anew else own for anew, own in zip(starting, given, strict=True)]
            inputs, skipped = rng.normal(size=(1, n)), rng.random(n) < 0.02
            many.step(inputs, skipped)
            for index in np.flatnonzero(~skipped):
                given[index].append(inputs[0, index])
            starting = rng.random(n) < 0.005
        assert max(map(len, given)) > 64 > min(map(len, given))
        for own, state in zip(given, many.save_states(np.arange(n), True), strict=True):
            assert read(state).inputs[:, 0].tolist() == own
        many.close()

    def test_that_are_damaged_are_none(self, pool, read):
        """In every byte: it is another record then, or none."""
        (state,) = pool.save_states(np.zeros(1, np.int64), True)
        told = 0
        for place in range(len(state)):
            damaged = bytearray(state)
            damaged[place] ^= 0xFF
            try:
                read(bytes(damaged))
            except SimulationError as error:
                told += "damaged" in str(error)
        assert told > 16


class TestStates:
    @pytest.mark.parametrize("index", [2, -1, 2**40])
    def test_of_instances_that_do_not_exist(self, pool, index):
        (state,) = pool.save_states(np.zeros(1, np.int64), False)
        with pytest.raises(SimulationError, match="a list of instances is damaged"):
            pool.save_states(np.array([index]), False)
        with pytest.raises(SimulationError, match="a list of instances is damaged"):
            pool.restore_states([state], np.array([0]), np.array([index]))

    @pytest.mark.parametrize("records", [False, True])
    def test_that_are_cut_off(self, pool, records):
        """However much of a state is there, it is whole or refused."""
        first = np.zeros(1, np.int64)
        (state,) = pool.save_states(first, records)
        is_whole = {len(state)} if records else set(range(49, len(state) + 1))
        for size in range(len(state) + 1):
            if size not in is_whole:
                with pytest.raises(SimulationError, match="damaged"):
                    pool.restore_states([state[:size]], first, first)
        pool.restore_states([state], first, first)
        assert pool.save_states(first, records) == [state]

    @pytest.mark.parametrize(
        "head",
        [(3, 0, 0), (-1, 0, 0), (2, -1, 0), (2, 0, -1), (2, 2**62, 0), (2, 0, 2**62), (2, 1, 2)],
    )
    def test_with_another_head(self, pool, head):
        (state,) = pool.save_states(np.zeros(1, np.int64), True)
        kind, starts, rows = head
        damaged = struct.pack("<qqdqq", kind, 1, 0.0, starts, rows) + state[40:]
        with pytest.raises(SimulationError, match="damaged"):
            pool.restore_states([damaged], np.array([0]), np.array([0]))

    def test_of_the_wrong_kind(self, pool):
        both, first = np.arange(2), np.zeros(1, np.int64)
        for states in (None, [None], ["text"]):
            with pytest.raises(TypeError):
                pool.restore_states(states, first, first)
        states = pool.save_states(both, False)
        with pytest.raises(SimulationError, match="a list of instances is damaged"):
            pool.restore_states(states, both, np.zeros(2, np.int64))
        with pytest.raises(SimulationError, match="the states differ in number"):
            pool.restore_states(states, both, first)


# Programs


def program(*rows, numbers=(), registers=4, tables=(), **changes):
    """A program with rows of operation, extra, register to write, and three operands."""
    parts = {"code": code(*rows), "constants": b"", "tables": tables, "registers": registers}
    return form_of_program(**(parts | changes)), tuple(numbers)


def conclusion(*rows, first=0):
    """A program that stores zeros as results, in rows from this number on."""
    return program(*stored_results(first, 0, 0, 0), constants=constants(0.0), numbers=rows)


def surroundings(pool):
    return {
        "kept": np.zeros_like(pool.outputs),
        "reads_kept": False,
        "before_inputs": (),
        "before_conclusion": (),
        "starts": tuple((row, np.float64(0.0).tobytes()) for row in pool.inputs),
    }


def prepare(pool, inputs, concluding=None, rows=(0,), draws=None, observation=None, **changes):
    n = pool.num_instances
    return pool.prepare_play(
        (pool.variable("theta_0"),),
        (inputs, concluding or conclusion(*RESULT_ROWS), observation or no_observation()),
        DISCRETE | kept_actions(n) | changes.pop("actions", {}),
        np.zeros((1, n)),
        draws or (uniform_draws(*rows), np.zeros((n, 6), np.uint64)),
        np.ones(n, np.bool_),
        surroundings(pool) | results_of(n, pool.observations.shape[1], len(rows)) | changes,
    )


FAILED = ("load_failed",)
FLOAT, DOUBLE = TYPES.index("f"), TYPES.index("d")


class TestPrograms:
    def test_a_sound_one(self, cart_poles):
        prepare(cart_poles, program(FAILED))

    @pytest.mark.parametrize(
        "row",
        [
            ("load_failed", 1),
            ("load_stopped", 60000),
            ("load_row", 0, 1),
            ("store_row", 0, 0, 1),
            ("store_floats", 0, 0, 0, 1),
            ("cast", 144, 1),
            ("take", 0, 1),
            ("interpolate", 0, 1),
            ("add d", 1, 1),
            ("add d", 0, 4),
            ("add d", 0, 1, 60000),
            ("add d", 0, 1, 0, 60000),
            ("where 8", 0, 1, 0, 0, 4),
            ("negative d", 0, 1, 1),
        ],
        ids=str,
    )
    def test_operands_that_an_operation_does_not_have(self, cart_poles, row):
        with pytest.raises(ValueError, match="the form of a play is damaged"):
            prepare(cart_poles, program(FAILED, row))

    @pytest.mark.parametrize(
        "changes",
        [
            {"code": b"1"},
            {"constants": b"12345678901234567"},
            {"registers": 257},
            {"registers": 0},
            {"constants": np.array([(0, 4, 8, 0)], CONSTANT).tobytes()},
            {"constants": np.array([(0, 0, 9, 0)], CONSTANT).tobytes()},
        ],
        ids=str,
    )
    def test_parts_that_do_not_fit(self, cart_poles, changes):
        with pytest.raises(ValueError, match="the form of a play is damaged"):
            prepare(cart_poles, program(FAILED, **changes))

    @pytest.mark.parametrize(
        ("table", "name"), [(np.zeros(0), "take"), (np.zeros(5), "interpolate")]
    )
    def test_tables_that_are_too_short(self, cart_poles, table, name):
        with pytest.raises(ValueError, match="the form of a play is damaged"):
            prepare(cart_poles, program(FAILED, (name, 0, 1), tables=(table,)))

    def test_rows_of_another_length(self, cart_poles):
        with pytest.raises(ValueError, match="a row of a program must be a vector of"):
            prepare(cart_poles, program(FAILED, numbers=(np.zeros(1),)))

    @pytest.mark.parametrize(
        "actions",
        [
            {"current": np.zeros((3, 3), np.int64)},
            {"current": np.zeros(3, np.float32)},
            {"current": np.zeros(3, np.complex64)},
            {"previous": np.zeros((3, 1), np.int64)},
            {"previous": np.zeros(3)},
            {"current": np.zeros(2, np.int64), "previous": np.zeros(2, np.int64)},
            {"none": np.zeros(1, np.int8)},
        ],
        ids=str,
    )
    def test_actions_that_do_not_fit(self, cart_poles, actions):
        with pytest.raises((TypeError, ValueError), match="action"):
            prepare(cart_poles, program(FAILED), actions=actions)

    @pytest.mark.parametrize(
        "changes",
        [
            {"starts": ((np.zeros(6), 1),)},
            {"starts": ((np.zeros(6, "f4"), 0),)},
            {"before_inputs": ((np.zeros(3, "f4"), np.zeros(3)),)},
            {"before_conclusion": ((np.zeros(3, "f4"), np.zeros(3)),)},
            {"starts": ((np.zeros(3), b"1"),)},
            {"unstepped": ((np.zeros(6, "f4"), 0),)},
            {"unstepped": ((ArrayElement(67, 0, 1, DOUBLE), b"1"),)},
            {"starts": ((np.zeros(6), np.zeros(6, "f4")),)},
            {"kept": np.zeros((1, 1))},
        ],
        ids=str,
    )
    def test_surroundings_that_do_not_fit(self, cart_poles, changes):
        with pytest.raises((TypeError, ValueError), match=r"must|differ|fit|float64|damaged"):
            prepare(cart_poles, program(FAILED), **changes)

    @pytest.mark.parametrize(
        "rows",
        [
            [ArrayElement(67, 0, 1, DOUBLE)],
            [ArrayElement(-1, 0, 1, DOUBLE)],
            [ArrayElement(4, 0, 1, DOUBLE)],
            [ArrayElement(1, 1, 1, DOUBLE)],
            [ArrayElement(1, 0, 2**40, DOUBLE)],
            [ArrayElement(1, 0, 1, 5)],
            [ArrayElement(1, 0, 1, FLOAT)],
            [ArrayElement(0, 0, 2, FLOAT), ArrayElement(0, 0, 2, DOUBLE)],
            [ArrayElement(0, 0, 3, FLOAT)],
        ],
        ids=str,
    )
    def test_elements_of_arrays_that_do_not_exist(self, cart_poles, rows):
        """A conclusion that stores in them would write beyond the results."""
        store_none = program(FAILED, numbers=(*rows, *RESULT_ROWS))
        with pytest.raises(ValueError, match=r"damaged|do not fit"):
            prepare(cart_poles, program(FAILED), store_none)

    def test_results_that_no_program_stores(self, cart_poles):
        with pytest.raises(ValueError, match="the arrays of results do not fit"):
            prepare(cart_poles, program(FAILED), program(FAILED), unstepped=())

    def test_results_where_there_are_none(self, cart_poles):
        """Before a step there are no arrays, at the start of an episode only observations."""
        with pytest.raises(ValueError, match="there is no such row"):
            prepare(cart_poles, conclusion(*RESULT_ROWS))
        with pytest.raises(ValueError, match="there is no such element"):
            prepare(cart_poles, program(FAILED), observation=conclusion(*RESULT_ROWS))

    def test_results_that_a_program_would_load(self, cart_poles):
        loading = program(("load_row", 0, 0), numbers=RESULT_ROWS)
        with pytest.raises(ValueError, match="its parts do not fit together"):
            prepare(cart_poles, program(FAILED), loading)

    @pytest.mark.parametrize("row", [1, 2**40])
    def test_rows_beyond_the_start_values(self, cart_poles, row):
        """They say where in memory draws are written."""
        prepare(cart_poles, program(FAILED), rows=(0, -1))
        with pytest.raises(ValueError, match="one is for no start value"):
            prepare(cart_poles, program(FAILED), rows=(row,))

    def test_what_does_not_hold_draws(self, cart_poles):
        draws, states = uniform_draws(0), np.zeros((6, 6), np.uint64)
        for odd in ((draws, states[:, :5]), (draws, states.view(np.int64)), (b"", states)):
            with pytest.raises((TypeError, ValueError)):
                prepare(cart_poles, program(FAILED), draws=odd)


# Memory

SCARCE = """
import json, resource, sys
from test_native_pool import FMU, LOG, FMULoadError, NativePool, PoolSpec, bundled_fmu
n = 200_000
results = []

def attempt():
    fmu = FMU(bundled_fmu("CartPole"))
    spec = PoolSpec((), (fmu.variable("x"),), 0.05, num_observed=1)
    limited = int(open("/proc/self/statm").read().split()[0]) * resource.getpagesize()
    return fmu, spec, limited

for extra in range(0, 160, 4):
    fmu, spec, size = attempt()
    limit = size + extra * 2**20
    resource.setrlimit(resource.RLIMIT_AS, (limit, resource.RLIM_INFINITY))
    try:
        pool = NativePool(fmu, spec, n, LOG, threads=1)
        result = "made"
    except (MemoryError, FMULoadError) as error:
        result = type(error).__name__
    except BaseException as error:
        result = repr(error)
    resource.setrlimit(resource.RLIMIT_AS, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
    pool = None
    results.append(result)
print(json.dumps(results))
"""


@on_linux
def test_want_of_memory_in_any_part_of_a_pool():
    done = run_python("-c", SCARCE)
    assert done.returncode == 0, done.stderr[-2000:]
    results = json.loads(done.stdout)
    assert set(results) <= {"MemoryError", "FMULoadError", "made"}, results
    assert "made" in results, "there was enough memory at last"
    assert results.index("made") > 5, "there was too little at first"


# Libraries and calls


def test_a_library_that_cannot_be_bound_when_it_is_loaded_anew(probe, temp_root):
    pool = make(NativePool, probe(), ["a"], ["sum"], 2, private_libraries=True)
    variables = tuple(map(pool.variable, ("fault", "fault_step")))
    pool.reset(variables, np.array([[4.0, 0.0], [1.0, 1.0]]))
    assert pool.step()[1].tolist() == [Status.FATAL, Status.OK]
    (copy,) = (p for p in temp_root.rglob("*") if p.is_file() and p.parts[-2:-1] == ("0",))
    copy.unlink()
    copy.write_bytes(Path(_library_without_fmi()).read_bytes())
    for _ in range(2):
        statuses = pool.reset((), np.zeros((0, 2)), np.array([True, False]))[1]
        assert statuses.tolist() == [Status.FATAL, Status.OK]
        assert "cannot be loaded anew" in pool.failure(0)
    assert pool.step()[1].tolist()[1] == Status.OK
    pool.close()


def _library_without_fmi():
    """Any library that has nothing of FMI."""
    import fmugym._native

    return fmugym._native.__file__


def test_after_an_error_no_other_type_is_set(probe):
    """The standard allows only a reset then."""
    pool = make(NativePool, probe(), ["a", "n", "on"], ["illegal"], 1)
    pool.reset((pool.variable("set_status"),), np.array([[3.0]]))
    assert pool.step()[1].tolist() == [Status.ERROR]
    pool.reset((), np.zeros((0, 1)))
    pool.step()
    assert pool.outputs.tolist() == [[0.0]]
    pool.close()


# The floating-point environment


@pytest.mark.skipif(sys.platform != "linux", reason="the zoo's faults are those of Linux")
def test_what_an_instantiation_changes_does_not_stay(tmp_path):
    fault, call = zoo_tools.FAULTS.index("round_up"), zoo_tools.CALLS.index("instantiate")
    path = zoo_tools.zoo_fmu(tmp_path, 2, f"{{zoo {fault} {call} 0}}")
    pool = make(NativePool, path, ["u"], ["y"], 2)
    assert 1.0 + float("1e-30") == 1.0
    pool.close()


@pytest.mark.skipif(sys.platform != "linux", reason="the zoo's faults are those of Linux")
@in_turn(
    {
        "version,fault": list(product((1, 2, 3), ("round_up", "flush_denormals"))),
        "substeps": [1, 2],
        "threads": [1, 3],
    }
)
def test_an_instance_that_changes_it_changes_no_other(tmp_path, version, fault, substeps, threads):
    """The sums of steps of 0.1 and of denormal numbers depend on it."""
    path = zoo_tools.zoo_fmu(tmp_path, version)
    n = 90
    names = ("fault", "call", "at")
    harmful = np.zeros((3, n))
    calls = [zoo_tools.CALLS.index(call) for call in ("exit", "set", "step", "get", "reset")]
    harmful[0, ::3] = zoo_tools.FAULTS.index(fault)
    harmful[1, ::3] = np.resize(calls, n // 3)
    inputs = np.where(np.arange(n) % 2, 0.1, 3e-320)[None]
    outputs = []
    for values in (np.zeros((3, n)), harmful):
        pool = make(
            NativePool, path, ["u"], ["y"], n, time_step=0.3, substeps=substeps, threads=threads
        )
        variables = tuple(map(pool.variable, names))
        for _ in range(3):
            pool.reset(variables, values)
            for _ in range(20):
                pool.step(inputs)
        outputs.append(pool.outputs[0].copy())
        pool.close()
        assert 1.0 + float("1e-30") == 1.0
        assert float("4e-324") * 1.0 > 0.0
    others = np.arange(n) % 3 > 0
    assert outputs[0][others].tobytes() == outputs[1][others].tobytes()
