"""Networks in C."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, Final

import numpy as np

from fmugym.errors import ConfigError
from fmugym.export.network import Activation, Network
from fmugym.export.operations import C_TYPES, constant

__all__ = ["array", "bare", "c_type", "network_lines"]

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
    widths = [network.width, *(len(layer.bias) for layer in network.layers)]
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
