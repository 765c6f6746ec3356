"""Asking an FMU for directional or adjoint derivatives."""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from fmugym.archive.variable import Variable

__all__ = ["DerivativeCall"]

Trailing = Callable[[int], tuple[Any, ...]]


class _Moved(NamedTuple):
    """Variables as FMI moves them: each array as a whole, and once.

    Attributes:
        references: The value references.
        places: Where the value of each variable is among all values.
        size: The number of these.
    """

    references: npt.NDArray[np.uint32]
    places: list[int]
    size: int

    @classmethod
    def of(cls, variables: Sequence[Variable]) -> _Moved:
        """Find the places of variables."""
        firsts: dict[Any, int] = {}
        references, places, size = [], [], 0
        for index, variable in enumerate(variables):
            key = index if variable.array is None else variable.array
            if key not in firsts:
                firsts[key] = size
                references.append(variable.value_reference)
                size += variable.size
            places.append(firsts[key] + variable.place)
        return cls(np.array(references, np.uint32), places, size)

    @property
    def arguments(self) -> tuple[Any, ...]:
        """The references and their number, for a call."""
        return self.references.ctypes.data_as(ctypes.c_void_p), ctypes.c_size_t(
            len(self.references)
        )


@dataclass(frozen=True)
class DerivativeCall:
    """One call for derivatives: of all unknowns by one known, or, adjoint, of one by all.

    Attributes:
        name: The function, without the prefix of its FMI version.
        doing: What the call does, for messages.
        arguments: All but the instance.
    """

    name: str
    doing: str
    arguments: tuple[Any, ...]
    _sensitivity: npt.NDArray[np.float64]
    _places: list[int]

    @classmethod
    def directional(
        cls, unknowns: Sequence[Variable], known: Variable, trailing: Trailing
    ) -> DerivativeCall:
        """Prepare a call for the derivatives of all unknowns by one known.

        Args:
            unknowns: The variables to differentiate.
            known: The variable to differentiate by.
            trailing: What the FMI version has after an array of so many numbers.
        """
        of, by = _Moved.of(unknowns), _Moved.of([known])
        doing = f"the derivative by {known.name!r}"
        return cls._of("GetDirectionalDerivative", doing, (of, by), by, of, trailing)

    @classmethod
    def adjoint(
        cls, unknown: Variable, knowns: Sequence[Variable], trailing: Trailing
    ) -> DerivativeCall:
        """Prepare a call for the derivatives of one unknown by all knowns; see ``directional``."""
        of, by = _Moved.of([unknown]), _Moved.of(knowns)
        doing = f"the derivative of {unknown.name!r}"
        return cls._of("GetAdjointDerivative", doing, (of, by), of, by, trailing)

    @classmethod
    def _of(
        cls,
        name: str,
        doing: str,
        listed: tuple[_Moved, _Moved],
        seeded: _Moved,
        others: _Moved,
        trailing: Trailing,
    ) -> DerivativeCall:
        seed, sensitivity = np.zeros(seeded.size), np.zeros(others.size)
        seed[seeded.places] = 1.0
        arguments = (
            *(argument for moved in listed for argument in moved.arguments),
            seed.ctypes.data_as(ctypes.c_void_p),
            *trailing(seeded.size),
            sensitivity.ctypes.data_as(ctypes.c_void_p),
            *trailing(others.size),
        )
        return cls(name, doing, arguments, sensitivity, others.places)

    @property
    def result(self) -> npt.NDArray[np.float64]:
        """The derivatives after the call, one for each of the several variables."""
        return self._sensitivity[self._places]
