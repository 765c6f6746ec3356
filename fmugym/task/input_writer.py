"""Writer of inputs: the result of ``_get_inputs`` becomes one number for each input."""

from __future__ import annotations

from collections.abc import Sequence
from math import hypot, isfinite
from typing import Any, Final

import numpy as np

from fmugym.archive.variable import Variable
from fmugym.errors import ConfigError, shown
from fmugym.pool.base import FloatArray
from fmugym.task.actions import flat_inputs

__all__ = ["InputWriter"]

_FLOATS: Final = frozenset({float, np.float64, np.float32})


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
