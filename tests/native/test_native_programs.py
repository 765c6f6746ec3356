"""Programs run in C on arrays of any length, beside the same expressions in numpy."""

import math

import numpy as np
import pytest
from program_tools import code, constants

from fmugym.expressions.program import TYPES
from fmugym.pool.pool_form import form_of_program

LENGTHS = (1, 15, 16, 17, 64, 127, 128, 129, 260)


def cast(source, target):
    return TYPES.index(source) * len(TYPES) + TYPES.index(target)


def evaluate(lines, rows, kept=(), tables=(), count=None):
    """Run a program whose first registers hold constants."""
    from fmugym import _native

    form = form_of_program(code(*lines), constants(*kept), tables, 16)
    return _native.evaluate((form, tuple(rows)), count or len(rows[0]))


@pytest.mark.parametrize("n", LENGTHS)
def test_runs_of_any_length(n):
    rng = np.random.default_rng(n)
    x, y, action = rng.normal(size=(3, n))
    counts = rng.integers(-5, 5, n)
    flags, numbers, seen = np.zeros(n, np.bool_), np.zeros(n), np.zeros((n, 2), np.float32)
    lines = (
        ("load_row", 0, 3),
        ("load_row", 1, 4),
        ("load_row", 4, 5),
        ("load_row", 2, 6),
        ("cast", cast("q", "d"), 7, 6),
        ("tan d", 0, 8, 3),
        ("multiply d", 0, 9, 8, 0),
        ("less d", 0, 1, 9, 5),
        ("where 8", 0, 2, 1, 4, 7),
        ("cast", cast("d", "f"), 10, 2),
        ("store_row", 7, 0, 10),
        ("cast", cast("d", "f"), 11, 5),
        ("store_row", 8, 0, 11),
        ("store_row", 3, 0, 9),
        ("store_row", 5, 0, 1),
        ("store_row", 6, 0, 2),
    )
    stored = np.zeros(n)
    evaluate(lines, (x, y, counts, stored, action, flags, numbers, *seen.T), (3.0,))
    expected = np.array([math.tan(value) for value in x]) * 3.0
    chosen = np.where(expected < action, y, counts)
    np.testing.assert_array_equal(stored, expected)
    np.testing.assert_array_equal(flags, expected < action)
    np.testing.assert_array_equal(numbers, chosen)
    np.testing.assert_array_equal(seen, np.stack([chosen, action], axis=1).astype(np.float32))


@pytest.mark.parametrize("n", LENGTHS)
def test_rows_that_a_program_both_reads_and_writes(n):
    rng = np.random.default_rng(n)
    first, second = rng.normal(size=(2, n))
    before = first.copy(), second.copy()
    lines = (
        ("load_row", 0, 0),
        ("load_row", 1, 1),
        ("store_row", 0, 0, 1),
        ("store_row", 1, 0, 0),
    )
    evaluate(lines, (first, second))
    np.testing.assert_array_equal(first, before[1])
    np.testing.assert_array_equal(second, before[0])


@pytest.mark.parametrize("n", LENGTHS)
def test_neighbouring_rows_become_neighbouring_elements(n):
    rows = np.random.default_rng(n).normal(size=(4, n)) * [[1.0], [1e30], [1e-50], [3.0]]
    seen = np.zeros((n, 5), np.float32)
    evaluate((("store_floats", 4, 0, 1, 3),), (*rows, *seen.T[1:4]))
    expected = np.zeros((n, 5), np.float32)
    expected[:, 1:4] = rows[1:].T
    np.testing.assert_array_equal(seen, expected)


@pytest.mark.parametrize(
    "line",
    [
        ("store_floats", 3, 0, 0, 0),  # none
        ("store_floats", 5, 0, 0, 2),  # beyond the last row
        ("store_floats", 3, 0, 1, 2),  # from a row of floats
        ("store_floats", 4, 0, 0, 2),  # to elements with one between them
        ("store_floats", 0, 0, 0, 1),  # to a row of doubles
        ("store_floats", 3, 0, 2, 1),
    ],
    ids=str,
)
def test_neighbours_that_do_not_exist(line):
    rows = np.zeros(3), np.zeros(3), np.zeros(3, np.float32)
    elements = np.zeros((3, 5), np.float32).T
    with pytest.raises(ValueError, match="the form of a program is damaged"):
        evaluate((line,), (*rows, *(elements[i] for i in (0, 1, 3))))


def points(count, rng):
    xs = np.sort(rng.integers(-3, 4, count).astype(float))  # some are the same
    return xs, rng.normal(size=count)


def long_points(kind, rng):
    """Many points: at equal distances, two at each place, or mostly near one another."""
    even = np.linspace(-3.0, 3.0, 301)
    xs = {
        "even": even,
        "steps": np.sort(np.concatenate([even[:-1], np.nextafter(even[1:], -9.0)])),
        "pairs": np.repeat(even, 2),
        "uneven": np.concatenate([-np.logspace(-9, 0.4, 200)[::-1], [0.0, 1e-300, 3.0]]),
        "alone": np.full(40, 1.0),
    }[kind]
    return xs, rng.normal(size=len(xs))


@pytest.mark.parametrize(
    ("xs", "ys"),
    [
        *(
            long_points(kind, np.random.default_rng(1))
            for kind in ("even", "steps", "pairs", "uneven", "alone")
        ),
        *(points(count, np.random.default_rng(count)) for count in (1, 2, 3, 6, 16, 17, 40)),
        ([0.0, 1.0, 2.0], [0.0, np.inf, 1.0]),
        ([0.0, 1.0, 2.0], [np.nan, 3.0, 3.0]),
        ([-np.inf, 0.0, np.inf], [1.0, 2.0, 2.0]),
        ([0.0, 1.0, 1.0, 1.0, 2.0], [-np.inf, 1.0, 2.0, np.inf, np.inf]),
    ],
    ids=lambda values: str(values)[:60],
)
def test_interpolation_is_that_of_numpy(xs, ys):
    rng = np.random.default_rng(0)
    special = [np.nan, np.inf, -np.inf, 0.0, -0.0, *xs]
    x = np.concatenate([special, rng.uniform(-4.0, 4.0, 1000), rng.integers(-4, 5, 100)])
    stored = np.zeros(len(x))
    table = np.array([*xs, *ys, -7.0, 7.0])
    lines = ("load_row", 0, 0), ("interpolate", 0, 1, 0), ("store_row", 1, 0, 1)
    evaluate(lines, (x, stored), tables=(table,))
    expected = [np.interp(value, xs, ys, left=-7.0, right=7.0) for value in x.tolist()]
    np.testing.assert_array_equal(stored, expected)


@pytest.mark.parametrize(
    "line", [("load_row", 0, 0), ("load_row", 0, 1, 60000), ("add d", 0, 0, 1, 1)], ids=str
)
def test_constants_stay_and_every_operand_exists(line):
    with pytest.raises(ValueError, match="the form of a program is damaged"):
        evaluate((line,), (np.zeros(3),), kept=(1.0,))


def test_a_row_that_is_not_aligned():
    row = np.zeros(25, np.uint8)[1:].view(np.float64)
    with pytest.raises(ValueError, match="aligned"):
        evaluate((("load_row", 0, 0),), (row, np.zeros(3)), count=3)


def results_of(operation, *rows):
    """What an operation makes of rows."""
    loads = [("load_row", place, place) for place in range(len(rows))]
    stored, to = np.zeros_like(rows[0]), len(rows)
    lines = *loads, (operation, 0, to, 0, to - 1), ("store_row", to, 0, to)
    evaluate(lines, (*rows, stored))
    return stored


FUNCTIONS = {
    **{f"{name} d": getattr(math, name) for name in ("sin", "cos", "tan", "sinh", "cosh", "tanh")},
    **{f"arc{name} d": getattr(math, f"a{name}") for name in ("sin", "cos", "tan", "sinh")},
    **{f"arc{name} d": getattr(math, f"a{name}") for name in ("cosh", "tanh", "tan2")},
    **{f"{name} d": getattr(math, name) for name in ("exp", "exp2", "expm1", "cbrt", "log")},
    **{f"{name} d": getattr(math, name) for name in ("log1p", "fmod", "copysign")},
    "power d": math.pow,
}
"""Functions of the C library, which Python has, too."""


@pytest.mark.parametrize("name", FUNCTIONS)
def test_functions_are_those_of_the_c_library(name):
    """At any place of a run, also where all values are the same: that is computed once."""
    rng, function = np.random.default_rng(0), FUNCTIONS[name]
    has_two = name.split()[0] in {"arctan2", "fmod", "copysign", "power"}
    for n in LENGTHS:
        x, y = 1.0 + rng.random((2, n)) if name == "arccosh d" else rng.random((2, n))
        x[n // 2 :] = x[0]
        for values in (x, np.full(n, x[0])):
            rows = (values, y) if has_two else (values,)
            expected = [function(*row) for row in zip(*rows, strict=True)]
            assert results_of(name, *rows).tolist() == expected


def test_functions_that_python_does_not_have_are_near_to_those_of_numpy():
    x, y = np.random.default_rng(0).uniform(0.1, 30.0, (2, 300))
    for ufunc in (np.log2, np.log10, np.hypot):
        rows = (x, y)[: ufunc.nin]
        np.testing.assert_allclose(results_of(f"{ufunc.__name__} d", *rows), ufunc(*rows), 1e-15)


def hard_numbers(count):
    """Numbers of all magnitudes."""
    rng = np.random.default_rng(1)
    mixed = rng.normal(size=count) * 10.0 ** rng.uniform(-170, 170, count)
    few = [0.0, -0.0, 1.0, -2.0, np.inf, -np.inf, np.nan, 5e-324, 1e-160, 1.3e154, 1e-125, 1e125]
    return np.concatenate([mixed, rng.uniform(-8.0, 8.0, count), few])


@pytest.mark.parametrize("letter", "df")
def test_squares_are_those_of_the_c_library(letter):
    """Most are products, but not all: the library rounds a few in the other direction."""
    rng, count, kind = np.random.default_rng(3), 100_000, np.dtype(letter).type
    powers = (2.0 ** np.arange(-9, 9)).astype(kind)
    near = [np.nextafter(rng.choice(powers, count), kind(s)) for s in (0.0, np.inf)]
    numbers = [hard_numbers(count), *near, np.sqrt(rng.uniform(0.5, 2.0, count))]
    with np.errstate(all="ignore"):
        x = np.concatenate(numbers).astype(kind)
        expected = np.array([number**2 for number in x])  # each by the library's pow or powf
        products = x * x
    found = results_of(f"power {letter}", x, np.full_like(x, 2.0))
    np.testing.assert_array_equal(found, expected)
    assert 0 < np.count_nonzero(found != products) < count / 100


@pytest.mark.parametrize("ufunc", [np.remainder, np.floor_divide], ids=lambda u: u.__name__)
def test_remainders_and_whole_quotients_are_those_of_numpy(ufunc):
    """Of all magnitudes and signs, and next to multiples of the divisor, where division rounds."""
    rng, count = np.random.default_rng(2), 20_000
    x = hard_numbers(count)
    y = rng.permutation(x)
    whole = rng.integers(-(2**27), 2**27, count) * np.full(count, 2 * np.pi)
    near = [np.nextafter(whole, side) for side in (-np.inf, np.inf)]
    x = np.concatenate([x, whole, *near, rng.integers(-99, 99, count) / 8.0])
    y = np.concatenate([y, np.full(3 * count, 2 * np.pi), rng.integers(-9, 9, count) / 4.0])
    with np.errstate(all="ignore"):
        expected = ufunc(x, y)
    found, numbers = results_of(f"{ufunc.__name__} d", x, y), expected == expected
    np.testing.assert_array_equal(found, expected)
    np.testing.assert_array_equal(np.signbit(found)[numbers], np.signbit(expected)[numbers])


@pytest.mark.parametrize("ufunc", [np.remainder, np.floor_divide, np.right_shift])
def test_integers_wrap_around_and_divide_by_zero_as_those_of_numpy(ufunc):
    limits = np.iinfo(np.int64)
    few = np.array([limits.min, limits.max, -7, -1, 0, 1, 3, 63, 64])
    x, y = (part.ravel() for part in np.meshgrid(few, few))
    with np.errstate(all="ignore"):
        expected = ufunc(x, y)
    np.testing.assert_array_equal(results_of(f"{ufunc.__name__} q", x, y), expected)


@pytest.mark.parametrize("first", ["sin", "cos"])
def test_a_sine_and_a_cosine_of_the_same_angles(first):
    """They are made together if they follow each other, and also then those of the C library."""
    second = "cos" if first == "sin" else "sin"
    for n in (*LENGTHS, 100_000):
        x = np.concatenate([np.random.default_rng(n).uniform(-9.0, 9.0, n - 1), [1e9]])
        for angles in (x, np.full(n, x[0])):
            one, other = np.zeros(n), np.zeros(n)
            functions = (f"{first} d", 0, 1, 0), (f"{second} d", 0, 2, 0)
            stores = ("store_row", 1, 0, 1), ("store_row", 2, 0, 2)
            lines = ("load_row", 0, 0), *functions, *stores
            evaluate(lines, (angles, one, other))
            assert one.tolist() == [getattr(math, first)(angle) for angle in angles.tolist()]
            assert other.tolist() == [getattr(math, second)(angle) for angle in angles.tolist()]
