"""The parts of declared tasks: expressions, units, durations."""

import math

import numpy as np
import pytest

import fmugym
from fmugym import ConfigError
from fmugym.checks import duration
from fmugym.expressions.functions import FUNCTIONS
from fmugym.expressions.graph import Graph, Value
from fmugym.expressions.language import Expression, Names
from fmugym.expressions.numpy_evaluation import function_of
from fmugym.fmi.description import Unit
from fmugym.fmi.units import conversion_between


class Env:
    def __init__(self, a, b):
        self.a, self.b = a, b


def function_of_text(text):
    graph = Graph()
    a, b = (Value.read(graph, name) for name in "ab")
    found = {"a": a, "b": b, "flag": a > 0.0}
    names = Names(graph, found.get, known=lambda: list(found))
    value = Expression.parse(text).value(names)
    return function_of(value)


VALUES = np.array([0.0, -0.0, 0.3, -0.7, 1.5, -2.5, 3.0, 1e-300, -1e300, 5.0, math.pi, 80.0])
PAIRS = np.array(np.meshgrid(VALUES, VALUES)).reshape(2, -1)

EXPRESSIONS = {
    "a + 2 * b": lambda a, b: a + 2 * b,
    "(a + 1) / b": lambda a, b: np.divide(a + 1, b),
    "a % b": np.remainder,
    "a ** b": np.float_power,
    "-a ** 2": lambda a, b: -np.float_power(a, 2.0),
    "2 ** -1 * a": lambda a, b: 0.5 * a,
    "a < b <= 3": lambda a, b: (a < b) & (b <= 3),
    "not a < b or b == a": lambda a, b: ~(a < b) | (b == a),
    "a if a > b else b": np.maximum,
    "(a > b) + (a != b)": lambda a, b: (a > b) * 1.0 + (a != b),
    "flag if a > b else a < -1": lambda a, b: np.where(a > b, a > 0, a < -1),
    "flag * b": lambda a, b: (a > 0) * b,
    "min(a, b, 1)": lambda a, b: np.minimum(np.minimum(a, b), 1),
    "clip(a, -1, b)": lambda a, b: np.minimum(np.maximum(a, -1), b),
    "float32(a)": lambda a, b: a.astype(np.float32).astype(np.float64),
    "12 * 2 * pi / 360 + a": lambda a, b: 12 * 2 * math.pi / 360 + a,
    "1 / 0 * a": lambda a, b: np.inf * a,
}


@pytest.mark.parametrize("text", EXPRESSIONS)
def test_an_expression_has_the_value_of_numpy(text):
    function = function_of_text(text)
    with np.errstate(all="ignore"):
        expected = EXPRESSIONS[text](*PAIRS)
    np.testing.assert_array_equal(function(Env(*PAIRS)), expected)


def calls():
    for name, function in FUNCTIONS.items():
        arguments = ["a", "b", "0.5"][: function.most or 3]
        yield f"{name}({', '.join(arguments)})"


@pytest.mark.parametrize("text", [*EXPRESSIONS, *calls()])
def test_one_number_has_the_same_value_as_an_element(text):
    function = function_of_text(text)
    together = function(Env(*PAIRS))
    alone = [float(function(Env(a, b))) for a, b in PAIRS.T.tolist()]
    same = np.asarray(together, float)
    np.testing.assert_array_equal(alone, same)
    numbers = ~np.isnan(same)
    np.testing.assert_array_equal(np.signbit(alone)[numbers], np.signbit(same)[numbers])


REFUSED = {
    "a[0]": "unknown name",
    "[a]": "list",
    "1j": "no number",
    "1e999": "no number",
    "a // b": r"operator in 'a // b'",
    "a & b": r"operator in 'a & b'",
    "~a": "not",
    "a is b": "Is",
    "a and b": "condition",
    "b if a else 1": "condition",
    "sin": "'min'|'sin'",
    "sin(x=a)": "by place",
    "min(*a)": "by place",
    "a.b(1)": "by their names",
    "(x := a)": "namedexpr",
    "exec(a)": "'exec'",
    "__import__": "'__import__'",
    "previous(a)": "'a'",
    "previous(a + b)": "one name",
    "await a": "await|no expression",
    "f'{a}'": "joinedstr",
    "a b": "column",
    "a\n+ b": "no expression",
    "(" * 300 + "a" + ")" * 300: "no expression",
    "-" * 60 + "a": "nested",
    "+".join(["a"] * 300): "parts",
    "a" * 3000: "2000",
    "\0": "no expression",
}


@pytest.mark.parametrize("text", REFUSED, ids=range(len(REFUSED)))
def test_what_is_not_in_the_grammar_is_refused(text):
    with pytest.raises(ConfigError, match=REFUSED[text]):
        function_of_text(text)


@pytest.mark.parametrize(
    ("text", "column"), [("a + bb", 5), ("  a + bb", 7), ("abs(a) * cc", 10), ("\u00e4 + a", 1)]
)
def test_an_error_tells_the_column(text, column):
    with pytest.raises(ConfigError, match=rf"column {column} of"):
        function_of_text(text)


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
