"""Tracing: hooks that are plain arithmetic become programs for the native pool.

A hook is called with symbols instead of numbers. The symbols record what the hook computes with
arithmetic, comparisons and a few functions of numpy. Only operations whose results are the same in
C and in numpy to the last bit are recorded. A hook that does anything else (sines, powers,
branches) cannot be traced, and is called on arrays.
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import Any, Final

import numpy as np
from gymnasium import spaces

from fmugym.env import FMUEnv
from fmugym.task.readings import Readings, reading
from fmugym.task.values import EpisodeVariables, NamedValues
from fmugym.vector.contents import borrowed
from fmugym.vector.hooks.program import (
    MOST_INSTRUCTIONS,
    OPERATIONS,
    Program,
    UntraceableError,
)

__all__ = ["trace_hooks"]


class Symbol:
    """Stands for a number that is not known yet, and records what is done with it.

    Args:
        operation: One of ``OPERATIONS``.
        operands: Symbols; or the index of the value to load; or the constant.
        is_bool: Whether it stands for a Boolean.
    """

    def __init__(self, operation: str, *operands: Any, is_bool: bool = False) -> None:
        self.operation = operation
        self.operands = operands
        self.is_bool = is_bool

    def __bool__(self) -> bool:
        raise UntraceableError("it branches on a value")

    def __array_ufunc__(self, ufunc: Any, method: str, *inputs: Any, **kwargs: Any) -> Symbol:
        function = _UFUNCS.get(ufunc)
        if function is None or method != "__call__" or kwargs:
            raise UntraceableError(f"it uses numpy.{ufunc.__name__}")
        return function(*map(_symbol, inputs))  # a scalar of numpy would call this method again

    def __array_function__(self, func: Any, types: Any, args: Any, kwargs: Any) -> Symbol:
        if func is np.where and len(args) == 3 and not kwargs:
            return _where(*args)
        raise UntraceableError(f"it uses numpy.{func.__name__}")

    def __add__(self, other: Any) -> Symbol:
        return _arithmetic("add", self, other)

    def __radd__(self, other: Any) -> Symbol:
        return _arithmetic("add", other, self)

    def __sub__(self, other: Any) -> Symbol:
        return _arithmetic("subtract", self, other)

    def __rsub__(self, other: Any) -> Symbol:
        return _arithmetic("subtract", other, self)

    def __mul__(self, other: Any) -> Symbol:
        return _arithmetic("multiply", self, other)

    def __rmul__(self, other: Any) -> Symbol:
        return _arithmetic("multiply", other, self)

    def __truediv__(self, other: Any) -> Symbol:
        return _arithmetic("divide", self, other)

    def __rtruediv__(self, other: Any) -> Symbol:
        return _arithmetic("divide", other, self)

    def __neg__(self) -> Symbol:
        return _arithmetic("negative", self)

    def __abs__(self) -> Symbol:
        return _arithmetic("absolute", self)

    def __lt__(self, other: Any) -> Symbol:
        return _comparison("less", self, other)

    def __le__(self, other: Any) -> Symbol:
        return _comparison("less_equal", self, other)

    def __gt__(self, other: Any) -> Symbol:
        return _comparison("greater", self, other)

    def __ge__(self, other: Any) -> Symbol:
        return _comparison("greater_equal", self, other)

    def __eq__(self, other: object) -> Symbol:  # type: ignore[override]
        return _comparison("equal", self, other)

    def __ne__(self, other: object) -> Symbol:  # type: ignore[override]
        return _comparison("not_equal", self, other)

    __hash__ = object.__hash__

    def __and__(self, other: Any) -> Symbol:
        return _logic("and", self, other)

    __rand__ = __and__

    def __or__(self, other: Any) -> Symbol:
        return _logic("or", self, other)

    __ror__ = __or__

    def __invert__(self) -> Symbol:
        return _logic("not", self)


def _symbol(value: Any) -> Symbol:
    """Make a symbol of a constant; only plain numbers can be traced."""
    if (
        isinstance(value, np.ndarray) and value.ndim == 0
    ):  # numpy wraps scalars and symbols like this
        value = value.item()
    if isinstance(value, Symbol):
        return value
    if isinstance(value, bool | np.bool_):
        return Symbol("constant", float(value), is_bool=True)
    if isinstance(value, int | float | np.float64 | np.integer):
        return Symbol("constant", float(value))
    raise UntraceableError(f"it computes with {type(value).__name__}")


def _arithmetic(operation: str, *operands: Any) -> Symbol:
    symbols = [_symbol(operand) for operand in operands]
    if all(symbol.is_bool for symbol in symbols):
        raise UntraceableError("it does arithmetic with Booleans alone")
    return Symbol(operation, *symbols)


def _comparison(operation: str, first: Any, second: Any) -> Symbol:
    return Symbol(operation, _symbol(first), _symbol(second), is_bool=True)


def _logic(operation: str, *operands: Any) -> Symbol:
    symbols = [_symbol(operand) for operand in operands]
    if not all(symbol.is_bool for symbol in symbols):
        raise UntraceableError("it does bit arithmetic with numbers")
    return Symbol(operation, *symbols, is_bool=True)


def _where(condition: Any, first: Any, second: Any) -> Symbol:
    chosen = _symbol(condition), _symbol(first), _symbol(second)
    if not chosen[0].is_bool or chosen[1].is_bool is not chosen[2].is_bool:
        raise UntraceableError("it chooses between values of different types")
    return Symbol("where", *chosen, is_bool=chosen[1].is_bool)


_UFUNCS: Final[Mapping[Any, Callable[..., Symbol]]] = {
    np.add: operator.add,
    np.subtract: operator.sub,
    np.multiply: operator.mul,
    np.true_divide: operator.truediv,
    np.negative: operator.neg,
    np.absolute: operator.abs,
    np.fabs: operator.abs,
    np.sqrt: lambda value: _arithmetic("square_root", value),
    np.square: lambda value: _arithmetic("multiply", value, value),
    np.minimum: lambda first, second: _arithmetic("minimum", first, second),
    np.maximum: lambda first, second: _arithmetic("maximum", first, second),
    np.less: operator.lt,
    np.less_equal: operator.le,
    np.greater: operator.gt,
    np.greater_equal: operator.ge,
    np.equal: operator.eq,
    np.not_equal: operator.ne,
    np.logical_and: operator.and_,
    np.logical_or: operator.or_,
    np.logical_not: operator.invert,
    np.bitwise_and: operator.and_,
    np.bitwise_or: operator.or_,
    np.invert: operator.invert,
}


def trace_hooks(env: FMUEnv) -> tuple[Program, Program]:
    """Trace the hooks of an environment.

    Args:
        env: A prototype with a ``Discrete`` action space and the default observation.

    Returns:
        The program from the action to the inputs, and the program from the outputs to done,
        truncated and reward.

    Raises:
        UntraceableError: If the hooks do what a program cannot do; the text names it.
    """
    _require_simple(env)
    with borrowed(env) as contents, reading(env, _symbolic(env)):
        try:
            programs = _traced(env)
        except UntraceableError:
            raise
        except Exception as error:  # hooks do with numbers what symbols cannot do
            raise UntraceableError(f"it fails on symbols: {error}") from error
        changed = contents.changed()
    if changed is not None:
        raise UntraceableError(f"a hook changes self.{changed}")
    return programs


def _traced(symbolic: FMUEnv) -> tuple[Program, Program]:
    inputs = _values(symbolic._get_inputs(), len(symbolic._interface.inputs))
    symbolic.inputs = tuple(inputs)
    done = _flag(symbolic._is_done())
    symbolic.done = done
    truncated = _flag(symbolic._is_truncated())
    reward = _symbol(symbolic._reward_policy())
    return _compile(inputs), _compile([done, truncated, reward])


def _require_simple(env: FMUEnv) -> None:
    space = env.observation_space
    is_flat = isinstance(space, spaces.Box) and space.dtype == np.float32
    obstacles = {
        "the actions are no single integers": not isinstance(env.action_space, spaces.Discrete),
        "the observation is not the default one": env._own.get_observation or not is_flat,
        "it has a hook _update": env._own.update,
        "its steps have an info": env._has_info,
        "it is a goal task": env._own.goal_reward,
        "it has episode variables": env.config.episode_variables,
        "it has inputs that are not Real": not env._input_writer.all_real,
    }
    for obstacle, is_there in obstacles.items():
        if is_there:
            raise UntraceableError(obstacle)


def _symbolic(env: FMUEnv) -> Readings:
    """Make readings in which symbols stand for what programs can load; the rest is missing."""
    names = list(env._interface.parameters)
    values = tuple(Symbol("output", index) for index in range(len(env.out)))
    return Readings(
        values=values,
        out=NamedValues("output", list(env.out), lambda: values),
        state=values[: env._output_count],
        previous_state=_Missing(),
        inputs=tuple(Symbol("input", index) for index in range(len(env._start_inputs))),
        action=Symbol("action", 0),
        previous_action=_Missing(),
        step_count=Symbol("step_count", 0),
        done=False,
        after_end=False,
        parameters=MappingProxyType(
            {name: Symbol("parameter", index) for index, name in enumerate(names)}
        ),
        variables=EpisodeVariables({}),
    )


class _Missing:
    """Stands for values that programs cannot load."""

    def __getattr__(self, name: str) -> Any:
        raise UntraceableError("it looks at the step before")

    def __iter__(self) -> Any:
        raise UntraceableError("it looks at the step before")

    def __getitem__(self, index: Any) -> Any:
        raise UntraceableError("it looks at the step before")


def _values(values: Any, count: int) -> list[Symbol]:
    rows = list(values) if isinstance(values, list | tuple) else [values]
    if len(rows) != count:
        raise UntraceableError("the number of inputs is not that of the config")
    return [_symbol(row) for row in rows]


def _flag(value: Any) -> Symbol:
    symbol = _symbol(value)
    if not symbol.is_bool:
        raise UntraceableError("a flag is no Boolean")
    return symbol


def _compile(results: Sequence[Symbol]) -> Program:
    """Number the symbols in the order of evaluation, equal ones once."""
    instructions: dict[tuple[int, ...], int] = {}
    constants: dict[str, int] = {}
    registers: dict[int, int] = {}
    for symbol in _in_order(results):
        operands = [
            registers[id(o)] if isinstance(o, Symbol) else _place(o, constants)
            for o in symbol.operands
        ]
        instruction = (OPERATIONS.index(symbol.operation), *operands, *[0] * (3 - len(operands)))
        registers[id(symbol)] = instructions.setdefault(instruction, len(instructions))
    if len(instructions) > MOST_INSTRUCTIONS:
        raise UntraceableError(f"it has more than {MOST_INSTRUCTIONS} operations")
    return Program(
        np.array(list(instructions), np.uint16),
        np.array([float.fromhex(text) for text in constants]),
        np.array([registers[id(symbol)] for symbol in results], np.uint16),
    )


def _in_order(results: Sequence[Symbol]) -> list[Symbol]:
    """All symbols that the results need, each after its operands."""
    order: list[Symbol] = []
    seen: set[int] = set()
    waiting = [(symbol, False) for symbol in reversed(results)]
    while waiting:
        symbol, has_operands = waiting.pop()
        if has_operands:
            order.append(symbol)
        elif id(symbol) not in seen:
            seen.add(id(symbol))
            waiting.append((symbol, True))
            waiting.extend((o, False) for o in symbol.operands if isinstance(o, Symbol))
    return order


def _place(operand: float, constants: dict[str, int]) -> int:
    """Return an index as it is, but a constant's place; 0.0 and -0.0 are two constants."""
    if isinstance(operand, float):
        return constants.setdefault(operand.hex(), len(constants))
    return int(operand)
