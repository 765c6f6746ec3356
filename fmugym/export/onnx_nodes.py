"""Builder of a graph of ONNX."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from fmugym.extras import imported

__all__ = ["Nodes"]


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
