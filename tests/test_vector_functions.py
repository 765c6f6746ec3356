"""Functions of numpy give compiled what they give on arrays, to the last bit."""

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fmugym.vector.hooks.graph import Graph
from fmugym.vector.hooks.lowering import Store, compile_graph
from fmugym.vector.hooks.patches import numpy_of
from fmugym.vector.hooks.program import UntraceableError, evaluate
from fmugym.vector.hooks.sorting import sorts_stably
from fmugym.vector.hooks.symbols import as_symbols, loaded, same_for_all

COUNT = 150


def compiled(function, *arrays):
    """Call a function on arrays whose last axis has the environments, as a program."""
    graph, rows = Graph(), {}
    symbols = []
    for number, array in enumerate(arrays):
        names = np.empty(array.shape[:-1], object)
        for place in np.ndindex(names.shape):
            names[place] = ("row", number, *place)
            rows[names[place]] = np.ascontiguousarray(array[place])
        symbols.append(loaded(graph, "row", names, array.dtype))
    with numpy_of(graph), np.errstate(all="ignore"):
        found = function(*symbols)
    is_tuple = isinstance(found, tuple)
    results = [as_symbols(graph, one) for one in (found if is_tuple else (found,))]
    stores, seen = [], []
    for number, one in enumerate(results):
        nodes = same_for_all(one)
        stores += [
            Store(int(n), None, (number, i, nodes.size)) for i, n in enumerate(nodes.reshape(-1))
        ]
        seen.append(np.zeros((arrays[0].shape[-1], *nodes.shape), one.dtype))
    program = compile_graph(graph, stores, [], len(seen))
    count = arrays[0].shape[-1]
    evaluate(program, rows.__getitem__, (np.zeros((count, 1)),) * 2, tuple(seen))
    moved = tuple(np.moveaxis(array, 0, -1) for array in seen)
    return moved if is_tuple else moved[0]


def require_bits(function, *arrays, zeros=True):
    """Compare a function compiled with the same on arrays; NaNs are equal."""
    with np.errstate(all="ignore"):
        expected = function(*arrays)
    found = compiled(function, *arrays)
    is_tuple = isinstance(expected, tuple)
    for one, other in zip(
        found if is_tuple else (found,), expected if is_tuple else (expected,), strict=True
    ):
        assert one.dtype == other.dtype
        assert one.shape == np.shape(other)
        numbers = one == one
        assert np.array_equal(numbers, other == other)
        if zeros:
            assert one[numbers].tobytes() == np.asarray(other)[numbers].tobytes()
        else:
            assert np.array_equal(one[numbers], np.asarray(other)[numbers])


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


# Functions element by element

PRODUCTS = {np.matmul, np.matvec, np.vecmat, np.vecdot}
UFUNCS = {u for u in vars(np).values() if isinstance(u, np.ufunc)} - PRODUCTS


@pytest.mark.parametrize("letter", "dq?fe")
@pytest.mark.parametrize(
    "ufunc", sorted(UFUNCS, key=lambda u: u.__name__), ids=lambda u: u.__name__
)
def test_every_function_of_numpy_is_compiled_or_refused_by_name(ufunc, letter):
    operands = [values(letter, seed=i) for i in range(ufunc.nin)]
    try:
        with np.errstate(all="ignore"):
            ufunc(*operands)
    except TypeError:  # numpy does not know it for this type
        with pytest.raises(TypeError):
            compiled(ufunc, *operands)
    except ValueError:  # numpy raises an exception if an integer has a negative power
        with pytest.raises(UntraceableError, match="power that is not a constant"):
            compiled(ufunc, *operands)
    else:
        require_bits(ufunc, *operands)


@pytest.mark.parametrize("letter", ["d", "q", "?"])
def test_products_of_matrices(letter):
    left, right = values(letter, 6).reshape(2, 3), values(letter, 3 * COUNT, 1).reshape(3, COUNT)
    left, right = (np.nan_to_num(one, posinf=2.0, neginf=-2.0) % 7 for one in (left, right))
    for function in (
        lambda x: np.matmul(left.astype(x.dtype), x),
        lambda x: np.vecmat(left[0].astype(x.dtype), x),
        lambda x: np.matvec(x.T, left[0].astype(x.dtype)),
        lambda x: np.vecdot(x.T, left[1].astype(x.dtype)),
    ):
        expected, found = function(right), compiled(function, right)
        assert (found.dtype, found.shape) == (expected.dtype, expected.shape)
        np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("letter", "fqihbQIHB?d")
def test_every_half_becomes_what_numpy_makes_of_it_and_back(letter):
    """There are 65,536 numbers of 16 bits."""
    halves = np.arange(1 << 16, dtype=np.uint16).view(np.float16)
    if letter not in "fd?":  # what does not fit into an integer is undefined
        info = np.iinfo(letter)
        with np.errstate(invalid="ignore"):
            halves = halves[(halves >= max(info.min, -65504)) & (halves <= min(info.max, 65504))]
    require_bits(lambda x: x.astype(letter), halves)
    assert len(halves) > 10_000
    others = np.concatenate([values(letter, 20_000), halves.astype(letter)])
    require_bits(lambda x: x.astype(np.float16), others)


def test_a_float64_is_rounded_once_to_16_bits():
    """Between two halves, and next to there, where a float32 would be in the middle."""
    halves = np.arange(0x7C00, dtype=np.uint16).view(np.float16).astype(np.float64)
    middle = (halves[:-1] + halves[1:]) / 2
    near = [np.nextafter(middle, side) for side in (-np.inf, np.inf)]
    around = np.concatenate([middle, *near, [65519.999, 65520.0, 65520.001, 2.0**-25]])
    require_bits(lambda x: x.astype(np.float16), np.concatenate([around, -around]))


# Sorting

ROWS = {
    "sort": lambda x: np.sort(x, axis=0),
    "sort in place": lambda x: (copied := np.array(x), copied.sort(0))[0],
    "sort backwards": lambda x: np.sort(x, axis=0)[::-1],
    "argsort": lambda x: np.argsort(x, axis=0, kind="stable"),
    "median": lambda x: np.median(x, axis=0),
    "median, kept": lambda x: np.median(x, axis=0, keepdims=True),
    "percentile": lambda x: np.percentile(x, 30, axis=0),
    "percentiles": lambda x: np.percentile(x, [0.0, 12.5, 66.0, 100.0], axis=0),
    "quantile": lambda x: np.quantile(x, 0.85, axis=0),
    "quantile of numpy": lambda x: np.quantile(x, np.float64(0.2), axis=0),
    "lower": lambda x: np.quantile(x, 0.4, axis=0, method="lower"),
    "higher": lambda x: np.quantile(x, 0.4, axis=0, method="higher"),
    "nearest": lambda x: np.quantile(x, 0.5, axis=0, method="nearest"),
    "midpoint": lambda x: np.quantile(x, 0.4, axis=0, method="midpoint"),
    "nansum": lambda x: np.nansum(x, axis=0),
    "nanprod": lambda x: np.nanprod(x, axis=0),
    "nancumsum": lambda x: np.nancumsum(x, axis=0),
    "nancumprod": lambda x: np.nancumprod(x, axis=0),
    "nanmin": lambda x: np.nanmin(x, axis=0),
    "nanmax": lambda x: np.nanmax(x, axis=0, keepdims=True),
    "nanmean": lambda x: np.nanmean(x, axis=0),
    "nanvar": lambda x: np.nanvar(x, axis=0),
    "nanstd": lambda x: np.nanstd(x, axis=0, ddof=1),
    "nanmedian": lambda x: np.nanmedian(x, axis=0),
    "nan_to_num": lambda x: np.nan_to_num(x, nan=1.0, posinf=2.0),
    "mean": lambda x: np.mean(x, axis=0),
    "mean, method": lambda x: x.mean(axis=0),
    "std": lambda x: np.std(x, axis=0),
    "frexp": lambda x: np.frexp(x)[1] + np.frexp(x)[0],
    "ldexp": lambda x: np.ldexp(x, 3),
    "divmod": lambda x: np.divmod(x, 3)[1],
    "modf": lambda x: np.modf(x)[0],
}
ZEROS = {
    "sort",
    "median",
    "percentile",
    "percentiles",
    "quantile",
    "lower",
    "higher",
    "nearest",
    "midpoint",
}
"""Whether a zero is negative depends on numpy's order of equal elements."""

HALVES = "nanmedian", "e"
"""It is refused; see below."""


@pytest.mark.filterwarnings("ignore::RuntimeWarning")  # numpy's, of arrays with NaNs only
@pytest.mark.parametrize(
    ("name", "letter"), [pair for pair in itertools.product(ROWS, "dqf?e") if pair != HALVES]
)
def test_functions_of_a_few_elements(name, letter):
    for count in (1, 2, 3, 4, 7):
        x = np.array([values(letter, seed=i) for i in range(count)])
        for row in x:
            np.random.default_rng(count).shuffle(row)
        try:
            with np.errstate(all="ignore"):
                ROWS[name](x)
        except TypeError:  # numpy does not know it for this type
            continue
        require_bits(ROWS[name], x, zeros=not ZEROS.intersection(name.replace(",", " ").split()))


@settings(max_examples=150, deadline=None)
@given(st.lists(st.floats(width=32), min_size=1, max_size=9), st.floats(0, 1))
def test_sorts_of_any_numbers(numbers, quantile):
    x = np.array(list(zip(numbers, reversed(numbers), np.roll(numbers, 1), strict=True)))
    require_bits(lambda x: np.argsort(x, axis=0, kind="stable"), x)
    require_bits(lambda x: np.sort(x, axis=0), x, zeros=False)
    require_bits(lambda x: np.quantile(x, quantile, axis=0), x, zeros=False)


@pytest.mark.parametrize("count", [2, 3, 5])
def test_an_order_that_depends_on_the_processor_is_not_guessed(count):
    """Equal elements of ``argsort`` come in an order that numpy does not promise."""
    x = np.array(list(itertools.product([0.0, 1.0], repeat=count))).T
    if sorts_stably(count, "d"):
        require_bits(lambda x: np.argsort(x, axis=0), x)
    else:
        with pytest.raises(UntraceableError, match=r"numpy\.argsort.*stable"):
            compiled(lambda x: np.argsort(x, axis=0), x)


REFUSED = {
    "more than 32 elements": lambda x: np.sort(np.concatenate([x] * 20), axis=0),
    "several axes": lambda x: np.median(x, axis=(0, 1)),
    "mixes the values of several environments": lambda x: np.median(x),
    "'hazen'": lambda x: np.quantile(x, 0.3, axis=0, method="hazen"),
    "not constant": lambda x: np.quantile(x, x[0], axis=0),
    "the argument where": lambda x: np.nansum(x, axis=0, where=x > 0),
    "out": lambda x: np.median(x, axis=0, out=x[0]),
    "complex128": lambda x: np.sum(x * 1j, axis=0),
    "nanmedian of float16": lambda x: np.nanmedian(x.astype(np.float16), axis=0),
    "object": lambda x: x + np.array([None, None])[:, None],
}


@pytest.mark.parametrize("reason", REFUSED)
def test_what_is_not_compiled_is_named(reason):
    with pytest.raises(UntraceableError, match=reason):
        compiled(REFUSED[reason], np.array([values("d"), values("d", seed=1)]))
