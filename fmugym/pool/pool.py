"""The contract of all pools, however they step their instances."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from fmugym.errors import SimulationError
from fmugym.fmi.variable import Variable
from fmugym.pool.machine_limits import available_processors
from fmugym.pool.pool_spec import DEFAULT_CALL_TIMEOUT, ISOLATIONS, PoolSpec, ResetMethod
from fmugym.pool.states import Bundle, IndexArray, SaveMethod

__all__ = [
    "DEFAULT_CALL_TIMEOUT",
    "ISOLATIONS",
    "FloatArray",
    "MaskArray",
    "Play",
    "Played",
    "Pool",
    "PoolSpec",
    "StatusArray",
    "available_processors",
]

FloatArray = npt.NDArray[np.float64]
StatusArray = npt.NDArray[np.int8]
MaskArray = npt.NDArray[np.bool_]


Played = tuple[int, bool, Any, Any, Any, tuple[Any, ...], tuple[Any, Any, Any] | None]
"""What a step with programs returns; see ``Play.step``."""


class Play(NamedTuple):
    """Play of a pool: its step with programs around it.

    ``before`` and ``after`` surround a step of the FMUs by the caller, who also starts episodes. A
    pool that steps and starts the FMUs itself has the other functions, too.

    Attributes:
        check: Refuses actions as ``step`` does: by a ``TypeError``, ``ValueError`` or
            ``BufferError``.
        before: Takes the actions, and makes the inputs.
        after: Returns what ``step`` returns, of the actions that ``before`` took.
        step: A function of actions and a flag; it does a step, and starts the episodes that have
            ended before it. If the flag is True, an episode that ends without a fault is followed
            by the next one in the same step. It returns seven values: how many instances had
            trouble (a status worse than a warning, or numbers that are not finite); whether any
            episode is at its end now; rewards, terminated, truncated, shape (N,); a tuple of the
            arrays of observations and infos; and None, or, if episodes have started, a tuple of
            where, shape (N,), what they have drawn, shape (draws, N), and the last observations
            and infos of those that have ended in this step, or None. All arrays are new, or those
            of an earlier step that nobody holds any more.
        start_and_step: The same; to be called if episodes may start.
        start: A function of a mask. If it is a contiguous array of N Booleans with at least one
            True, it starts these episodes and returns how many instances had trouble, whether any
            episode is at its end now, the arrays of observations and infos, a copy of the mask, and
            what was drawn. Otherwise it does nothing and returns None.
    """

    check: Callable[[Any], None]
    before: Callable[[Any], None]
    after: Callable[[], Played]
    step: Callable[[Any, bool], Played] | None = None
    start_and_step: Callable[[Any, bool], Played] | None = None
    start: Callable[[Any], tuple[int, bool, tuple[Any, ...], Any, Any] | None] | None = None


class Pool(ABC):
    """N instances of one FMU.

    Arrays have variables first, ``(k, N)``, so that a hook's ``x, v = state`` gives one row each.
    The pool returns the same two arrays for outputs and statuses each time; the next call
    overwrites them.

    A status is a ``fmugym.fmi.Status``. A failure of an FMU is never raised, because it
    concerns one instance only. Its status shows the failure, and ``failure`` gives the reason.
    Its outputs stay as they were before the call, and the next reset repairs or replaces the
    instance. The same holds for an instance whose inputs are not finite: it is not stepped.

    Attributes:
        num_instances: N.
        inputs: Shape (k_in, N); the caller writes to it before a step.
        outputs: Shape (k, N).
        statuses: Shape (N,).
        observations: The first ``num_observed`` outputs after a step, shape (N, num_observed).
        step_own: Steps all instances with the values in ``inputs``. Returns how many have a status
            worse than a warning.
        execution: Sentences on how the pool runs, and why; see ``fmugym.pool.opening``.
    """

    num_instances: int
    inputs: FloatArray
    outputs: FloatArray
    statuses: StatusArray
    observations: npt.NDArray[np.float32]
    step_own: Callable[[], int]
    execution: tuple[str, ...] = ()

    @abstractmethod
    def reset(
        self, variables: tuple[Variable, ...], values: FloatArray, mask: MaskArray | None = None
    ) -> tuple[FloatArray, StatusArray]:
        """Start instances anew, at the first communication point, warm-up included.

        Args:
            variables: The variables to set before initialization, P of them; all numeric.
                ``START_TIME`` of ``fmugym.pool.pool_spec`` stands for the first communication
                point.
            values: Their values, shape (P, N); only the columns in the mask are used.
            mask: Which instances to start anew, shape (N,); None for all.

        Returns:
            The outputs, shape (k, N), and the statuses, shape (N,). Both are unchanged for
            instances outside the mask.
        """

    @abstractmethod
    def step(
        self,
        inputs: FloatArray | None = None,
        skip: MaskArray | None = None,
    ) -> tuple[FloatArray, StatusArray]:
        """Do one step with the instances.

        Args:
            inputs: Shape (k_in, N), finite, copied to ``self.inputs``; None to use those values.
            skip: The instances not to step, shape (N,). Their outputs and statuses stay unchanged.

        Returns:
            The outputs, shape (k, N), and the statuses, shape (N,).
        """

    @abstractmethod
    def failure(self, index: int) -> str:
        """Say why an instance's last status was worse than a warning."""

    @abstractmethod
    def read(self, variables: tuple[Variable, ...]) -> FloatArray:
        """Read any numeric variables now, shape (len(variables), N).

        Raises:
            SimulationError: If an instance refuses.
        """

    def differentiate(
        self, unknowns: tuple[Variable, ...], knowns: tuple[Variable, ...]
    ) -> FloatArray:
        """Ask the FMU for partial derivatives now, with the values in ``inputs`` set.

        Args:
            unknowns: Outputs or derivatives of states, k of them.
            knowns: Continuous states or inputs, m of them.

        Returns:
            Shape (k, m, N).

        Raises:
            SimulationError: If the FMU offers no directional derivatives, or an instance refuses.
        """
        raise SimulationError(f"a {type(self).__name__} has no directional derivatives")

    @abstractmethod
    def health(self) -> dict[str, npt.NDArray[np.int64]]:
        """Return the counters of each instance by name, each of shape (N,); see ``HEALTH``."""

    @abstractmethod
    def forget_health(self) -> None:
        """Set all counters to zero."""

    @abstractmethod
    def close(self) -> None:
        """Free all instances. It may be called more than once."""

    # Optional abilities. The defaults are for pools without them.

    @property
    def save_method(self) -> SaveMethod | None:
        """Method of ``save_instances``; None if the pool cannot save."""
        return None

    def save_instances(self, indices: IndexArray) -> Bundle:
        """Save the states of single instances, as a value that fits any others.

        Args:
            indices: The instances, shape (M,). All must have been reset once.

        Raises:
            SimulationError: If the pool cannot save states, or an instance fails.
        """
        raise SimulationError(f"a {type(self).__name__} has no states that could be saved")

    def write(self, variables: tuple[Variable, ...], values: FloatArray) -> None:
        """Set tunable parameters of all instances between two steps.

        Args:
            variables: The parameters, P of them.
            values: Shape (P, N).

        Raises:
            SimulationError: If the pool cannot do it, or an instance refuses.
        """
        raise SimulationError(f"a {type(self).__name__} cannot set parameters between steps")

    def restore_instances(
        self, bundle: Bundle, sources: IndexArray, indices: IndexArray
    ) -> StatusArray:
        """Let instances go on from saved states of any instances of the same FMU.

        Args:
            bundle: From ``save_instances`` of any pool of the same FMU and specification.
            sources: Which of the states each instance gets, shape (M,).
            indices: The instances, shape (M,), each of them once.

        Returns:
            The statuses of all instances, shape (N,).

        Raises:
            SimulationError: If the pool cannot restore states.
        """
        raise SimulationError(f"a {type(self).__name__} has no states that could be restored")

    @property
    def is_real(self) -> bool:
        """Whether a step may move real hardware, so that trials with it are forbidden."""
        return False

    @property
    def reset_method(self) -> ResetMethod:
        """Method by which instances start a new episode."""
        return ResetMethod.RESET

    @property
    def retries_resets(self) -> bool:
        """Whether ``reset`` may be tried again, so that no other call should start episodes."""
        return False

    @property
    def plays_alone(self) -> bool:
        """Whether the pool steps and starts the FMUs itself in a step with programs."""
        return False

    def extract(self) -> bool:
        """Extract the FMU's files anew that have been removed; returns whether there were any.

        Raises:
            FMULoadError: If the FMU has been removed or changed, too.
        """
        return False

    def prepare_play(self, variables: tuple[Variable, ...], *parts: Any) -> Play:
        """Prepare a step with programs before and after it.

        Args:
            variables: As for ``reset``.
            parts: As for ``fmugym.pool.native_pool.prepare``.

        Returns:
            The functions of the step, and of resets where the pool has one of its own.

        Raises:
            SimulationError: If the pool does not support it.
        """
        raise SimulationError(f"a {type(self).__name__} cannot run programs")

    def halt(self) -> None:
        """Stop at once whatever runs on without being stepped; the next reset starts it again."""
        return

    def note_fault(self, index: int) -> None:
        """Count a fault that the caller found: numbers computed from the outputs are not finite."""
        return

    def info(self) -> dict[str, npt.NDArray[Any]]:
        """Return facts about the last step by name, each of shape (N,)."""
        return {}
