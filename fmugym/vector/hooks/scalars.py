"""Symbols for the hooks of a single environment: numbers of Python and numpy, and small arrays.

A single environment's hooks read numbers where a batch's hooks read arrays. Numbers follow other
rules: a float of Python adapts to the type of numpy's operand, its powers are those of the C
library, and its division by zero raises an exception. So the trace of a single environment has
symbols of its own. Where Python would raise, the program gives a reward or an input that is NaN,
and the step is repeated in Python.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from fmugym.vector.hooks.graph import Cell, Graph
from fmugym.vector.hooks.program import UntraceableError
from fmugym.vector.hooks.symbols import Symbols, Unboxed, as_symbols, handlers, lift

__all__ = ["Scalar", "ScalarGraph", "SmallArray", "array_of", "scalar_of"]

_BOOL, _INT, _FLOAT = np.dtype(np.bool_), np.dtype(np.int64), np.dtype(np.float64)

_DTYPES: Final = {bool: _BOOL, int: _INT, float: _FLOAT}
"""What holds the numbers of Python; integers are taken to be small."""

_MOST_SHIFTED: Final = 30
"""Integers of Python that are shifted farther may need more than 64 bits."""

_MOST_TERMS: Final = 7
"""numpy adds more neighbours than these in another order than from the first to the last."""


class ScalarGraph(Graph):
    """A graph whose arrays are those of one environment.

    Attributes:
        guards: Values that are true where Python would raise an exception.
        depth: How many functions of numpy are being followed; only the outermost makes scalars.
    """

    def __init__(self) -> None:
        super().__init__()
        self.array_type = SmallArray
        self.guards: list[Cell] = []
        self.depth = 0

    def guard(self, bad: Cell) -> None:
        """Note where Python would raise an exception."""
        known = self.value(bad)
        if known is None:
            self.guards.append(bad)
        elif known:
            raise UntraceableError("it always raises an exception")

    def any_guard(self) -> Cell | None:
        """Whether Python would have raised; None if it never does."""
        if not self.guards:
            return None
        result = self.guards[0]
        for guard in self.guards[1:]:
            result = self.apply(np.logical_or, (result, guard), _BOOL)
        return result

    def follow(self, makes_arrays: bool, call: Callable[[], Any]) -> Any:
        """Call a function of symbolic arrays; the outermost one gives scalars, as numpy does."""
        self.depth += 1
        try:
            result = call()
        finally:
            self.depth -= 1
        return result if self.depth or makes_arrays else unboxed(result)

    def patched(self, own: Callable[..., Any], function: Any, args: Any, keywords: Any) -> Any:
        """See ``Graph.patched``."""
        args = tuple(map(_boxed, args))
        makes_arrays = function.__name__ not in _PATCHED_SCALARS
        return self.follow(makes_arrays, lambda: own(self, function, *args, **keywords))


_PATCHED_SCALARS: Final = frozenset(
    {"take", "sum", "prod", "mean", "std", "var", "any", "all", "max", "min", "amax", "amin"}
    | {"ptp", "norm", "look_up", "median", "quantile", "percentile", "nansum", "nanprod"}
    | {"nanmin", "nanmax", "nanmean", "nanvar", "nanstd", "nanmedian", "average"}
    | {"argmax", "argmin", "interp", "searchsorted", "digitize", "choose", "nan_to_num"}
)
"""Functions that return numbers instead of arrays without dimensions."""


def unboxed(value: Any) -> Any:
    """Turn arrays without dimensions into scalars."""
    if isinstance(value, Symbols) and value.ndim == 0:
        return Scalar(value)
    if isinstance(value, list | tuple):
        return type(value)(map(unboxed, value))
    return value


class Scalar(Unboxed):
    """A number that is not known yet.

    Args:
        symbols: An array without dimensions.
        weak: ``bool``, ``int`` or ``float`` for a number of Python; None for one of numpy.
    """

    __slots__ = ("symbols", "weak")

    def __init__(self, symbols: Symbols, weak: Any = None) -> None:
        self.symbols, self.weak = symbols, weak

    @property
    def graph(self) -> Any:
        """The graph that records the operations."""
        return self.symbols.graph

    @property
    def cell(self) -> Cell:
        """The only element."""
        cell: Any = self.symbols.cells[()]
        found: Cell = cell
        return found

    @property
    def dtype(self) -> np.dtype[Any]:
        """The type of the value."""
        dtype: np.dtype[Any] = self.symbols.dtype
        return dtype

    ndim, shape, size = 0, (), 1

    def __array_ufunc__(self, ufunc: Any, method: str, *inputs: Any, **keywords: Any) -> Any:
        return _call_ufunc(self.graph, ufunc, method, inputs, keywords)

    def __array_function__(self, function: Any, types: Any, args: Any, keywords: Any) -> Any:
        return _call_function(self.graph, function, args, keywords)

    def __array__(self, dtype: Any = None, copy: Any = None) -> Any:
        """Convert to a number of numpy, as ``numpy.float64(x)`` asks for."""
        number = self.symbols.cast(self.dtype if dtype is None else dtype)
        symbols: Any = number.like(number.cells)
        symbols.is_number = True
        return symbols

    def astype(self, dtype: Any, **_: Any) -> Scalar:
        """Convert a number of numpy."""
        if self.weak is not None:
            raise AttributeError("astype")
        return Scalar(self.symbols.cast(dtype))

    def __bool__(self) -> bool:
        raise UntraceableError("it branches on a value")

    def _item(self, *_: Any) -> Any:
        raise UntraceableError("it turns a value into a number of Python")

    __float__ = __int__ = __index__ = __complex__ = __round__ = _item
    __floor__ = __ceil__ = __trunc__ = _item
    __hash__ = None  # type: ignore[assignment]  # not hashable

    def __divmod__(self, other: Any) -> Any:
        return self // other, self % other

    def __rdivmod__(self, other: Any) -> Any:
        return other // self, other % self

    def __neg__(self) -> Any:
        return self._unary(np.negative)

    def __pos__(self) -> Any:
        return self._unary(np.positive)

    def __abs__(self) -> Any:
        return self._unary(np.absolute)

    def __invert__(self) -> Any:
        if self.weak is float:
            raise UntraceableError("it inverts a float")
        return self._unary(np.invert)

    def _unary(self, ufunc: Any) -> Any:
        if self.weak is None:
            return ufunc(self)
        kind = int if self.weak is bool else self.weak
        dtype = _DTYPES[kind]
        cell = self.graph.apply(ufunc, (self.graph.cast(self.cell, dtype),), dtype)
        return _scalar(self.graph, cell, dtype, kind)


class SmallArray(Symbols):
    """A symbolic array of one environment; its elements are scalars."""

    is_number = False
    """Whether it stands for a number of numpy, which has powers of its own."""

    def __pow__(self, exponent: Any, modulo: Any = None) -> Any:
        if self.is_number:
            return _boxless(self) ** exponent
        return super().__pow__(exponent)

    def like(self, cells: Any, dtype: npt.DTypeLike | None = None) -> Symbols:
        """See ``Symbols.like``."""
        array = cells
        if not isinstance(cells, np.ndarray):
            array = np.empty((), object)
            array[()] = cells
        return Symbols(self._graph, array, self.dtype if dtype is None else dtype, self._writeable)

    def __array_ufunc__(self, ufunc: Any, method: str, *inputs: Any, **keywords: Any) -> Any:
        return _call_ufunc(self.graph, ufunc, method, inputs, keywords)

    def __array_function__(self, function: Any, types: Any, args: Any, keywords: Any) -> Any:
        return _call_function(self.graph, function, args, keywords)

    def __getitem__(self, key: Any) -> Any:
        graph: Any = self.graph
        return graph.follow(False, lambda: Symbols.__getitem__(self, _boxed(key)))

    def __iter__(self) -> Iterator[Any]:
        return (self[index] for index in range(len(self)))


_ARRAY_MAKERS: Final = frozenset(
    {np.where, np.select, np.zeros_like, np.ones_like, np.empty_like, np.full_like, np.copy}
    | {np.reshape, np.squeeze, np.broadcast_to, np.broadcast_arrays}
)
"""Functions that return arrays even if these have no dimensions."""


def _boxless(array: Symbols) -> Scalar:
    return Scalar(array.like(array.cells))


def _call_ufunc(graph: Any, ufunc: Any, method: str, inputs: Any, keywords: Any) -> Any:
    if method == "reduce":
        _require_few(ufunc, inputs[0])
    boxed = tuple(map(_boxed, inputs))
    return graph.follow(False, lambda: handlers["ufunc"](graph, ufunc, method, boxed, keywords))


def _require_few(ufunc: Any, values: Any) -> None:
    if (
        ufunc is np.add
        and np.size(values.cells if isinstance(values, Symbols) else 0) > _MOST_TERMS
    ):
        raise UntraceableError(
            f"it adds more than {_MOST_TERMS} elements, which numpy does in an order of its own"
        )


def _call_function(graph: Any, function: Any, args: Any, keywords: Any) -> Any:
    adapt = function in (np.select, np.choose)
    args = tuple(_boxed(value, adapt) for value in args)
    keywords = {name: _boxed(value, adapt) for name, value in keywords.items()}
    makes_arrays = function in _ARRAY_MAKERS
    return graph.follow(makes_arrays, lambda: handlers["function"](function, args, keywords))


def _boxed(value: Any, adapt: bool = False) -> Any:
    """What the functions of symbolic arrays take: numbers of Python stay weak.

    Args:
        value: An argument.
        adapt: Whether numbers in lists stay weak, too. Where numpy makes an array of the list, they
            do not.
    """
    if isinstance(value, list | tuple):
        return type(value)(map(_boxed if adapt else _boxless_part, value))
    if not isinstance(value, Scalar):
        return value
    symbols = value.symbols.like(value.cell)
    symbols.weak = value.weak if value.weak in (int, float) else None
    return symbols


def _boxless_part(part: Any) -> Any:
    """An element of a list, which does not adapt to other types any more."""
    return part.symbols.like(part.cell) if isinstance(part, Scalar) else _boxed(part)


def _scalar(graph: Any, cell: Cell, dtype: np.dtype[Any], weak: Any) -> Scalar:
    array = np.empty((), object)
    array[()] = cell
    return Scalar(Symbols(graph, array, dtype), weak)


def scalar_of(graph: Any, kind: str, what: Any, dtype: npt.DTypeLike, weak: Any) -> Scalar:
    """A number that a program loads."""
    return _scalar(graph, graph.load(kind, what, dtype, None), np.dtype(dtype), weak)


def array_of(graph: Any, kind: str, names: npt.NDArray[Any], dtype: npt.DTypeLike) -> Symbols:
    """An array that a program loads; hooks may only read it."""
    cells = np.empty(names.shape, object)
    for place in np.ndindex(names.shape):
        what: Any = names[place]
        cells[place] = graph.load(kind, what, dtype, None)
    return Symbols(graph, cells, dtype, writeable=False)


# The operators of Python.


def _python_kind(value: Any) -> Any:
    """The type of a number of Python; None for anything else."""
    if isinstance(value, Scalar):
        return value.weak
    return type(value) if type(value) in _DTYPES else None


def _cell(graph: Any, value: Any, dtype: np.dtype[Any]) -> Cell:
    if isinstance(value, Scalar):
        cast: Cell = graph.cast(value.cell, dtype)
        return cast
    constant: Cell = graph.constant(np.asarray(value, dtype), dtype)
    return constant


def _operator(ufunc: Any, of_python: Callable[[Any, Any, Any, Any], Any]) -> tuple[Any, Any]:
    def combine(first: Any, second: Any) -> Any:
        kinds = _python_kind(first), _python_kind(second)
        if None not in kinds:
            graph = (first if isinstance(first, Scalar) else second).graph
            return of_python(graph, kinds, first, second)
        return NotImplemented if _is_strange(first, second) else _of_numpy(ufunc, first, second)

    return combine, lambda second, first: combine(first, second)


def _is_strange(*values: Any) -> bool:
    known = (Scalar, np.ndarray, np.generic, bool, int, float)
    return not all(isinstance(value, known) for value in values)


def _of_numpy(ufunc: Any, first: Any, second: Any) -> Any:
    is_scalar = not any(isinstance(value, np.ndarray) for value in (first, second))
    if ufunc is not np.power or not is_scalar:
        return ufunc(first, second)
    graph = (first if isinstance(first, Scalar) else second).graph
    kinds = [
        _python_kind(v) if _python_kind(v) in (int, float) else v.dtype for v in (first, second)
    ]
    result = np.power.resolve_dtypes((*kinds, None))[-1]
    if result.kind != "f":
        return ufunc(first, second)
    cells = tuple(_cell(graph, value, result) for value in (first, second))
    return _scalar(graph, _power(graph, cells, result), result, None)


def _power(graph: Any, cells: tuple[Cell, ...], dtype: np.dtype[Any]) -> Cell:
    if dtype.itemsize not in (4, 8):
        raise UntraceableError(f"it computes with {dtype}")

    def fold(base: Any, exponent: Any) -> Any:
        return np.array([base[0] ** exponent[0]], dtype)

    cell: Cell = graph.compute("scalar_power", None, cells, dtype, fold)
    return cell


def _arithmetic(ufunc: Any) -> Callable[..., Any]:
    def combine(graph: Any, kinds: Any, first: Any, second: Any) -> Any:
        kind = float if float in kinds else int
        dtype = _DTYPES[kind]
        cells = _cell(graph, first, dtype), _cell(graph, second, dtype)
        return _scalar(graph, graph.apply(ufunc, cells, dtype), dtype, kind)

    return combine


def _division(ufunc: Any) -> Callable[..., Any]:
    def combine(graph: Any, kinds: Any, first: Any, second: Any) -> Any:
        kind = float if float in kinds or ufunc is np.true_divide else int
        dtype = _DTYPES[kind]
        cells = _cell(graph, first, dtype), _cell(graph, second, dtype)
        zero = _cell(graph, 0, dtype)
        graph.guard(graph.apply(np.equal, (cells[1], zero), _BOOL))
        return _scalar(graph, graph.apply(ufunc, cells, dtype), dtype, kind)

    return combine


def _power_of_python(graph: Any, kinds: Any, first: Any, second: Any) -> Any:
    if isinstance(second, Scalar) or second < 0:
        raise UntraceableError("the exponent of a power is negative, or no constant")
    if float not in kinds:
        cells = _cell(graph, first, _INT), _cell(graph, second, _INT)
        return _scalar(graph, graph.apply(np.power, cells, _INT), _INT, int)
    cells = _cell(graph, first, _FLOAT), _cell(graph, second, _FLOAT)
    result = _power(graph, cells, _FLOAT)
    if second != int(second):  # Python gives a complex number
        graph.guard(graph.apply(np.less, (cells[0], _cell(graph, 0.0, _FLOAT)), _BOOL))
    graph.guard(graph.apply(np.equal, (result, _cell(graph, np.inf, _FLOAT)), _BOOL))
    graph.guard(graph.apply(np.equal, (result, _cell(graph, -np.inf, _FLOAT)), _BOOL))
    return _scalar(graph, result, _FLOAT, float)


def _comparison(ufunc: Any) -> Callable[..., Any]:
    def combine(graph: Any, kinds: Any, first: Any, second: Any) -> Any:
        dtype = _DTYPES[float if float in kinds else int]
        cells = _cell(graph, first, dtype), _cell(graph, second, dtype)
        return _scalar(graph, graph.apply(ufunc, cells, _BOOL), _BOOL, bool)

    return combine


def _bitwise(ufunc: Any, of_flags: Any) -> Callable[..., Any]:
    def combine(graph: Any, kinds: Any, first: Any, second: Any) -> Any:
        if float in kinds:
            raise UntraceableError("it combines floats bit by bit")
        kind = bool if kinds == (bool, bool) else int
        dtype = _DTYPES[kind]
        cells = _cell(graph, first, dtype), _cell(graph, second, dtype)
        function = of_flags if kind is bool else ufunc
        return _scalar(graph, graph.apply(function, cells, dtype), dtype, kind)

    return combine


def _shift(ufunc: Any) -> Callable[..., Any]:
    def combine(graph: Any, kinds: Any, first: Any, second: Any) -> Any:
        if float in kinds:
            raise UntraceableError("it shifts the bits of a float")
        cells = _cell(graph, first, _INT), _cell(graph, second, _INT)
        for bad, limit in ((np.less, 0), (np.greater, _MOST_SHIFTED)):
            graph.guard(graph.apply(bad, (cells[1], _cell(graph, limit, _INT)), _BOOL))
        return _scalar(graph, graph.apply(ufunc, cells, _INT), _INT, int)

    return combine


_OPERATORS: Final[dict[str, tuple[Any, Callable[..., Any]]]] = {
    "add": (np.add, _arithmetic(np.add)),
    "sub": (np.subtract, _arithmetic(np.subtract)),
    "mul": (np.multiply, _arithmetic(np.multiply)),
    "truediv": (np.true_divide, _division(np.true_divide)),
    "floordiv": (np.floor_divide, _division(np.floor_divide)),
    "mod": (np.remainder, _division(np.remainder)),
    "pow": (np.power, _power_of_python),
    "lshift": (np.left_shift, _shift(np.left_shift)),
    "rshift": (np.right_shift, _shift(np.right_shift)),
    "and": (np.bitwise_and, _bitwise(np.bitwise_and, np.logical_and)),
    "or": (np.bitwise_or, _bitwise(np.bitwise_or, np.logical_or)),
    "xor": (np.bitwise_xor, _bitwise(np.bitwise_xor, np.logical_xor)),
}
_COMPARISONS: Final = {
    "lt": np.less,
    "le": np.less_equal,
    "gt": np.greater,
    "ge": np.greater_equal,
    "eq": np.equal,
    "ne": np.not_equal,
}

for _name, (_ufunc, _of_python) in _OPERATORS.items():
    _forward, _backward = _operator(_ufunc, _of_python)
    setattr(Scalar, f"__{_name}__", _forward)
    setattr(Scalar, f"__r{_name}__", _backward)
for _name, _ufunc in _COMPARISONS.items():
    setattr(Scalar, f"__{_name}__", _operator(_ufunc, _comparison(_ufunc))[0])


def lifted(graph: Any, value: Any) -> Symbols:
    """Make symbols of what a hook returns: scalars, arrays, or lists of them."""
    if isinstance(value, Scalar):
        return value.symbols
    return (
        as_symbols(graph, value)
        if isinstance(value, list | tuple)
        else lift(graph, np.asarray(value) if not isinstance(value, Symbols) else value)
    )
