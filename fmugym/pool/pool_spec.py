"""The specification of a pool: its part of the config, checked and resolved for the FMU."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from enum import StrEnum
from functools import cached_property
from typing import Final

from fmugym.fmi.description import ModelDescription
from fmugym.fmi.variable import Variable

__all__ = [
    "DEFAULT_CALL_TIMEOUT",
    "DEFAULT_LEAK_LIMIT",
    "DEFAULT_TOLERANCE",
    "FIXED_STEP_SOLVERS",
    "INITIALIZATION_FACTOR",
    "ISOLATIONS",
    "REUSING",
    "SAMPLINGS",
    "SOLVERS",
    "START_TIME",
    "PoolSpec",
    "ResetMethod",
    "is_start_time",
    "whole_number_of_steps",
]

ISOLATIONS: Final = ("none", "process")
"""Where FMUs run: in the caller's process, or in worker processes."""

SAMPLINGS: Final = ("last", "mean", "integral", "min", "max")
"""What a step gives of the values that an output has after each of its substeps.

The order is that of ``Sampling`` in ``native/pool/pool.h``.
"""

FIXED_STEP_SOLVERS: Final = ("euler", "rk4")
"""The methods of integration whose steps do not depend on the tolerance."""

SOLVERS: Final = ("dormand_prince", "euler", "rk4", "rosenbrock")
"""The methods of integration for model exchange; see ``native/model_exchange/methods.h``."""

DEFAULT_TOLERANCE: Final = 1e-6
"""Relative tolerance of the solver where neither the config nor the FMU gives one: float32
observations do not show smaller errors."""

DEFAULT_CALL_TIMEOUT: Final = 60.0
"""How long a call to a worker process may take, in seconds of real time."""

INITIALIZATION_FACTOR: Final = 10
"""How many times as long as another call an instantiation or initialization may take."""

DEFAULT_LEAK_LIMIT: Final = 64 * 2**20
"""By how many bytes a worker process may grow."""


START_TIME: Final = Variable(
    "the start time", "StartTime", 0, "independent", "continuous", "exact", unit="s"
)
"""Stands among start variables for the first communication point of the episode.

Without it, episodes begin at ``PoolSpec.start_time``.
"""


def is_start_time(variable: Variable) -> bool:
    """Whether a start variable is ``START_TIME``, which other processes have copies of."""
    return variable.type == START_TIME.type


class ResetMethod(StrEnum):
    """Method by which an instance starts an episode, from the fastest to the most reliable."""

    RESTORE = "restore"
    """Restore the FMU state after initialization if the start values are the same."""
    RESET = "reset"
    """Call the FMU's reset function and initialize the instance."""
    INSTANCE = "instance"
    """Free the instance and make a new one."""
    LIBRARY = "library"
    """Also load the shared library anew, to reset its global variables."""
    PROCESS = "process"
    """Start a new worker process."""


REUSING: Final = (ResetMethod.RESTORE, ResetMethod.RESET)
"""The methods that keep the instance."""


@dataclass(frozen=True)
class PoolSpec:
    """Work of a pool at each reset and step.

    Attributes:
        inputs: The variables set before each step, in the order of the rows of ``step``'s argument.
        outputs: The variables read after each step, in the order of the rows of its result. Between
            steps an integral is 0, and other samplings are the values at that time.
        time_step: Simulated time of one step, in seconds.
        num_observed: How many of the outputs, from the first, make an observation.
        substeps: Number of communication steps in one step.
        start_time: First communication point, in seconds, unless ``START_TIME`` is among the start
            variables.
        stop_time: Passed to the FMU unless it is None, in seconds.
        tolerance: Passed to the FMU unless it is None.
        warm_up_steps: Steps simulated at each reset, inputs at their start values, before the
            first output is read.
        fault_retries: How often a communication step that an FMU discards is repeated, as 2, 4,
            8 ... smaller ones, from the FMU state before it.
        leak_limit: By how many bytes a worker process may grow before it is replaced; None for no
            limit.
        reset_method: How instances start a new episode.
        component_resets: For each component of a system, how it starts a new episode; empty if all
            do by ``reset_method``.
        one_initialization: Whether only one instance in a process may be made, initialized, reset
            or freed at a time. Steps run in parallel all the same.
        max_instances: How many instances of the FMU this process may have at once; None for no
            limit.
        licence_wait: How long to wait for a refused licence, in seconds of real time.
        blind_start: Whether outputs have the start values of the model description until the first
            step, because the FMU cannot be read before.
        solver: The method of integration for FMUs of model exchange, one of ``SOLVERS``.
        max_step: The longest step of the solver, in seconds; None for no limit other than the
            communication step.
        records: Whether the inputs of episodes are kept, because it is not known yet whether the
            FMU's states can be saved; see ``fmugym.pool.saving_pool``.
    """

    inputs: tuple[Variable, ...]
    outputs: tuple[Variable, ...]
    time_step: float
    num_observed: int = 0
    substeps: int = 1
    start_time: float = 0.0
    stop_time: float | None = None
    tolerance: float | None = None
    warm_up_steps: int = 0
    fault_retries: int = 0
    leak_limit: int | None = None
    reset_method: ResetMethod = ResetMethod.RESET
    component_resets: tuple[ResetMethod, ...] = ()
    one_initialization: bool = False
    max_instances: int | None = None
    licence_wait: float = 0.0
    blind_start: bool = False
    records: bool = False
    solver: str = SOLVERS[0]
    max_step: float | None = None

    def communication_point(self, count: int, start_time: float | None = None) -> float:
        """The time after ``count`` communication steps; not a running sum, which would drift.

        Args:
            count: The number of steps.
            start_time: That of the episode; by default that of the spec.
        """
        start = self.start_time if start_time is None else start_time
        return start + count * self.time_step / self.substeps

    @property
    def samplings(self) -> tuple[str, ...]:
        """For each output, one of ``SAMPLINGS``; empty if all are ``"last"``."""
        samplings = tuple(variable.sampling for variable in self.outputs)
        return samplings if {*samplings} - {"last"} else ()

    @property
    def start_outputs(self) -> tuple[float, ...]:
        """The start values of the outputs in the model description; 0 where it has none."""
        return tuple(variable.start_number for variable in self.outputs)

    def fitting(self, description: ModelDescription) -> PoolSpec:
        """The spec for this FMU: one that has no function for resets is instantiated anew.

        Of a system, only the components without this function are.
        """
        if description.has_reset or self.component_resets or self.reset_method not in REUSING:
            return self
        methods = tuple(
            ResetMethod.RESET if part.has_reset else ResetMethod.INSTANCE
            for part in description.components
        )
        return replace(self, reset_method=ResetMethod.INSTANCE, component_resets=methods)

    def beginning_by(self, method: ResetMethod) -> PoolSpec:
        """The spec with another reset method for the whole FMU or system."""
        return replace(self, reset_method=method, component_resets=())

    @property
    def whole_reset_method(self) -> ResetMethod:
        """Reset method of the FMU as a whole: components with methods of their own are reset."""
        return ResetMethod.RESET if self.component_resets else self.reset_method

    @cached_property
    def makes_anew(self) -> bool:
        """Whether resets make instances anew."""
        return any(one not in REUSING for one in (self.reset_method, *self.component_resets))

    @property
    def reloads(self) -> bool:
        """Whether anything is loaded anew, which must be a private copy then."""
        return ResetMethod.LIBRARY in (self.reset_method, *self.component_resets)

    @property
    def communication_step_size(self) -> float:
        """The step size that the FMU sees, in seconds."""
        return self.time_step / self.substeps


def whole_number_of_steps(duration: float, time_step: float) -> int | None:
    """The number of steps in a duration, or None if it is not a whole number."""
    quotient = duration / time_step
    if not math.isfinite(quotient):
        return None
    count = round(quotient)
    return count if math.isclose(count * time_step, duration, abs_tol=1e-9) else None
