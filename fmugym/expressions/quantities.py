"""The quantities of an episode: what formulas read, and where it is found."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final, NamedTuple

import numpy as np

__all__ = ["QUANTITIES", "EpisodeQuantity"]

_FLOAT: Final = np.dtype(np.float64)


class EpisodeQuantity(NamedTuple):
    """A value of an episode, or several of them.

    Attributes:
        name: Its name in graphs; keys may follow, such as the place of an output.
        in_hooks: The attribute of an environment that has it.
        before: The kind of the rows that a program loads before the FMU's step; None if there are
            none.
        after: The same after the FMU's step.
        dtype: Its type; that of an action depends on the action space.
    """

    name: str
    in_hooks: str
    before: str | None = None
    after: str | None = None
    dtype: np.dtype[Any] = _FLOAT


QUANTITIES: Final[Mapping[str, EpisodeQuantity]] = {
    one.name: one
    for one in (
        EpisodeQuantity("outputs", "inside.readings.values", "output", "output"),
        EpisodeQuantity("previous_outputs", "previous_state", "output", "kept"),
        EpisodeQuantity("inputs", "inputs", "input", "input"),
        EpisodeQuantity("action", "action"),
        EpisodeQuantity("previous_action", "previous_action"),
        EpisodeQuantity("parameters", "parameters", "parameter", "parameter"),
        EpisodeQuantity("variables", "variables", "variable", "before"),
        EpisodeQuantity("step_count", "step_count", "step_count", "step_count", np.dtype(np.int64)),
        EpisodeQuantity("time", "time"),
        EpisodeQuantity("done", "done", dtype=np.dtype(np.bool_)),
        EpisodeQuantity("after_end", "after_end", dtype=np.dtype(np.bool_)),
    )
}
"""By name. ``outputs`` are those of the config and the monitored variables. Programs take the
action from the pool, compute the time from the steps, know ``done`` once they have found it, and
run no step after the end of an episode."""
