"""Clocks whose intervals are fractions of a second: they tick at exact times."""

import ctypes
import logging
from contextlib import closing
from fractions import Fraction
from itertools import takewhile

import clocks_tools
import fmpy
import fmu_tools
import numpy as np
import pytest
from fmpy.fmi3 import FMU3Model
from pool_kinds import POOLS

from fmugym import FMU, FMULoadError
from fmugym.archive.variable import Interval
from fmugym.pool import PoolSpec
from fmugym.trial import opening

LOG = logging.getLogger("fmugym.test")
TIMED = ("constant", "fixed", "calculated", "tunable", "changing", "countdown")
all_kinds = pytest.mark.parametrize("kind", list(POOLS))
both_interfaces = pytest.mark.parametrize("interface", ["CoSimulation", "ModelExchange"])


@pytest.fixture(scope="module")
def fmu_path(tmp_path_factory):
    folder = tmp_path_factory.mktemp("fractions")
    return {
        interface: clocks_tools.clocks_fmu(
            folder / f"{interface}.fmu", interface, clocks=clocks_tools.FRACTIONS
        )
        for interface in ("CoSimulation", "ModelExchange")
    }


def open_pool(path, kind, step, outputs):
    fmu = FMU(path, probe_timeout=None)
    spec = PoolSpec((), tuple(map(fmu.variable, outputs)), time_step=step)
    return closing(opening.make_pool(fmu, spec, 1, LOG, **POOLS[kind]))


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


def check(found, until):
    for name in TIMED:
        count, last = last_tick(name, until)
        assert found[f"count of {name}"] == count, (name, until)
        if name == "countdown":  # it begins at 0.3, which no float64 is
            assert found[f"last {name}"] == pytest.approx(float(last), abs=1e-9)
        else:
            assert found[f"last {name}"] == float(last), (name, until)


OUTPUTS = tuple(f"{what} {name}" for what in ("count of", "last") for name in TIMED)


@all_kinds
@both_interfaces
@pytest.mark.parametrize("size", [0.1, 0.77, 5.0])
def test_each_ticks_at_its_exact_times(fmu_path, kind, interface, size):
    with open_pool(fmu_path[interface], kind, size, OUTPUTS) as pool:
        pool.reset((), np.zeros((0, 1)))
        assert not pool.statuses.any(), pool.failure(0)
        for index in range(int(5 / size)):
            outputs, statuses = pool.step()
            assert not statuses.any(), pool.failure(0)
            until = Fraction(round((index + 1) * size * 100), 100)
            check(dict(zip(OUTPUTS, outputs[:, 0], strict=True)), until)


@both_interfaces
def test_ticks_do_not_drift(fmu_path, interface):
    """In 10,000 s, to the last bit: some multiples of a rounded 1/7 s would not be."""
    with open_pool(fmu_path[interface], "native", 10.0, OUTPUTS) as pool:
        pool.reset((), np.zeros((0, 1)))
        for index in range(1000):
            outputs, statuses = pool.step()
            assert not statuses.any(), pool.failure(0)
            if index % 37 == 0:
                found = dict(zip(OUTPUTS, outputs[:, 0], strict=True))
                check(found, Fraction(10 * (index + 1)))


@both_interfaces
def test_a_restored_state_goes_on_with_the_same_ticks(fmu_path, interface):
    ends = []
    with open_pool(fmu_path[interface], "native", 0.37, OUTPUTS) as pool:
        pool.reset((), np.zeros((0, 1)))
        for _ in range(7):
            pool.step()
        snapshot = pool.save()
        for _ in range(2):
            ends.append([pool.step()[0].tolist() for _ in range(20)])
            pool.restore(snapshot)
    assert ends[0] == ends[1]


def test_a_fraction_that_is_none_is_named(fmu_path):
    with open_pool(fmu_path["ModelExchange"], "native", 0.1, OUTPUTS) as pool:
        variable = FMU(fmu_path["ModelExchange"]).variable("bad counter")
        pool.reset((variable,), np.full((1, 1), 5.0))
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
def test_numbers_too_large_for_exact_fractions_begin_anew(tmp_path, interface):
    """No double holds the common denominators of these, nor sums of these counters."""
    path = clocks_tools.clocks_fmu(
        tmp_path / "large.fmu", interface, clocks=clocks_tools.FRACTIONS, scale=2**50
    )
    with open_pool(path, "native", 10.0, OUTPUTS) as pool:
        outputs, _ = pool.reset((), np.zeros((0, 1)))
        for end in (10, 20):
            outputs, statuses = pool.step()
            assert not statuses.any(), pool.failure(0)
            found = dict(zip(OUTPUTS, outputs[:, 0], strict=True))
            for name in TIMED:
                count, last = last_tick(name, Fraction(end))
                assert found[f"count of {name}"] == count
                assert found[f"last {name}"] == pytest.approx(float(last), abs=1e-9)
