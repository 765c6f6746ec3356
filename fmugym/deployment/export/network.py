"""Networks as data: layers of weights, features, and the choice of an action."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from fmugym.control.controller import either, limited
from fmugym.errors import ConfigError, shown

__all__ = ["ACTIVATIONS", "Activation", "Layer", "Network", "Scaling", "network_of"]

_Array = npt.NDArray[Any]


@dataclass(frozen=True)
class Activation:
    """A function that is applied to each value of a layer.

    Attributes:
        name: One of ``ACTIVATIONS``.
        arguments: Its constants.
    """

    name: str
    arguments: tuple[float, ...] = ()

    def __call__(self, values: _Array) -> _Array:
        """Apply the function."""
        result: _Array = ACTIVATIONS[self.name](values, *self.arguments)
        return result.astype(values.dtype)


def _softplus(x: _Array, beta: float, threshold: float) -> _Array:
    scaled = x * beta
    return np.where(scaled > threshold, x, np.log1p(np.exp(np.minimum(scaled, threshold))) / beta)


ACTIVATIONS: Final[dict[str, Callable[..., Any]]] = {
    "tanh": np.tanh,
    "relu": lambda x: np.maximum(x, 0),
    "leaky_relu": lambda x, slope: np.where(x > 0, x, x * slope),
    "elu": lambda x, alpha: np.where(x > 0, x, alpha * np.expm1(np.minimum(x, 0))),
    "sigmoid": lambda x: 1 / (1 + np.exp(-x)),
    "silu": lambda x: x / (1 + np.exp(-x)),
    "softplus": _softplus,
    "clamp": lambda x, low, high: np.clip(x, low, high),
}
"""Activation functions by name, with the constants of PyTorch's modules."""

_MODULES: Final[dict[str, Callable[[Any], Activation]]] = {
    "Tanh": lambda m: Activation("tanh"),
    "ReLU": lambda m: Activation("relu"),
    "LeakyReLU": lambda m: Activation("leaky_relu", (float(m.negative_slope),)),
    "ELU": lambda m: Activation("elu", (float(m.alpha),)),
    "Sigmoid": lambda m: Activation("sigmoid"),
    "SiLU": lambda m: Activation("silu"),
    "Softplus": lambda m: Activation("softplus", (float(m.beta), float(m.threshold))),
    "Hardtanh": lambda m: Activation("clamp", (float(m.min_val), float(m.max_val))),
    "ReLU6": lambda m: Activation("clamp", (0.0, 6.0)),
}

_WITHOUT_EFFECT: Final = ("Flatten", "Identity", "Dropout")


@dataclass(frozen=True)
class Layer:
    """A matrix of weights, a bias, and functions of each value.

    Attributes:
        weights: Shape (outputs, inputs).
        bias: Shape (outputs,).
        activations: Applied in this order.
    """

    weights: _Array
    bias: _Array
    activations: tuple[Activation, ...] = ()


@dataclass(frozen=True)
class Scaling:
    """A normalization of observations: the mean is taken away, then it is divided and clipped.

    Attributes:
        mean, divisor: For each element of the observation.
        limit: The largest magnitude of each element afterwards; infinite for none.
    """

    mean: _Array
    divisor: _Array
    limit: _Array

    def __call__(self, observation: Iterable[Any]) -> list[Any]:
        """Normalize the elements of an observation, numbers or formulas, with float64."""
        facts = np.array([self.mean, self.divisor, self.limit], np.float64).T
        pairs = zip(observation, facts, strict=True)
        return [limited((one - mean) / by, -limit, limit) for one, (mean, by, limit) in pairs]


@dataclass(frozen=True)
class Network:
    """A deterministic policy.

    Attributes:
        layers: From the observation to the last values.
        space: The action space.
        scaling: The normalization of observations; None for none.
        squashed: Whether values from -1 to 1 become actions from the lowest to the highest one.
            If not, they are clipped to these limits.
    """

    layers: tuple[Layer, ...]
    space: spaces.Space[Any]
    scaling: Scaling | None = None
    squashed: bool = False
    dtype: np.dtype[Any] = field(default=np.dtype(np.float32))

    def __post_init__(self) -> None:
        widths = [layer.weights.shape for layer in self.layers]
        for (before, _), (_, after) in itertools.pairwise(widths):
            if before != after:
                raise ConfigError(f"a layer gives {before} values, the next one takes {after}")
        if widths[-1][0] != sum(self.parts):
            raise ConfigError(
                f"the network gives {widths[-1][0]} values, expected {sum(self.parts)} for "
                f"{self.space}"
            )

    @property
    def input_count(self) -> int:
        """Number of inputs of the network."""
        return int(self.layers[0].weights.shape[1])

    @property
    def parts(self) -> tuple[int, ...]:
        """Numbers of last values that decide on each element of the action."""
        space: Any = self.space
        if isinstance(space, spaces.Discrete):
            return (int(space.n),)
        if isinstance(space, spaces.MultiDiscrete):
            return tuple(int(n) for n in space.nvec.ravel())
        return (1,) * int(np.prod(space.shape))

    def require_fitting(self, count: int, space: spaces.Space[Any]) -> None:
        """Refuse a task that gives another number of values, or has other actions."""
        if self.input_count != count:
            raise ConfigError(
                f"the agent is for another task: its network takes {self.input_count} values, "
                f"the task gives {count}"
            )
        if self.space != space:
            raise ConfigError(
                f"the agent is for another task: its actions are {self.space}, those of the task "
                f"are {space}"
            )

    def unscaled(self, space: Any) -> Network:
        """The same policy with actions in a bounded ``space``, which its own from -1 to 1 mean."""
        if self.squashed:
            return replace(self, space=space)
        low, high = space.low.ravel().astype(np.float64), space.high.ravel().astype(np.float64)
        half, middle = (((high + sign * low) / 2).astype(self.dtype) for sign in (-1, 1))
        return replace(self, layers=(*self.layers, Layer(np.diag(half), middle)), space=space)

    def scaled(self, observation: Sequence[Any]) -> Sequence[Any]:
        """Scale numbers or formulas to inputs of the first layer, in its type."""
        return observation if self.scaling is None else self.scaling(observation)

    def values(self, observation: _Array) -> _Array:
        """The last values for an observation of shape (k,)."""
        values: _Array = np.array(self.scaled([*observation]), self.dtype)
        for layer in self.layers:
            values = layer.weights @ values + layer.bias
            for activation in layer.activations:
                values = activation(values)
        return values

    def action(self, observation: _Array) -> _Array:
        """The action for an observation of shape (k,), flat."""
        return np.array(self.chosen([*self.values(observation)]), self.space.dtype)

    def chosen(self, values: Sequence[Any]) -> list[Any]:
        """The elements of the action that the last values mean, numbers or formulas.

        They are brought into the range of a ``Box``. Otherwise the largest one of each part
        chooses.
        """
        space: Any = self.space
        if not isinstance(space, spaces.Box):
            ends = itertools.accumulate(self.parts, initial=0)
            starts = np.ravel(space.start)
            return [
                _place_of_largest(values[end : end + count]) + start
                for end, count, start in zip(ends, self.parts, starts, strict=False)
            ]
        limits = zip(values, space.low.flat, space.high.flat, strict=True)
        if not self.squashed:
            return [limited(one, low, high) for one, low, high in limits]
        half, unit = self.dtype.type(0.5), self.dtype.type(1.0)
        return [low + half * (one + unit) * (high - low) for one, low, high in limits]


def _place_of_largest(values: Sequence[Any]) -> Any:
    """Index of the largest value; of equal ones, the first."""
    place, largest = 0, values[0]
    for index, one in enumerate(values[1:], 1):
        is_larger = one > largest
        place, largest = either(is_larger, index, place), either(is_larger, one, largest)
    return place


def network_of(modules: Any, space: spaces.Space[Any], **more: Any) -> Network:
    """Read a network of PyTorch.

    Args:
        modules: A module, such as a ``Sequential``, or several that follow each other: linear
            layers and the functions in ``ACTIVATIONS``.
        space: The action space.
        more: ``scaling`` and ``squashed`` of ``Network``.

    Raises:
        ConfigError: If a module is of another kind; the text names it.
    """
    layers: list[Layer] = []
    for module in _flat(modules if isinstance(modules, Sequence) else [modules]):
        kind = type(module).__name__
        if kind == "Linear":
            layers.append(_linear(module))
        elif kind in _MODULES and layers:
            last = layers[-1]
            activations = (*last.activations, _MODULES[kind](module))
            layers[-1] = Layer(last.weights, last.bias, activations)
        elif kind not in _WITHOUT_EFFECT:
            raise ConfigError(
                f"a network with {shown(kind)} cannot be exported; linear layers can, and "
                f"{', '.join(_MODULES)} behind them"
            )
    if not layers:
        raise ConfigError("a network without a linear layer cannot be exported")
    return Network(tuple(layers), space, dtype=layers[0].weights.dtype, **more)


def _flat(modules: Any) -> list[Any]:
    """The modules in the order in which they are applied."""
    flat: list[Any] = []
    for module in modules:
        is_container = type(module).__name__ == "Sequential"
        flat.extend(_flat(module) if is_container else [module])
    return flat


def _linear(module: Any) -> Layer:
    weights = _numbers(module.weight)
    bias = np.zeros(len(weights), weights.dtype) if module.bias is None else _numbers(module.bias)
    return Layer(weights, bias)


def _numbers(tensor: Any) -> _Array:
    array: _Array = tensor.detach().cpu().numpy().copy()
    if array.dtype not in (np.float32, np.float64) or not np.isfinite(array).all():
        raise ConfigError(
            f"the weights of a network must be finite numbers of type float32 or float64, got "
            f"{array.dtype}"
        )
    return array
