"""What a step has led to in N environments that are asked one after another."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from fmugym.pool.base import FloatArray, MaskArray
from fmugym.task.results import as_reward
from fmugym.task.step import Numbers

__all__ = ["Outcomes", "Unconverted"]


class Unconverted(Numbers):
    """The ``Form`` of environments whose rewards become floats together, when all are there."""

    def rewards(self, value: Any) -> Any:
        """See ``Form.rewards``; numpy's floats stay as they are."""
        kind = type(value)
        if kind is np.float64 or kind is np.float32:
            self.reward_type = kind  # the next environment's is of the same type
            return value
        return as_reward(value)


class Outcomes:
    """The results of a step, without the observations.

    Args:
        count: N.

    Attributes:
        rewards, terminated, truncated: Those of each environment.
        infos: The infos, by the number of the environment; one that is missing is empty.
        values: The outputs before the step, of environments whose numbers are not checked yet.
        variables: Copies of their episode variables, where hooks write them.
        misfits: Their observations that are not finite, as hooks returned them.
    """

    def __init__(self, count: int) -> None:
        self.rewards: list[Any] = [0.0] * count
        self.terminated, self.truncated = [False] * count, [False] * count
        self.infos: dict[int, Mapping[str, Any]] = {}
        self.values: list[Any] = [None] * count
        self.variables: list[dict[str, Any] | None] = [None] * count
        self.misfits: dict[int, Any] = {}

    def note(
        self, index: int, reward: float, ended: bool, cut_off: bool, info: Mapping[str, Any]
    ) -> None:
        """Note the result of one environment, whose numbers are checked."""
        self.rewards[index], self.values[index] = reward, None
        self.terminated[index], self.truncated[index] = ended, cut_off
        if info:
            self.infos[index] = info

    def faulty(self, finite: MaskArray) -> list[int]:
        """The environments with a reward or an observation that is not finite.

        Args:
            finite: Which observations are finite; those of ``misfits`` do not count.
        """
        fine = finite & np.isfinite(np.array(self.rewards, np.float64))
        if not self.misfits and fine.all():
            return []
        found = {*np.flatnonzero(~fine).tolist(), *self.misfits}
        return sorted(index for index in found if self.values[index] is not None)

    def sorted_infos(self) -> dict[int, Mapping[str, Any]]:
        """The infos in the order of the environments."""
        return {index: self.infos[index] for index in sorted(self.infos)}

    def arrays(self) -> tuple[FloatArray, MaskArray, MaskArray]:
        """The rewards, terminated and truncated, each of shape (N,)."""
        rewards = np.array(self.rewards, np.float64)
        return rewards, np.array(self.terminated, np.bool_), np.array(self.truncated, np.bool_)
