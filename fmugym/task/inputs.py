"""The writing of inputs: what ``_get_inputs`` returned becomes one number for each input."""

from __future__ import annotations

from collections.abc import Sequence
from math import hypot, isfinite
from struct import Struct
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from fmugym.archive.variable import Variable
from fmugym.errors import ConfigError, shown
from fmugym.pool.base import FloatArray
from fmugym.task.actions import flat_inputs

__all__ = ["InputWriter"]

_FLOATS: Final = frozenset({float, np.float64, np.float32})
_FLOAT64: Final = np.dtype(np.float64)
_FLOAT32: Final = np.dtype(np.float32)


class InputWriter:
    """Checks and writes the inputs of a single environment.

    Args:
        variables: The inputs.

    Attributes:
        all_real: Whether all inputs are Reals, so that no value is rounded.
    """

    def __init__(self, variables: Sequence[Variable]) -> None:
        self._variables = variables
        self.all_real = all(variable.kind == "real" for variable in variables)
        self._is_one_real = self.all_real and len(variables) == 1
        self._are_float64 = all(variable.type in {"Real", "Float64"} for variable in variables)
        self._count = len(variables)
        self._pack = Struct(f"={len(variables)}d")

    def checked(self, values: Any, action: Any) -> tuple[float, ...]:
        """Check values.

        Args:
            values: What ``_get_inputs`` returned.
            action: The action, for errors.

        Returns:
            The values, rounded to the inputs' types.

        Raises:
            ConfigError: If they are not one finite number for each input.
        """
        if self._is_one_real and type(values) in _FLOATS and isfinite(values):
            return (float(values),)
        if self._are_float64 and type(values) is np.ndarray and values.dtype.char in "fd":
            inputs = tuple(values.ravel().tolist())
            if len(inputs) == self._count and isfinite(hypot(*inputs)):
                return inputs
        return self._flat(values, action)

    def of_actions(self, actions: npt.NDArray[Any]) -> FloatArray | None:
        """The inputs of M environments whose actions are their inputs.

        Args:
            actions: Shape (M, ...).

        Returns:
            Shape (M, k); None if ``checked`` would have to round them, or would refuse one.
        """
        if not self._are_float64 or actions.dtype.char not in "fd":
            return None
        rows = actions.reshape(len(actions), actions[:1].size).astype(np.float64)
        fit = rows.shape[1] == self._count and np.isfinite(rows).all()
        return rows if fit else None

    def packed(self, values: Any, action: Any) -> float | bytes:
        """Copy values for ``unpacked``; they may not be finite, unlike those of ``checked``.

        What a hook returns has to be copied at once: its memory may serve the next hook.
        """
        kind = type(values)
        if self._is_one_real:
            number: float = values if kind in _FLOATS else self.checked(values, action)[0]
            return number
        if self._are_float64 and kind is np.ndarray and values.size == self._count:
            dtype = values.dtype
            if dtype is _FLOAT64 or dtype is _FLOAT32:
                copied: bytes = values.tobytes()
                return copied
        return self._pack.pack(*self.checked(values, action))

    def unpacked(self, parts: Sequence[Any]) -> FloatArray:
        """The inputs of M environments, shape (M, k), from what ``packed`` has returned."""
        if self._is_one_real:
            return np.array(parts, np.float64).reshape(-1, 1)
        sizes = set(map(len, parts))
        if len(sizes) > 1:  # of several types
            return np.concatenate([self.unpacked([part]) for part in parts])
        is_double = not sizes or self._pack.size in sizes
        rows = np.frombuffer(b"".join(parts), _FLOAT64 if is_double else _FLOAT32)
        return rows.reshape(len(parts), self._count).astype(np.float64)

    def _flat(self, values: Any, action: Any) -> tuple[float, ...]:
        flat = flat_inputs(values, self._variables, lambda values: _source(values, action))
        inputs = tuple(flat.tolist())
        if not all(map(isfinite, inputs)):
            pairs = zip((v.name for v in self._variables), inputs, strict=True)
            listing = ", ".join(f"{name} = {value}" for name, value in pairs)
            raise ConfigError(f"action {shown(action)} makes {listing}; every input must be finite")
        return inputs

    def write(self, inputs: tuple[float, ...], row: FloatArray) -> None:
        """Write checked inputs to the pool's array, shape (k,)."""
        if self._is_one_real:
            row[0] = inputs[0]  # takes a quarter of the time
        else:
            row[:] = inputs


def _source(values: Any, action: Any) -> str:
    """Say for an error where inputs come from."""
    if values is action:
        return f"action {shown(values)}"
    return f"what _get_inputs returned for action {shown(action)}, {shown(values)},"
