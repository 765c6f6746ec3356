"""Agents as ONNX: a function from measurements and memory to actions and the next memory.

The operations of graphs become nodes. Where ONNX Runtime has a function in float32 only, or not at
all, it is composed of others.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Callable, Container, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from fmugym.deployment.export.c_source import field_names
from fmugym.deployment.export.exported_agent import ExportedAgent
from fmugym.deployment.export.identifiers import new_file
from fmugym.deployment.export.network import Activation, Network
from fmugym.errors import ConfigError
from fmugym.expressions.graph import Graph, Node, Value, where
from fmugym.expressions.program import letter_of, operation_of
from fmugym.extras import imported

__all__ = ["Nodes", "Operations", "onnx_model", "write_onnx"]


class Nodes:
    """Collects nodes and constants; equal ones are there once.

    Attributes:
        nodes: The nodes in the order of evaluation.
        tensors: The constants.
    """

    def __init__(self) -> None:
        self._onnx = imported("onnx", "onnx")
        self.nodes: list[Any] = []
        self.tensors: list[Any] = []
        self._known: dict[Any, str] = {}

    def add(self, operation: str, *operands: str, **attributes: Any) -> str:
        """Add a node, and return the name of its result."""
        key = operation, operands, tuple(attributes.items())
        if key not in self._known:
            self._known[key] = name = f"{operation.lower()}_{len(self.nodes)}"
            self.named(operation, operands, name, **attributes)
        return self._known[key]

    def named(self, operation: str, operands: Any, name: str, **attributes: Any) -> None:
        """Add a node whose result has a given name."""
        make = self._onnx.helper.make_node
        self.nodes.append(make(operation, list(operands), [name], **attributes))

    def cast(self, operand: str, dtype: np.dtype[Any]) -> str:
        """A value in another type."""
        return self.add("Cast", operand, to=self.type_of(dtype))

    def type_of(self, dtype: np.dtype[Any]) -> int:
        """ONNX's number of a type."""
        return int(self._onnx.helper.np_dtype_to_tensor_dtype(dtype))

    def constant(self, value: Any, dtype: np.dtype[Any]) -> str:
        """A number."""
        return self.tensor(np.array(value, dtype))

    def tensor(self, values: npt.NDArray[Any]) -> str:
        """An array of constants."""
        key = values.dtype.char, values.shape, values.tobytes()
        if key not in self._known:
            self._known[key] = name = f"constant_{len(self.tensors)}"
            self.tensors.append(self._onnx.numpy_helper.from_array(values, name))
        return self._known[key]


_SAME: Final[Mapping[str, str]] = {
    **{
        name: name.capitalize()
        for name in (
            *("add", "less", "equal", "greater", "and", "or", "xor", "not"),
            *("sqrt", "exp", "log", "sin", "cos", "tanh", "floor", "ceil"),
        )
    },
    "subtract": "Sub",
    "multiply": "Mul",
    "divide": "Div",
    "less_equal": "LessOrEqual",
    "greater_equal": "GreaterOrEqual",
    "minimum": "Min",
    "maximum": "Max",
    "power": "Pow",
    "absolute": "Abs",
    "negative": "Neg",
    "rint": "Round",
}
"""Operations that ONNX has, for the same types of operands."""

_ANGLES: Final[Mapping[str, str]] = {"arcsin": "Asin", "arccos": "Acos", "arctan": "Atan"}
"""Functions that ONNX Runtime computes with float32 only."""


def _remainder(a: Any, b: Any) -> Any:
    """The remainder with the sign of the divisor."""
    rest = np.fmod(a, b)
    return where((rest != 0.0) & ((rest < 0.0) != (b < 0.0)), rest + b, rest)


def _arctan2(y: Any, x: Any) -> Any:
    """2 atan(y / (r + x)), and pi on the negative axis."""
    length = np.hypot(x, y)
    below = length + x
    is_axis = below == 0.0
    angle = 2.0 * np.arctan(y / where(is_axis, 1.0, below))
    return where(is_axis, where(length == 0.0, 0.0, math.pi), angle)


_COMPOSED: Final[Mapping[str, Callable[..., Any]]] = {
    "not_equal": lambda a, b: (a == b) ^ True,
    "remainder": _remainder,
    "floor_divide": lambda a, b: np.rint((a - np.remainder(a, b)) / b),
    "hypot": lambda a, b: np.sqrt(a * a + b * b),
    "arctan2": _arctan2,
    "tan": lambda x: np.sin(x) / np.cos(x),
    "sinh": lambda x: 0.5 * (np.exp(x) - np.exp(-x)),
    "cosh": lambda x: 0.5 * (np.exp(x) + np.exp(-x)),
    "arcsinh": lambda x: np.log(x + np.sqrt(x * x + 1.0)),
    "arccosh": lambda x: np.log(x + np.sqrt(x * x - 1.0)),
    "arctanh": lambda x: 0.5 * np.log((1.0 + x) / (1.0 - x)),
    "log1p": lambda x: np.log(x + 1.0),
    "log2": lambda x: np.log(x) * (1 / math.log(2)),
    "log10": lambda x: np.log(x) * (1 / math.log(10)),
    "expm1": lambda x: np.exp(x) - 1.0,
    "exp2": lambda x: np.power(2.0, x),
}
"""Functions of values, by others that ONNX has."""


class Operations:
    """Writes the operations of a graph as nodes of ONNX.

    Args:
        nodes: Takes the nodes.
        graph: The operations. Those that make up others are added.
        loads: The numbers of those that the model finds.
        load: Returns the name of such a value.
    """

    def __init__(
        self, nodes: Nodes, graph: Graph, loads: Container[int], load: Callable[[int], str]
    ) -> None:
        self._nodes, self._graph, self._loads, self._load = nodes, graph, loads, load
        self._names: dict[int, str] = {}

    def written(self, numbers: Iterable[int]) -> list[str]:
        """Write operations, and the ones that they need; returns the names of their results.

        Raises:
            ConfigError: If one cannot be written.
        """
        numbers = list(numbers)
        for number in self._graph.needed(numbers, self._loads):
            if number not in self._names:
                is_load = number in self._loads
                name = self._load(number) if is_load else self._write(self._graph.nodes[number])
                self._names[number] = name
        return [self._names[number] for number in numbers]

    def _write(self, node: Node) -> str:
        operands, what, nodes = [self._names[one] for one in node.operands], node.what, self._nodes
        match node.kind:
            case "constant":
                return nodes.constant(node.number, node.dtype)
            case "ufunc":
                return self._function(what, node.operands)
            case "cast":
                return nodes.cast(operands[0], node.dtype)
            case "where":
                return nodes.add("Where", *operands)
            case "take":
                return nodes.add("Gather", nodes.tensor(self._graph.tables[what]), *operands)
        return self._interpolated(node.operands[0], self._graph.tables[what])

    def _function(self, ufunc: Any, numbers: Iterable[int]) -> str:
        add, operands = self._nodes.add, [self._names[number] for number in numbers]
        values = list(map(self._value, numbers))
        dtype = values[0].dtype
        operation = str(operation_of(ufunc, letter_of(dtype)))
        match operation:
            case "fmod d":
                return add("Mod", *operands, fmod=1)
            case "remainder q":
                return add("Mod", *operands)
            case "floor_divide q":
                rest = add("Mod", *operands)
                return add("Div", add("Sub", operands[0], rest), operands[1])
        name, *_ = operation.split()
        if name in _SAME:
            return add(_SAME[name], *operands)
        if name in _ANGLES:
            narrow = self._nodes.cast(operands[0], np.dtype(np.float32))
            return self._nodes.cast(add(_ANGLES[name], narrow), dtype)
        if name in _COMPOSED:
            return self._composed(_COMPOSED[name](*values))
        raise ConfigError(f"numpy.{name} of type {dtype} cannot be exported to ONNX")

    def _value(self, number: int) -> Value:
        return Value(self._graph, number)

    def _named(self, name: str) -> Value:
        """A result of the model that the graph did not know."""
        number = self._graph.load("node", name, np.float64)
        self._names[number] = name
        return self._value(number)

    def _composed(self, value: Value) -> str:
        (name,) = self.written([value.node])
        return name

    def _interpolated(self, number: int, table: Any) -> str:
        """Interpolate a value in a table, as ``numpy.interp`` does.

        Args:
            number: Position in the table.
            table: The arguments, the values, and the values before the first and after the last.
        """
        count, nodes, x = len(table) // 2 - 1, self._nodes, self._value(number)
        place = self._place(self._names[number], nodes.tensor(table[:count]))
        following = nodes.add("Add", place, nodes.constant(1, np.dtype(np.int64)))
        after = nodes.add("Min", following, nodes.constant(count - 1, np.dtype(np.int64)))
        low, high, first, last = (
            self._named(nodes.add("Gather", nodes.tensor(part), one))
            for part in (table[:count], table[count : 2 * count])
            for one in (place, after)
        )
        width = high - low
        slope = (last - first) / where(width == 0.0, 1.0, width)  # both are the last one
        inside = where(x < table[0], table[-2], slope * (x - low) + first)
        return self._composed(where(x > table[count - 1], table[-1], inside))

    def _place(self, x: str, arguments: str) -> str:
        """The number of the last argument that is not above x; of the first one if all are."""
        add, axis = self._nodes.add, self._nodes.tensor(np.array([-1]))
        reached = add("GreaterOrEqual", add("Unsqueeze", x, axis), arguments)
        whole = np.dtype(np.int64)
        number = add("ReduceSum", self._nodes.cast(reached, whole), axis, keepdims=0)
        place = add("Sub", number, self._nodes.constant(1, whole))
        return add("Max", place, self._nodes.constant(0, whole))


_OPSET: Final = 18
_IR_VERSION: Final = 9
_COUNT: Final = "count"
_ROWS: Final = "N"
_WHOLE: Final = np.dtype(np.int64)
_DOUBLE: Final = np.dtype(np.float64)


def write_onnx(agent: ExportedAgent, path: str | os.PathLike[str]) -> Path:
    """Write an agent as an ONNX model.

    The model takes ``measurements`` of type float64, shape (N, m), and gives ``actions`` of shape
    (N, a), for N plants at once. What the agent keeps from one sample to the next are inputs, too:
    ``count``, the number of samples until now, and more arrays. The outputs ``next_count`` and so
    on are their values for the next sample. The metadata of the model tell names, units, the time
    between samples, and what the memory begins with.

    Args:
        agent: The agent.
        path: The file, which must not exist.

    Returns:
        The path.

    Raises:
        ConfigError: If the package onnx is missing (the extra ``onnx``), or the task computes what
            cannot be written in ONNX.
        FileExistsError: If the file exists.
    """
    file = new_file(path)
    file.write_bytes(onnx_model(agent).SerializeToString())
    return file


def onnx_model(agent: ExportedAgent) -> Any:
    """Make the model of ``write_onnx``, a ``ModelProto``."""
    return _Model(agent).model()


class _Model:
    """Makes the model of one agent."""

    def __init__(self, agent: ExportedAgent) -> None:
        self._agent, self._logic = agent, agent.logic
        self._onnx, self._nodes = imported("onnx", "onnx"), Nodes()
        self._fields = field_names(agent)
        logic, load = agent.logic, self._loaded
        self._operations = Operations(self._nodes, logic.graph, logic.loads, load)
        self._given = ""

    def model(self) -> Any:
        """The checked model."""
        logic = self._logic
        if self._agent.network is not None:
            self._given = self._network(self._agent.network)
        self._store("actions", logic.input_nodes, _DOUBLE)
        outputs = [self._value("actions", _DOUBLE, len(logic.inputs))]
        outputs += self._next_memory()
        make, helper = self._onnx.helper.make_graph, self._onnx.helper
        nodes = self._nodes
        graph = make(nodes.nodes, self._agent.name, self._inputs(), outputs, nodes.tensors)
        model = helper.make_model(
            graph,
            producer_name="fmugym",
            producer_version=self._agent.version,
            opset_imports=[helper.make_opsetid("", _OPSET)],
            ir_version=_IR_VERSION,
            doc_string=" ".join(self._agent.notes),
        )
        helper.set_model_props(model, self._metadata())
        self._onnx.checker.check_model(model)
        return model

    # The interface.

    def _value(self, name: str, dtype: np.dtype[Any], width: int | None) -> Any:
        shape: list[Any] = [_ROWS] if width is None else [_ROWS, width]
        return self._onnx.helper.make_tensor_value_info(name, self._nodes.type_of(dtype), shape)

    def _inputs(self) -> list[Any]:
        inputs = [self._value("measurements", _DOUBLE, len(self._logic.measurements))]
        inputs.append(self._value(_COUNT, _WHOLE, None))
        for name, kept in zip(self._fields, self._logic.kept, strict=True):
            inputs.append(self._value(name, kept.dtype, len(kept.starts)))
        return inputs

    def _next_memory(self) -> list[Any]:
        one = self._nodes.constant(1, _WHOLE)
        self._nodes.named("Add", (_COUNT, one), f"next_{_COUNT}")
        outputs = [self._value(f"next_{_COUNT}", _WHOLE, None)]
        for name, kept in zip(self._fields, self._logic.kept, strict=True):
            if kept.updates:
                self._store(f"next_{name}", kept.updates, kept.dtype)
            else:
                self._nodes.named("Identity", (name,), f"next_{name}")
            outputs.append(self._value(f"next_{name}", kept.dtype, len(kept.starts)))
        return outputs

    def _metadata(self) -> dict[str, str]:
        logic = self._logic
        starts = {
            name: [None if start != start else start for start in kept.starts]  # JSON has no NaN
            for name, kept in zip(self._fields, logic.kept, strict=True)
        }
        facts: dict[str, Any] = {
            "sample_time": logic.time_step,
            "measurements": [{"name": v.name, "unit": v.unit} for v in logic.measurements],
            "actions": [{"name": v.name, "unit": v.unit} for v in logic.inputs],
            "memory": {_COUNT: 0, **starts},
        }
        return {name: json.dumps(value) for name, value in facts.items()}

    # The program around the network. A value has the shape (N,), a constant none.

    def _loaded(self, number: int) -> str:
        load, nodes = self._logic.loads[number], self._nodes
        match load[0]:
            case "measurement":
                return self._column("measurements", load[1])
            case "kept":
                return self._kept(load[1], load[2])
            case "count":
                return _COUNT
            case "active":
                return nodes.add("Greater", _COUNT, nodes.constant(0, _WHOLE))
            case "given":
                return self._column(self._given, load[1])
        return nodes.constant(load[1], self._logic.graph.nodes[number].dtype)

    def _column(self, array: str, place: int) -> str:
        return self._nodes.add("Gather", array, self._nodes.constant(place, _WHOLE), axis=1)

    def _kept(self, field: int, element: int) -> str:
        value = self._column(self._fields[field], element)
        if self._logic.kept[field].name != "previous":
            return value
        is_first = self._nodes.add("Equal", _COUNT, self._nodes.constant(0, _WHOLE))
        return self._nodes.add("Where", is_first, self._column("measurements", element), value)

    def _rows(self, numbers: Sequence[int], dtype: np.dtype[Any]) -> str:
        """Values side by side, shape (N, k)."""
        nodes = self._nodes
        shape, axis = nodes.add("Shape", _COUNT), nodes.tensor(np.array([1]))
        columns = []
        for number, value in zip(numbers, self._operations.written(numbers), strict=True):
            if self._logic.graph.nodes[number].dtype != dtype:
                value = nodes.cast(value, dtype)
            columns.append(nodes.add("Unsqueeze", nodes.add("Expand", value, shape), axis))
        return nodes.add("Concat", *columns, axis=1)

    def _store(self, name: str, numbers: Sequence[int], dtype: np.dtype[Any]) -> None:
        self._nodes.named("Identity", (self._rows(numbers, dtype),), name)

    # The network.

    def _network(self, network: Network) -> str:
        """The last values of the network, shape (N, k)."""
        nodes, values = self._nodes, self._rows(self._logic.features, network.dtype)
        for layer in network.layers:
            weights, bias = nodes.tensor(layer.weights), nodes.tensor(layer.bias)
            values = nodes.add("Gemm", values, weights, bias, transB=1)
            for activation in layer.activations:
                values = _activated(nodes, values, activation, network.dtype)
        return values


def _activated(nodes: Nodes, values: str, activation: Activation, dtype: np.dtype[Any]) -> str:
    numbers = activation.arguments
    match activation.name:
        case "tanh" | "relu" | "sigmoid":
            return nodes.add(activation.name.capitalize(), values)
        case "leaky_relu":
            return nodes.add("LeakyRelu", values, alpha=numbers[0])
        case "elu":
            return nodes.add("Elu", values, alpha=numbers[0])
        case "silu":
            return nodes.add("Mul", values, nodes.add("Sigmoid", values))
        case "clamp":
            return nodes.add("Clip", values, *(nodes.constant(one, dtype) for one in numbers))
    beta = nodes.constant(numbers[0], dtype)
    soft = nodes.add("Softplus", nodes.add("Mul", values, beta))
    return nodes.add("Div", soft, beta)
