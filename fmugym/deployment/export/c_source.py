"""Agents as C99 without dependencies: a header and a source file.

The operations of graphs become expressions in C, and networks functions.
"""

from __future__ import annotations

import os
import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from fmugym.checks import check_path
from fmugym.deployment.export.exported_agent import ExportedAgent
from fmugym.deployment.export.identifiers import identifiers, new_file
from fmugym.deployment.export.network import Activation, Network
from fmugym.errors import ConfigError
from fmugym.expressions.graph import Node
from fmugym.expressions.program import letter_of, operation_of
from fmugym.fmi.variable import Variable

__all__ = [
    "C_TYPES",
    "HELPERS",
    "array",
    "bare",
    "c_type",
    "constant",
    "expression",
    "field_names",
    "header",
    "network_lines",
    "source",
    "write_c",
]

C_TYPES: Final[Mapping[str, str]] = {
    "d": "double",
    "f": "float",
    "?": "bool",
    "q": "int64_t",
    "l": "int64_t",
}
"""C's types by numpy's letters."""

_INFIX: Final[Mapping[str, str]] = {
    "add": "+",
    "subtract": "-",
    "multiply": "*",
    "divide": "/",
    "less": "<",
    "less_equal": "<=",
    "greater": ">",
    "greater_equal": ">=",
    "equal": "==",
    "not_equal": "!=",
    "and": "&&",
    "or": "||",
    "xor": "!=",
    "bitwise_and": "&",
    "bitwise_xor": "^",
    "right_shift": ">>",
}
_PREFIX: Final[Mapping[str, str]] = {"negative": "-", "not": "!"}

_OF_MATH: Final[Mapping[str, str]] = {"power": "pow", "absolute": "fabs"}
"""Functions of the C library whose names differ from numpy's by more than ``arc``."""

HELPERS: Final[Mapping[str, str]] = {
    "minimum": "{T} {name}({T} a, {T} b) {{\n    return (a < b || a != a) ? a : b;\n}}",
    "maximum": "{T} {name}({T} a, {T} b) {{\n    return (a > b || a != a) ? a : b;\n}}",
    "remainder": (
        "{T} {name}({T} a, {T} b) {{\n    const {T} r = fmod(a, b);\n"
        "    if (r == 0) {{\n        return copysign(0, b);\n    }}\n"
        "    return ((r < 0) != (b < 0)) ? r + b : r;\n}}"
    ),
    "floor_divide": (
        "{T} {name}({T} a, {T} b) {{\n    const {T} r = fmod(a, b);\n"
        "    const {T} q = (a - r) / b - ((r != 0 && (r < 0) != (b < 0)) ? 1 : 0);\n"
        "    const {T} whole = floor(q);\n    if (b == 0 || q == 0) {{\n"
        "        return (b == 0) ? a / b : copysign(0, a / b);\n    }}\n"
        "    return (q - whole > 0.5) ? whole + 1 : whole;\n}}"
    ),
    "interpolate": (
        "{T} {name}({T} x, const {T} *xs, const {T} *ys, int count) {{\n"
        "    int low = 0, high = count - 1;\n"
        "    if (!(x >= xs[0])) {{\n        return (x != x) ? x : ys[count];\n    }}\n"
        "    if (x > xs[high]) {{\n        return ys[count + 1];\n    }}\n"
        "    while (high - low > 1) {{\n        const int middle = low + (high - low) / 2;\n"
        "        if (x < xs[middle]) {{\n            high = middle;\n        }} else {{\n"
        "            low = middle;\n        }}\n    }}\n"
        "    if (x >= xs[high]) {{\n        return ys[high];\n    }}\n"
        "    return (ys[high] - ys[low]) / (xs[high] - xs[low]) * (x - xs[low]) + ys[low];\n}}"
    ),
}
"""Functions that the C library lacks, as numpy computes them."""


def constant(value: Any, letter: str) -> str:
    """A number as C writes it; reading it gives the same number."""
    if letter in "df":
        return _float(value, letter)
    if letter == "?":
        return "true" if value else "false"
    number = int(value)
    if number == -(2**63):  # C has no literal of it
        return f"({constant(number + 1, letter)} - 1)"
    text = str(number) if abs(number) < 2**31 else f"INT64_C({number})"
    return text if number >= 0 else f"({text})"


def _float(value: Any, letter: str) -> str:
    if not np.isfinite(value):
        text = "NAN" if np.isnan(value) else "INFINITY"
        return f"(-({C_TYPES[letter]}){text})" if value < 0 else f"(({C_TYPES[letter]}){text})"
    text = str(np.float32(value)) if letter == "f" else repr(float(value))
    text = text if "." in text or "e" in text else f"{text}.0"
    text += "f" if letter == "f" else ""
    return f"({text})" if text.startswith("-") else text


def expression(
    ufunc: Any, operands: Sequence[str], dtype: np.dtype[Any], use: Callable[[str, str], str]
) -> str:
    """A function of numpy as an expression.

    Args:
        ufunc: A function that programs have for this type, see ``operation_of``.
        operands: The expressions of its operands, in parentheses where needed.
        dtype: Their type.
        use: A function that notes a helper, for a letter, and returns its name.

    Raises:
        ConfigError: If it cannot be written.
    """
    letter = letter_of(dtype)
    name, *_ = str(operation_of(ufunc, letter)).split()
    if name in _INFIX:
        return f"({operands[0]} {_INFIX[name]} {operands[1]})"
    if name in _PREFIX:
        return f"({_PREFIX[name]}{operands[0]})"
    if letter == "q" and name not in {"minimum", "maximum"}:
        raise ConfigError(f"numpy.{name} of type {dtype} cannot be exported to C")
    if name in HELPERS:
        function = use(name, letter)
    else:
        suffix = "f" if letter == "f" else ""
        function = _OF_MATH.get(name, name.replace("arc", "a")) + suffix
    return f"{function}({', '.join(operands)})"


_WIDTH: Final = 96


def c_type(dtype: np.dtype[Any]) -> str:
    """C's name of a type.

    Raises:
        ConfigError: If C has none.
    """
    if dtype.char not in C_TYPES:
        raise ConfigError(f"values of type {dtype} cannot be exported to C")
    return C_TYPES[dtype.char]


def bare(text: str) -> str:
    """An expression without parentheses around all of it."""
    if not (text.startswith("(") and text.endswith(")")):
        return text
    depth = 0
    for place, letter in enumerate(text):
        depth += (letter == "(") - (letter == ")")
        if depth == 0 and place < len(text) - 1:
            return text
    return text[1:-1]


def array(name: str, values: Any) -> Iterator[str]:
    """A constant array."""
    flat, letter = np.ravel(values), values.dtype.char
    yield f"static const {c_type(values.dtype)} {name}[{len(flat)}] = {{"
    line = "   "
    for value in flat:
        text = f" {bare(constant(value, letter))},"
        if len(line) + len(text) > _WIDTH:
            yield line
            line = "   "
        line += text
    yield line
    yield "};"


_ACTIVATIONS: Final[Mapping[str, str]] = {
    "tanh": "tanh{f}(x)",
    "relu": "x > 0 ? x : 0",
    "leaky_relu": "x > 0 ? x : x * {0}",
    "elu": "x > 0 ? x : {0} * expm1{f}(x)",
    "sigmoid": "1 / (1 + exp{f}(-x))",
    "silu": "x / (1 + exp{f}(-x))",
    "softplus": "x * {0} > {1} ? x : log1p{f}(exp{f}(x * {0})) / {0}",
    "clamp": "x < {0} ? {0} : x > {1} ? {1} : x",
}


def network_lines(name: str, network: Network) -> Iterator[str]:
    """The arrays and functions of a network.

    Args:
        name: The name of the agent.
        network: The network.
    """
    for index, layer in enumerate(network.layers):
        yield from array(f"{name}_weights_{index}", layer.weights.T)
        yield from array(f"{name}_bias_{index}", layer.bias)
        yield ""
    yield _FUNCTIONS.format(name=name, kind=c_type(network.dtype))
    yield from _network_body(name, network, network.dtype.char)
    yield "}"
    yield ""


_FUNCTIONS: Final = """/* The sum of each column of weights times an input, and a bias. */
static void {name}_layer(const {kind} *weights, const {kind} *bias, const {kind} *from,
    int inputs, {kind} *to, int outputs) {{
    for (int i = 0; i < outputs; i++) {{
        to[i] = bias[i];
    }}
    for (int j = 0; j < inputs; j++) {{
        const {kind} *column = weights + j * outputs;
        for (int i = 0; i < outputs; i++) {{
            to[i] += column[i] * from[j];
        }}
    }}
}}

static void {name}_network(const {kind} *features, {kind} *given) {{"""


def _network_body(name: str, network: Network, letter: str) -> Iterator[str]:
    kind = C_TYPES[letter]
    arrays = ["features", *(f"values_{i}" for i in range(len(network.layers) - 1)), "given"]
    widths = [network.input_count, *(len(layer.bias) for layer in network.layers)]
    for array, width in zip(arrays[1:-1], widths[1:-1], strict=True):
        yield f"    {kind} {array}[{width}];"
    yield ""
    for index, layer in enumerate(network.layers):
        to, width = arrays[index + 1], widths[index + 1]
        counts = f"{arrays[index]}, {widths[index]}, {to}, {width}"
        yield f"    {name}_layer({name}_weights_{index}, {name}_bias_{index}, {counts});"
        for activation in layer.activations:
            yield from _activation_lines(activation, to, width, letter)


def _activation_lines(activation: Activation, array: str, width: int, letter: str) -> Iterator[str]:
    numbers = [constant(number, letter) for number in activation.arguments]
    suffix = "f" if letter == "f" else ""
    text = _ACTIVATIONS[activation.name].format(*numbers, f=suffix)
    yield f"    for (int i = 0; i < {width}; i++) {{"
    yield f"        const {C_TYPES[letter]} x = {array}[i];"
    yield f"        {array}[i] = {text};"
    yield "    }"


_LONGEST_INLINE: Final = 56


_HEADER: Final = """{comment}
#ifndef {upper}_H
#define {upper}_H

#include <stdint.h>

#ifdef __cplusplus
extern "C" {{
#endif

/* Seconds from one sample to the next. */
#define {upper}_SAMPLE_TIME {time_step}

/* The places of the measurements. */
{measurements}

/* The places of the actions. */
{actions}

/* What the agent keeps from one sample to the next. */
typedef struct {{
    int64_t count; /* of the samples until now */
{fields}}} {name}_state;

/* Begin an episode. */
void {name}_init({name}_state *state);

/* Take a sample: from the measurements to the actions.
 *
 * Returns 0. If a measurement is not finite, or a value is looked up outside of its
 * table, it returns 1, and changes neither the state nor the actions. */
int {name}_step({name}_state *state, const double *measurements, double *actions);

#ifdef __cplusplus
}}
#endif

#endif
"""


def header(agent: ExportedAgent) -> str:
    """The header of an agent."""
    name, upper, logic = agent.name, agent.name.upper(), agent.logic
    return _HEADER.format(
        comment="\n".join(_comment(agent)),
        name=name,
        upper=upper,
        time_step=constant(logic.time_step, "d"),
        measurements="\n".join(_enumeration(f"{upper}_MEASUREMENT", logic.measurements)),
        actions="\n".join(_enumeration(f"{upper}_ACTION", logic.inputs)),
        fields="".join(f"{line}\n" for line in _fields(agent)),
    )


def _comment(agent: ExportedAgent) -> list[str]:
    lines = [f"The agent {agent.name!r}, exported by fmugym {agent.version}.", *agent.notes]
    first, *others = map(_safe, lines)
    return [f"/* {first}", *(f" * {line}".rstrip() for line in others), " */"]


def _safe(text: str) -> str:
    """A text that may stand in a comment."""
    return re.sub(r"\*/|/\*|[^ -~]", "?", text)


def _enumeration(prefix: str, variables: Sequence[Variable]) -> list[str]:
    names = identifiers(variable.name for variable in variables)
    lines = [
        f"    {prefix}_{name},{_unit(variable)}"
        for name, variable in zip(names, variables, strict=True)
    ]
    return ["enum {", *lines, f"    {prefix}S", "};"]


def _unit(variable: Variable) -> str:
    told = ", ".join(filter(None, [variable.unit, variable.description]))
    return f" /* {_safe(told)} */" if told else ""


def field_names(agent: ExportedAgent) -> list[str]:
    """The names of the fields of the state after ``count``."""
    taken = ["measurements", "actions"]  # of ONNX models
    return identifiers([*taken, *(kept.name for kept in agent.logic.kept)])[len(taken) :]


def _fields(agent: ExportedAgent) -> Iterator[str]:
    settable = {agent.logic.kept[one.field].name for one in agent.logic.parameters}
    for name, kept in zip(field_names(agent), agent.logic.kept, strict=True):
        told = " /* a parameter: set it after the beginning */" if kept.name in settable else ""
        yield f"    {c_type(kept.dtype)} {name}[{len(kept.starts)}];{told}"


def source(agent: ExportedAgent) -> str:
    """The source of an agent."""
    return _Source(agent).text()


class _Source:
    """Writes the source file of an agent."""

    def __init__(self, agent: ExportedAgent) -> None:
        self._agent, self._logic, self._name = agent, agent.logic, agent.name
        self._graph = agent.logic.graph
        self._helpers: dict[tuple[str, str], str] = {}
        self._tables: dict[Any, str] = {}
        self._texts: dict[int, str] = {}
        self._uses = self._counted_uses()
        self._fields = field_names(agent)

    def text(self) -> str:
        """The whole file."""
        step, network = self._step(), self._agent.network
        return "\n".join(
            [
                f"/* See {self._name}.h. */",
                "",
                f'#include "{self._name}.h"',
                "",
                "#include <math.h>",
                "#include <stdbool.h>",
                "",
                *self._table_lines(),
                *self._helper_lines(),
                *(() if network is None else network_lines(self._name, network)),
                *self._init(),
                "",
                *step,
                "",
            ]
        )

    # The numbers of the graph.

    def _counted_uses(self) -> Counter[int]:
        roots, loads = self._logic.roots, self._logic.loads
        computed = set(self._graph.needed(roots, loads)) - loads.keys()
        return Counter([*roots, *(one for n in computed for one in self._graph.nodes[n].operands)])

    def _use(self, helper: str, letter: str) -> str:
        suffix = "" if letter == "d" else f"_{letter}"
        return self._helpers.setdefault((helper, letter), f"{self._name}_{helper}{suffix}")

    def _evaluated(self, numbers: Iterable[int]) -> Iterator[str]:
        """Write the lines that compute some nodes, with the nodes that these need."""
        needed = set(self._graph.needed(numbers, self._logic.loads))
        for number in sorted(needed - self._texts.keys()):
            node = self._graph.nodes[number]
            letter = node.dtype.char
            if node.kind == "constant":
                self._texts[number] = constant(node.number, letter)
                continue
            if node.kind == "take":
                yield from self._checked_place(node)
            text = self._expression(number, node)
            is_short = len(text) <= _LONGEST_INLINE and self._uses[number] < 2
            is_load = number in self._logic.loads
            if (is_short or is_load) and "state->" not in text:  # the end of a step changes that
                self._texts[number] = text
                continue
            self._texts[number] = f"t{number}"
            yield f"    const {c_type(node.dtype)} t{number} = {bare(text)};"

    def _expression(self, number: int, node: Node) -> str:
        if number in self._logic.loads:
            return self._loaded(number, node)
        operands = [self._texts[operand] for operand in node.operands]
        match node.kind:
            case "ufunc":
                dtype = self._graph.nodes[node.operands[0]].dtype
                return expression(node.what, operands, dtype, self._use)
            case "cast":
                return self._cast(node, operands[0])
            case "where":
                return f"({operands[0]} ? {operands[1]} : {operands[2]})"
            case "take":
                table, place = self._table(node.what), operands[0]
                count = len(self._graph.tables[node.what])
                return f"{table}[{place} < 0 ? {place} + {count} : {place}]"
        return self._interpolation(node, operands[0])

    def _loaded(self, number: int, node: Node) -> str:
        load = self._logic.loads[number]
        match load[0]:
            case "measurement":
                return f"measurements[{load[1]}]"
            case "kept":
                return self._kept_value(load[1], load[2])
            case "count":
                return "count"
            case "active":
                return "(count > 0)"
            case "given":
                return f"given[{load[1]}]"
        return constant(load[1], node.dtype.char)

    def _kept_value(self, field: int, element: int) -> str:
        text = f"state->{self._fields[field]}[{element}]"
        if self._logic.kept[field].name == "previous":
            return f"(count == 0 ? measurements[{element}] : {text})"
        return text

    def _cast(self, node: Node, operand: str) -> str:
        if node.dtype == np.bool_:
            return f"({operand} != 0)"
        return f"({c_type(node.dtype)}){operand}"

    def _checked_place(self, node: Node) -> Iterator[str]:
        """Look at an index before it is used, which must therefore have a name."""
        (operand,) = node.operands
        count, text = len(self._graph.tables[node.what]), self._texts[operand]
        if not re.fullmatch(r"t\d+", text):
            self._texts[operand] = f"t{operand}"
            yield f"    const {c_type(self._graph.nodes[operand].dtype)} t{operand} = {bare(text)};"
        place = self._texts[operand]
        yield f"    if ({place} < -{count} || {place} >= {count}) {{"
        yield "        return 1;"
        yield "    }"

    def _table(self, key: Any) -> str:
        return self._tables.setdefault(key, f"{self._name}_table_{len(self._tables)}")

    def _interpolation(self, node: Node, operand: str) -> str:
        table, count = self._table(node.what), len(self._graph.tables[node.what]) // 2 - 1
        name = self._use("interpolate", "d")
        return f"{name}({bare(operand)}, {table}, {table} + {count}, {count})"

    # The parts of the file.

    def _table_lines(self) -> Iterator[str]:
        for key, name in self._tables.items():
            yield from array(name, self._graph.tables[key])
            yield ""

    def _helper_lines(self) -> Iterator[str]:
        for (helper, letter), name in self._helpers.items():
            yield "static " + HELPERS[helper].format(T=C_TYPES[letter], name=name)
            yield ""

    def _init(self) -> Iterator[str]:
        yield f"void {self._name}_init({self._name}_state *state) {{"
        yield "    state->count = 0;"
        for field, kept in zip(self._fields, self._logic.kept, strict=True):
            for element, start in enumerate(kept.starts):
                yield f"    state->{field}[{element}] = {bare(constant(start, kept.dtype.char))};"
        yield "}"

    def _step(self) -> list[str]:
        logic, name = self._logic, self._name
        return [
            f"int {name}_step({name}_state *state, const double *measurements, double *actions) {{",
            "    const int64_t count = state->count;",
            "",
            *self._check_of_measurements(),
            *self._asking_the_network(),
            *self._evaluated(logic.roots),
            *self._stored("actions", logic.input_nodes, "double"),
            *self._stored_state(),
            "    state->count = count + 1;",
            "    return 0;",
            "}",
        ]

    def _check_of_measurements(self) -> Iterator[str]:
        count = len(self._logic.measurements)
        if not count:
            yield "    (void)measurements;"
            return
        yield f"    for (int i = 0; i < {count}; i++) {{"
        yield "        if (!isfinite(measurements[i])) {"
        yield "            return 1;"
        yield "        }"
        yield "    }"

    def _asking_the_network(self) -> Iterator[str]:
        features, network = self._logic.features, self._agent.network
        if network is not None:
            yield from self._evaluated(features)
            yield f"    {c_type(network.dtype)} features[{len(features)}];"
            yield f"    {c_type(network.dtype)} given[{sum(network.parts)}];"
            yield from self._stored("features", features, c_type(network.dtype))
            yield f"    {self._name}_network(features, given);"

    def _stored(self, array: str, nodes: Sequence[int], kind: str) -> Iterator[str]:
        for index, node in enumerate(nodes):
            is_same = c_type(self._graph.nodes[node].dtype) == kind
            text = self._texts[node]
            yield f"    {array}[{index}] = {bare(text) if is_same else f'({kind}){text}'};"

    def _stored_state(self) -> Iterator[str]:
        for field, kept in zip(self._fields, self._logic.kept, strict=True):
            if kept.updates:
                yield from self._stored(f"state->{field}", kept.updates, c_type(kept.dtype))


def write_c(agent: ExportedAgent, folder: str | os.PathLike[str]) -> list[Path]:
    """Write an agent as C99: a header and a source file, which need nothing but the C library.

    Args:
        agent: The agent. Its name is that of the files.
        folder: Where to write them; neither file may exist.

    Returns:
        The paths of the header and the source.

    Raises:
        ConfigError: If the task computes what cannot be written in C; the text names it.
        FileExistsError: If a file exists.
    """
    files = [new_file(check_path("folder", folder) / f"{agent.name}.{end}") for end in "hc"]
    for file, text in zip(files, (header(agent), source(agent)), strict=True):
        file.write_text(text, encoding="ascii", newline="\n")
    return files
