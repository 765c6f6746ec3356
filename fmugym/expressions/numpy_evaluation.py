"""The evaluation of graphs by numpy: of one environment, or of arrays of them.

It is the reference of the programs that the C extension runs. One number has the same value, to the
last bit, as an element of an array: operations are numpy's functions, or operators of Python that
IEEE 754 settles.
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Mapping, Sequence
from functools import partial, reduce
from typing import Any, Final

import numpy as np

from fmugym.expressions.compiler import registers_of
from fmugym.expressions.graph import Computed, Formulas, Graph, Node, Update, Value
from fmugym.expressions.quantities import QUANTITIES

__all__ = ["function_of", "hooks_of", "update_by"]


def function_of(result: Computed) -> Callable[[Any], Any]:
    """Make a function of the environment that returns values, lists of them as tuples.

    It serves one environment and arrays of them. A value that is needed several times is computed
    once.
    """
    values: list[Value] = []
    _each(values.append, result)
    graph = values[0].graph if values else Graph()
    results = [value.node for value in values]
    order = graph.needed(results)
    constants = [number for number in order if graph.nodes[number].kind == "constant"]
    computed = [(n, graph.nodes[n]) for n in order if graph.nodes[n].kind != "constant"]
    places = registers_of([(n, node.operands) for n, node in computed], constants, results)
    known = [_constant(graph.nodes[number].number) for number in constants]
    known += [None] * (1 + max(places.values(), default=-1) - len(known))
    steps = [
        (places[n], _operation(graph, node), [places[one] for one in node.operands] or [-1])
        for n, node in computed
    ]
    form = _each(lambda value: places[value.node], result)

    def evaluate(env: Any) -> Any:
        registers = [*known, env]
        find = registers.__getitem__
        with np.errstate(all="ignore"):  # a result that is not finite is a fault of the episode
            for place, operation, operands in steps:
                registers[place] = operation(*map(find, operands))
        return _each(find, form)

    return evaluate


def hooks_of(formulas: Formulas) -> dict[str, Callable[[Any], Any]]:
    """Make the hooks of a step that formulas stand for, by the names of the hooks."""
    inputs = formulas.inputs
    if inputs is not None and len(inputs) == 1:
        inputs = inputs[0]  # type: ignore[assignment]  # a number for one input
    values = {
        "_get_inputs": inputs,
        "_is_done": formulas.terminated,
        "_is_truncated": formulas.truncated,
        "_reward_policy": formulas.reward,
        "_get_observation": formulas.observation,
        "_get_info": formulas.info or None,
    }
    hooks = {hook: function_of(value) for hook, value in values.items() if value is not None}
    return hooks | ({"_update": update_by(formulas.updates)} if formulas.updates else {})


def update_by(updates: Sequence[Update]) -> Callable[[Any], None]:
    """Make a function of the environment that writes its episode variables, see ``Formulas``."""
    functions = [(list(one), function_of(list(one.values()))) for one in updates]

    def update(env: Any) -> None:
        for names, function in functions:
            for name, value in zip(names, function(env), strict=True):
                is_array = isinstance(value, tuple)
                env.variables[name] = np.stack(np.broadcast_arrays(*value)) if is_array else value

    return update


def _constant(number: Any) -> Any:
    """A number of Python, which takes less time; an integer of numpy wraps around as in C."""
    return number if isinstance(number, np.integer) else number.item()


def _each(function: Callable[[Any], Any], parts: Any) -> Any:
    """Apply a function to each part of a result."""
    if isinstance(parts, Mapping):
        return {name: _each(function, part) for name, part in parts.items()}
    if isinstance(parts, list | tuple):
        return tuple([_each(function, part) for part in parts])
    return function(parts)


def _operation(graph: Graph, node: Node) -> Callable[..., Any]:
    """The function of Python for a node: of its operands, or of the environment."""
    what: Any = node.what
    match node.kind:
        case "row":
            name, *keys = what
            read = operator.attrgetter(QUANTITIES[name].path if name in QUANTITIES else name)
            return lambda env: reduce(operator.getitem, keys, read(env))
        case "cast":
            return partial(_cast, node.dtype)
        case "where":
            return _chosen
        case "take":
            return partial(_looked_up, graph.tables, what)
        case "interpolate":
            return partial(_interpolated, graph.tables, what)
    function: Callable[..., Any] = _OF_PYTHON.get(what, what)
    return function


def _cast(dtype: np.dtype[Any], value: Any) -> Any:
    """The value in another type."""
    return np.asarray(value).astype(dtype)[()]


def _chosen(condition: Any, first: Any, second: Any) -> Any:
    """Choose the first number if a condition holds, otherwise the second."""
    if isinstance(condition, bool | np.bool_):
        return np.float64(first if condition else second)  # the type that numpy.where gives
    return np.where(condition, first, second)[()]  # a number if all are numbers


def _looked_up(tables: Mapping[Any, Any], key: Any, index: Any) -> Any:
    """The number with this index in a table, which is found in each call: it may be replaced."""
    table = tables[key]
    return float(table[index]) if isinstance(index, int | np.integer) else np.take(table, index)


def _interpolated(tables: Mapping[Any, Any], key: Any, place: Any) -> Any:
    """The number at a place of a table, on straight lines; see ``Value.interpolated``."""
    table = tables[key]
    count = len(table) // 2 - 1
    return np.interp(place, table[:count], table[count:-2], table[-2], table[-1])


def _divide(first: Any, second: Any) -> Any:
    """A quotient; by 0, it is not finite."""
    try:
        return first / second
    except ZeroDivisionError:  # Python's floats raise where numpy gives an infinity or NaN
        return np.divide(first, second)


def _remainder(first: Any, second: Any) -> Any:
    """Remainder of a division; NaN for a division by 0."""
    try:
        return first % second
    except ZeroDivisionError:
        return np.remainder(first, second)


def _power(base: Any, exponent: Any) -> Any:
    """The function ``pow`` of C."""
    return np.float_power(*np.broadcast_arrays(base, exponent))[()]


def _power_of_float32(base: Any, exponent: Any) -> Any:
    """The function ``powf`` of C; numpy's loop over arrays may round otherwise."""
    operands = (np.float32(one) if isinstance(one, float) else one for one in (base, exponent))
    bases, exponents = np.broadcast_arrays(*operands)
    pairs = zip(bases.flat, exponents.flat, strict=True)
    return np.array([one**other for one, other in pairs], np.float32).reshape(bases.shape)[()]


_OF_PYTHON: Final[Mapping[Any, Callable[..., Any]]] = {
    np.add: operator.add,
    np.subtract: operator.sub,
    np.multiply: operator.mul,
    np.negative: operator.neg,
    np.absolute: abs,
    np.less: operator.lt,
    np.less_equal: operator.le,
    np.greater: operator.gt,
    np.greater_equal: operator.ge,
    np.equal: operator.eq,
    np.not_equal: operator.ne,
    np.bitwise_and: operator.and_,
    np.bitwise_or: operator.or_,
    np.bitwise_xor: operator.xor,
    np.right_shift: operator.rshift,
    np.divide: _divide,
    np.remainder: _remainder,
    np.float_power: _power,
    np.power: _power_of_float32,
}
"""Functions of Python in place of numpy's, which take far more time for single numbers."""
