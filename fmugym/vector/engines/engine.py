"""The interface that all engines for N environments share."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from fmugym.env import FMUEnv
from fmugym.fmi.status import TERMINATED_CODE, WARNING_CODE
from fmugym.pool.base import FloatArray, MaskArray, Pool, StatusArray
from fmugym.pool.bundle import IndexArray
from fmugym.task.snapshot import Columns
from fmugym.vector.arguments import UnknownAttributeError

__all__ = ["Engine", "StepResult", "attribute", "failed_in"]


def failed_in(statuses: StatusArray) -> MaskArray:
    """Mask of FMUs that have failed; a request to stop is no failure."""
    failed: MaskArray = (statuses > WARNING_CODE) & (statuses != TERMINATED_CODE)
    return failed


def attribute(env: FMUEnv, name: str) -> Any:
    """Return an attribute of an environment, or else a variable or parameter of its episode.

    Raises:
        ConfigError: If there is none of this name (it is an ``AttributeError``, too).
    """
    if not hasattr(env, name):
        for own in (env.variables, env.parameters):
            if name in own:
                return own[name]
    try:
        return getattr(env, name)
    except AttributeError as error:
        raise UnknownAttributeError(str(error)) from None


class StepResult(NamedTuple):
    """The result of a step of N environments; no later step changes arrays that somebody holds."""

    observations: Any
    rewards: FloatArray
    terminated: MaskArray
    truncated: MaskArray
    infos: dict[str, Any]


class Engine(ABC):
    """Drives N environments; the caller decides when an ended one starts again.

    Attributes:
        way: How hooks are called: ``"expressions"`` (not at all: programs do their work),
            ``"arrays"`` or ``"one by one"``.
        ended: Whether the last step ended the episode, shape (N,); always the same array.
        any_ended: Whether the last step ended any episode.
        has_moved: Whether the last step or reset got as far as the FMUs.
        offsets: What is added to each output after each step, shape (k,); None for nothing.
        starts_at_ends: Whether the caller wants the next episode to start in the step that ends one
            (the mode ``SAME_STEP``). An engine may leave that to ``reset``.
    """

    way: str

    _observed: npt.NDArray[np.float32] | None = None
    """The observations that the pool writes in its step; None for none."""

    def __init__(self, pool: Pool) -> None:
        self._pool, self.ended = pool, np.zeros(pool.num_instances, np.bool_)
        self.any_ended = False
        self.has_moved = False
        self.offsets: FloatArray | None = None
        self.starts_at_ends = False

    def _add_offsets(self, idle: MaskArray | None = None) -> None:
        """Add the offsets to the outputs of the instances that have stepped.

        Args:
            idle: Which instances have not stepped, shape (N,); None if all have.
        """
        if self.offsets is not None:
            failed = failed_in(self._pool.statuses)
            left_out = failed if idle is None else failed | idle
            self._pool.outputs += np.where(left_out, 0.0, self.offsets[:, np.newaxis])

    def note_ends(self, terminated: MaskArray, truncated: MaskArray) -> None:
        """Note which episodes a step has ended."""
        np.logical_or(terminated, truncated, out=self.ended)
        self.any_ended = bool(np.count_nonzero(self.ended))

    def note_starts(self, mask: MaskArray) -> None:
        """Note which episodes have started."""
        self.ended[mask] = False
        self.any_ended = bool(np.count_nonzero(self.ended))

    @abstractmethod
    def reset(
        self, mask: MaskArray, seeds: Sequence[int | None] | None, options: Mapping[str, Any]
    ) -> tuple[Any, dict[str, Any]]:
        """Start episodes of the environments in the mask; return the observations of all.

        Args:
            mask: Which environments; the engine may keep this array.
            seeds: A seed or None for each environment, or None for no seeds.
            options: As for a single environment.
        """

    def reset_by(self, options: Any) -> tuple[Any, dict[str, Any]] | None:
        """Do a reset of some environments at once, after one of all.

        Args:
            options: What the caller has given to ``reset``, not checked yet.

        Returns:
            As ``reset``. None if ``reset`` has to do it; then nothing has happened.
        """
        return None

    def step(
        self, actions: Any, resetting: MaskArray | None, resting: MaskArray | None = None
    ) -> StepResult:
        """Step the environments, in the order that all engines share.

        Args:
            actions: Of all environments.
            resetting: Which ones start an episode instead; None for none.
            resting: Which ones stay as they are, with a reward of 0; their episodes count as
                ended. None for none; at most one of both masks is given.
        """
        idle = resetting if resting is None else resting
        taken = self._take_actions(actions, idle)
        self.has_moved = True
        started = None if resetting is None else self._start(resetting)
        self._pool.step(None, idle, self._observed)
        if resting is not None:
            self._pool.statuses[resting] = 0  # a fault was told when it came
        self._add_offsets(idle)
        result = self._conclude(taken, idle, started)
        if resting is not None:
            self.ended |= resting
            self.any_ended = True
        return result

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

    @abstractmethod
    def _conclude(self, taken: Any, idle: MaskArray | None, started: Any) -> StepResult:
        """Make the result of a step of the FMUs.

        Args:
            taken: What ``_take_actions`` has returned.
            idle: Which environments have not stepped, shape (N,); None if all have.
            started: What ``_start`` has returned; None if no episode has started.
        """

    @abstractmethod
    def seed_of(self, index: int) -> int | None:
        """Return the seed of an environment's generator."""

    @abstractmethod
    def close(self) -> None:
        """Close the environments, but not the pool."""

    @abstractmethod
    def single(self, index: int) -> AbstractContextManager[FMUEnv]:
        """Lend one environment as a single one, to read it and call its methods."""

    def read(self, name: str, index: int) -> Any:
        """Read an attribute, or else a parameter of the FMU, of one environment."""
        with self.single(index) as env:
            return attribute(env, name)

    @abstractmethod
    def call(
        self,
        name: str,
        indices: Sequence[int],
        arguments: Sequence[Any],
        keywords: Mapping[str, Any],
    ) -> list[Any]:
        """Call a method of some environments; attributes that it assigns take effect.

        Raises:
            ConfigError: If a method changes something that all environments of this engine must
                share. Then no environment is changed.
        """

    @abstractmethod
    def evaluate(
        self, function: Callable[[Any], Sequence[Any]], actions: Any, indices: IndexArray
    ) -> FloatArray:
        """Evaluate a function of the environment, which reads as hooks do and changes nothing.

        Args:
            function: Returns numbers for a single environment, and arrays of shape (M,) for a
                prototype that stands for M of them.
            actions: The latest actions of all environments, these first.
            indices: The M environments to evaluate it for.

        Returns:
            The values, shape (k, M).
        """

    @abstractmethod
    def set_attribute(self, name: str, values: Mapping[int, Any]) -> None:
        """Set an attribute of some environments, by index.

        Raises:
            ConfigError: If environments of this engine cannot have these values.
        """

    @property
    def has_expressions_only(self) -> bool:
        """Whether programs of expressions run in the place of hooks."""
        return self.way == "expressions"

    @abstractmethod
    def set_variable(self, name: str, values: FloatArray) -> None:
        """Give an episode variable one value for each environment, now and at each start.

        Args:
            name: The variable.
            values: Environments last.
        """

    @abstractmethod
    def set_parameter(self, name: str, values: npt.NDArray[Any]) -> None:
        """Give a parameter one value for each environment, from its next episode on.

        Args:
            name: The parameter.
            values: Checked values: numbers, or the texts of a String as objects, shape (N,).
        """

    # Snapshots

    @abstractmethod
    def columns(self, indices: IndexArray) -> Columns:
        """Copy the quantities and random streams of some episodes, without the FMUs' states."""

    def require_fit(self, columns: Columns) -> None:
        """Refuse columns that these environments cannot have.

        Raises:
            ConfigError: If there are such columns.
        """
        return

    @abstractmethod
    def place(self, columns: Columns, sources: IndexArray, indices: IndexArray) -> None:
        """Let environments go on from columns; environment ``indices[i]`` from ``sources[i]``."""

    @abstractmethod
    def assuming(
        self, tables: Mapping[str, FloatArray], offsets: FloatArray | None
    ) -> AbstractContextManager[None]:
        """Let hooks read other data and outputs inside of a ``with`` block.

        Args:
            tables: Those of series, by name.
            offsets: What is added to each output after each step, shape (k,); None for nothing.
        """

    @abstractmethod
    def show(self, variables: Mapping[str, float], parameters: Mapping[str, FloatArray]) -> None:
        """Let hooks of all environments read other values in these episodes.

        Args:
            variables: Those of episode variables, by name.
            parameters: Those of parameters, arrays of shape (N,) by name.
        """

    @abstractmethod
    def observe(self, indices: IndexArray) -> Any:
        """Observations of all environments; the given ones may have changed."""
