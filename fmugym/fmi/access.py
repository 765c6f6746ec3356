"""Getting and setting a fixed list of variables with arguments prepared once."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from fmugym.archive.texts import number_of, text_among
from fmugym.archive.variable import Variable, unlisted
from fmugym.fmi.instance import Instance
from fmugym.fmi.status import Status, sane

__all__ = ["Access"]

_Group = tuple[list[int], list[int], npt.NDArray[Any], Any]
"""The places of variables in the list and in the FMU's memory, this memory, and the calls."""


def _by_type(instance: Instance, variables: Sequence[Variable]) -> dict[str, list[int]]:
    by_type: dict[str, list[int]] = {}
    for index, variable in enumerate(variables):
        if variable.kind == "string":
            continue
        by_type.setdefault(instance.c_type(variable), []).append(index)
    return by_type


def _memory_of(variable: Variable, index: int) -> tuple[int, int]:
    """What variables with the same memory have in common: an array has one, each scalar its own."""
    return variable.value_reference, -1 if variable.array is not None else index


def _offsets(variables: Sequence[Variable]) -> tuple[dict[tuple[int, int], int], int]:
    """Where the memory of each array and scalar begins, and the size of all."""
    offsets: dict[tuple[int, int], int] = {}
    size = 0
    for index, variable in enumerate(variables):
        memory = _memory_of(variable, index)
        if memory not in offsets:
            offsets[memory] = size
            size += variable.size
    return offsets, size


class Access:
    """The values of a fixed list of variables, moved to or from the FMU with one call per C type.

    Args:
        instance: The instance.
        variables: The variables: numeric ones, and Strings, whose values are the numbers of their
            texts. ``set_texts`` sets them; ``set`` leaves them out.
        values: The memory to use, contiguous float64; by default new memory.

    Attributes:
        values: The values, float64, in the order of the variables. If all variables have the C type
            ``double``, the FMU reads and writes this memory directly.
    """

    def __init__(
        self,
        instance: Instance,
        variables: Sequence[Variable],
        values: npt.NDArray[np.float64] | None = None,
    ) -> None:
        self.values = np.zeros(len(variables)) if values is None else values
        self._instance = instance
        self._strings = [(i, v) for i, v in enumerate(variables) if v.kind == "string"]
        self._groups = [
            self._group(instance, c_type, indices, variables)
            for c_type, indices in _by_type(instance, variables).items()
        ]
        self._use_single_call()

    def _group(
        self,
        instance: Instance,
        c_type: str,
        indices: list[int],
        variables: Sequence[Variable],
    ) -> _Group:
        """Prepare the calls for the variables of one C type."""
        own = [variables[index] for index in indices]
        offsets, size = _offsets(own)
        places = [offsets[_memory_of(v, i)] + v.place for i, v in enumerate(own)]
        dtype = instance.dtypes[c_type]
        shares = dtype == np.float64 and places == indices and size == len(variables)
        buffer = self.values if shares else np.zeros(size, dtype)
        for variable in unlisted(own):
            buffer[offsets[_memory_of(variable, 0)] + variable.place] = variable.start_number
        references = np.array([reference for reference, _ in offsets], np.uint32)
        return indices, places, buffer, instance.prepare_access(c_type, references, buffer)

    def _use_single_call(self) -> None:
        """Replace the methods with the FMU's functions if one call moves all values, as usual."""
        if len(self._groups) == 1 and self._groups[0][2] is self.values:
            get, set_, arguments = self._groups[0][3]
            self.get = functools.partial(get, *arguments)  # type: ignore[method-assign]  # faster
            self.set = functools.partial(set_, *arguments)  # type: ignore[method-assign]  # faster

    def get(self) -> int:
        """Read all values from the FMU; return the worst status."""
        worst = 0
        for indices, places, buffer, (get, _, arguments) in self._groups:
            worst = max(worst, sane(get(*arguments)))
            if worst > Status.WARNING:
                break
            if buffer is not self.values:
                self.values[indices] = buffer[places]
        return max(worst, self._get_texts()) if self._strings and worst <= Status.WARNING else worst

    def _get_texts(self) -> int:
        """Read the Strings: the values are the numbers of their texts."""
        worst = 0
        for index, variable in self._strings:
            status, text = self._instance.get_string(variable)
            worst = max(worst, status)
            if status <= Status.WARNING:
                self.values[index] = number_of(text)
        return worst

    def set(self) -> int:
        """Write all values to the FMU; return the worst status."""
        worst = 0
        for indices, places, buffer, (_, set_, arguments) in self._groups:
            if buffer is not self.values:
                buffer[places] = self.values[indices].astype(buffer.dtype)
            worst = max(worst, sane(set_(*arguments)))
            if worst > Status.WARNING:
                break
        return worst

    def set_texts(self) -> None:
        """Write the Strings to the FMU: for each the text that its value stands for.

        Raises:
            SimulationError: If the FMU refuses one.
        """
        for index, variable in self._strings:
            text = text_among(variable, float(self.values[index]))
            self._instance.set_string(variable, text)
