"""The writing of inputs: what ``_get_inputs`` returned becomes one number for each input."""

from __future__ import annotations

from collections.abc import Sequence
from math import isfinite
from typing import Any, Final

import numpy as np

from fmugym.archive.description import Variable
from fmugym.errors import ConfigError, shown
from fmugym.pool.base import FloatArray
from fmugym.task.actions import flat_inputs

__all__ = ["InputWriter"]

_FLOATS: Final = frozenset({float, np.float64, np.float32})


class InputWriter:
    """Writes the inputs of a single environment.

    Args:
        variables: The inputs.

    Attributes:
        all_real: Whether all inputs are Reals, so that no value is rounded.
    """

    def __init__(self, variables: Sequence[Variable]) -> None:
        self._variables = variables
        self.all_real = all(variable.kind == "real" for variable in variables)
        self._is_one_real = self.all_real and len(variables) == 1

    def write(self, values: Any, action: Any, row: FloatArray) -> tuple[float, ...]:
        """Check values and write them.

        Args:
            values: What ``_get_inputs`` returned.
            action: The action, for errors.
            row: The pool's array of inputs, shape (k,).

        Returns:
            The values, rounded to the inputs' types.

        Raises:
            ConfigError: If they are not one finite number for each input. Nothing is written then.
        """
        if self._is_one_real and type(values) in _FLOATS and isfinite(values):
            row[0] = values
            return (float(values),)
        flat = flat_inputs(values, self._variables, lambda values: _source(values, action))
        inputs = tuple(flat.tolist())
        if not all(map(isfinite, inputs)):
            pairs = zip((v.name for v in self._variables), inputs, strict=True)
            listing = ", ".join(f"{name} = {value}" for name, value in pairs)
            raise ConfigError(f"action {shown(action)} makes {listing}; every input must be finite")
        row[:] = inputs
        return inputs


def _source(values: Any, action: Any) -> str:
    """Say for an error where inputs come from."""
    if values is action:
        return f"action {shown(values)}"
    return f"what _get_inputs returned for action {shown(action)}, {shown(values)},"
