"""Clocks whose intervals are fractions of a second: they tick at exact times."""

import ctypes
from fractions import Fraction
from itertools import product, takewhile

import clocks_tools
import fmpy
import fmu_tools
import pytest
from combinations import in_turn
from fmpy.fmi3 import FMU3Model
from pool_tools import KINDS, open_pool, reset, start, step

from fmugym import FMU, FMULoadError
from fmugym.fmi.variable import Interval

TIMED = ("constant", "fixed", "calculated", "tunable", "changing", "countdown")
INTERFACES = ("CoSimulation", "ModelExchange")
both_interfaces = pytest.mark.parametrize("interface", INTERFACES)


@pytest.fixture(scope="module")
def fmu_path(tmp_path_factory):
    folder = tmp_path_factory.mktemp("fractions")
    return {
        interface: clocks_tools.clocks_fmu(
            folder / f"{interface}.fmu", interface, clocks=clocks_tools.FRACTIONS
        )
        for interface in INTERFACES
    }


@pytest.fixture
def make_pool(opened):
    def make(path, step, kind="native"):
        fmu = FMU(path, probe_timeout=None)
        return opened(open_pool(fmu, (), OUTPUTS, step, options=KINDS[kind]))

    return make


def last_tick(name, until):
    """How often a clock has ticked, and when last, by the definitions in ``exchange/clocks.c``."""
    third = Fraction(1, 3)
    if name == "tunable":
        rounds, rest = divmod(until, third + Fraction(1, 4))
        extra = rest >= Fraction(1, 4)
        return int(2 * rounds + extra + 1), rounds * Fraction(7, 12) + extra * Fraction(1, 4)
    if name == "changing":
        *_, last = takewhile(lambda k: Fraction(k * (k + 3), 60) <= until, range(10**4))
        return last + 1, Fraction(last * (last + 3), 60)
    interval, shift = {
        "constant": (third, third),
        "fixed": (Fraction(1, 7), Fraction(0)),
        "calculated": (third, Fraction(1, 7)),
        "countdown": (Fraction(1), Fraction(11, 20)),
    }[name]
    passed = (until - shift) // interval
    return (0, -1) if passed < 0 else (int(passed + 1), shift + passed * interval)


def check(pool, until, exact=True):
    found = dict(zip(OUTPUTS, pool.outputs[:, 0], strict=True))
    for name in TIMED:
        count, last = last_tick(name, until)
        assert found[f"count of {name}"] == count, (name, until)
        if name == "countdown" or not exact:  # it begins at 0.3, which no float64 is
            assert found[f"last {name}"] == pytest.approx(float(last), abs=1e-9)
        else:
            assert found[f"last {name}"] == float(last), (name, until)


OUTPUTS = tuple(f"{what} {name}" for what in ("count of", "last") for name in TIMED)


@in_turn({"kind,interface": list(product(KINDS, INTERFACES)), "size": [0.1, 0.77, 5.0]})
def test_each_ticks_at_its_exact_times(fmu_path, make_pool, kind, interface, size):
    pool = start(make_pool(fmu_path[interface], size, kind))
    for index in range(int(5 / size)):
        step(pool)
        check(pool, Fraction(round((index + 1) * size * 100), 100))


@both_interfaces
def test_ticks_do_not_drift(fmu_path, make_pool, interface):
    """In 10,000 s, to the last bit: some multiples of a rounded 1/7 s would not be."""
    pool = start(make_pool(fmu_path[interface], 10.0))
    for index in range(1000):
        step(pool)
        if index % 37 == 0:
            check(pool, Fraction(10 * (index + 1)))


def test_a_fraction_that_is_none_is_named(fmu_path, make_pool):
    pool = make_pool(fmu_path["ModelExchange"], 0.1)
    reset(pool, {"bad counter": 5.0})
    assert "value reference 2" in pool.failure(0)
    assert "5/0 s" in pool.failure(0)


@pytest.mark.parametrize("resolution", ["0", "three", "9007199254740993"])
def test_a_bad_resolution_is_named(fmu_path, tmp_path, resolution):
    edits = {'resolution="7"': f'resolution="{resolution}"'}
    path = fmu_tools.edited_fmu(fmu_path["ModelExchange"], tmp_path, edits)
    with pytest.raises(FMULoadError) as caught:
        _ = FMU(path).description
    for fact in ("'fixed'", f"resolution='{resolution}'", "4503599627370496"):
        assert fact in str(caught.value)


def test_fmpy_gets_the_same_fractions(fmu_path):
    """What the description and the pool know of the clocks, by FMPy's own calls."""
    path = str(fmu_path["ModelExchange"])
    description = fmpy.read_model_description(path, validate=False)  # no "calculated"
    model = FMU3Model(
        guid=description.guid,
        unzipDirectory=fmpy.extract(path),
        modelIdentifier="Clocks",
        instanceName="fmpy",
    )
    model.instantiate()
    model.enterInitializationMode()
    counter, resolution = ctypes.c_uint64(), ctypes.c_uint64()
    found = {}
    for name in ("calculated", "tunable", "changing"):
        reference = (ctypes.c_uint32 * 1)(list(clocks_tools.FRACTIONS).index(name))
        model.getIntervalFraction(reference, counter, resolution, ctypes.c_int())
        found[name] = counter.value, resolution.value
    model.freeInstance()
    assert found == {"calculated": (1, 3), "tunable": (1, 3), "changing": (1, 30)}
    constant = FMU(path).variable("constant")
    assert constant.interval == Interval(1 / 3, 1, 3)
    assert constant.by_fractions


@both_interfaces
def test_numbers_too_large_for_exact_fractions_begin_anew(tmp_path, make_pool, interface):
    """No double holds the common denominators of these, nor sums of these counters."""
    path = clocks_tools.clocks_fmu(
        tmp_path / "large.fmu", interface, clocks=clocks_tools.FRACTIONS, scale=2**50
    )
    pool = start(make_pool(path, 10.0))
    for end in (10, 20):
        step(pool)
        check(pool, Fraction(end), exact=False)
