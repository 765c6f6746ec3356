"""Expressions: arithmetic over the names of a task, as text.

The grammar is a part of Python's: numbers, names, ``+ - * / % **``, comparisons, ``and``, ``or``,
``not``, ``a if condition else b``, and calls of the functions of ``fmugym.declared.mathematics``.
``previous(x)`` is the value of ``x`` before the step. There are no attributes, subscripts, texts or
assignments. Each value is a number or a condition; in arithmetic a condition counts as 0 or 1.

An expression becomes the code of a function of the environment. Its only names are those of the
tables that the caller gives. It works element by element, so that the same code serves one
environment, arrays of them, and the trace that compiles hooks.
"""

from __future__ import annotations

import ast
import math
import re
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import numpy as np

from fmugym.declared.mathematics import FUNCTIONS, OPERATIONS, float32, float64
from fmugym.errors import ConfigError, shown, unknown_name

__all__ = ["CONSTANTS", "Code", "Expression", "Names", "code_of_number", "function_of"]

_LONGEST: Final = 2000
_MOST_NODES: Final = 500
_DEEPEST: Final = 40
_LONGEST_CODE: Final = 200_000
_LONGEST_FUNCTION: Final = 1_000_000

_BINARY: Final[Mapping[type[ast.operator], str]] = {
    ast.Add: "({} + {})",
    ast.Sub: "({} - {})",
    ast.Mult: "({} * {})",
    ast.Div: "divide({}, {})",
    ast.Mod: "remainder({}, {})",
    ast.Pow: "power({}, {})",
}
_COMPARISONS: Final[Mapping[type[ast.cmpop], str]] = {
    ast.Lt: "<",
    ast.LtE: "<=",
    ast.Gt: ">",
    ast.GtE: ">=",
    ast.Eq: "==",
    ast.NotEq: "!=",
}

_NAMESPACE: Final[dict[str, Any]] = {
    "__builtins__": {},
    "inf": math.inf,
    "nan": math.nan,
    **OPERATIONS,
    **{f"fn_{name}": function.call for name, function in FUNCTIONS.items()},
    "fn_float32": lambda value: float64(float32(value)),
}
"""What the code of expressions may call."""


_MAY_WARN: Final = re.compile(
    r"\b(inf\b|noise|chance|divide|remainder|power|fn_(?!abs|min|max|clip))"
)
"""Calls for which numpy may warn of what is not finite; it takes time to keep it quiet."""


class Code(NamedTuple):
    """Python code for a value.

    Attributes:
        text: The code; it may use ``env``, the environment.
        is_flag: Whether it is a condition, not a number.
        value: The value if it is a constant.
    """

    text: str
    is_flag: bool = False
    value: float | bool | None = None

    @property
    def number(self) -> Code:
        """The same as a number: 0 or 1 for a condition."""
        if not self.is_flag:
            return self
        if self.value is not None:
            return code_of_number(float(self.value))
        return Code(f"({self.text} * 1.0)")


def code_of_number(value: float) -> Code:
    """The code of a constant."""
    text = repr(float(value))
    return Code(f"({text})" if text.startswith("-") else text, value=float(value))


class Names(NamedTuple):
    """What names stand for where an expression is evaluated.

    Attributes:
        find: Returns the code of a name; None if there is no such name.
        find_previous: Returns the code of a name's value before the step; None if it has none.
        known: The names to suggest for one that is misspelt.
    """

    find: Callable[[str], Code | None]
    find_previous: Callable[[str], Code | None]
    known: Callable[[], list[str]]


CONSTANTS: Final[Mapping[str, Code]] = {
    "pi": code_of_number(math.pi),
    "true": Code("True", True, True),
    "false": Code("False", True, False),
}
"""Names that have the same value everywhere."""

_ONLY_CONSTANTS: Final = Names(CONSTANTS.get, lambda name: None, lambda: list(CONSTANTS))


@dataclass(frozen=True)
class Expression:
    """An expression whose grammar is checked.

    Attributes:
        text: As the user wrote it.
        tree: What it consists of.
    """

    text: str
    tree: ast.expr

    @classmethod
    def parse(cls, value: Any) -> Expression:
        """Parse an expression.

        Args:
            value: A text; a number or a Boolean stands for itself.

        Raises:
            ConfigError: If it is no expression. The text tells the column.
        """
        if isinstance(value, bool | int | float):
            value = repr(value)
        if not isinstance(value, str):
            raise ConfigError(f"expected an expression, got {shown(value)}")
        if len(value) > _LONGEST:
            raise ConfigError(f"an expression has at most {_LONGEST} characters, got {len(value)}")
        tree = _parsed(value)
        _check_size(value, tree)
        return cls(value, tree)

    @property
    def names(self) -> set[str]:
        """The names that it reads."""
        called = {id(node.func) for node in ast.walk(self.tree) if isinstance(node, ast.Call)}
        nodes = [node for node in ast.walk(self.tree) if isinstance(node, ast.Name)]
        return {node.id for node in nodes if id(node) not in called}

    @property
    def previous_names(self) -> set[str]:
        """The names whose values before the step it reads."""
        calls = [node for node in ast.walk(self.tree) if isinstance(node, ast.Call)]
        return {
            argument.id
            for call in calls
            if isinstance(call.func, ast.Name) and call.func.id == "previous"
            for argument in call.args
            if isinstance(argument, ast.Name)
        }

    def code(self, names: Names = _ONLY_CONSTANTS) -> Code:
        """Make code of it.

        Args:
            names: What the names stand for.

        Raises:
            ConfigError: If a name is unknown, or the expression has something that is not in the
                grammar. The text tells the column.
        """
        try:
            return _Writer(self.text, names).write(self.tree)
        except RecursionError:
            raise ConfigError("expressions read each other in too long a row") from None

    def constant(self) -> float:
        """The value of an expression without names.

        Raises:
            ConfigError: If it has names, or the value is not finite.
        """
        value = self.code().number.value
        if value is None or not math.isfinite(value):
            raise ConfigError(f"{self.text!r} is no finite number, but {value}")
        return float(value)


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
    """Say what is wrong, and where."""
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
        level = [child for node in level for child in _operands(node)]
        if not level:
            break
    if level or count > _MOST_NODES:
        raise ConfigError(
            f"{shown(text)} is too long: an expression has at most {_MOST_NODES} parts, nested "
            f"{_DEEPEST} times"
        )


def _operands(node: ast.AST) -> list[Any]:
    return [child for child in ast.iter_child_nodes(node) if isinstance(child, ast.expr)]


class _Writer:
    """Turns the nodes of an expression into code.

    Args:
        text: The expression, for errors.
        names: What names stand for.
    """

    def __init__(self, text: str, names: Names) -> None:
        self._text, self._names = text, names

    def write(self, node: ast.expr) -> Code:
        """Make code of a node and its operands."""
        method = getattr(self, f"_write_{type(node).__name__.lower()}", None)
        if isinstance(node, ast.Attribute | ast.Subscript):
            name = ast.get_source_segment(self._text.strip(), node)
            raise self._error(
                node,
                f"{shown(name)} cannot stand in an expression; a variable of this name needs an "
                f'alias in [variables]: alias = {{ name = "{name}" }}',
            )
        if method is None:
            what = type(node).__name__.lower()
            raise self._error(node, f"{what} is not allowed here")
        code: Code = method(node)
        return code

    def _error(self, node: ast.AST, text: object) -> ConfigError:
        offset = len(self._text.strip().encode()[: getattr(node, "col_offset", 0)].decode())
        return ConfigError(f"{text} (column {_column(self._text, offset)} of {shown(self._text)})")

    def _write_constant(self, node: ast.Constant) -> Code:
        value = node.value
        if isinstance(value, bool):
            return Code(str(value), True, value)
        if isinstance(value, int | float):
            number = _as_float(value)
            if math.isfinite(number):
                return code_of_number(number)
        raise self._error(node, f"{shown(value)} is no number")

    def _write_name(self, node: ast.Name) -> Code:
        code = CONSTANTS.get(node.id) or self._names.find(node.id)
        if code is None:
            raise self._error(node, unknown_name("name", node.id, self._known()))
        return code

    def _known(self) -> list[str]:
        return list(dict.fromkeys([*self._names.known(), *CONSTANTS]))

    def _write_unaryop(self, node: ast.UnaryOp) -> Code:
        operand = self.write(node.operand)
        if isinstance(node.op, ast.Not):
            return _folded("({} ^ True)", [self._flag(node.operand, operand)], True)
        if isinstance(node.op, ast.USub):
            return _folded("(-{})", [operand.number])
        if isinstance(node.op, ast.UAdd):
            return operand.number
        raise self._error(node, "the operator ~ is not allowed here; write 'not'")

    def _write_binop(self, node: ast.BinOp) -> Code:
        template = _BINARY.get(type(node.op))
        if template is None:
            what = shown(ast.get_source_segment(self._text.strip(), node))
            raise self._error(
                node,
                f"the operator in {what} is not allowed here; there are + - * / % ** (power) and "
                "or not",
            )
        return _folded(template, [self.write(node.left).number, self.write(node.right).number])

    def _write_boolop(self, node: ast.BoolOp) -> Code:
        sign = "&" if isinstance(node.op, ast.And) else "|"
        flags = [self._flag(value, self.write(value)) for value in node.values]
        return _folded("(" + f" {sign} ".join(["{}"] * len(flags)) + ")", flags, True)

    def _flag(self, node: ast.expr, code: Code) -> Code:
        if code.is_flag:
            return code
        raise self._error(node, "expected a condition such as 'x > 1', got a number")

    def _write_compare(self, node: ast.Compare) -> Code:
        operands = [self.write(part).number for part in (node.left, *node.comparators)]
        parts = []
        for sign, first, second in zip(node.ops, operands, operands[1:], strict=False):
            if type(sign) not in _COMPARISONS:
                raise self._error(node, f"{type(sign).__name__} is not allowed here")
            parts.append(_folded(f"({{}} {_COMPARISONS[type(sign)]} {{}})", [first, second], True))
        return parts[0] if len(parts) == 1 else _folded(_joined(len(parts)), parts, True)

    def _write_ifexp(self, node: ast.IfExp) -> Code:
        condition = self._flag(node.test, self.write(node.test))
        first, second = self.write(node.body), self.write(node.orelse)
        both = first.is_flag and second.is_flag
        if both:
            return _folded("(({0} & {1}) | (({0} ^ True) & {2}))", [condition, first, second], True)
        return _folded("where({}, {}, {})", [condition, first.number, second.number])

    def _write_call(self, node: ast.Call) -> Code:
        if not isinstance(node.func, ast.Name):
            raise self._error(node, "only functions by their names can be called")
        name = node.func.id
        if node.keywords or any(isinstance(argument, ast.Starred) for argument in node.args):
            raise self._error(node, f"{name} takes arguments by place only")
        if name == "previous":
            return self._write_previous(node)
        function = FUNCTIONS.get(name)
        if function is None:
            raise self._error(node, unknown_name("function", name, [*FUNCTIONS, "previous"]))
        count = len(node.args)
        if count < function.fewest or (function.most is not None and count > function.most):
            few = f"at least {function.fewest}" if function.most is None else function.fewest
            raise self._error(node, f"{name} takes {few} arguments, got {count}")
        arguments = [self.write(argument).number for argument in node.args]
        return _folded(f"fn_{name}({', '.join(['{}'] * count)})", arguments)

    def _write_previous(self, node: ast.Call) -> Code:
        names = [argument.id for argument in node.args if isinstance(argument, ast.Name)]
        if len(names) != 1 or len(node.args) != 1:
            raise self._error(node, "previous takes one name")
        self.write(node.args[0])  # which refuses an unknown name
        code = self._names.find_previous(names[0])
        if code is None:
            raise self._error(
                node,
                f"{names[0]!r} has no value before the step here; previous is for observed "
                "variables and actions",
            )
        return code


def _joined(count: int) -> str:
    return "(" + " & ".join(["{}"] * count) + ")"


def _as_float(value: float) -> float:
    try:
        return float(value)
    except OverflowError:
        return math.inf


def _folded(template: str, operands: list[Code], is_flag: bool = False) -> Code:
    """Combine operands; what consists of constants is computed at once."""
    text = template.format(*(operand.text for operand in operands))
    if len(text) > _LONGEST_CODE:
        raise ConfigError(
            f"the expression is too long: with the expressions that it reads, its code has more "
            f"than {_LONGEST_CODE} characters"
        )
    if any(operand.value is None for operand in operands):
        return Code(text, is_flag)
    with np.errstate(all="ignore"):
        value: Any = eval(text, dict(_NAMESPACE))
    if is_flag:
        return Code(str(bool(value)), True, bool(value))
    return code_of_number(float(value))


def function_of(text: str, constants: Mapping[str, Any], file: str) -> Callable[[Any], Any]:
    """Make a function of the environment from code.

    Args:
        text: Code that was made of expressions.
        constants: Values that the code reads by name, such as tables.
        file: A name for the code in tracebacks.

    Raises:
        ConfigError: If the code is too large.
    """
    too_large = ConfigError(
        f"{file}: expressions read each other in too long a row, or have too many terms"
    )
    if len(text) > _LONGEST_FUNCTION:
        raise too_large
    try:
        code = compile(f"lambda env: {text}", f"<{file}>", "eval")
    except (SyntaxError, MemoryError, RecursionError):  # limits of Python's own
        raise too_large from None
    function: Callable[[Any], Any] = eval(code, {**_NAMESPACE, **constants})
    if not _MAY_WARN.search(text):
        return function

    def evaluate(env: Any) -> Any:
        with np.errstate(all="ignore"):  # a result that is not finite is a fault of the episode
            return function(env)

    return evaluate
