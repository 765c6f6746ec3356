"""What the other rooms of the package need of an environment."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import numpy.typing as npt

from fmugym.pool import PoolSpec
from fmugym.task.episode import EpisodePlan
from fmugym.task.inputs import InputWriter
from fmugym.task.interface import Interface
from fmugym.task.opening import PoolOpening
from fmugym.task.readings import Readings
from fmugym.task.warm_up import WarmUps

__all__ = ["Inside", "OwnHooks"]


@dataclass(frozen=True, slots=True)
class OwnHooks:
    """Which methods an environment does not have from ``FMUEnv``, but from its class or itself.

    A hook may also be an attribute of the environment, such as a function.
    """

    step: bool
    reset: bool
    update: bool
    is_truncated: bool
    get_observation: bool
    get_info: bool
    goal_reward: bool
    reward_policy: bool
    get_action_space: bool

    @classmethod
    def of(cls, env: Any, base: type[Any]) -> OwnHooks:
        """Compare the methods of an environment with those of its base class ``FMUEnv``."""
        return cls(*[_is_own(env, base, field.name) for field in fields(cls)])

    def __contains__(self, hook: str) -> bool:
        """Whether the environment has a hook of its own, by the hook's name."""
        return bool(getattr(self, hook.removeprefix("_")))


def _is_own(env: Any, base: type[Any], name: str) -> bool:
    name = name if name in {"step", "reset"} else f"_{name}"
    found = getattr(env, name)
    return getattr(found, "__func__", found) is not getattr(base, name)


class Inside:
    """What the other rooms of the package need of an environment: its attribute ``inside``.

    An environment in a batch has the fields of its class, and those of the batch where hooks read.

    Attributes:
        interface: The variables of the config, as the FMU has them.
        spec: What the pool does at each reset and step.
        opening: Opens pools.
        plan: What is drawn for an episode.
        own: The hooks that the class has itself.
        readings: What hooks read now.
        in_hooks: Whether hooks are being called, which must not draw random numbers.
        was_reset, ended: Whether there was an episode, and whether there is none that goes on.
        output_count: The number of outputs, without monitored variables.
        no_monitors: Whether there are none of these.
        start_inputs: The names and start values of the inputs.
        input_writer: Checks inputs and writes them.
        no_action: What counts as the action of an episode that begins.
        elements: The integers that are actions; None for other spaces.
        action_values: The values of the input for these, if they are others.
        step_limit: The number of steps after which an episode is truncated.
        warm_ups: What happens in warm-ups with moving inputs, or None.
        warm_up_steps: The steps of a warm-up.
        has_info: Whether a step has an info.
        pool_tells: Whether the pool adds to it.
        pool_observes: Whether the pool makes the observation.
        observe: Makes the default observation from the outputs.
        observation_row: The pool's observation of this environment.
        is_finite: Whether all numbers of an observation are finite.
    """

    __slots__ = (
        *("action_values", "elements", "ended", "has_info", "in_hooks", "input_writer"),
        *("interface", "is_finite", "no_action", "no_monitors", "observation_row", "observe"),
        *("opening", "output_count", "own", "plan", "pool_observes", "pool_tells", "readings"),
        *("spec", "start_inputs", "step_limit", "warm_up_steps", "warm_ups", "was_reset"),
    )

    action_values: Sequence[int] | None
    elements: Any
    ended: bool
    has_info: bool
    in_hooks: bool
    input_writer: InputWriter
    interface: Interface
    is_finite: Callable[[Any], bool]
    no_action: Any
    no_monitors: bool
    observation_row: npt.NDArray[np.float32]
    observe: Callable[[Any], Any]
    opening: PoolOpening
    output_count: int
    own: OwnHooks
    plan: EpisodePlan
    pool_observes: bool
    pool_tells: bool
    readings: Readings
    spec: PoolSpec
    start_inputs: list[tuple[str, float]]
    step_limit: int
    warm_up_steps: int
    warm_ups: WarmUps | None
    was_reset: bool

    def __init__(self) -> None:
        self.pool_tells, self.warm_ups = False, None
