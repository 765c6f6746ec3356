"""The environment: episodes around a pool of one FMU instance."""

from __future__ import annotations

import logging
import os
import sys
from collections.abc import Callable, Mapping
from math import floor, hypot, isfinite, nan
from types import MappingProxyType
from typing import Any, ClassVar, Final, Never, cast

import numpy as np
from gymnasium import logger as gymnasium_logger
from gymnasium import spaces

from fmugym.checks import check_mapping, check_seed
from fmugym.config import EnvConfig
from fmugym.distributions import as_distribution
from fmugym.errors import (
    ConfigError,
    FMUGymError,
    SimulationError,
    shown,
    unknown_argument,
    unknown_name,
)
from fmugym.fmi.status import Status
from fmugym.pool import Pool, PoolSpec
from fmugym.pool.health import fault_rates
from fmugym.pool.patience import failed_reset
from fmugym.task import spaces as fmu_spaces
from fmugym.task.actions import (
    elements_of,
    flat_inputs,
    has_nan,
    is_element,
    is_misfit,
    no_action,
)
from fmugym.task.episode import Episode, EpisodePlan
from fmugym.task.hooks import OwnHooks
from fmugym.task.interface import checked, output_variable, resolve, start_variable
from fmugym.task.opening import PoolOpening, env_numbers, open_fmu, pools_are_deferred
from fmugym.task.pictures import Pictured
from fmugym.task.results import (
    FLOAT32_LIMIT,
    as_flag,
    as_info,
    as_reward,
    finiteness_of,
)
from fmugym.task.values import EpisodeVariables, NamedValues

__all__ = ["FMI1CSEnv", "FMI2CSEnv", "FMI3CSEnv", "FMUEnv"]

_WARNING: Final = int(Status.WARNING)
_TERMINATED: Final = int(Status.TERMINATED)
_ARGUMENTS: Final = ("fmu_path", "config", "log_level", "render_mode", "backend", "isolation")
_FASTEST_FPS: Final = 1_000_000
_FLOATS: Final = frozenset({float, np.float64})


class FMUEnv(Pictured):
    """A co-simulation FMU as a Gymnasium environment.

    A class for your own FMU derives from ``FMI1CSEnv``, ``FMI2CSEnv`` or ``FMI3CSEnv`` and supplies
    ``_is_done``; every other hook of ``fmugym.task.hooks.Hooks`` has a default. A step calls the
    hooks once each, in the order in which they stand there. All but ``_get_inputs`` and ``_update``
    must be free of side effects. None may draw random numbers; random values are distributions in
    the config.

    A hook that returns something unusable raises ``ConfigError`` with the hook's name. A reward or
    an observation that is not finite is a fault of the episode, like a failure of the FMU.

    An exception that a hook raises reaches the caller of ``step`` unchanged. If the FMU has stepped
    already, the episode is over, and ``reset`` must follow. An exception of ``_get_inputs`` leaves
    the episode as it was; it becomes a ``ConfigError`` if it comes from an action that is not in
    the action space.

    Args:
        fmu_path: The FMU; a relative path is relative to the file of the class.
        config: See ``EnvConfig``.
        log_level: Level of this class's logger, which gets the FMU's messages.
        render_mode: One of the class's ``metadata["render_modes"]``, or None. For another mode of
            Gymnasium there is a warning, and no pictures.
        backend: What stands in for the FMU, which then only describes the variables: an object
            with ``reset``, ``step`` and ``stop`` (``fmugym.Backend``), or ``fmugym.Paced`` around
            it. Or the name of a way to step the FMU, see ``fmugym.trial.opening.make_pool``.
        isolation: Where the FMU runs; by default where the config says.

    Attributes:
        fmu: The FMU; ``fmu.description`` is its model description.
        config: The checked config.
        state: The outputs in the order of the config, floats.
        out: The outputs and the monitored variables by name, a read-only mapping.
        action: The action of this step as it was given; zeros after a reset.
        inputs: The FMU's inputs in this step, floats.
        previous_state: ``state`` before this step.
        previous_action: The action of the step before; zeros in the first.
        step_count: Steps since the reset.
        done: What ``_is_done`` returned in this step.
        after_end: Whether this step began after the end of the episode.
        parameters: The parameters of this episode by name.
        variables: The episode variables by name; ``_update`` may write them.
        logger: The logger of the class.

    Raises:
        ConfigError: If an argument does not fit, or the config does not fit the FMU.
        ArgumentError: If there is no argument of this name; that is a ``TypeError``, too.
        FMULoadError: If the FMU cannot be used on this machine.
    """

    fmi_version: ClassVar[int | None] = None
    """The FMI version that the FMU must have; None for any."""

    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012  (Gymnasium's own form)

    steps_after_end: ClassVar[bool] = False
    """Whether ``step`` may go on after the end of an episode, as some of Gymnasium's own do."""

    reset_options: ClassVar[tuple[str, ...]] = ("model_parameters",)
    """The keys that ``reset`` takes in its options."""

    _values: Any
    _number: int
    _constructor_arguments: tuple[tuple[Any, ...], dict[str, Any]]

    _has_info: bool
    _pool_tells = False
    _pool: Pool | None = None
    _is_closed = False

    def __new__(cls, *args: Any, **kwargs: Any) -> FMUEnv:
        """Keep the arguments, because an environment pickles as its class and arguments.

        The number tells a vector environment which environments are new.
        """
        env = super().__new__(cls)
        env._constructor_arguments = args, kwargs
        env._number = next(env_numbers)
        return env

    def __init__(
        self,
        fmu_path: str | os.PathLike[str],
        config: Mapping[str, Any] | EnvConfig,
        log_level: int = logging.WARNING,
        *,
        render_mode: str | None = None,
        backend: Any = None,
        isolation: str | None = None,
        **unknown: Never,
    ) -> None:
        for name in unknown:
            raise unknown_argument(type(self).__name__, name, _ARGUMENTS)
        self.logger = logging.getLogger(f"fmugym.{type(self).__name__}")
        _set_level(self.logger, log_level)
        self.config = EnvConfig.from_dict(config)
        self.render_mode = self._checked_render_mode(render_mode)
        self.fmu = open_fmu(type(self), fmu_path, self.config)
        self._require_fmi_version()
        self._interface = resolve(self.config, self.fmu.description)
        self._spec = self._interface.pool_spec()
        self._warn_of_peculiarities()
        self._prepare_values()
        self._prepare_episodes()
        self._prepare_spaces()
        self._prepare_hooks()
        self._opening = PoolOpening(
            self.fmu, self._spec, self.config, self._plan, self.logger, backend, isolation
        )
        if not pools_are_deferred():
            self._use(self._opening.open())

    def _use(self, pool: Pool) -> None:
        """Let a pool of one step this environment, or one of N if a vector environment does it."""
        self._pool = pool
        self._step_pool, self._halt = pool.step_own, pool.halt
        self._input_row, self._output_row = pool.inputs[:, 0], pool.outputs[:, 0]
        self._observation_row = pool.observations[0]
        self._pool_tells = bool(pool.info())
        self._has_info = self._has_info or self._pool_tells

    @property
    def reset_method(self) -> str:
        """How episodes begin; see ``EnvConfig``."""
        return str(self._open_pool("reset_method").reset_method)

    def _require_fmi_version(self) -> None:
        found = self.fmu.description.fmi_major_version
        if self.fmi_version is not None and found != self.fmi_version:
            raise ConfigError(
                f"{type(self).__name__} is made for FMI {self.fmi_version}.0, but "
                f"{self.fmu.path.name} is an FMU of FMI {self.fmu.description.fmi_version}; "
                f"derive from FMI{found}CSEnv instead"
            )

    def _warn_of_peculiarities(self) -> None:
        internal = self.fmu.description.fixed_internal_step_size
        if internal is not None and self._spec.communication_step_size < 0.999999 * internal:
            self.logger.warning(
                "the communication step of %g s is smaller than the internal step of %g s of %s: "
                "some of the steps will do nothing",
                self._spec.communication_step_size,
                internal,
                self.fmu.path.name,
            )
        if self.fmu.description.capabilities.needs_execution_tool:
            self.logger.warning("%s needs the tool that exported it to run", self.fmu.path.name)

    def _prepare_values(self) -> None:
        """Set what hooks may read to what it is before the first reset."""
        interface = self._interface
        names = [variable.name for variable in interface.outputs + interface.monitors]
        fps = min(1 / interface.time_step, _FASTEST_FPS)
        self.metadata = {**self.metadata, "render_fps": max(1, round(fps))}
        self._output_count = len(interface.outputs)
        self._no_monitors = not interface.monitors
        self._values = (nan,) * len(names)
        self.out = NamedValues("output", names, lambda: self._values)
        self.state = self._values[: self._output_count]
        self.previous_state = self.state
        self._start_inputs = [(v.name, v.start_number) for v in interface.inputs]
        self.inputs = tuple(start for _, start in self._start_inputs)
        self.action = None
        self.previous_action = None
        self.parameters: Mapping[str, Any] = MappingProxyType({})
        self.variables = EpisodeVariables(self.config.episode_variables)
        self.step_count = 0
        self.done = False
        self.after_end = False

    def _prepare_episodes(self) -> None:
        self._plan = self._plan_episode({})
        self._step_limit = _step_limit(self.config, self._spec)
        self._ended = True
        self._in_hooks = False
        self._was_reset = False

    def _prepare_spaces(self) -> None:
        self.action_space = self._get_action_space()
        self.observation_space = self._get_observation_space()
        for name, space in (("action", self.action_space), ("observation", self.observation_space)):
            if not isinstance(space, spaces.Space):
                raise ConfigError(
                    f"{type(self).__name__}._get_{name}_space returned {shown(space)}, "
                    "expected a gymnasium.spaces.Space"
                )
        self._no_action = no_action(self.action_space)

    def _prepare_hooks(self) -> None:
        """Find out which hooks the class overrides, and prepare the defaults of the others."""
        interface, space = self._interface, self.observation_space
        self._own = own = OwnHooks.of(self, FMUEnv)
        # A subclass with its own step may take other actions.
        self._elements = None if own.step else elements_of(self.action_space)
        derived = not own.get_action_space
        values = fmu_spaces.discrete_values(interface, interface.inputs) if derived else None
        self._action_values = values
        default = not own.get_observation
        make = fmu_spaces.default_observation if default else fmu_spaces.outputs_observation
        self._observe = make(interface, space)
        self._is_finite = finiteness_of(space)
        # The pool writes this observation in the pass that steps the FMU.
        self._pool_observes = (
            default and isinstance(space, spaces.Box) and space.dtype == np.float32
        )
        self._has_info = own.get_info or self._pool_tells
        self._real_inputs = all(v.kind == "real" for v in interface.inputs)
        self._takes_one_real = [v.kind for v in interface.inputs] == ["real"]

    # Gymnasium's interface.

    def reset(
        self, *, seed: int | None = None, options: Mapping[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Start a new episode with the FMU instance at hand.

        Random values are drawn from this environment's own generator: first the parameters in the
        order of the config, then those that only the options have, then the episode variables.

        Args:
            seed: Seeds the generator, an integer of at least 0; None goes on with the generator.
            options: ``{"model_parameters": {name: value or distribution}}`` overrides parameters
                for this episode; an environment may take more, see its ``reset_options``.

        Returns:
            The first observation, and the info with the values that were drawn or overridden
            under ``"drawn"``.

        Raises:
            ConfigError: If the seed or an option does not fit. The episode then goes on.
            SimulationError: If the FMU cannot be initialized, the first observation is not finite,
                or the environment is closed.
        """
        pool = self._open_pool("reset")
        if not self._was_reset:
            self._prepare_hooks()  # the constructor of the class may have set some as attributes
        seed, plan = check_seed(seed), self._plan_of_reset(options)
        super().reset(seed=seed)
        episode = plan.draw(self.np_random)
        self._ended = True  # there is no episode if the FMU fails
        try:
            pool.reset(plan.model_variables, episode.start_values)
            if pool.statuses.item(0) > Status.WARNING:
                raise failed_reset(pool.failure(0))
            self._begin_episode(episode)
            observation, info = self._observation_and_info()
        except BaseException:
            self._ended = True
            self._halt()
            raise
        info["drawn"] = episode.drawn
        if self.render_mode == "human":
            self.render()
        return observation, info

    def _plan_of_reset(self, options: Mapping[str, Any] | None) -> EpisodePlan:
        if options is None:
            return self._plan
        options = check_mapping("the options of reset", options)
        for name in options:
            if name not in self.reset_options:
                raise unknown_name("reset option", name, self.reset_options)
        if not options:
            return self._plan
        parameters = self._get_episode_parameters(options)
        return self._plan_episode(
            check_mapping("what _get_episode_parameters returned", parameters)
        )

    def _plan_episode(self, overrides: Mapping[str, Any]) -> EpisodePlan:
        """Prepare the draws of episodes in which these parameters replace the config's."""
        parameters = dict(self._interface.parameters)
        for name, value in overrides.items():
            value = as_distribution(repr(name), value)
            variable = start_variable(self.fmu.description, name, value)
            if not variable.numeric:
                raise ConfigError(f"{name!r} is a String: it can be set in the config only")
            parameters[name] = checked(variable, value)
        return EpisodePlan(
            tuple(map(self.fmu.variable, parameters)),
            parameters,
            self.config.episode_variables,
            overrides.keys(),
        )

    def _begin_episode(self, episode: Episode) -> None:
        self.parameters = episode.parameters
        self.variables.update(episode.variables)
        self.step_count = 0
        self.action = self.previous_action = self._no_action
        self.inputs = tuple(self.parameters.get(n, start) for n, start in self._start_inputs)
        self.done = self.after_end = False
        self._set_values()
        self.previous_state = self.state
        self._last_reward, self._return = None, 0.0
        self._was_reset, self._ended = True, False

    def _set_values(self) -> None:
        """Give hooks the pool's outputs as Python floats, which are faster than numpy's."""
        self._values = values = tuple(self._output_row.tolist())
        self.state = values if self._no_monitors else values[: self._output_count]

    def _observation_and_info(self) -> tuple[Any, dict[str, Any]]:
        self._in_hooks = True
        try:
            observation = self._get_observation()
            if not self._is_finite(observation):
                raise SimulationError(f"the first observation is not finite: {shown(observation)}")
            return observation, self._info()
        finally:
            self._in_hooks = False

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Write the action to the FMU, simulate one time step and evaluate the hooks.

        Args:
            action: An element of the action space, or what ``_get_inputs`` can make use of; no
                number in it may be NaN.

        Returns:
            Observation, reward, terminated, truncated, info. After a fault the observation is the
            last good one. The info then has ``"fault"``, the reason, and ``"fault_rate"``, the part
            of the episodes until now that ended by a fault.

        Raises:
            ConfigError: If the action does not fit the inputs or is not finite, or a hook returns
                something unusable.
            SimulationError: Before the first reset, after the end of an episode, after ``close``,
                and, with ``on_fault="raise"``, after a fault.
        """
        pool = self._pool
        if pool is None or self._ended:
            pool = self._checked_before_step()
        self._in_hooks = True
        try:
            self._take_action(action)
            try:
                troubled = self._step_pool()
                self.step_count += 1
                result = self._evaluate(pool, pool.statuses.item(0) if troubled else 0)
            except BaseException:  # the FMU has moved, so that the step cannot be tried again
                self._ended = True
                raise
        except BaseException:  # a real system must not go on without its controller
            self._halt()
            raise
        finally:
            self._in_hooks = False
        if self.render_mode is not None:
            self._note_for_picture(result[1])
        return result

    def _checked_before_step(self) -> Pool:
        pool = self._open_pool("step")
        if not self._was_reset:
            raise SimulationError("step was called before the first reset")
        if not self.steps_after_end:
            raise SimulationError("step was called after the end of the episode; call reset first")
        if not self.after_end:
            gymnasium_logger.warn("step was called after the end of the episode; call reset first")
        return pool

    def _open_pool(self, method: str) -> Pool:
        if self._pool is None:
            if self._is_closed:
                raise SimulationError(f"{method} was called on a closed {type(self).__name__}")
            self._opening = self._opening.apart()
            self.fmu = self._opening.fmu
            self._use(self._opening.open())
        return cast(Pool, self._pool)

    def _take_action(self, action: Any) -> None:
        elements = self._elements
        if elements is not None:
            if not is_element(action, elements):
                raise ConfigError(f"action {shown(action)} is not in {self.action_space}")
        elif has_nan(action):
            raise ConfigError(f"action {shown(action)} has a NaN; every number must be finite")
        before = self.action, self.previous_action, self.previous_state
        self.previous_action, self.action, self.previous_state = self.action, action, self.state
        try:
            self._write_inputs(self._get_inputs())
        except BaseException as error:  # the FMU was not touched: a better action may follow
            self.action, self.previous_action, self.previous_state = before
            if self._blames_action(action, error):
                raise ConfigError(
                    f"action {shown(action)} is not in {self.action_space}: {shown(error)}"
                ) from error
            raise

    def _blames_action(self, action: Any, error: BaseException) -> bool:
        """Whether ``_get_inputs`` failed because of an action outside of the action space."""
        if isinstance(error, FMUGymError) or not isinstance(error, Exception):
            return False
        if self._own.step:  # then its actions may be others
            return False
        return is_misfit(action, self.action_space, error)

    def _write_inputs(self, values: Any) -> None:
        if self._takes_one_real and type(values) in _FLOATS and isfinite(values):
            self._input_row[0] = values
            self.inputs = (float(values),)
            return
        inputs = tuple(flat_inputs(values, self._interface.inputs, self._source).tolist())
        if not all(map(isfinite, inputs)):
            self._raise_for_inputs(inputs, "every input must be finite")
        self._input_row[:] = inputs
        self.inputs = inputs

    def _source(self, values: Any) -> str:
        """Say for an error where inputs come from."""
        if values is self.action:
            return f"action {shown(values)}"
        return f"what _get_inputs returned for action {shown(self.action)}, {shown(values)},"

    def _raise_for_inputs(self, inputs: tuple[float, ...], why: str) -> None:
        pairs = zip(self.config.model_input_names, inputs, strict=True)
        listing = ", ".join(f"{name} = {value}" for name, value in pairs)
        raise ConfigError(f"action {shown(self.action)} makes {listing}; {why}")

    def _evaluate(self, pool: Pool, status: int) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        stopped = status == _TERMINATED
        if status > _WARNING and not stopped:
            return self._fault(pool.failure(0))
        self.after_end = self._ended
        before = self._values, self.variables.copy() if self._own.update else {}
        self._set_values()
        if self._own.update:
            self._update()
        done = self._is_done()
        if done is not True and done is not False:
            done = as_flag("_is_done", done)
        self.done = terminated = stopped or done
        truncated = self.step_count >= self._step_limit
        if self._own.is_truncated:
            truncated = as_flag("_is_truncated", self._is_truncated()) or truncated
        reward = self._reward_policy()
        if type(reward) is not float:
            reward = as_reward(reward)
        if self._pool_observes:
            observation: Any = self._observation_row.copy()
            is_finite = hypot(*self.state) <= FLOAT32_LIMIT or self._is_finite(observation)
        else:
            observation = self._get_observation()
            is_finite = self._is_finite(observation)
        if not (is_finite and isfinite(reward)):
            return self._fault_of_hooks(reward, observation, before)
        info = self._info() if self._has_info else {}
        if stopped:
            info["fmu_terminated"] = True
        if terminated or truncated:
            self._ended = True
        return observation, reward, terminated, truncated, info

    def _info(self) -> dict[str, Any]:
        """Return the info of the hook and of the pool."""
        info = as_info(self._get_info())
        if self._pool_tells:
            info = info | {
                name: value.item(0) for name, value in self._open_pool("info").info().items()
            }
        return info

    @property
    def time(self) -> float:
        """The FMU's time in seconds."""
        steps = self._spec.warm_up_steps + self.step_count
        return self._spec.communication_point(steps * self._spec.substeps)

    def _fault_of_hooks(
        self, reward: float, observation: Any, before: tuple[Any, dict[str, Any]]
    ) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """End the episode because of a number that is not finite, in the state before the step."""
        if isfinite(reward):
            reason = f"the observation is {shown(observation)} at t = {self.time:g} s"
        else:
            reason = f"_reward_policy returned {reward} at t = {self.time:g} s"
        self._values, variables = before
        self.state = self.previous_state
        self.variables.update(variables)
        self._open_pool("step").note_fault(0)
        self._halt()
        return self._fault(reason)

    def _fault(self, reason: str) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self._ended = True
        policy = self.config.on_fault
        if policy == "raise":
            raise SimulationError(reason)
        self.logger.warning("%s", reason)
        self.done = policy == "terminate"
        info = self._info() | {"fault": reason, "fault_rate": self._fault_rate()}
        observation = self._get_observation()
        if not self._is_finite(observation):
            raise SimulationError(f"{reason}; before it the observation is {shown(observation)}")
        return observation, self.config.fault_reward, self.done, not self.done, info

    def _fault_rate(self) -> float:
        return float(fault_rates(self._open_pool("health").health())[0])

    @property
    def health(self) -> dict[str, int]:
        """Counts of what happened since the environment was made, by name.

        ``resets``; ``steps`` (communication steps); faults by kind: ``discards``, ``errors``,
        ``fatals``, ``not_finite``, ``deaths`` (of its worker process); ``retries`` of discarded
        steps; ``replacements`` of the instance, and of these ``recyclings`` because of leaks; and
        ``memory_growth``, the bytes that resets have taken from this process, or by which its
        worker process has grown.

        Raises:
            SimulationError: If the environment is closed.
        """
        counts = self._open_pool("health").health()
        return {name: int(values[0]) for name, values in counts.items()}

    @property
    def compute_reward(self) -> Callable[[Any, Any, Any], Any]:
        """The goal reward in the form that hindsight replay calls; see ``_goal_reward``.

        Raises:
            AttributeError: If this is no goal task, as Stable-Baselines3 expects it.
        """
        if not self._own.goal_reward:
            raise AttributeError(f"{type(self).__name__} is no goal task: it has no _goal_reward")
        return lambda achieved, desired, info: self._goal_reward(achieved, desired)

    def read_variables(self, *names: str) -> dict[str, float]:
        """Read any numeric variables of the FMU now, for inspection outside of an episode's loop.

        Raises:
            ConfigError: If a name is unknown or its variable is not numeric.
            SimulationError: If the environment is closed or was never reset.
        """
        pool = self._open_pool("read_variables")
        if not self._was_reset:
            raise SimulationError("read_variables was called before the first reset")
        variables = tuple(output_variable(self.fmu.description, name) for name in names)
        return dict(zip(names, pool.read(variables)[:, 0].tolist(), strict=True))

    @property
    def np_random(self) -> np.random.Generator:
        """The environment's generator; hooks must not use it."""
        if self._in_hooks:
            raise SimulationError(
                "a hook drew random numbers; give a distribution in the config under "
                "'model_parameters' or 'episode_variables' instead and read the drawn value"
            )
        return super().np_random

    @np_random.setter
    def np_random(self, value: np.random.Generator) -> None:
        self._np_random = value
        self._np_random_seed = -1

    def close(self) -> None:
        """Free the FMU and its temporary folder; more than one call is fine."""
        self._is_closed = True
        self._close_pool()
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None
        super().close()

    def _close_pool(self) -> None:
        if self._pool is not None:
            self._pool.close()
            self._pool = None

    def __reduce__(self) -> tuple[Callable[..., FMUEnv], tuple[Any, ...]]:
        return _rebuild, (type(self), *self._constructor_arguments)


class FMI1CSEnv(FMUEnv):
    """Base class for FMUs of FMI 1.0 co-simulation; see ``FMUEnv``."""

    fmi_version = 1


class FMI2CSEnv(FMUEnv):
    """Base class for FMUs of FMI 2.0 co-simulation; see ``FMUEnv``."""

    fmi_version = 2


class FMI3CSEnv(FMUEnv):
    """Base class for FMUs of FMI 3.0 co-simulation; see ``FMUEnv``."""

    fmi_version = 3


def _set_level(logger: logging.Logger, level: Any) -> None:
    try:
        logger.setLevel(level)
    except Exception:  # a TypeError or ValueError; or the object's own method fails
        raise ConfigError(f"log_level must be a level of logging, got {shown(level)}") from None


def _rebuild(cls: type[FMUEnv], args: tuple[Any, ...], kwargs: dict[str, Any]) -> FMUEnv:
    return cls(*args, **kwargs)


def _step_limit(config: EnvConfig, spec: PoolSpec) -> int:
    """The number of steps after which an episode is truncated."""
    limit = sys.maxsize if config.max_episode_steps is None else config.max_episode_steps
    if config.stop_time is None:
        return limit
    span = (config.stop_time - spec.start_time) / spec.time_step
    if span > limit:
        return limit
    steps = floor(span + 1e-9) - spec.warm_up_steps
    if steps < 1:
        raise ConfigError(
            f"stop_time = {config.stop_time} s leaves no time for a step of {spec.time_step} s "
            f"after start_time = {spec.start_time} s and the warm-up"
        )
    return min(limit, steps)
