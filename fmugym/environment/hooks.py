"""Hooks of an environment: their order, their defaults, and the quantities that they may read.

The order is that of the hooks that are called when the FMU has stepped. Single environments and
batches of environments share it: they differ in what hooks read and return, which is numbers or
arrays. The defaults convert actions to inputs, and outputs to observations.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Container, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, fields
from difflib import get_close_matches
from inspect import signature
from operator import attrgetter
from types import FunctionType
from typing import TYPE_CHECKING, Any, Final, Protocol

import gymnasium
import numpy as np
from gymnasium import spaces

from fmugym.checks import check_mapping
from fmugym.environment import spaces as fmu_spaces
from fmugym.environment.actions import InputWriter, elements_of, no_action
from fmugym.environment.config import EnvConfig
from fmugym.environment.episode import READABLE, Episode, environments_first, read_by
from fmugym.environment.hook_results import as_flag, as_reward, finiteness_of
from fmugym.environment.interface import Interface
from fmugym.environment.value_mappings import NamedValues
from fmugym.errors import ConfigError, SimulationError

if TYPE_CHECKING:
    from fmugym.rendering import Scene

__all__ = [
    "NUMBERS",
    "ORDER",
    "AssignedHook",
    "Conversions",
    "Form",
    "Hooks",
    "Numbers",
    "OwnHooks",
    "call_hooks",
    "is_overridden",
    "misspelt_hooks",
]


@dataclass(frozen=True, slots=True)
class OwnHooks:
    """Methods that an environment has from its class or itself, and not from ``FMUEnv``.

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
    def of(cls, env: Any, expressed: Container[str]) -> OwnHooks:
        """Compare the methods of an environment with the methods of ``FMUEnv``.

        Args:
            env: The environment.
            expressed: The hooks that evaluate an expression, which count as own ones.
        """
        names = [name if name in _METHODS else f"_{name}" for name in map(_name_of, fields(cls))]
        return cls(*[name in expressed or is_overridden(env, name) for name in names])

    def __contains__(self, hook: str) -> bool:
        """Whether the environment has a hook of its own, by the hook's name."""
        return bool(getattr(self, hook.removeprefix("_")))


_METHODS: Final = ("step", "reset")
_name_of: Final = attrgetter("name")


def is_overridden(env: Any, name: str) -> bool:
    """Whether an environment has another method of this name than ``FMUEnv``."""
    found = getattr(env, name)
    return getattr(found, "__func__", found) is not getattr(env._base, name)


ORDER: Final = (
    "_get_inputs",
    "_update",
    "_is_done",
    "_is_truncated",
    "_reward_policy",
    "_get_observation",
    "_get_info",
)
"""The hooks of a step. The FMU steps after the first."""


class Form(Protocol):
    """Conversion of results of hooks to numbers or arrays.

    Each method raises ``ConfigError`` with the name of the hook if a result cannot be used.

    Attributes:
        flag_type: Values of this type are flags already; None for no type.
        reward_type: Values of this type are rewards already; None for no type.
    """

    flag_type: type | None
    reward_type: type | None

    def update(self, env: Hooks) -> None:
        """Call ``_update``."""

    def flags(self, hook: str, value: Any) -> Any:
        """Turn the result of ``_is_done`` or ``_is_truncated`` into Booleans."""

    def rewards(self, value: Any) -> Any:
        """Turn the result of ``_reward_policy`` into rewards, which need not be finite."""


class Numbers:
    """The ``Form`` of a single environment."""

    flag_type: type | None = bool
    reward_type: type | None = float

    @staticmethod
    def update(env: Hooks) -> None:
        """See ``Form.update``."""
        env._update()

    flags = staticmethod(as_flag)
    rewards: Callable[[Any], Any] = staticmethod(as_reward)


NUMBERS: Final = Numbers()
"""All single environments share it, so that it stays in the processor's caches."""


def call_hooks(
    env: Hooks, form: Form, stopped: Any, cut_off: Any, observed: Any
) -> tuple[Any, ...]:
    """Ask the hooks for the result of a step.

    Args:
        env: The environment; its attributes hold what hooks read after the step.
        form: What the results become.
        stopped: Whether the FMU has asked to stop; False if none of them has.
        cut_off: Whether the limit of steps is reached.
        observed: The observation if it is there already; None for that of the hook.

    Returns:
        The observation as the hook returned it, the reward, terminated and truncated.
    """
    own = env._own_hooks
    if own.update:
        form.update(env)
    done = env._is_done()
    if type(done) is not form.flag_type:
        done = form.flags("_is_done", done)
    if stopped is not False:
        done = done | stopped
    env._episode.done = done
    if own.is_truncated:
        cut_off = form.flags("_is_truncated", env._is_truncated()) | cut_off
    if observed is None:
        reward, observed = env._reward_and_observation()
    else:
        reward = env._reward_policy()
    if type(reward) is not form.reward_type:
        reward = form.rewards(reward)
    return observed, reward, done, cut_off


@dataclass
class Conversions:
    """The conversions of an environment: of actions to inputs, and of outputs to observations.

    Attributes:
        elements: The integers that are actions; None for other spaces.
        action_values: The values of the input for these, if they are others.
        no_action: The action of an episode that begins.
        input_writer: Checks inputs and writes them.
        observe: Makes the default observation from the outputs.
        pool_observes: Whether the pool makes the observation.
        is_finite: Whether all numbers of an observation are finite.
        has_info: Whether a step has an info.
    """

    elements: Collection[int] | None
    action_values: Sequence[int] | None
    no_action: Any
    input_writer: InputWriter
    observe: Callable[[Any], Any]
    pool_observes: bool
    is_finite: Callable[[Any], bool]
    has_info: bool

    @classmethod
    def of(
        cls,
        interface: Interface,
        action_space: spaces.Space[Any],
        observation_space: spaces.Space[Any],
        own: OwnHooks,
        *,
        tells: bool,
    ) -> Conversions:
        """Prepare the conversions of an environment.

        Args:
            interface: The variables of the config.
            action_space: That of the environment.
            observation_space: That of the environment.
            own: The hooks of its class.
            tells: Whether the pool adds to infos.

        Raises:
            ConfigError: If the elements of the action are not those of an Enumeration.
        """
        default = not own.get_observation
        make = fmu_spaces.default_observation if default else fmu_spaces.outputs_observation
        if own.get_action_space and not own.get_inputs:
            fmu_spaces.check_choices(interface.inputs, action_space)
        is_float32 = (
            isinstance(observation_space, spaces.Box) and observation_space.dtype == np.float32
        )
        return cls(
            # A class with its own step may take other actions.
            elements=None if own.step else elements_of(action_space),
            action_values=None
            if own.get_action_space
            else fmu_spaces.discrete_values(interface.chosen_inputs),
            no_action=no_action(action_space),
            input_writer=InputWriter(interface.inputs),
            observe=make(interface, observation_space),
            pool_observes=default and is_float32,
            is_finite=finiteness_of(observation_space),
            has_info=own.get_info or tells,
        )


_ALIKE: Final = 0.85
"""How alike the names of a method and of a hook are if one is meant to be the other."""


def misspelt_hooks(cls: type[Any], base: type[Any]) -> dict[str, str]:
    """Find methods that are probably meant to be hooks, which a class does not have.

    Args:
        cls: The class of an environment.
        base: ``FMUEnv``.

    Returns:
        The hooks by the names of the methods. They take the same number of arguments.
    """
    inherited = {name: getattr(cls, name) for name in vars(Hooks) if name.startswith("_")}
    hooks = {
        name.strip("_"): (name, len(signature(method).parameters))
        for name, method in inherited.items()
        if isinstance(method, FunctionType) and method is getattr(base, name)
    }
    added = [vars(owner) for owner in cls.__mro__ if owner not in base.__mro__]
    methods = {n: m for names in added for n, m in names.items() if isinstance(m, FunctionType)}
    found = {}
    for name in sorted(methods.keys() - set(dir(base))):
        near = get_close_matches(name.strip("_"), hooks, n=1, cutoff=_ALIKE)
        if near and hooks[near[0]][1] == len(signature(methods[name]).parameters):
            found[name] = hooks[near[0]][0]
    return found


def _with_copied_goals(observation: Any) -> Any:
    if type(observation) is not dict:
        return observation
    names = [name for name in ("achieved_goal", "desired_goal") if name in observation]
    return observation | {name: copy(observation[name]) for name in names}


class AssignedHook:
    """Hook of one environment, which the package assigns to it, whatever its class.

    Args:
        call: Does what the hook does.
    """

    def __init__(self, call: Callable[[], Any]) -> None:
        self._call = call

    def __call__(self) -> Any:
        """Call the hook."""
        return self._call()


class Hooks(gymnasium.Env[Any, Any]):
    """Hooks with their defaults; a subclass of ``FMUEnv`` overrides those of its task.

    ``FMUEnv`` lists what the hooks may read.
    """

    config: EnvConfig

    # The quantities of an episode, which are made of the table of quantities below.
    state: Any
    previous_state: Any
    out: NamedValues
    inputs: Any
    action: Any
    previous_action: Any
    step_count: Any
    done: Any
    after_end: Any
    parameters: Mapping[str, Any]
    variables: dict[str, Any]

    interface: Interface
    _episode: Episode
    _own_hooks: OwnHooks
    _conversions: Conversions
    _expressed: Mapping[str, Callable[[Any], Any]]

    # In the order of a step.

    def _get_inputs(self) -> Any:
        """Turn ``self.action`` into the values of the inputs, in the order of the config.

        Returns:
            One number for each input. By default, these are the values of ``inputs`` of the config
            and the elements of the action. For a ``Discrete`` made from an Enumeration or Integer,
            it is the value of the element.
        """
        evaluate = self._expressed.get("_get_inputs")
        if evaluate is not None:
            return evaluate(self)
        values = self._conversions.action_values
        if values is None:
            return self.action
        if isinstance(values, range):  # the range of an Integer, which may be wide
            return values[0] + self.action
        return np.take(values, self.action)

    def _update(self) -> None:
        """Update integrators and filters of the task; called once after each step of the FMU.

        By default, the expressions of ``memory`` do so.
        """
        evaluate = self._expressed.get("_update")
        if evaluate is not None:
            evaluate(self)

    def _is_done(self) -> Any:
        """Whether the task has ended in success or failure; becomes ``terminated``.

        By default, ``terminated`` of the config says so.
        """
        evaluate = self._expressed.get("_is_done")
        return False if evaluate is None else evaluate(self)

    def _is_truncated(self) -> Any:
        """Whether to cut the episode short for a reason outside the task.

        By default, ``truncated`` of the config says so.
        """
        evaluate = self._expressed.get("_is_truncated")
        return False if evaluate is None else evaluate(self)

    def _reward_policy(self) -> Any:
        """The reward of this step.

        Returns:
            By default ``reward`` of the config; without one, ``negative_reward`` where the task has
            ended and ``positive_reward`` otherwise. For a goal task, ``_goal_reward`` of this
            observation.
        """
        evaluate = self._expressed.get("_reward_policy")
        if evaluate is not None:
            return evaluate(self)
        positive, negative = self.config.positive_reward, self.config.negative_reward
        if self._own_hooks.goal_reward:
            return self._reward_for_goals(self._get_observation())
        if isinstance(self.done, bool):
            return negative if self.done else positive
        return np.where(self.done, negative, positive)

    def _reward_for_goals(self, observation: Mapping[str, Any]) -> Any:
        """Call ``_goal_reward`` as ``compute_reward`` does, with environments on the first axis."""
        try:
            achieved, desired = observation["achieved_goal"], observation["desired_goal"]
        except (KeyError, TypeError, IndexError):
            raise ConfigError(
                "_get_observation of a goal task must return a dict with 'achieved_goal' and "
                "'desired_goal'"
            ) from None
        if not isinstance(self.done, bool):
            achieved, desired = environments_first(achieved), environments_first(desired)
        return self._goal_reward(achieved, desired)

    def _reward_and_observation(self) -> tuple[Any, Any]:
        """Ask the hooks for both, and for the observation once.

        ``_goal_reward`` gets copies: what it does to them must not change the observation.
        """
        if self._own_hooks.reward_policy or not self._own_hooks.goal_reward:
            reward = self._reward_policy()
            return reward, self._get_observation()
        observation = self._get_observation()
        return self._reward_for_goals(_with_copied_goals(observation)), observation

    def _fault_reward(self) -> Any:
        """The reward of a step that failed; by default ``fault_reward`` of the config.

        It is called in the state before that step.
        """
        return self.config.fault_reward

    def _get_observation(self) -> Any:
        """The observation, a new array (or dict of new arrays).

        Returns:
            By default, ``observations`` of the config; without them, the outputs in the type of the
            observation space. If they do not fit that space (an overriding hook may add elements),
            in the type of their default space.
        """
        evaluate = self._expressed.get("_get_observation")
        if evaluate is not None:
            elements = np.broadcast_arrays(*evaluate(self))
            return np.array(elements, dtype=self.observation_space.dtype)
        return self._conversions.observe(self.state)

    def _get_info(self) -> dict[str, Any]:
        """Additional facts about this step by name, as a new dict.

        By default, those of ``reward`` with names, ``costs`` and ``info`` of the config.
        """
        evaluate = self._expressed.get("_get_info")
        return {} if evaluate is None else dict(evaluate(self))

    # Called once, at construction.

    def _get_action_space(self) -> spaces.Space[Any]:
        """The action space; by default made from the inputs' types, min and max."""
        return fmu_spaces.action_space(self.interface)

    def _get_observation_space(self) -> spaces.Space[Any]:
        """The observation space; by default made from the outputs' types, min and max."""
        return fmu_spaces.observation_space(self.interface)

    # For some tasks only.

    def _goal_reward(self, achieved_goal: Any, desired_goal: Any) -> Any:
        """The element-wise reward for reaching ``achieved_goal`` when ``desired_goal`` was wanted.

        Override it for a goal task, whose observations are dicts with ``achieved_goal`` and
        ``desired_goal``. The default reward and ``compute_reward`` then call it.
        """
        raise SimulationError(f"{type(self).__name__} is no goal task: it has no _goal_reward")

    def _explain(self, reward: float) -> str:
        """Say where a reward that is not finite comes from."""
        if "_reward_policy" in self._expressed:
            texts = [repr(term["expr"].text) for term in self.config.reward_terms.values()]
            return f"the reward {' + '.join(texts)} is {reward}"
        return f"_reward_policy returned {reward}"

    def _get_episode_parameters(self, options: Mapping[str, Any]) -> Mapping[str, Any]:
        """The parameters that the options of ``reset`` override for one episode, by name."""
        return check_mapping("option 'model_parameters'", options.get("model_parameters", {}))

    # For pictures.

    def _get_scene(self) -> Scene[Any]:
        """The scene that ``render`` draws; see ``fmugym.rendering``. Called once."""
        raise SimulationError(f"{type(self).__name__} has render modes, but no _get_scene")

    def _get_frame(self) -> Any:
        """The data that the scene needs to draw the current state; by default ``out``."""
        return self.out

    def _describe_action(self) -> str:
        """The text that shows the action in the picture."""
        return ", ".join(f"{value:+.3g}" for value in self.inputs)


for _name in READABLE:
    setattr(Hooks, _name, read_by(_name))
