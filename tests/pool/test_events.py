"""Event mode in co-simulation, clocks, early return: FMI 3.0."""

import contextlib
import functools
from itertools import product

import clocks_tools
import exchange_tools
import fmu_tools
import numpy as np
import pytest
import wine_tools
from combinations import in_turn
from pool_tools import KINDS, open_pool, reset, start, step
from vector_tools import require_same_alone

from fmugym import FMU, ConfigError
from fmugym.cli.class_skeleton import Skeleton

TIMED = ("constant", "fixed", "calculated", "tunable", "changing", "countdown")
COUNTS = tuple(f"count of {name}" for name in clocks_tools.CLOCKS)
LASTS = tuple(f"last {name}" for name in clocks_tools.CLOCKS)
all_kinds = pytest.mark.parametrize("kind", [*KINDS, "wine"])
PAIRS = [
    *(("native", "CoSimulation"), ("native", "ModelExchange")),
    *(("process", "ModelExchange"), ("wine", "CoSimulation")),
]
each_pair = pytest.mark.parametrize(("kind", "interface"), PAIRS)
both_interfaces = pytest.mark.parametrize("interface", ["CoSimulation", "ModelExchange"])


@pytest.fixture(scope="session")
def fmu_path(tmp_path_factory):
    @functools.cache
    def make(
        interface="CoSimulation", event_mode=True, building=contextlib.nullcontext, arrays=False
    ):
        path = tmp_path_factory.mktemp("clocks") / "Clocks.fmu"
        with building():
            return clocks_tools.clocks_fmu(path, interface, event_mode, arrays=arrays)

    return make


@pytest.fixture
def make_pool(request, fmu_path, opened):
    def make(kind, interface="CoSimulation", n=1, inputs=(), outputs=COUNTS, step=0.1, **spec):
        arrays = any(name.endswith("]") for name in inputs)
        building = contextlib.nullcontext
        if kind == "wine":
            request.getfixturevalue("wine")
            building = wine_tools.building_for_windows
        fmu = FMU(fmu_path(interface, building=building, arrays=arrays), probe_timeout=None)
        return opened(open_pool(fmu, inputs, outputs, step, n, KINDS.get(kind, {}), **spec))

    return make


def ticks_of(period=0.2, pace=0.5, until=10.0):
    """The times of all ticks by the definitions in ``exchange/clocks.c``."""
    many = np.arange(1000)
    changing = 0.1 * many * (many + 3) / 2
    times = {
        "constant": 0.05 + 0.1 * many,
        "fixed": 0.25 * many,
        "calculated": period * (0.5 + many),
        "tunable": pace * many,
        "changing": changing,
        "countdown": 0.55 + many,
    }
    return {name: values[values <= until + 1e-9] for name, values in times.items()}


class TestTimedClocks:
    @in_turn({"kind,interface": PAIRS, "size": [0.1, 0.37, 1.3]})
    def test_each_ticks_at_its_times_within_steps(self, make_pool, kind, interface, size):
        pool = start(make_pool(kind, interface, outputs=COUNTS + LASTS, step=size))
        for index in range(int(5 / size)):
            now = (index + 1) * size
            found = dict(zip(COUNTS + LASTS, step(pool)[:, 0], strict=True))
            for name, times in ticks_of(until=now).items():
                assert found[f"count of {name}"] == len(times), (name, now)
                last = times[-1] if len(times) else -1.0
                assert found[f"last {name}"] == pytest.approx(last, abs=1e-9)

    @both_interfaces
    def test_ticks_do_not_drift(self, make_pool, interface):
        pool = start(make_pool("native", interface, outputs=("last constant",), step=10.0))
        for index in range(1000):
            last = step(pool)[0, 0]
            assert last == pytest.approx(10.0 * (index + 1) - 0.05, abs=1e-10)

    @each_pair
    def test_each_instance_has_its_own_clocks(self, make_pool, kind, interface):
        periods, paces = np.array([0.2, 0.3, 0.7]), np.array([0.5, 0.11, 1.3])
        pool = start(make_pool(kind, interface, n=3), {"period": periods, "pace": paces})
        for _ in range(23):
            found = step(pool)
        for i in range(3):
            for name, times in ticks_of(periods[i], paces[i], until=2.3).items():
                assert found[COUNTS.index(f"count of {name}"), i] == len(times)

    @each_pair
    def test_a_new_interval_of_a_tunable_clock_begins_with_its_next_tick(
        self, make_pool, kind, interface
    ):
        pool = start(make_pool(kind, interface, inputs=("pace",), outputs=("last tunable",)))
        lasts = [step(pool, 0.5 if now < 0.65 else 0.2)[0, 0] for now in np.arange(15) * 0.1]
        expected = [0.0] * 4 + [0.5] * 5 + [1.0, 1.0, 1.2, 1.2, 1.4, 1.4]
        np.testing.assert_allclose(lasts, expected, atol=1e-9)

    @all_kinds
    def test_early_returns_leave_the_time_of_the_step(self, make_pool, kind):
        pool = start(make_pool(kind, outputs=("x", *COUNTS), step=0.5), {"eager": 0.013})
        for index in range(6):
            found = step(pool)[:, 0]
            assert found[0] == pytest.approx(0.5 * (index + 1), abs=1e-12)
        for name, times in ticks_of(until=3.0).items():
            assert found[1 + COUNTS.index(f"count of {name}")] == len(times)


class TestEarlyReturn:
    """Without event mode: FMI 3.0 by a flag, FMI 2.0 by Discard and the last successful time."""

    @in_turn({"kind,version": list(product(KINDS, (2, 3))), "size": [0.1, 0.37]})
    def test_the_rest_of_the_step_follows(self, tmp_path, opened, kind, version, size):
        ends = {}
        for options in ((), ("-DEARLY=0.03",)):
            path = exchange_tools.exchange_fmu(
                tmp_path / "model.fmu", "dahlquist", version, ("CoSimulation",), "", options
            )
            fmu = FMU(path, probe_timeout=None)
            pool = opened(open_pool(fmu, ["u"], ["x"], size, 2, KINDS[kind]))
            start(pool)
            ends[options] = [step(pool, 0.5)[0] for _ in range(10)]
        plain, early = ends.values()
        np.testing.assert_allclose(early, plain, rtol=2e-3)  # its Euler steps end elsewhere

    @in_turn({"kind": list(KINDS), "name": ["constant", "fixed"]})
    def test_a_clock_without_interval_is_named(self, fmu_path, tmp_path, opened, kind, name):
        given = {"constant": ' intervalDecimal="0.1"', "fixed": ' intervalCounter="1"'}[name]
        fmu = FMU(fmu_tools.edited_fmu(fmu_path(), tmp_path, {given: ""}), probe_timeout=None)
        pool = opened(open_pool(fmu, (), ["x"], options=KINDS[kind]))
        reset(pool)
        reference = list(clocks_tools.CLOCKS).index(name)
        assert f"value reference {reference} has an interval of nan" in pool.failure(0)


class TestTriggeredClocks:
    @each_pair
    def test_an_input_clock_ticks_when_it_is_set(self, make_pool, kind, interface):
        outputs = ("count of strike", "last strike", "strike")
        pool = start(make_pool(kind, interface, inputs=("strike",), outputs=outputs))
        found = np.array([step(pool, value)[:, 0] for value in (0, 1, 1, 0, 1, 0)])
        np.testing.assert_array_equal(found[:, 0], [0, 1, 2, 2, 3, 3])
        np.testing.assert_allclose(found[:, 1], [-1, 0.1, 0.2, 0.2, 0.4, 0.4], atol=1e-12)
        np.testing.assert_array_equal(found[:, 2], [0, 1, 1, 0, 1, 0])

    @each_pair
    def test_an_output_clock_tells_whether_it_ticked_in_the_step(self, make_pool, kind, interface):
        pool = start(make_pool(kind, interface, outputs=("bell", "count of bell", "countdown")))
        found = np.array([step(pool)[:, 0] for _ in range(7)])
        np.testing.assert_array_equal(found[:, 0], [0, 0, 1, 0, 0, 1, 0])
        np.testing.assert_array_equal(found[:, 1], [0, 0, 1, 1, 1, 2, 2])
        np.testing.assert_array_equal(found[:, 2], [0, 0, 0, 0, 0, 1, 0])


class TestClockedInputs:
    @each_pair
    def test_a_value_takes_effect_with_the_next_tick(self, make_pool, kind, interface):
        pool = make_pool(
            kind, interface, inputs=("command", "plain"), outputs=("sample",), step=0.04
        )
        start(pool)
        values = np.arange(12) + 1.0
        found = [step(pool, value, 0.5 * value)[0, 0] for value in values]
        ticks = 0.05 + 0.1 * np.arange(10)
        ends = 0.04 * (np.arange(12) + 1)
        held = [max([values[int(t // 0.04)] for t in ticks if t <= e], default=0) for e in ends]
        np.testing.assert_array_equal(found, held)

    @each_pair
    def test_so_do_those_of_arrays(self, make_pool, kind, interface):
        """Scalars and arrays, with and without clocks, in any order."""
        inputs = ("plains[2]", "command", "commands[1]", "plain", "plains[1]", "commands[2]")
        outputs = ("sample", "samples[1]", "samples[2]", "plains[1]", "plains[2]", "plain")
        pool = make_pool(kind, interface, 2, inputs=inputs, outputs=outputs, step=0.04)
        start(pool)
        given = np.random.default_rng(3).uniform(-1, 1, (12, len(inputs), 2))
        ticks = 0.05 + 0.1 * np.arange(10)
        for index, values in enumerate(given):
            found = step(pool, *values)
            latest = [int(t // 0.04) for t in ticks if t <= 0.04 * (index + 1)]
            held = given[latest[-1]][[1, 2, 5]] if latest else np.zeros((3, 2))
            np.testing.assert_array_equal(found[:3], held)
            np.testing.assert_array_equal(found[3:], values[[4, 0, 3]])


class TestStates:
    @each_pair
    def test_a_restored_state_goes_on_with_the_same_ticks(self, make_pool, kind, interface):
        inputs = ("strike", "command")
        pool = make_pool(kind, interface, 2, inputs, COUNTS + LASTS + ("sample", "bell"))
        start(pool, {"pace": [0.5, 0.15]})
        actions = np.random.default_rng(1).integers(0, 2, (40, 2))
        for action in actions[:13]:
            step(pool, *action)
        snapshot = pool.save()
        first = [step(pool, *action) for action in actions[13:]]
        pool.restore(snapshot)
        again = [step(pool, *action) for action in actions[13:]]
        np.testing.assert_array_equal(first, again)


class TestEnvironments:
    CONFIG = {  # noqa: RUF012
        "model_input_names": ["strike", "command"],
        "model_output_names": ["x", "sample", "bell", "strike"],
        "bounds": {"command": (-1, 1)},
        "time_step": 0.1,
        "max_episode_steps": 20,
    }

    @pytest.mark.parametrize("isolation", ["none", "process"])
    def test_single_and_vector_environments_agree(self, fmu_path, isolation):
        path = fmu_path()
        require_same_alone(lambda: fmu_tools.PlainEnv(path, self.CONFIG, isolation=isolation), 15)


class TestRefusals:
    @pytest.mark.parametrize("name", [*TIMED, "bell"])
    def test_clocks_that_tick_by_themselves_are_no_inputs(self, fmu_path, name):
        with pytest.raises(ConfigError, match=f"'{name}'.*triggered"):
            fmu_tools.PlainEnv(
                fmu_path(), {"model_input_names": [name], "model_output_names": ["x"]}
            )

    def test_clocks_need_event_mode(self, fmu_path):
        config = {"model_input_names": ["strike"], "model_output_names": ["x"]}
        with pytest.raises(ConfigError, match=r"'strike'.*event mode"):
            fmu_tools.PlainEnv(fmu_path(event_mode=False), config)

    def test_clocks_have_no_start_values(self, fmu_path):
        config = {
            "model_input_names": ["plain"],
            "model_output_names": ["x"],
            "model_parameters": {"strike": 1},
        }
        with pytest.raises(ConfigError, match=r"'strike'.*clock"):
            fmu_tools.PlainEnv(fmu_path(), config)


class TestProposals:
    @pytest.mark.parametrize("event_mode", [True, False])
    def test_name_only_clocks_that_may_be_used(self, fmu_path, event_mode):
        skeleton = Skeleton(FMU(fmu_path(event_mode=event_mode)))
        clocks = {name for name in clocks_tools.CLOCKS if event_mode}
        assert {v.name for v in skeleton.inputs} == {"command", "plain"} | clocks & {"strike"}
        assert {v.name for v in skeleton.outputs} & set(clocks_tools.CLOCKS) == clocks & {"bell"}
