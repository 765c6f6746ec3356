"""Networks in C."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, Final

import numpy as np
from gymnasium import spaces

from fmugym.errors import ConfigError
from fmugym.export.network import Activation, Network
from fmugym.export.operations import TYPES, constant

__all__ = ["array", "bare", "c_type", "network_lines"]

_WIDTH: Final = 96


def c_type(dtype: np.dtype[Any]) -> str:
    """C's name of a type.

    Raises:
        ConfigError: If C has none.
    """
    if dtype.char not in TYPES:
        raise ConfigError(f"values of type {dtype} cannot be exported to C")
    return TYPES[dtype.char]


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
    letter = network.dtype.char
    kind = TYPES[letter]
    for index, layer in enumerate(network.layers):
        yield from array(f"{name}_weights_{index}", layer.weights.T)
        yield from array(f"{name}_bias_{index}", layer.bias)
        yield ""
    yield "/* The sum of each column of weights times an input, and a bias. */"
    yield f"static void {name}_layer(const {kind} *weights, const {kind} *bias, const {kind} *from,"
    yield f"    int inputs, {kind} *to, int outputs) {{"
    yield "    for (int i = 0; i < outputs; i++) {"
    yield "        to[i] = bias[i];"
    yield "    }"
    yield "    for (int j = 0; j < inputs; j++) {"
    yield f"        const {kind} *column = weights + j * outputs;"
    yield "        for (int i = 0; i < outputs; i++) {"
    yield "            to[i] += column[i] * from[j];"
    yield "        }"
    yield "    }"
    yield "}"
    yield ""
    yield from _scaling_arrays(name, network)
    yield f"static void {name}_network(const {kind} *features, {c_type(network.gives)} *given) {{"
    yield from _network_body(name, network, letter)
    yield "}"
    yield ""


def _scaling_arrays(name: str, network: Network) -> Iterator[str]:
    if network.scaling is not None:
        for what in ("mean", "divisor", "limit"):
            yield from array(f"{name}_{what}", getattr(network.scaling, what).astype(np.float64))
        yield ""


def _network_body(name: str, network: Network, letter: str) -> Iterator[str]:
    kind = TYPES[letter]
    widths = [network.width, *(len(layer.bias) for layer in network.layers)]
    before = "features"
    if network.scaling is not None:
        yield f"    {kind} scaled[{network.width}];"
    for index, width in enumerate(widths[1:]):
        yield f"    {kind} values_{index}[{width}];"
    yield ""
    if network.scaling is not None:
        before = "scaled"
        yield f"    for (int i = 0; i < {network.width}; i++) {{"
        yield f"        const double shifted = (double)features[i] - {name}_mean[i];"
        yield f"        const double x = shifted / {name}_divisor[i];"
        yield f"        const double limit = {name}_limit[i];"
        yield f"        scaled[i] = ({kind})(x > limit ? limit : x < -limit ? -limit : x);"
        yield "    }"
    for index, layer in enumerate(network.layers):
        counts = f"{before}, {widths[index]}, values_{index}, {widths[index + 1]}"
        yield f"    {name}_layer({name}_weights_{index}, {name}_bias_{index}, {counts});"
        before = f"values_{index}"
        for activation in layer.activations:
            yield from _activation_lines(activation, before, widths[index + 1], letter)
    yield from _result(network, before)


def _activation_lines(activation: Activation, array: str, width: int, letter: str) -> Iterator[str]:
    numbers = [constant(number, letter) for number in activation.arguments]
    suffix = "f" if letter == "f" else ""
    text = _ACTIVATIONS[activation.name].format(*numbers, f=suffix)
    yield f"    for (int i = 0; i < {width}; i++) {{"
    yield f"        const {TYPES[letter]} x = {array}[i];"
    yield f"        {array}[i] = {text};"
    yield "    }"


def _result(network: Network, values: str) -> Iterator[str]:
    """The last values themselves, or the elements that the largest ones choose."""
    if isinstance(network.space, spaces.Box):
        yield f"    for (int i = 0; i < {len(network.parts)}; i++) {{"
        yield f"        given[i] = {values}[i];"
        yield "    }"
        return
    begin = 0
    for index, (count, start) in enumerate(zip(network.parts, network.starts, strict=True)):
        yield f"    given[{index}] = 0;"
        yield f"    for (int i = 1; i < {count}; i++) {{"
        yield f"        if ({values}[{begin} + i] > {values}[{begin} + given[{index}]]) {{"
        yield f"            given[{index}] = ({c_type(network.gives)})i;"
        yield "        }"
        yield "    }"
        if start:
            yield f"    given[{index}] += {start};"
        begin += count
