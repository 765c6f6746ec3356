"""The language of expressions: programs in C compute what numpy does, and so do hooks in Python."""

import ast
import ctypes
import itertools
import re
from collections.abc import Callable
from operator import itemgetter
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
import pytest
from expression_table import (
    FUNCTIONS,
    NAMES,
    NOT_IN_THE_LANGUAGE,
    OPERATIONS,
    TEXTS,
    UFUNCS,
    in_c,
    numbers,
    operands,
    pow_of_c,
    powf_of_c,
)
from hypothesis import given
from hypothesis import strategies as st

from fmugym import ConfigError
from fmugym.expressions import functions, program
from fmugym.expressions.compiler import Store, compile_graph
from fmugym.expressions.functions import chance, noise
from fmugym.expressions.graph import Graph, Value
from fmugym.expressions.language import CONSTANTS, Expression, Names
from fmugym.expressions.numpy_evaluation import function_of

LENGTHS = (1, 2, 15, 16, 17, 127, 128, 129, 260)
"""Programs compute 16 values at once, and 128 in a run."""


def value_of(text, types=NAMES):
    """An expression over the names of the table."""
    graph = Graph()
    found = {name: Value.read(graph, name, dtype=letter) for name, letter in types.items()}
    return Expression.parse(text).value(Names(graph, found.get, known=lambda: list(found)))


def names_in(text):
    """The names of the table that a text reads."""
    return sorted(Expression.parse(text).names & NAMES.keys())


def program_of(*values):
    """A function from columns, one for each name, to an array for each value: a program in C."""
    stores = [Store(one.node, ("result", place)) for place, one in enumerate(values)]
    made = compile_graph(values[0].graph, stores)

    def run(columns):
        count = len(next(iter(columns.values())))
        results = [np.zeros((count, 2), one.dtype)[:, 1] for one in values]
        find = {("result", place): one for place, one in enumerate(results)}
        find |= {(name,): column for name, column in columns.items()}
        program.engine().evaluate(made.with_rows(find.__getitem__), count)
        return results

    return run


def require_bits(found, wanted, note=""):
    """Compare types, numbers and the signs of zeros; any NaN is as good as another."""
    found, wanted = np.asarray(found), np.asarray(wanted)
    assert found.dtype == wanted.dtype, note
    np.testing.assert_array_equal(found, wanted, note)
    is_number = wanted == wanted
    if wanted.dtype.kind == "f":
        signs = np.signbit(found)[is_number], np.signbit(wanted)[is_number]
        np.testing.assert_array_equal(*signs, note)


def require_near(found, wanted):
    """Compare the functions of two libraries, which differ in the last bits."""
    eps = 2e-15 if wanted.dtype == np.float64 else 1e-6
    np.testing.assert_allclose(found, wanted, rtol=eps, atol=1e-300)


def require_programs(value, columns, wanted):
    """At any number of environments, at columns with a stride, and where some are the same."""
    count, run = len(wanted), program_of(value)
    for length in (*LENGTHS, count):
        (found,) = run({name: one[:length] for name, one in columns.items()})
        require_bits(found, wanted[:length], f"of {length}")
    apart = {name: np.repeat(one, 3)[::3] for name, one in columns.items()}
    require_bits(run(apart)[0], wanted, "with a stride")
    ones = [{name: one[n : n + 1] for name, one in columns.items()} for n in range(0, count, 5)]
    require_bits(np.concatenate([run(one)[0] for one in ones]), wanted[::5], "one at a time")
    same = [{name: np.repeat(one, 130) for name, one in column.items()} for column in ones[::3]]
    found = np.concatenate([run(one)[0] for one in same])
    require_bits(found, np.repeat(wanted[::15], 130), "130 times the same")
    for column in columns.values() if len(columns) > 1 else ():
        values, counts = np.unique(column, return_counts=True)
        for one in values[counts > 9]:
            rows = {name: other[column == one] for name, other in columns.items()}
            require_bits(run(rows)[0], wanted[column == one], f"{one} beside others")


def require_hooks(value, columns, wanted):
    """In Python, one environment has the same value as an element of arrays."""
    hook = function_of(value)
    require_bits(hook(SimpleNamespace(**columns)), wanted)
    rows = zip(*(column[::5].tolist() for column in columns.values()), strict=True)
    found = [hook(SimpleNamespace(**dict(zip(columns, row, strict=True)))) for row in rows]
    require_bits(np.array(found, wanted.dtype), wanted[::5], "one at a time")


# The table


def test_each_function_of_the_language_has_a_row():
    assert {text.partition("(")[0] for text in FUNCTIONS} == set(functions.FUNCTIONS)


def test_each_constant_of_the_language_has_a_row():
    assert set(CONSTANTS) <= {name for text in TEXTS for name in Expression.parse(text).names}


def test_each_operator_of_python_has_a_row_or_is_refused():
    kinds = ast.operator, ast.unaryop, ast.cmpop, ast.boolop
    known = {one for kind in kinds for one in kind.__subclasses__()}
    in_table = {type(node) for text in TEXTS for node in ast.walk(ast.parse(text))} & known
    refused = {type(node) for text in NOT_IN_THE_LANGUAGE for node in ast.walk(ast.parse(text))}
    assert in_table | (refused & known) == known
    for text in NOT_IN_THE_LANGUAGE:
        with pytest.raises(ConfigError, match="not allowed here"):
            value_of(text)


def test_each_operation_of_programs_has_a_row():
    own = {program.operation_of(ufunc, letter) for ufunc, letter in OPERATIONS.values()}
    moves = {"load_row", "load_failed", "load_stopped", "store_row", "store_floats"}
    others = {"cast", "take", "interpolate", "where 8", "where 4", "where 1"}
    assert own | moves | others == set(program.OPERATIONS)


@pytest.mark.parametrize("text", TEXTS)
def test_a_program_has_the_value_of_numpy(text, engine):
    row, value, columns, wanted = given_row(text)
    if row.function:
        exact = in_c(row.function)(*columns.values())
        require_near(exact, wanted)
        wanted = exact
    require_programs(value, columns, wanted)


@pytest.mark.parametrize("text", TEXTS)
def test_a_hook_in_python_has_the_value_of_numpy(text):
    _, value, columns, wanted = given_row(text)
    require_hooks(value, columns, wanted)


def given_row(text):
    """The row of a text, its value, numbers for its names, and what numpy makes of them."""
    names = names_in(text)
    columns = dict(zip(names, operands("".join(NAMES[name] for name in names)), strict=True))
    with np.errstate(all="ignore"):
        wanted = np.asarray(TEXTS[text].wanted(*columns.values()))
    return TEXTS[text], value_of(text), columns, wanted


@pytest.mark.parametrize("name", OPERATIONS)
def test_a_program_has_each_operation_of_numpy(name, engine):
    ufunc, letter = OPERATIONS[name]
    graph, columns = Graph(), dict(zip("xy"[: ufunc.nin], operands(letter * 2), strict=False))
    value = ufunc(*(Value.read(graph, one, dtype=letter) for one in columns))
    with np.errstate(all="ignore"):
        wanted = ufunc(*columns.values())
    if UFUNCS[ufunc].function:
        kind = {"d": ctypes.c_double, "f": ctypes.c_float}[letter]
        exact = in_c(UFUNCS[ufunc].function, kind)(*columns.values())
        require_near(exact, wanted)
        wanted = exact
    require_programs(value, columns, wanted)


@pytest.mark.parametrize(("source", "target"), [*itertools.product(program.TYPES, repeat=2)])
def test_a_program_casts_as_numpy_does(source, target, engine):
    """What the other type can hold; C leaves open what becomes of the rest."""
    column = numbers(source)[0]
    with np.errstate(all="ignore"):
        if target in "qb":
            column = column[np.abs(column.astype(float)) < np.iinfo(target).max]
        wanted = column.astype(target)
    value = Value.read(Graph(), "x", dtype=source).cast(target)
    require_programs(value, {"x": column}, wanted)


@pytest.mark.parametrize("letter", "dfq?b")
def test_a_program_chooses_values_of_each_type(letter, engine):
    graph = Graph()
    names = {"chosen": "?", "x": letter, "y": letter}
    nodes = [graph.load("row", (name,), dtype) for name, dtype in names.items()]
    columns = dict(zip(names, operands("?" + 2 * letter), strict=True))
    wanted = np.where(*columns.values())
    require_programs(Value(graph, graph.choose(*nodes)), columns, wanted)


@pytest.mark.parametrize("letter", "dfq?b")
def test_a_program_looks_values_up(letter, engine):
    """Also from the end of the table."""
    graph = Graph()
    graph.tables["table"] = table = numbers(letter)[0][:9]
    indices = np.random.default_rng(0).integers(-9, 9, 300)
    value = Value.read(graph, "x", dtype="q").taken("table")
    require_programs(value, {"x": indices}, table[indices])
    require_bits(function_of(value)(SimpleNamespace(x=indices)), table[indices])


RNG = np.random.default_rng(1)
EVEN = np.linspace(-3.0, 3.0, 301)
CURVES = {
    "even": EVEN,
    "steps": np.sort(np.concatenate([EVEN[:-1], np.nextafter(EVEN[1:], -9.0)])),
    "pairs": np.repeat(EVEN, 2),
    "uneven": np.concatenate([-np.logspace(-9, 0.4, 200)[::-1], [0.0, 1e-300, 3.0]]),
    "at one place": np.full(40, 1.0),
    **{f"{n} points": np.sort(RNG.integers(-3, 4, n) * 1.0) for n in (1, 2, 3, 6, 16, 17, 40)},
    "to infinity": np.array([-np.inf, 0.0, np.inf]),
}
"""The coordinates of points."""

HEIGHTS = {
    "a step to infinity": ([0.0, 1.0, 2.0], [0.0, np.inf, 1.0]),
    "nothing at first": ([0.0, 1.0, 2.0], [np.nan, 3.0, 3.0]),
    "infinite on both sides": ([0.0, 1.0, 1.0, 1.0, 2.0], [-np.inf, 1.0, 2.0, np.inf, np.inf]),
    "flat to infinity": ([-np.inf, 0.0, np.inf], [1.0, 2.0, 2.0]),
    **{name: (xs, RNG.normal(size=len(xs))) for name, xs in CURVES.items()},
}


@pytest.mark.parametrize("name", HEIGHTS)
def test_a_curve_is_that_of_numpy(name, engine):
    """With a value before its first point, and one after its last point."""
    xs, ys = map(np.asarray, HEIGHTS[name])
    rng, graph = np.random.default_rng(0), Graph()
    x = np.concatenate(
        [
            [np.nan, np.inf, -np.inf, 0.0, -0.0],
            xs,
            *(rng.uniform(-4.0, 4.0, 1000), rng.integers(-4, 5, 100)),
        ]
    )
    graph.tables["curve"] = np.array([*xs, *ys, -7.0, 7.0])
    value = Value.read(graph, "x", dtype="d").interpolated("curve")
    wanted = np.array([np.interp(one, xs, ys, left=-7.0, right=7.0) for one in x])
    require_programs(value, {"x": x}, wanted)
    require_hooks(value, {"x": x}, np.interp(x, xs, ys, left=-7.0, right=7.0))


# Whole expressions


EXACT = [text for text, row in TEXTS.items() if not row.function and text != "a ** b"]
"""What is the same to the last bit. A power with the constant 2 is a product, others are not."""

CONDITIONAL = [text for text in EXACT if value_of(text).is_flag]
NUMERIC = [text for text in EXACT if text not in CONDITIONAL]


class Part(NamedTuple):
    """A part of an expression: its text, and its value in numpy for columns of the names."""

    text: str
    wanted: Callable[[Any], Any]


def filled(text, texts):
    """A text with others in the places of its names."""
    return re.sub(r"\b[abcpq]\b", lambda name: f"({texts[name[0]]})", text)


def part_of(text, inner):
    """A row of the table with other parts in the places of its names."""
    row, names = TEXTS[text], names_in(text)
    whole = filled(text, {name: inner[name].text for name in names})
    return Part(whole, lambda columns: row.wanted(*(inner[one].wanted(columns) for one in names)))


def parts(depth):
    """Numbers and conditions, by their types, of rows in rows."""
    found = {
        letter: st.sampled_from(
            [Part(n, itemgetter(n)) for n, own in NAMES.items() if own == letter]
        )
        for letter in "d?"
    }
    found["d"] |= st.sampled_from([0.0, 0.5, 3.0, -1.25, 1e300, 5e-324]).map(constant)
    found["?"] |= st.booleans().map(constant)
    for _ in range(depth):
        inner = st.fixed_dictionaries({name: found[letter] for name, letter in NAMES.items()})
        found = {
            "d": st.builds(part_of, st.sampled_from(NUMERIC), inner),
            "?": st.builds(part_of, st.sampled_from(CONDITIONAL), inner),
        }
    return found["d"] | found["?"]


def constant(number):
    """A number or a condition as it is written."""
    return Part(repr(number).lower(), lambda _: np.full(200, number))


def is_refused(text):
    """Whether an expression is a constant that is no number."""
    try:
        value_of(text)
    except ConfigError as error:
        return "is no finite number" in str(error)
    return False


@given(parts(depth=1) | parts(depth=2) | parts(depth=3))
def test_an_expression_of_expressions_has_the_value_of_numpy(engine, part):
    """In a program for many environments and for one, and in Python."""
    columns = {name: one[:200] for name, one in zip(NAMES, operands("ddd??"), strict=True)}
    with np.errstate(all="ignore"):
        wanted = np.broadcast_to(part.wanted(columns), 200)
    if not np.isfinite(wanted).any() and is_refused(part.text):
        return
    value = value_of(part.text)
    run = program_of(value)
    require_bits(run(columns)[0], wanted, part.text)
    one = {name: column[7:8] for name, column in columns.items()}
    require_bits(run(one)[0], wanted[7:8], part.text)
    found = function_of(value)(SimpleNamespace(**columns))
    require_bits(np.broadcast_to(found, 200), wanted, part.text)


def chains_of(parts, signs):
    """One part or more with operators between them."""
    others = st.lists(st.tuples(st.sampled_from(signs), parts).map(" ".join), max_size=2)
    return st.builds(lambda first, others: " ".join([first, *others]), parts, others)


OPERANDS = st.sampled_from(["a", "b", "c", "0.5", "3", "-a", "+b", "-c", "-3"])
SUMS = chains_of(OPERANDS, ["+", "-", "*", "/", "%", "**"])
COMPARISONS = st.builds("{} {} {}".format, SUMS, st.sampled_from(["<", ">=", "=="]), SUMS)
CHAINS = chains_of(COMPARISONS, ["<=", ">", "!="])
NEGATIONS = CHAINS | CHAINS.map("not {}".format)


@given(SUMS, chains_of(NEGATIONS, ["and", "or"]), SUMS)
def test_operators_bind_as_in_python(engine, first, condition, second):
    """There are no parentheses that could tell it."""
    text = f"{first} if {condition} else {second}"
    numbers = {"a": np.float64(0.7), "b": np.float64(-1.5), "c": np.float64(2.25)}
    with np.errstate(all="ignore"):
        wanted = np.array([eval(text, dict(numbers))], np.float64)
    value = value_of(text, dict.fromkeys(numbers, "d"))
    columns = {name: np.array([one]) for name, one in numbers.items()}
    require_bits(program_of(value)(columns)[0], wanted, text)


@pytest.mark.parametrize("text", TEXTS)
def test_constants_have_the_value_that_names_would_have(text):
    """A number that is not finite is refused when the task is loaded."""
    row, _, columns, wanted = given_row(text)
    names, count = [*columns], 0
    for place, *known in zip(range(90), *columns.values(), strict=False):
        if not np.isfinite(known).all() or (text == "a ** b" and known[1] == 2.0):
            continue
        literals = {name: repr(one.item()).lower() for name, one in zip(names, known, strict=True)}
        if np.isfinite(wanted[place]):
            found = np.asarray(value_of(filled(text, literals)).constant, wanted.dtype)
            (require_near if row.function else require_bits)(found, wanted[place])
            count += 1
        else:
            with pytest.raises(ConfigError, match="is no finite number"):
                value_of(filled(text, literals))
    assert count > 9


@pytest.mark.parametrize("letter", "df")
def test_a_constant_of_numpy_keeps_its_type(letter):
    number = np.dtype(letter).type(0.3)
    value = Value.read(Graph(), "x", dtype=letter)
    for formula in (
        lambda x: -x,
        lambda x: x - np.float64(1.1),
        lambda x: np.float64(1.1) - x,
        lambda x: np.float32(0.1) * x + np.float32(0.7),
        lambda x: x > np.float32(0.3),
    ):
        found = function_of(formula(value))(SimpleNamespace(x=number))
        require_bits(found, formula(number))


# Functions of the C library


@pytest.mark.parametrize("first", ["sin", "cos"])
def test_a_sine_and_a_cosine_of_the_same_angles_are_those_of_c(first, engine):
    """A program makes them together, in any order."""
    second = "cos" if first == "sin" else "sin"
    graph = Graph()
    names = {"a": Value.read(graph, "a", dtype="d")}
    values = [
        Expression.parse(f"{name}(a)").value(Names(graph, names.get)) for name in (first, second)
    ]
    run = program_of(*values)
    for count in (*LENGTHS, 20_000):
        angles = np.random.default_rng(count).uniform(-9.0, 9.0, count)
        angles[-1] = 1e9
        for column in (angles, np.full(count, angles[0])):
            found = run({"a": column})
            require_bits(found[0], in_c(first)(column))
            require_bits(found[1], in_c(second)(column))


@pytest.mark.parametrize("text", ["pow(a, 2)", "powf(a, 2)"])
def test_squares_by_pow_are_those_of_c(text, engine):
    """Most are products, but not all: the library rounds a few in the other direction."""
    kind, power = {"pow(a, 2)": (np.float64, pow_of_c), "powf(a, 2)": (np.float32, powf_of_c)}[text]
    rng, count = np.random.default_rng(3), 30_000
    powers = (2.0 ** np.arange(-9, 9)).astype(kind)
    near = [np.nextafter(rng.choice(powers, count), kind(side)) for side in (0.0, np.inf)]
    column = np.concatenate([*near, np.sqrt(rng.uniform(0.5, 2.0, count)), numbers("d")[0]])
    with np.errstate(all="ignore"):
        column = column.astype(kind)
        products = (column * column).astype(np.float64)
        column = column.astype(np.float64)
    wanted = power(column, np.full_like(column, 2.0))
    require_bits(program_of(value_of(text))({"a": column})[0], wanted)
    different = np.count_nonzero((wanted != products) & (wanted == wanted))
    assert 0 < different < count / 100


@pytest.mark.parametrize("ufunc", [np.remainder, np.floor_divide])
def test_remainders_next_to_multiples_of_the_divisor_are_those_of_numpy(ufunc, engine):
    """There the division rounds."""
    rng, count = np.random.default_rng(2), 5_000
    wholes = rng.integers(-(2**27), 2**27, count) * np.full(count, 2 * np.pi)
    near = [np.nextafter(wholes, side) for side in (-np.inf, np.inf)]
    x = np.concatenate([wholes, *near, rng.integers(-99, 99, count) / 8.0])
    y = np.concatenate([np.full(3 * count, 2 * np.pi), rng.integers(-9, 9, count) / 4.0])
    graph = Graph()
    names = (Value.read(graph, name, dtype="d") for name in "xy")
    with np.errstate(all="ignore"):
        wanted = ufunc(x, y)
    require_bits(program_of(ufunc(*names))({"x": x, "y": y})[0], wanted)


@pytest.mark.parametrize("draw", [noise, chance])
def test_random_numbers_of_episodes_steps_and_sensors_have_nothing_in_common(draw, engine):
    graph = Graph()
    key, count = (Value.read(graph, name, dtype="d") for name in ("key", "count"))
    keys, counts = np.meshgrid(np.arange(50.0), np.arange(50.0))
    columns = {"key": keys.ravel(), "count": counts.ravel()}
    values = [draw(key, count, channel) for channel in range(4)]
    drawn = np.array(function_of(values)(SimpleNamespace(**columns)))
    np.testing.assert_allclose(program_of(*values)(columns), drawn, rtol=1e-12, atol=1e-12)
    assert len(np.unique(drawn)) == drawn.size
    mean, deviation = {noise: (0.0, 1.0), chance: (0.5, 12**-0.5)}[draw]
    assert abs(drawn.mean() - mean) < 4 * deviation / drawn.size**0.5
    assert abs(drawn.std() / deviation - 1) < 0.03
