"""Getting and setting a fixed list of variables with arguments prepared once."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from fmugym.archive.description import Variable
from fmugym.fmi.instance import Instance
from fmugym.fmi.status import Status, sane

__all__ = ["Access"]


class Access:
    """The values of a fixed list of variables, moved to or from the FMU with one call per C type.

    Args:
        instance: The instance.
        variables: The variables, all of them numeric.
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
        by_type: dict[str, list[int]] = {}
        for index, variable in enumerate(variables):
            by_type.setdefault(instance.c_type(variable), []).append(index)
        references = np.array([v.value_reference for v in variables], np.uint32)
        self._groups: list[tuple[list[int], npt.NDArray[Any], Any]] = []
        for c_type, indices in by_type.items():
            dtype = instance.dtypes[c_type]
            shares = dtype == np.float64 and len(indices) == len(variables)
            buffer = self.values if shares else np.zeros(len(indices), dtype)
            calls = instance.prepare_access(c_type, references[indices], buffer)
            self._groups.append((indices, buffer, calls))
        self._use_single_call()

    def _use_single_call(self) -> None:
        """Replace the methods with the FMU's functions if one call moves all values, as usual."""
        if len(self._groups) == 1 and self._groups[0][1] is self.values:
            get, set_, arguments = self._groups[0][2]
            self.get = functools.partial(get, *arguments)  # type: ignore[method-assign]  # faster
            self.set = functools.partial(set_, *arguments)  # type: ignore[method-assign]  # faster

    def get(self) -> int:
        """Read all values from the FMU; return the worst status."""
        worst = 0
        for indices, buffer, (get, _, arguments) in self._groups:
            worst = max(worst, sane(get(*arguments)))
            if worst > Status.WARNING:
                break
            if buffer is not self.values:
                self.values[indices] = buffer
        return worst

    def set(self) -> int:
        """Write all values to the FMU; return the worst status."""
        worst = 0
        for indices, buffer, (_, set_, arguments) in self._groups:
            if buffer is not self.values:
                np.copyto(buffer, self.values[indices], casting="unsafe")
            worst = max(worst, sane(set_(*arguments)))
            if worst > Status.WARNING:
                break
        return worst
