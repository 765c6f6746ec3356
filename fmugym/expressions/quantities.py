"""Quantities of an episode: values that hooks, formulas and snapshots read.

From this table come the arrays of N episodes, the numbers of one, the attributes of environments
that hooks read, the columns of snapshots, and the names that formulas use. A new quantity is a line
here, what writes it (in Python for numbers and for arrays, in C for programs), and a sentence in
``docs/class.md``.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final, NamedTuple

import numpy as np

__all__ = ["KEPT", "PREVIOUS", "QUANTITIES", "EpisodeQuantity"]

_FLOAT: Final = np.dtype(np.float64)
_COUNT: Final = np.dtype(np.int64)
_STATUS: Final = np.dtype(np.int32)
_FLAG: Final = np.dtype(np.bool_)


class EpisodeQuantity(NamedTuple):
    """A value of an episode, or several of them.

    Attributes:
        name: Its name in graphs; keys may follow, such as the place of an output.
        attribute: The attribute of an environment and of ``Episode`` that has it.
        shape: One value for each of the ``"outputs"`` and monitored variables, of the ``"states"``
            (the outputs only) or of the ``"inputs"``; the shape of an ``"action"``; a
            ``"number"``; values that are ``"named"``; ``"derived"`` if it follows from others.
        dtype: Its type; that of an action depends on the action space.
        before: The kind of the rows that a program loads before the FMU's step; None if there are
            none.
        after: The same after the FMU's step.
        of: The attribute whose value before the step it has.
        array: The attribute of a pool that is its array; "" if it has one of its own.
    """

    name: str
    attribute: str
    shape: str
    dtype: np.dtype[Any] = _FLOAT
    before: str | None = None
    after: str | None = None
    of: str = ""
    array: str = ""

    @property
    def zero(self) -> Any:
        """Zero in its type."""
        return self.dtype.type().item()

    @property
    def path(self) -> str:
        """Attribute of an environment from which functions in Python read the quantity."""
        return "_episode.outputs" if self.name == "outputs" else self.attribute


QUANTITIES: Final[Mapping[str, EpisodeQuantity]] = {
    one.name: one
    for one in (
        EpisodeQuantity(
            "outputs", "outputs", "outputs", _FLOAT, "output", "output", array="outputs"
        ),
        EpisodeQuantity(
            "previous_outputs", "previous_state", "states", _FLOAT, "output", "kept", of="state"
        ),
        EpisodeQuantity("inputs", "inputs", "inputs", _FLOAT, "input", "input", array="inputs"),
        EpisodeQuantity(
            "previous_inputs",
            "previous_inputs",
            "inputs",
            _FLOAT,
            "previous_inputs",
            "previous_inputs",
            of="inputs",
        ),
        EpisodeQuantity("action", "action", "action"),
        EpisodeQuantity("previous_action", "previous_action", "action", of="action"),
        EpisodeQuantity("step_count", "step_count", "number", _COUNT, "step_count", "step_count"),
        EpisodeQuantity("fmu_status", "fmu_status", "number", _STATUS, array="statuses"),
        EpisodeQuantity("time", "time", "derived"),
        EpisodeQuantity("done", "done", "number", _FLAG),
        EpisodeQuantity("after_end", "after_end", "number", _FLAG),
        EpisodeQuantity("parameters", "parameters", "named", _FLOAT, "parameter", "parameter"),
        EpisodeQuantity("variables", "variables", "named", _FLOAT, "variable", "before"),
    )
}
"""By name. Programs take the action from the pool, compute the time from the steps, know ``done``
once they have found it, and run no step after the end of an episode."""

KEPT: Final = tuple(one for one in QUANTITIES.values() if one.shape not in {"named", "derived"})
"""The quantities that are kept as numbers or arrays, in the order of columns of snapshots."""

PREVIOUS: Final = {one.attribute: one.of for one in KEPT if one.of}
"""By attribute, the attribute whose value before the step it has."""
