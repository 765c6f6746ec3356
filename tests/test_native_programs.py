"""Programs run in C on arrays of any length, beside the same expressions in numpy."""

import numpy as np
import pytest

from fmugym.vector.hooks import loops, lowering, program
from fmugym.vector.hooks.graph import Graph
from fmugym.vector.hooks.loops import has_known_sines, loop_of, squares_nearly_exactly
from fmugym.vector.hooks.program import CONSTANT, OPERATIONS, SLOT, TYPES

LENGTHS = (1, 15, 16, 17, 64, 127, 128, 129, 260)
DOUBLE = np.dtype(np.float64)


def cast(source, target):
    return TYPES.index(source) * len(TYPES) + TYPES.index(target)


def evaluate(code, rows, actions, results=(), seen=(), constants=(), slots=(), calls=(), tables=()):
    """Run a program whose first registers hold the constants."""
    from fmugym import _native

    lines = [[OPERATIONS.index(name), *rest, *[0] * (5 - len(rest))] for name, *rest in code]
    filled = [(np.float64(value).view("u8"), i, 8, 0) for i, value in enumerate(constants)]
    parts = (
        np.array(lines, np.uint16).tobytes(),
        np.array(filled, CONSTANT).tobytes(),
        np.array(list(slots), SLOT).tobytes(),
        calls,
        tuple(rows),
        tuple(tables),
        16,
        len(seen),
        tuple(range(len(constants), len(constants) + len(results))),
    )
    return _native.evaluate(parts, len(actions), 1, actions, actions, tuple(results), tuple(seen))


@pytest.mark.parametrize("n", LENGTHS)
def test_runs_of_any_length(n):
    rng = np.random.default_rng(n)
    x, y, action = rng.normal(size=(3, n))
    counts = rng.integers(-5, 5, n)
    flags, numbers, seen = np.zeros(n, np.bool_), np.zeros(n), np.zeros((n, 2), np.float32)
    sine = loop_of(np.sin, (DOUBLE, DOUBLE)), 1, (8, 8), 1
    code = (
        ("load_row", 0, 3),
        ("load_row", 1, 4),
        ("load_action", 0, 5),
        ("load_row", 2, 6),
        ("cast", cast("q", "d"), 7, 6),
        ("call", 0, 8, 3),
        ("multiply d", 0, 9, 8, 0),
        ("less d", 0, 1, 9, 5),
        ("where 8", 0, 2, 1, 4, 7),
        ("cast", cast("d", "f"), 10, 2),
        ("store_seen", 0, 0, 10),
        ("cast", cast("d", "f"), 11, 5),
        ("store_seen", 1, 0, 11),
        ("store_row", 3, 0, 9),
    )
    slots = (0, 0, 2, TYPES.index("f")), (0, 1, 2, TYPES.index("f"))
    stored = np.zeros(n)
    rows = x, y, counts, stored
    evaluate(code, rows, action, (flags, numbers), (seen,), (3.0,), slots, (sine,))
    expected = np.sin(x) * 3.0
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
    code = (
        ("load_row", 0, 0),
        ("load_row", 1, 1),
        ("store_row", 0, 0, 1),
        ("store_row", 1, 0, 0),
    )
    evaluate(code, (first, second), np.zeros(n))
    np.testing.assert_array_equal(first, before[1])
    np.testing.assert_array_equal(second, before[0])


@pytest.mark.parametrize("n", LENGTHS)
def test_neighbouring_rows_become_neighbouring_elements(n):
    rows = np.random.default_rng(n).normal(size=(4, n)) * [[1.0], [1e30], [1e-50], [3.0]]
    seen = np.zeros((n, 5), np.float32)
    slots = [(0, element, 5, TYPES.index("f")) for element in (1, 2, 3)]
    evaluate((("store_floats", 0, 0, 1, 3),), rows, np.zeros(n), (), (seen,), (), slots)
    expected = np.zeros((n, 5), np.float32)
    expected[:, 1:4] = rows[1:].T
    np.testing.assert_array_equal(seen, expected)


FLOAT = TYPES.index("f")


@pytest.mark.parametrize(
    ("line", "slots"),
    [
        (("store_floats", 0, 0, 0, 0), [(0, 0, 3, FLOAT)]),
        (("store_floats", 0, 0, 0, 2), [(0, 0, 3, FLOAT)]),
        (("store_floats", 0, 0, 1, 2), [(0, 0, 3, FLOAT), (0, 1, 3, FLOAT)]),
        (("store_floats", 0, 0, 0, 2), [(0, 0, 3, FLOAT), (0, 2, 3, FLOAT)]),
        (("store_floats", 0, 0, 0, 2), [(0, 0, 3, FLOAT), (0, 1, 3, TYPES.index("d"))]),
        (("store_floats", 0, 0, 2, 1), [(0, 0, 3, FLOAT)]),
    ],
    ids=str,
)
def test_neighbours_that_do_not_exist(line, slots):
    rows = np.zeros(3), np.zeros(3), np.zeros(3, np.float32)
    seen = np.zeros((3, 3), np.float32)
    with pytest.raises(ValueError, match="a program is not sound"):
        evaluate((line,), rows, np.zeros(3), (), (seen,), (), slots)


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
    code = ("load_row", 0, 0), ("interpolate", 0, 1, 0), ("store_row", 1, 0, 1)
    evaluate(code, (x, stored), np.zeros(len(x)), tables=(table,))
    expected = [np.interp(value, xs, ys, left=-7.0, right=7.0) for value in x.tolist()]
    np.testing.assert_array_equal(stored, expected)


@pytest.mark.parametrize(
    "line", [("load_row", 0, 0), ("load_row", 0, 1, 60000), ("add d", 0, 0, 1, 1)], ids=str
)
def test_constants_stay_and_every_operand_exists(line):
    with pytest.raises(ValueError, match="a program is not sound"):
        evaluate((line,), (np.zeros(3),), np.zeros(3), constants=(1.0,))


def test_a_row_that_is_not_aligned():
    row = np.zeros(25, np.uint8)[1:].view(np.float64)
    with pytest.raises(ValueError, match="aligned"):
        evaluate((("load_row", 0, 0),), (row,), np.zeros(3))


def squares(values, operation):
    """Raise values to the power of 2 in C."""
    loop = loop_of(np.float_power, (DOUBLE,) * 3), 2, (8, 0, 8), 2
    code = ("load_row", 0, 1), (operation, 0, 2, 1, 0), ("store_row", 1, 0, 2)
    stored = np.zeros_like(values)
    evaluate(code, (values, stored), np.zeros_like(values), constants=(2.0,), calls=(loop,))
    return stored


def remainders(x, y, operation):
    """Compute remainders in C."""
    loop = loop_of(np.remainder, (DOUBLE,) * 3), 2, (8, 8, 8), 2
    code = ("load_row", 0, 0), ("load_row", 1, 1), (operation, 0, 2, 0, 1), ("store_row", 2, 0, 2)
    stored = np.zeros_like(x)
    evaluate(code, (x, y, stored), x, calls=(loop,))
    return stored


def test_remainders_are_those_of_numpy():
    """Of all magnitudes and signs, and next to multiples of the divisor, where division rounds."""
    rng = np.random.default_rng(2)
    x = hard_numbers(20_000)
    y = rng.permutation(hard_numbers(20_000))
    near = rng.integers(-(2**27), 2**27, 60_000) * y[:60_000]
    count = 60_000
    angles = rng.normal(size=count) * 10.0 ** rng.uniform(-9, 9, count)
    turns = np.full(count, 2 * np.pi) * rng.choice([1.0, -1.0, 0.5], count)
    with np.errstate(all="ignore"):
        whole = rng.integers(-(2**27), 2**27, count) * turns
        sides = [np.nextafter(part, side) for part in (near, whole) for side in (-np.inf, np.inf)]
        x = np.concatenate([x, near, angles, whole, *sides, rng.integers(-99, 99, count) / 8.0])
        y = np.concatenate([y, y[:count], turns, turns, y[:count], y[:count], turns, turns])
        y = np.concatenate([y, rng.integers(-9, 9, count) / 4.0])
        expected = np.remainder(x, y)
    for operation in ("call", "call_remainder"):
        found = remainders(x, y, operation)
        np.testing.assert_array_equal(found, expected)
        numbers = expected == expected
        np.testing.assert_array_equal(np.signbit(found)[numbers], np.signbit(expected)[numbers])


def waves(function, x, operation):
    """Compute sines or cosines in C."""
    loop = loop_of(function, (DOUBLE,) * 2), 1, (8, 8), 1
    code = ("load_row", 0, 0), (operation, 0, 1, 0), ("store_row", 1, 0, 1)
    stored = np.zeros_like(x)
    evaluate(code, (x, stored), x, calls=(loop,))
    return stored


def hard_angles(count):
    """Angles of all magnitudes, and those next to multiples of a quarter of a turn."""
    rng = np.random.default_rng(3)
    whole = rng.integers(-(2**19), 2**19, count) * (np.pi / 2)
    near = np.arange(-400, 400) * (np.pi / 2)
    parts = [
        rng.uniform(-np.pi, np.pi, 4 * count),
        rng.uniform(-30.0, 30.0, 4 * count),
        rng.normal(size=count) * 10.0 ** rng.uniform(-12, 8, count),
        whole,
        *(near + offset for offset in (0.0, 1e-16, -1e-9, 1e-6, -1e-5, 1e-3)),
        np.linspace(-0.9, 0.9, count),
        np.arange(-3000.0, 3000.0) / 4,
        [0.0, -0.0, np.inf, -np.inf, np.nan, 5e-324, -1e-200, 1e-160, 2.0**20, 1e300, 1e-8],
    ]
    return np.concatenate(parts)


@pytest.mark.skipif(not has_known_sines(), reason="the error of this system's sine is not known")
@pytest.mark.parametrize(
    ("function", "operation"), [(np.sin, "call_sine"), (np.cos, "call_cosine")]
)
def test_sines_are_those_of_numpy(function, operation):
    x = hard_angles(100_000)
    with np.errstate(all="ignore"):
        expected = function(x)
    for name in ("call", operation):
        found = waves(function, x, name)
        np.testing.assert_array_equal(found, expected)
        numbers = expected == expected
        assert found[numbers].tobytes() == expected[numbers].tobytes()


@pytest.mark.skipif(not has_known_sines(), reason="the error of this system's sine is not known")
@pytest.mark.parametrize("first", [np.sin, np.cos])
def test_the_sine_and_the_cosine_of_an_angle_stand_side_by_side(first):
    graph = Graph()
    angle = graph.load("row", ("output", 0), DOUBLE, None)
    other = np.cos if first is np.sin else np.sin
    one = graph.apply(first, (angle,), DOUBLE)
    between = graph.apply(np.square, (one,), DOUBLE)
    last = graph.apply(other, (angle,), DOUBLE)
    stores = [lowering.Store(cell.node, ("input", 0)) for cell in (between, last)]
    compiled = lowering.compile_graph(graph, stores, [], 0)
    names = [OPERATIONS[line[0]] for line in compiled.code]
    assert names[:3] == ["load_row", "call_sine", "call_cosine"]
    assert len(names) == 6


@pytest.mark.skipif(not has_known_sines(), reason="the error of this system's sine is not known")
@pytest.mark.parametrize("n", LENGTHS)
def test_both_at_once_are_those_of_numpy(n):
    x = np.resize(hard_angles(7)[::-1], n)
    stored = np.zeros((2, n))
    loops_of = [(loop_of(f, (DOUBLE,) * 2), 1, (8, 8), 1) for f in (np.sin, np.cos)]
    code = (
        ("load_row", 0, 0),
        ("call_sine", 0, 1, 0),
        ("call_cosine", 1, 2, 0),
        ("store_row", 1, 0, 1),
        ("store_row", 2, 0, 2),
    )
    evaluate(code, (x, *stored), x, calls=tuple(loops_of))
    with np.errstate(all="ignore"):
        np.testing.assert_array_equal(stored, np.stack([np.sin(x), np.cos(x)]))


def computed_by_all_operations_that_share(x):
    """What the operations that compute equal values once make of an array."""
    remainder = loop_of(np.remainder, (DOUBLE,) * 3), 2, (8, 8, 8), 2
    sines = [(loop_of(f, (DOUBLE,) * 2), 1, (8, 8), 1) for f in (np.sin, np.cos)]
    table = np.array([-1.0, 0.0, 2.0, 5.0, 3.0, 4.0, -7.0, 7.0])
    lines = (
        ("call_sine", 0, 2, 1),
        ("call_cosine", 1, 3, 1),
        ("call_remainder", 2, 4, 1, 0),
        ("interpolate", 0, 5, 1),
        ("scalar_power d", 0, 6, 1, 0),
    )
    stores = [("store_row", 1 + k, 0, 2 + k) for k in range(len(lines))]
    stored = np.zeros((len(lines), len(x)))
    code = ("load_row", 0, 1), *lines, *stores
    calls = *sines, remainder
    evaluate(code, (x, *stored), x, constants=(3.0,), calls=calls, tables=(table,))
    return stored


@pytest.mark.skipif(not has_known_sines(), reason="the error of this system's sine is not known")
@pytest.mark.parametrize("n", LENGTHS)
@pytest.mark.parametrize("value", [0.75, 0.0, -0.0, np.pi, 1e300, -0.5, np.nan, np.inf], ids=str)
def test_values_that_all_share_are_those_of_numpy(n, value):
    """With one that differs in no place, the last one, and the first one."""
    for place in (None, n - 1, 0):
        x = np.full(n, value)
        if place is not None:
            x[place] = -x[place] if value == 0.0 else 0.25
        with np.errstate(all="ignore"):
            expected = [np.sin(x), np.cos(x), np.remainder(x, 3.0)]
            expected.append(np.interp(x, [-1.0, 0.0, 2.0], [5.0, 3.0, 4.0], left=-7.0, right=7.0))
            expected.append([number**3.0 for number in x])
        found = computed_by_all_operations_that_share(x)
        np.testing.assert_array_equal(found, expected)
        numbers = ~np.isnan(expected)
        signs = np.signbit(found), np.signbit(expected)
        np.testing.assert_array_equal(signs[0][numbers], signs[1][numbers])


def hard_numbers(count):
    """Numbers of all magnitudes, and those whose squares lie between two floats or on one."""
    rng = np.random.default_rng(1)
    mixed = rng.normal(size=count) * 10.0 ** rng.uniform(-170, 170, count)
    roots = np.sqrt(2.0 ** rng.integers(-40, 40, count)) * rng.choice([1.0, 1 - 2**-53], count)
    odd = (2.0 * rng.integers(2**25, 2**26, count) + 1.0) * 2.0**-30
    few = [0.0, -0.0, 1.0, -2.0, np.inf, -np.inf, np.nan, 5e-324, 1e-160, 1.3e154, 1e-125, 1e125]
    return np.concatenate([mixed, roots, odd, rng.uniform(-8.0, 8.0, 20 * count), few])


@pytest.mark.skipif(
    not squares_nearly_exactly(), reason="the error of this system's pow is not known"
)
def test_powers_of_2_are_those_of_numpy():
    values = hard_numbers(20_000)
    with np.errstate(all="ignore"):
        expected = np.float_power(values, 2.0)
        assert (expected != values * values).sum() > 100  # a product would not do
    for operation in ("call", "call_square"):
        np.testing.assert_array_equal(squares(values, operation), expected)


@pytest.mark.parametrize(
    ("function", "exponent", "is_known", "operation"),
    [
        (np.float_power, 2.0, True, "call_square"),
        (np.float_power, 2.0, False, "call"),
        (np.float_power, 3.0, True, "call"),
        (np.power, 2.0, True, "call"),
    ],
)
def test_which_powers_are_squared(function, exponent, is_known, operation, monkeypatch):
    monkeypatch.setattr(lowering, "squares_nearly_exactly", lambda: is_known)
    graph = Graph()
    cells = graph.load("row", ("output", 0), DOUBLE, None), graph.constant(exponent, DOUBLE)
    node = graph.apply(function, cells, DOUBLE).node
    compiled = lowering.compile_graph(graph, [lowering.Store(node, ("input", 0))], [], 0)
    names = [OPERATIONS[line[0]] for line in compiled.code]
    assert names == ["load_row", operation, "store_row"]


def test_powers_that_are_less_exact_are_not_taken_for_squares():
    values = np.linspace(1.0, 2.0, 1001)
    assert loops._is_within(np.float_power(values, 2.0), values, 0.515)
    assert not loops._is_within(np.nextafter(values * values, 9.0), values, 0.515)


@pytest.mark.parametrize(
    ("low", "high", "operations"),
    [
        (-1.0, 2.0, ["maximum d", "minimum d"]),
        (2.0, -1.0, ["maximum d", "minimum d"]),
        (-np.inf, 1e-300, ["maximum d", "minimum d"]),
        (0.0, 1.0, ["call"]),  # -0.0 may stay or become 0.0
        (-1.0, -0.0, ["call"]),
        (np.nan, 1.0, ["call"]),
    ],
)
def test_limits_that_need_no_loop_of_numpy(low, high, operations):
    graph = Graph()
    limits = graph.constant(low, DOUBLE), graph.constant(high, DOUBLE)
    cells = graph.load("row", ("output", 0), DOUBLE, None), *limits
    node = graph.apply(np._core.umath.clip, cells, DOUBLE).node
    compiled = lowering.compile_graph(graph, [lowering.Store(node, ("input", 0))], [], 0)
    names = [OPERATIONS[line[0]] for line in compiled.code]
    assert names == ["load_row", *operations, "store_row"]
    x = np.array([-0.0, 0.0, np.nan, np.inf, -np.inf, 1e-300, -1e-300, -1.0, 2.0, 7.0, -7.0])
    stored = np.zeros_like(x)
    rows = {("output", 0): x, ("input", 0): stored}
    program.evaluate(compiled, rows.__getitem__, (x, x))
    assert stored.tobytes() == np.clip(x, low, high).tobytes()
