"""What the other rooms of the package need of an environment."""

from __future__ import annotations

from collections.abc import Callable, Container, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, fields
from operator import attrgetter
from threading import RLock
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import numpy.typing as npt

from fmugym.expressions.formulas import Formulas
from fmugym.pool import Pool, PoolSpec
from fmugym.pool.base import FloatArray
from fmugym.task.episode import EpisodeDraws
from fmugym.task.future import Future
from fmugym.task.input_writer import InputWriter
from fmugym.task.interface import Interface
from fmugym.task.readings import NoReadings, Readings
from fmugym.task.warm_up import WarmUps

if TYPE_CHECKING:
    from fmugym.rendering import Renderer

__all__ = ["Inside", "OwnHooks", "is_overridden"]


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
    get_inputs: bool

    @classmethod
    def of(cls, env: Any, base: type[Any], expressed: Container[str]) -> OwnHooks:
        """Compare the methods of an environment with those of its base class ``FMUEnv``.

        Args:
            env: The environment.
            base: The class.
            expressed: The hooks that evaluate an expression, which count as own ones.
        """
        names = [name if name in _METHODS else f"_{name}" for name in map(_name_of, fields(cls))]
        return cls(*[name in expressed or is_overridden(env, base, name) for name in names])

    def __contains__(self, hook: str) -> bool:
        """Whether the environment has a hook of its own, by the hook's name."""
        return bool(getattr(self, hook.removeprefix("_")))


_METHODS: Final = ("step", "reset")
_name_of: Final = attrgetter("name")


def is_overridden(env: Any, base: type[Any], name: str) -> bool:
    """Whether an environment has another method of this name than its base class."""
    found = getattr(env, name)
    return getattr(found, "__func__", found) is not getattr(base, name)


@dataclass(init=False, repr=False, eq=False, slots=True)
class Inside:
    """What the other rooms of the package need of an environment: its attribute ``inside``.

    An environment in a batch has the fields of its class, and those of the batch where hooks read.

    Attributes:
        number: Tells which environments are newer.
        base: ``FMUEnv``, with whose methods those of an environment are compared.
        own_names: The attributes that are not a subclass's own.
        as_constructed: The plain attributes of a subclass when its hooks were prepared.
        interface: The variables of the config, as the FMU has them.
        spec: What the pool does at each reset and step.
        backend, isolation: Those of the constructor, for the pool.
        pool: The open pool: of one, or of N if a vector environment steps it.
        step_pool, halt, input_row, output_row: Parts of the pool that each step needs.
        observation_row: The pool's observation of this environment.
        pool_tells: Whether the pool adds to the info of a step.
        compiled_step: The step by programs, if the hooks are expressions and a native pool steps
            the FMU; or None.
        has_compiled: Whether it is known if there is such a step.
        draws: What is drawn for an episode.
        quantities: Lists what a declared task has names for; None for other tasks.
        formulas: What the task computes, as far as expressions say it; None without expressions.
        expressed: By name, the functions of the environment that evaluate these formulas; the
            defaults of hooks call them.
        future: What a declared task reads of the future; None for other tasks.
        controllers: Makes the simple controllers of a declared task; None for other tasks.
        model: Makes an environment to plan with, where a plant stands in for the FMU; or None.
        held: Returns the outputs that a plant has not told now, whose last values go on.
        own: The hooks that the class has itself.
        readings: What hooks read now.
        standing_in: Held while other values stand in for those that hooks read: threads that do so
            at once would put back each other's.
        is_closed: Whether the environment is.
        was_reset, ended: Whether there was an episode, and whether there is none that goes on.
        output_count: The number of outputs, without monitored variables.
        no_monitors: Whether there are none of these.
        start_inputs: The names and start values of the inputs.
        input_writer: Checks inputs and writes them.
        no_action: What counts as the action of an episode that begins.
        elements: The integers that are actions; None for other spaces.
        action_values: The values of the input for these, if they are others.
        step_limit: The number of steps after which an episode is truncated.
        variable_starts: By name, what episode variables start with in the place of what the config
            says.
        warm_ups: What happens in warm-ups with moving inputs, or None.
        warm_up_steps: The steps of a warm-up.
        has_info: Whether a step has an info.
        pool_observes: Whether the pool makes the observation.
        observe: Makes the default observation from the outputs.
        is_finite: Whether all numbers of an observation are finite.
        scope: What snapshots of it fit; None until there is one, see ``scope_of``.
        renderer: Draws the pictures, once there are any.
        pictured: The reward and the return that a picture shows.
    """

    action_values: Sequence[int] | None
    as_constructed: dict[str, Any]
    base: type
    compiled_step: Any
    elements: Any
    ended: bool
    expressed: Mapping[str, Callable[[Any], Any]]
    formulas: Formulas | None
    future: Future | None
    controllers: Callable[[], list[Any]] | None
    model: Callable[[], Any] | None
    held: Callable[[], Sequence[str]]
    halt: Callable[[], None]
    has_compiled: bool
    has_info: bool
    input_row: FloatArray
    input_writer: InputWriter
    interface: Interface
    is_closed: bool
    is_finite: Callable[[Any], bool]
    no_action: Any
    no_monitors: bool
    number: int
    observation_row: npt.NDArray[np.float32]
    observe: Callable[[Any], Any]
    backend: Any
    isolation: str | None
    output_count: int
    output_row: FloatArray
    own: OwnHooks
    own_names: frozenset[str]
    pictured: tuple[float | None, float]
    draws: EpisodeDraws
    pool: Pool
    pool_observes: bool
    pool_tells: bool
    quantities: Callable[[], Any] | None
    readings: Readings
    renderer: Renderer[Any] | None
    scope: dict[str, str] | None
    spec: PoolSpec
    standing_in: AbstractContextManager[Any]
    start_inputs: list[tuple[str, float]]
    step_limit: int
    step_pool: Callable[[], int]
    variable_starts: dict[str, Any]
    warm_up_steps: int
    warm_ups: WarmUps | None
    was_reset: bool

    def __init__(self, number: int) -> None:
        self.number, self.own_names = number, frozenset()
        self.pool_tells = self.has_info = self.has_compiled = False
        self.was_reset = self.is_closed = False
        self.standing_in = RLock()
        self.ended = True
        self.warm_ups = self.compiled_step = self.quantities = self.renderer = self.scope = None
        self.formulas, self.expressed, self.variable_starts = None, {}, {}
        self.future = self.controllers = self.model = None
        self.held = lambda: ()
        self.pictured = None, 0.0
        self.readings = NoReadings()  # type: ignore[assignment]  # until there are any

    @property
    def is_open(self) -> bool:
        """Whether there is an open pool."""
        return hasattr(self, "pool")

    def use(self, pool: Pool) -> None:
        """Let a pool of one step the environment, or one of N if a vector environment does it."""
        self.pool = pool
        self.step_pool, self.halt = pool.step_own, pool.halt
        self.input_row, self.output_row = pool.inputs[:, 0], pool.outputs[:, 0]
        self.observation_row = pool.observations[0]
        self.pool_tells = bool(pool.info())
        self.has_info = self.has_info or self.pool_tells

    def close_pool(self) -> None:
        """Close the pool, if one is open; hooks then read what the latest step has left."""
        if self.is_open:
            self.readings, self.ended = self.readings.copy(), True
            self.compiled_step, self.has_compiled = None, False
            self.pool.close()
            del self.pool
