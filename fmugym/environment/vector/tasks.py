"""Task of N environments: what surrounds a step of their FMUs, in the one order of a step."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from typing import Any

import numpy as np

from fmugym.environment.vector.episodes import Episodes
from fmugym.environment.vector.infos import add_ends, last_observations, merged, restricted
from fmugym.fmi.status import TERMINATED_CODE, WARNING_CODE
from fmugym.pool.pool import FloatArray, MaskArray, StatusArray
from fmugym.pool.states import IndexArray

__all__ = ["StepResult", "VectorTask", "failed_in"]


def failed_in(statuses: StatusArray) -> MaskArray:
    """Mask of FMUs that have failed; a request to stop is no failure."""
    failed: MaskArray = (statuses > WARNING_CODE) & (statuses != TERMINATED_CODE)
    return failed


StepResult = tuple[Any, FloatArray, MaskArray, MaskArray, dict[str, Any]]
"""Observations, rewards, terminated, truncated and infos of a step of N environments. No later step
changes arrays that somebody holds."""


class VectorTask(ABC):
    """Conversion of actions to inputs, and of outputs to observations, rewards and ends.

    Args:
        episodes: The episodes of the environments.

    Attributes:
        way: How hooks are called: ``"expressions"`` (not at all: programs do their work),
            ``"arrays"`` or ``"one by one"``.
        episodes: As given.
        has_moved: Whether the last step or reset got as far as the FMUs.
        offsets: What is added to each output after each step, shape (k,); None for nothing.
    """

    way: str

    def __init__(self, episodes: Episodes) -> None:
        self.episodes, self._pool = episodes, episodes.pool
        self.has_moved = False
        self.offsets: FloatArray | None = None

    @property
    def has_expressions_only(self) -> bool:
        """Whether programs of expressions run in the place of hooks."""
        return self.way == "expressions"

    # Steps

    def step(self, actions: Any, may_restart: bool = False) -> StepResult:
        """Step the environments, and start the episodes that have ended before it.

        Args:
            actions: Of all environments.
            may_restart: Whether the task may also start the next episodes where this step ends
                some. ``restarted`` starts those that it leaves; without it, the next step starts
                them, and does not step their FMUs.
        """
        episodes = self.episodes
        return self._compose(actions, episodes.ended.copy() if episodes.any_ended else None, None)

    def step_around(self, actions: Any, resting: MaskArray) -> StepResult:
        """Step some environments, while the others stay as they are; no episode starts.

        Args:
            actions: Of all environments.
            resting: Which ones stay as they are, shape (N,), with a reward of 0; their episodes
                count as ended.
        """
        result = self._compose(actions, None, resting)
        self.episodes.ended |= resting
        self.episodes.any_ended = True
        return result

    def _compose(
        self, actions: Any, fresh: MaskArray | None, resting: MaskArray | None
    ) -> StepResult:
        """Do a step of its parts, in the order of all tasks.

        Args:
            actions: Of all environments.
            fresh: Which ones start an episode and do not step; None for none.
            resting: Which ones stay as they are; None for none.
        """
        idle = fresh if resting is None else resting
        taken = self._take_actions(actions, idle)
        self.has_moved = True
        started = None if fresh is None else self._start(fresh)
        self._pool.step(None, idle)
        if resting is not None:
            self._pool.statuses[resting] = 0  # a fault was told when it came
        self._add_offsets(idle)
        return self._conclude(taken, idle, started)

    @abstractmethod
    def _take_actions(self, actions: Any, idle: MaskArray | None) -> Any:
        """Check the actions, and write the inputs of the FMUs. If one is refused, nothing moves.

        Args:
            actions: Of all environments.
            idle: Which environments will not step, shape (N,); None if all will.

        Returns:
            What ``_conclude`` needs of them.
        """

    @abstractmethod
    def _start(self, mask: MaskArray) -> Any:
        """Start episodes in the middle of a step; return their infos for ``_conclude``."""

    def _add_offsets(self, idle: MaskArray | None = None) -> None:
        """Add the offsets to the outputs of the instances that have stepped.

        Args:
            idle: Which instances have not stepped, shape (N,); None if all have.
        """
        if self.offsets is not None:
            failed = failed_in(self._pool.statuses)
            left_out = failed if idle is None else failed | idle
            self._pool.outputs += np.where(left_out, 0.0, self.offsets[:, np.newaxis])

    @abstractmethod
    def _conclude(self, taken: Any, idle: MaskArray | None, started: Any) -> StepResult:
        """Make the result of a step of the FMUs.

        Args:
            taken: What ``_take_actions`` has returned.
            idle: Which environments have not stepped, shape (N,); None if all have.
            started: What ``_start`` has returned; None if no episode has started.
        """

    def restarted(self, result: StepResult) -> StepResult:
        """Start the next episodes where a step has ended some.

        Args:
            result: Of the step.

        Returns:
            The same with the first observations of the next episodes; the infos also have the
            last ones, as ``FMUVectorEnv`` tells.
        """
        observed, rewards, terminated, truncated, told = result
        ended, space = self.episodes.ended.copy(), self.episodes.prototype.observation_space
        last = last_observations(space, observed, ended)
        try:
            observations, infos = self.reset(ended)
        finally:
            self.has_moved = True  # in the step
        add_ends(infos, last, restricted(told, ended), ended)
        if told:
            infos = merged(restricted(told, ~ended), infos)
        return observations, rewards, terminated, truncated, infos

    # Episodes

    @abstractmethod
    def reset(
        self,
        mask: MaskArray,
        seeds: Sequence[int | None] | None = None,
        options: Mapping[str, Any] = {},
    ) -> tuple[Any, dict[str, Any]]:
        """Start episodes of the environments in the mask; return the observations of all.

        Args:
            mask: Which environments; the task may keep this array.
            seeds: A seed or None for each environment, or None for no seeds.
            options: As for a single environment.
        """

    def start_at_once(self, mask: Any) -> tuple[Any, dict[str, Any]] | None:
        """Start episodes of some environments by a call of the pool, after a reset of all.

        Args:
            mask: Which environments, as the caller has given them: not checked yet.

        Returns:
            As ``reset``. None if ``reset`` has to do it; then nothing has happened.
        """
        return None

    @abstractmethod
    def observe(self, indices: IndexArray) -> Any:
        """Observations of all environments; the given ones may have changed."""

    def rebind(self) -> None:
        """Use the arrays of the episodes anew, of which some are other ones now."""
        return

    @abstractmethod
    def assuming(
        self, tables: Mapping[str, FloatArray], offsets: FloatArray | None
    ) -> AbstractContextManager[None]:
        """Let hooks read other data and outputs inside of a ``with`` block.

        Args:
            tables: Those of series, by name.
            offsets: What is added to each output after each step, shape (k,); None for nothing.
        """
