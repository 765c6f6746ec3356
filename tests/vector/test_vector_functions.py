"""Functions of numpy give compiled what they give on arrays, or are refused by name."""

import itertools

import numpy as np
import pytest

from fmugym.expressions.graph import Graph
from fmugym.expressions.lowering import Store, compile_graph
from fmugym.expressions.program import UntraceableError, evaluate
from fmugym.vector.hooks.patches import numpy_of
from fmugym.vector.hooks.symbols import as_symbols, loaded_rows, same_for_all

COUNT = 150


def compiled(function, *arrays):
    """Call a function on arrays whose last axis has the environments, as a program."""
    graph, rows = Graph(), {}
    symbols = []
    for number, array in enumerate(arrays):
        for index, row in enumerate(array.reshape(-1, array.shape[-1])):
            rows["row", number, index] = np.ascontiguousarray(row)
        symbols.append(loaded_rows(graph, array.shape[:-1], "row", number, dtype=array.dtype))
    with numpy_of(graph), np.errstate(all="ignore"):
        found = function(*symbols)
    result = as_symbols(graph, found)
    nodes, count = same_for_all(result), arrays[0].shape[-1]
    flat = nodes.reshape(-1)
    stores = [Store(int(n), None, (0, i, flat.size)) for i, n in enumerate(flat)]
    seen = np.zeros((count, *nodes.shape), result.dtype)
    program = compile_graph(graph, stores, [], 1)
    evaluate(program, rows.__getitem__, (np.zeros((count, 1)),) * 2, (seen,))
    return np.moveaxis(seen, 0, -1), graph.tolerance


def require_same(function, *arrays):
    """Compare a function compiled with the same on arrays: to the last bit, or as it promises."""
    with np.errstate(all="ignore"):
        expected = np.asarray(function(*arrays))
    found, tolerance = compiled(function, *arrays)
    assert (found.dtype, found.shape) == (expected.dtype, expected.shape)
    if tolerance:
        np.testing.assert_allclose(found, expected, rtol=tolerance)
        return
    numbers = found == found
    assert np.array_equal(numbers, expected == expected)
    assert found[numbers].tobytes() == expected[numbers].tobytes()


def test_numpy_is_the_same_after_a_trace():
    before = np.array, np.take, np.linalg.norm
    compiled(np.negative, np.ones(3))
    assert (np.array, np.take, np.linalg.norm) == before


def values(letter, count=COUNT, seed=0):
    """Random values of a type, with the difficult ones among them."""
    rng = np.random.default_rng(seed)
    dtype = np.dtype(letter)
    if dtype == np.bool_:
        return rng.random(count) > 0.5
    if dtype.kind in "iu":
        info = np.iinfo(dtype)
        mixed = rng.integers(-9 if dtype.kind == "i" else 0, 9, count)
        found = mixed.astype(dtype)
        found[: min(5, count)] = [info.max, info.min, 0, 1, info.max - 1][:count]
        return found
    difficult = [0.0, -0.0, np.nan, np.inf, -np.inf, 1.0, -1.0, 0.5, 1e-7, -6e-8, 6e4, 1e300]
    with np.errstate(over="ignore"):
        found = (rng.normal(size=count) * rng.choice([0.01, 1.0, 30.0], count)).astype(dtype)
        size = min(len(difficult), count)
        found[:size] = np.array(difficult, dtype)[:size]
    return found


COMPILED = {
    **dict.fromkeys(("add", "subtract", "multiply", "divide", "negative", "square"), "dfq"),
    **dict.fromkeys(("less", "less_equal", "greater", "greater_equal", "equal"), "dfq?"),
    **dict.fromkeys(("minimum", "maximum", "not_equal", "isnan", "float_power"), "dfq?"),
    **dict.fromkeys(("absolute", "sign", "isfinite", "isinf", "fabs", "positive"), "dfq"),
    **dict.fromkeys(("logical_and", "logical_or", "logical_xor", "logical_not"), "dfq?"),
    **dict.fromkeys(("bitwise_and", "bitwise_xor"), "q?"),
    **dict.fromkeys(("floor", "ceil", "trunc"), "dfq?"),
    **dict.fromkeys(("remainder", "floor_divide", "copysign", "signbit", "rint", "sqrt"), "dfq"),
    **dict.fromkeys(("deg2rad", "degrees", "rad2deg", "radians"), "dfq"),
    **dict.fromkeys(("sin", "cos", "tan", "arcsin", "arccos", "arctan", "arctan2"), "dfq"),
    **dict.fromkeys(("sinh", "cosh", "tanh", "arcsinh", "arccosh", "arctanh"), "dfq"),
    **dict.fromkeys(("exp", "exp2", "expm1", "log", "log2", "log10", "log1p"), "dfq"),
    **dict.fromkeys(("cbrt", "hypot"), "dfq"),
    **dict.fromkeys(("power", "fmod", "reciprocal"), "df"),
    **dict.fromkeys(("bitwise_or", "invert"), "?"),
    "add": "dfq?",
    "multiply": "dfq?",
    "divide": "dfq?",
    "right_shift": "q",
    "conjugate": "dfq?",
}
"""For which types functions of numpy are compiled; all others are refused."""

UFUNCS = {u for u in vars(np).values() if isinstance(u, np.ufunc) and u.nout == 1}
UFUNCS -= {np.matmul, np.matvec, np.vecmat, np.vecdot}


@pytest.mark.parametrize(
    "ufunc", sorted(UFUNCS, key=lambda u: u.__name__), ids=lambda u: u.__name__
)
def test_every_function_of_numpy_is_compiled_or_refused_by_name(ufunc):
    """Narrow integers, those without sign and numbers of 16 bits are always refused."""
    for letter in "dfq?ehB":
        operands = [values(letter, seed=i) for i in range(ufunc.nin)]
        if letter in COMPILED.get(ufunc.__name__, ""):
            require_same(ufunc, *operands)
        else:
            with pytest.raises(
                (UntraceableError, TypeError), match=f"{ufunc.__name__}|computes|boolean|int8"
            ):
                compiled(ufunc, *operands)


# Functions of a few elements

ROWS = {
    "sum": lambda x: np.sum(x, axis=0),
    "mean": lambda x: np.mean(x, axis=0),
    "mean, method": lambda x: x.mean(axis=0),
    "std": lambda x: np.std(x, axis=0),
    "prod": lambda x: np.prod(x, axis=0, keepdims=True),
    "max": lambda x: np.max(x, axis=0),
    "all": lambda x: np.all(x > 0, axis=0),
    "argmax": lambda x: np.argmax(x, axis=0),
    "norm": lambda x: np.linalg.norm(x, axis=0),
    "clip": lambda x: np.clip(x, 0.0, np.float32(1.5)),
    "clip by arrays": lambda x: np.clip(x, x[::-1], 0.5),
    "powers": lambda x: x**2 + x**3,
    "divmod": lambda x: np.divmod(x, 3)[1] + divmod(x, -3)[0],
    "round": lambda x: np.round(1.0 * x, 1),
    "casts": lambda x: x.astype(np.float32).astype(np.float64) + (x > 0).astype(np.int64),
    "flags": lambda x: (x.astype(bool) + (x > 1)) * (x < 5),
    "choices": lambda x: np.select([x > 1, x > 0], [x, np.isclose(x, 0.5)], -1),
}


@pytest.mark.parametrize("name", ROWS)
def test_functions_of_a_few_elements(name):
    for letter, count in itertools.product("dqf", (1, 2, 3, 7)):
        x = np.array([values(letter, seed=i) for i in range(count)])
        for row in x:
            np.random.default_rng(count).shuffle(row)
        try:
            with np.errstate(all="ignore"):
                ROWS[name](x)
        except TypeError:  # numpy does not know it for this type
            continue
        require_same(ROWS[name], x)


REFUSED = {
    "uses numpy.sort": lambda x: np.sort(x, axis=0),
    "uses the attribute sort": lambda x: np.array(x).sort(axis=0),
    "uses numpy.cumsum": lambda x: np.cumsum(x, axis=0),
    "uses numpy.add.accumulate": lambda x: np.add.accumulate(x),
    "uses numpy.frexp": lambda x: np.frexp(x)[0],
    "an argument of numpy.add.reduce": lambda x: np.sum(x, axis=0, where=x > 0),
    "power that is not a small constant": lambda x: (x > 0).astype(int) ** -1,
    "mixes the values of several environments": lambda x: np.sum(x),
    "use numpy.where": lambda x: x[x > 0],
    "not of lengths": lambda x: np.linalg.norm(x, np.inf, axis=0),
    "float16": lambda x: x.astype(np.float16),
    "int32": lambda x: x + np.array([[1], [2]], np.int32),
    "complex128": lambda x: np.sum(x * 1j, axis=0),
    "object": lambda x: x + np.array([None, None])[:, None],
    "coordinates that fall": lambda x: np.interp(x, [1.0, 0.0], [0.0, 1.0]),
}


@pytest.mark.parametrize("reason", REFUSED)
def test_what_is_not_compiled_is_named(reason):
    with pytest.raises(UntraceableError, match=reason):
        compiled(REFUSED[reason], np.array([values("d"), values("d", seed=1)]))


def test_functions_of_float32_have_the_tolerance_of_float32():
    assert compiled(np.exp, values("d"))[1] == 1e-12
    assert compiled(np.exp, values("f"))[1] == 1e-5
    assert compiled(lambda x: np.floor(x) % 3, values("f"))[1] == 0.0


@pytest.mark.parametrize(
    "square",
    [
        lambda x: x**2,
        lambda x: x**2.0,
        lambda x: np.power(x, 2),
        lambda x: np.float_power(x, np.int64(2)),
    ],
)
def test_squares_are_products_as_in_numpy(square):
    """The C library's power takes thirty times as long, and may round otherwise."""
    numbers = np.random.default_rng(0).normal(size=COUNT) * 10.0 ** np.arange(-75, 75)
    found, tolerance = compiled(square, numbers)
    assert tolerance == 0.0
    np.testing.assert_array_equal(found, numbers * numbers)
    np.testing.assert_array_equal(square(numbers), numbers * numbers)
