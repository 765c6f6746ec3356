"""Expressions: arithmetic over the names of a task, as text.

The grammar is a part of Python's: numbers, names, ``+ - * / % **``, comparisons, ``and``, ``or``,
``not``, ``a if condition else b``, and calls of functions, see ``FUNCTIONS`` in
``fmugym.expressions.functions``. ``previous(x)`` is the value of ``x`` before the step. A name
may have dots and indices, as those of an FMU do: ``zone[1].T``. There are no texts or assignments.
Each value is a number or a condition; in arithmetic a condition counts as 0 or 1.

An expression becomes nodes of a graph, see ``fmugym.expressions.graph``. Its only names are those
that the caller gives. It works element by element, so that it serves one environment and arrays of
them.
"""

from __future__ import annotations

import ast
import copy
import math
import warnings
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property, partial, reduce
from itertools import pairwise
from typing import Any, Final, NamedTuple

import numpy as np

from fmugym.checks import float_or_nan
from fmugym.errors import ConfigError, ConsequenceError, shown, unknown_name
from fmugym.expressions.functions import FUNCTIONS
from fmugym.expressions.graph import Graph, Value, where

__all__ = ["CONSTANTS", "Expression", "Names"]

_LONGEST: Final = 2000
_MOST_NODES: Final = 500
_DEEPEST: Final = 40


def _power(base: Any, exponent: Any) -> Any:
    if exponent.constant == 2.0:  # a product takes far less time
        return np.square(base)
    return np.float_power(base, exponent)


_OPERATIONS: Final[Mapping[type[ast.AST], Callable[..., Any]]] = {
    ast.Add: np.add,
    ast.Sub: np.subtract,
    ast.Mult: np.multiply,
    ast.Div: np.divide,
    ast.Mod: np.remainder,
    ast.Pow: _power,
    ast.USub: np.negative,
    ast.And: np.bitwise_and,
    ast.Or: np.bitwise_or,
    ast.Lt: np.less,
    ast.LtE: np.less_equal,
    ast.Gt: np.greater,
    ast.GtE: np.greater_equal,
    ast.Eq: np.equal,
    ast.NotEq: np.not_equal,
}


class Names(NamedTuple):
    """Values of the names in an expression.

    Attributes:
        graph: Gets the nodes of expressions.
        find: Returns the value of a name; None if there is no such name.
        find_previous: Returns the value of a name before the step; None if it has none.
        known: The names to suggest for one that is misspelt.
    """

    graph: Graph
    find: Callable[[str], Value | None] = lambda name: None
    find_previous: Callable[[str], Value | None] = lambda name: None
    known: Callable[[], list[str]] = list


CONSTANTS: Final[Mapping[str, float | bool]] = {"pi": math.pi, "true": True, "false": False}
"""Names that have the same value everywhere."""


@dataclass(frozen=True)
class Expression:
    """An expression whose grammar is checked.

    Attributes:
        text: As the user wrote it.
        tree: Syntax tree.
    """

    text: str
    tree: ast.expr = field(repr=False, compare=False)

    @classmethod
    def parse(cls, value: Any) -> Expression:
        """Parse an expression.

        Args:
            value: A text; a number or a Boolean stands for itself.

        Raises:
            ConfigError: If it is no expression. The text tells the column.
        """
        if isinstance(value, bool | int | float):
            value = repr(value) if isinstance(value, bool) else _text_of(value)
        if not isinstance(value, str):
            raise ConfigError(f"expected an expression, got {shown(value)}")
        if len(value) > _LONGEST:
            raise ConfigError(f"an expression has at most {_LONGEST} characters, got {len(value)}")
        tree = _parsed(value)
        _check_size(value, tree)
        return cls(value, tree).renamed(lambda name: name)

    def renamed(self, name_of: Callable[[str], str]) -> Expression:
        """The same with other names.

        Args:
            name_of: Takes a name as it stands in the text, and returns the new one. Python's parser
                gives names in their normal form.
        """
        if self.text.isascii():
            return self
        tree, text = copy.deepcopy(self.tree), self.text.strip()
        for node in ast.walk(tree):
            if isinstance(node, ast.Name):
                node.id = name_of(ast.get_source_segment(text, node) or node.id)
        return replace(self, tree=tree)

    @cached_property
    def names(self) -> frozenset[str]:
        """The names that it reads."""
        return frozenset(_names_in(self.text, self.tree))

    @property
    def previous_names(self) -> set[str]:
        """The names whose values before the step it reads."""
        calls = [node for node in ast.walk(self.tree) if isinstance(node, ast.Call)]
        found = {
            _name_of(self.text, argument)
            for call in calls
            if isinstance(call.func, ast.Name) and call.func.id == "previous"
            for argument in call.args
        }
        return {name for name in found if name is not None}

    def differences(self, *, or_comparisons: bool = False) -> Iterator[tuple[Any, Any]]:
        """Both sides of each minus: a name, a number, or None for anything else.

        Args:
            or_comparisons: Whether to give those of comparisons, too.
        """
        for node in ast.walk(self.tree):
            match node:
                case ast.BinOp(left, ast.Sub(), right):
                    yield _name_or_number(left), _name_or_number(right)
                case ast.Compare(left, _, others) if or_comparisons:
                    yield from pairwise(map(_name_or_number, (left, *others)))

    def value(self, names: Names) -> Value:
        """Make nodes of it.

        Args:
            names: Values of the names.

        Raises:
            ConfigError: If a name is unknown, or the expression has something that is not in the
                grammar. The text tells the column.
        """
        value = _Evaluation(self.text, names).evaluate(self.tree)
        if value.constant is not None and not math.isfinite(value.constant):
            raise ConfigError(f"{shown(self.text)} is no finite number, but {value.constant}")
        return value

    def constant(self) -> float:
        """The value of an expression without names.

        Raises:
            ConfigError: If it has names, or the value is not finite.
        """
        value = self.value(Names(Graph())).number.constant
        if value is None:
            raise ConfigError(f"expected a number, got {shown(self.text)}")
        return float(value)


def _text_of(value: float) -> str:
    """A finite number as Python's own types write it, whatever a derived type makes of it."""
    if not math.isfinite(float_or_nan(value)):
        raise ConfigError(f"expected an expression or a finite number, got {shown(value)}")
    return int.__repr__(value) if isinstance(value, int) else float.__repr__(value)


def _parsed(text: str) -> ast.expr:
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of Python's own grammar
            return ast.parse(text.strip(), mode="eval").body
    except SyntaxError as error:
        raise ConfigError(f"{shown(text)} is no expression: {_misfit(text, error)}") from None
    except (ValueError, MemoryError, RecursionError):
        raise ConfigError(f"{shown(text)} is no expression") from None


def _misfit(text: str, error: SyntaxError) -> str:
    """Describe a mistake and its place."""
    if not error.offset:
        return "it ends too early" if text.strip() else "it is empty"
    column = _column(text, error.offset - 1)
    if error.msg != "invalid syntax":  # such as "'(' was never closed"
        return f"{error.msg} (column {column})"
    hint = "; comparisons are == != < <= > >=" if text[column - 1 : column] == "=" else ""
    return f"column {column} does not fit{hint}"


def _column(text: str, offset: int) -> int:
    return 1 + offset + len(text) - len(text.lstrip())


def _check_size(text: str, tree: ast.expr) -> None:
    count, level = 0, [tree]
    for _ in range(_DEEPEST):
        count += len(level)
        parts = (child for node in level for child in ast.iter_child_nodes(node))
        level = [child for child in parts if isinstance(child, ast.expr)]
        if not level:
            break
    if level or count > _MOST_NODES:
        raise ConfigError(
            f"{shown(text)} is too long: an expression has at most {_MOST_NODES} parts, nested "
            f"{_DEEPEST} times"
        )


def _name_of(text: str, node: ast.expr) -> str | None:
    """The name that a part of an expression is; None if it is anything else."""
    if isinstance(node, ast.Name):
        return node.id
    if not isinstance(node, ast.Attribute | ast.Subscript):
        return None
    return "".join((ast.get_source_segment(text.strip(), node) or "").split())


def _names_in(text: str, node: ast.expr) -> Iterator[str]:
    """Names in a part of an expression, without names of functions."""
    name = _name_of(text, node)
    if name is not None:
        yield name
        return
    parts = node.args if isinstance(node, ast.Call) else ast.iter_child_nodes(node)
    for part in parts:
        if isinstance(part, ast.expr):
            yield from _names_in(text, part)


def _name_or_number(node: ast.expr) -> str | float | None:
    match node:
        case ast.Name(name):
            return name
        case ast.Constant(int() | float() as number):
            return float(number)
    return None


class _Evaluation:
    """Evaluates an expression: its operators and functions make nodes.

    Args:
        text: The expression, for errors.
        names: Values of the names.
    """

    def __init__(self, text: str, names: Names) -> None:
        self._text, self._names = text, names

    def evaluate(self, node: ast.expr) -> Value:
        """The value of a part of the expression."""
        method = getattr(self, f"_value_of_{type(node).__name__.lower()}", None)
        if method is None:
            what = type(node).__name__.lower()
            raise self._error(node, f"{what} is not allowed here")
        value: Value = method(node)
        return value

    def _evaluated(self, *nodes: ast.expr) -> list[Value]:
        """The values of parts, or one error for all that are wrong in them."""
        values, errors = list[Value](), dict[str, ConfigError]()
        known: ConsequenceError | None = None
        for node in nodes:
            try:
                values.append(self.evaluate(node))
            except ConsequenceError as error:
                known = error
            except ConfigError as error:
                errors.setdefault(str(error), error)
        if len(errors) > 1:
            raise ConfigError("; ".join(errors))
        for one in (*errors.values(), known):
            if one is not None:
                raise one
        return values

    def _error(self, node: ast.AST, text: object) -> ConfigError:
        offset = len(self._text.strip().encode()[: getattr(node, "col_offset", 0)].decode())
        return ConfigError(f"{text} (column {_column(self._text, offset)} of {shown(self._text)})")

    def _value_of_constant(self, node: ast.Constant) -> Value:
        value = node.value if isinstance(node.value, bool) else float_or_nan(node.value)
        if not math.isfinite(value):
            raise self._error(node, f"{shown(node.value)} is no number")
        return self._constant(value)

    def _value_of_name(self, node: ast.expr) -> Value:
        name = _name_of(self._text, node) or ""
        if name in CONSTANTS:
            return self._constant(CONSTANTS[name])
        value = self._names.find(name)
        if value is None:
            known = [*self._names.known(), *CONSTANTS]
            raise self._error(node, unknown_name("name", name, known))
        return value

    _value_of_attribute = _value_of_subscript = _value_of_name

    def _constant(self, number: float | bool) -> Value:
        return Value.of(self._names.graph, number)

    def _value_of_unaryop(self, node: ast.UnaryOp) -> Value:
        operand = self.evaluate(node.operand)
        if isinstance(node.op, ast.Not):
            return self._flag(node.operand, operand) ^ True
        if isinstance(node.op, ast.Invert):
            raise self._error(node, "the operator ~ is not allowed here; write 'not'")
        return (
            operand.number if isinstance(node.op, ast.UAdd) else _applied(node.op, operand.number)
        )

    def _value_of_binop(self, node: ast.BinOp) -> Value:
        if type(node.op) not in _OPERATIONS:
            what = shown(ast.get_source_segment(self._text.strip(), node))
            raise self._error(
                node,
                f"the operator in {what} is not allowed here; there are + - * / % ** (power) and "
                "or not",
            )
        first, second = self._evaluated(node.left, node.right)
        return _applied(node.op, first.number, second.number)

    def _value_of_boolop(self, node: ast.BoolOp) -> Value:
        values = zip(node.values, self._evaluated(*node.values), strict=True)
        flags = [self._flag(part, value) for part, value in values]
        return reduce(partial(_applied, node.op), flags)

    def _flag(self, node: ast.expr, value: Value) -> Value:
        if value.is_flag:
            return value
        raise self._error(node, "expected a condition such as 'x > 1', got a number")

    def _value_of_compare(self, node: ast.Compare) -> Value:
        operands = [one.number for one in self._evaluated(node.left, *node.comparators)]
        parts = []
        for sign, first, second in zip(node.ops, operands, operands[1:], strict=False):
            if type(sign) not in _OPERATIONS:
                raise self._error(node, f"{type(sign).__name__} is not allowed here")
            parts.append(_applied(sign, first, second))
        return reduce(partial(_applied, ast.And()), parts)

    def _value_of_ifexp(self, node: ast.IfExp) -> Value:
        condition, first, second = self._evaluated(node.test, node.body, node.orelse)
        condition = self._flag(node.test, condition)
        if first.is_flag and second.is_flag:
            return (condition & first) | ((condition ^ True) & second)
        return where(condition, first.number, second.number)

    def _value_of_call(self, node: ast.Call) -> Value:
        if not isinstance(node.func, ast.Name):
            raise self._error(node, "only functions by their names can be called")
        name = node.func.id
        if node.keywords or any(isinstance(argument, ast.Starred) for argument in node.args):
            raise self._error(node, f"{name} takes arguments by place only")
        if name == "previous":
            return self._value_of_previous(node)
        function = FUNCTIONS.get(name)
        if function is None:
            raise self._error(node, unknown_name("function", name, [*FUNCTIONS, "previous"]))
        count = len(node.args)
        if count < function.fewest or (function.most is not None and count > function.most):
            few = f"at least {function.fewest}" if function.most is None else function.fewest
            raise self._error(node, f"{name} takes {few} arguments, got {count}")
        arguments = [one.number for one in self._evaluated(*node.args)]
        value: Value = function.call(*arguments)
        return value

    def _value_of_previous(self, node: ast.Call) -> Value:
        names = [_name_of(self._text, argument) for argument in node.args]
        if len(names) != 1 or names[0] is None:
            raise self._error(node, "previous takes one name")
        self.evaluate(node.args[0])  # which refuses an unknown name
        value = self._names.find_previous(names[0])
        if value is None:
            raise self._error(
                node,
                f"{names[0]!r} has no value before the step here; previous is for observed "
                "variables and actions",
            )
        return value


def _applied(sign: ast.AST, *operands: Value) -> Value:
    value: Value = _OPERATIONS[type(sign)](*operands)
    return value
