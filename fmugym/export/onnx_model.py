"""Agents as ONNX: a function from measurements and memory to actions and the next memory."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from fmugym.export.c99 import field_names
from fmugym.export.exportable import ExportedAgent
from fmugym.export.names import new_file
from fmugym.export.network import Activation, Network
from fmugym.export.onnx_nodes import Nodes
from fmugym.export.onnx_operations import Operations
from fmugym.extras import imported

__all__ = ["onnx_model", "write_onnx"]

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
