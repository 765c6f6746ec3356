"""Units and durations of declared tasks become numbers."""

import math

import pytest

import fmugym
from fmugym import ConfigError
from fmugym.checks import duration
from fmugym.fmi.description import Unit
from fmugym.fmi.units import conversion_between

METRE = Unit((0, 1, 0, 0, 0, 0, 0, 0), display_units={"mm": (1000.0, 0.0)})
KELVIN = Unit((0, 0, 0, 0, 1, 0, 0, 0), display_units={"degC": (1.0, -273.15)})
DEFINED = {
    "m": METRE,
    "km": Unit(METRE.dimension, 1000.0),
    "K": KELVIN,
    "degF": Unit(KELVIN.dimension, 5 / 9, 459.67 * 5 / 9),
    "strange": Unit(METRE.dimension, 7.0),
    "bare": Unit(display_units={"half": (0.5, 1.0)}),
}

CONVERSIONS = [
    ("m", "mm", 1.5, 1500.0),
    ("m", "km", 1500.0, 1.5),
    ("km", "mm", 2.0, 2e6),
    ("strange", "m", 2.0, 14.0),
    ("K", "degC", 300.0, 26.85),
    ("degF", "degC", 212.0, 100.0),
    ("K", "degF", 373.15, 212.0),
    ("bare", "half", 4.0, 3.0),
    ("W", "kW", 1500.0, 1.5),
    ("rad/s", "rpm", 2 * math.pi, 60.0),
    ("W/(m2.K)", "kW/(m**2*K)", 1000.0, 1.0),
    ("Pa", "bar", 1e5, 1.0),
    ("kg.m2/s2", "kJ", 1000.0, 1.0),
    ("m3/s", "l/min", 1e-3, 60.0),
    ("1", "%", 0.5, 50.0),
    ("J", "kWh", 3.6e6, 1.0),
    (None, "kW", 3.0, 3.0),
    ("W", None, 3.0, 3.0),
]


@pytest.mark.parametrize(("own", "wanted", "value", "expected"), CONVERSIONS)
def test_units_are_converted_there_and_back(own, wanted, value, expected):
    conversion = conversion_between(own, wanted, DEFINED)
    assert conversion(value) == pytest.approx(expected, rel=1e-12)
    assert conversion.inverse(expected) == pytest.approx(value, rel=1e-12)


@pytest.mark.parametrize(("own", "wanted"), [("m", "kg"), ("m", "mtr"), ("strng", "m"), ("K", ")")])
def test_units_that_do_not_fit_are_named(own, wanted):
    with pytest.raises(ConfigError, match=r"'(kg|mtr|strng|\))'"):
        conversion_between(own, wanted, DEFINED)


@pytest.mark.parametrize("version", ["1.0", "2.0", "3.0"])
def test_units_of_every_version_of_fmi_are_read(version):
    fmu = fmugym.FMU(fmugym.bundled_fmu("Pendulum", version))
    conversion = conversion_between("rad", "deg", fmu.description.units)
    assert conversion(math.pi) == pytest.approx(180.0, rel=1e-14)
    assert "deg" in fmu.description.units["rad"].display_units


@pytest.mark.parametrize(
    ("value", "seconds"),
    [("15min", 900), ("0.02s", 0.02), ("20ms", 0.02), ("1h 30min", 5400), ("2d", 172800), (3, 3)],
)
def test_durations(value, seconds):
    assert duration("t", value) == seconds


@pytest.mark.parametrize(
    "value", ["", "15", "15 minutes", "-1s", "min", "1h30", None, -1, "1e999s"]
)
def test_what_is_no_duration(value):
    with pytest.raises(ConfigError, match=r"^t must"):
        duration("t", value)
