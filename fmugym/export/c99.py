"""Agents as C99 without dependencies: a header and a source file."""

from __future__ import annotations

import os
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from fmugym.archive.variable import Variable
from fmugym.checks import check_path
from fmugym.export.exportable import ExportedAgent
from fmugym.export.layers import array, bare, c_type, network_lines
from fmugym.export.names import identifiers, new_file
from fmugym.export.operations import C_TYPES, HELPERS, constant, expression
from fmugym.expressions.graph import Node

__all__ = ["field_names", "header", "source", "write_c"]

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
