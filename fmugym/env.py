"""The environment: hooks, spaces and episodes around a pool of one FMU instance."""

from __future__ import annotations

import inspect
import logging
import math
import operator
import os
import sys
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, ClassVar

import gymnasium
import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from fmugym.archive.fmu import FMU
from fmugym.config import EnvConfig
from fmugym.errors import ConfigError, SimulationError, unknown_name
from fmugym.fmi.status import Status
from fmugym.pool import Pool, PoolSpec
from fmugym.pool.health import fault_rates
from fmugym.task import spaces as fmu_spaces
from fmugym.task.episode import Episode, EpisodePlan
from fmugym.task.interface import checked, output_variable, resolve, start_variable
from fmugym.task.values import EpisodeVariables, NamedValues
from fmugym.trial.opening import make_pool

if TYPE_CHECKING:
    from fmugym.rendering import Renderer, Scene

__all__ = ["FMI1CSEnv", "FMI2CSEnv", "FMI3CSEnv", "FMUEnv"]


_WARNING = int(Status.WARNING)
_TERMINATED = int(Status.TERMINATED)

_pool_request: ContextVar[tuple[int, dict[str, Any]]] = ContextVar("request", default=(1, {}))


@contextmanager
def request_pool(num_instances: int, **options: Any) -> Iterator[None]:
    """Let environments that are made in this context have a pool of this size.

    Args:
        num_instances: Number of FMU instances; a vector environment's prototype has all of them.
        options: Passed to ``fmugym.trial.opening.make_pool``.
    """
    token = _pool_request.set((num_instances, options))
    try:
        yield
    finally:
        _pool_request.reset(token)


class FMUEnv(gymnasium.Env[Any, Any], ABC):
    """A co-simulation FMU as a Gymnasium environment.

    A subclass for an FMU of its own derives from ``FMI1CSEnv``, ``FMI2CSEnv`` or ``FMI3CSEnv``
    and supplies ``_is_done``; every other hook has a default. Hooks are called once a step in the
    order in which they stand below. All but ``_get_inputs`` and ``_update`` are free of side
    effects, and none draws random numbers: what is random is a distribution in the config.

    Args:
        fmu_path: The FMU; a relative path is relative to the file of the class.
        config: See ``EnvConfig``.
        log_level: Level of this class's logger, which gets the FMU's messages.
        render_mode: One of the class's ``metadata["render_modes"]``, or None.
        backend: What stands in for the FMU, which then only describes the variables: an object
            with ``reset``, ``step`` and ``stop`` (``fmugym.Backend``), or ``fmugym.Paced`` around
            it. Or the name of a way to step the FMU, see ``fmugym.trial.opening.make_pool``.
        isolation: Where the FMU runs, if not where the config says.

    Attributes:
        fmu: The FMU; ``fmu.description`` is what it says of itself.
        config: The checked config.
        state: The outputs in the order of the config, floats.
        out: The outputs and the monitored variables by name.
        action: The action of this step as it was given; zeros after a reset.
        inputs: What was written to the FMU's inputs in this step, floats.
        previous_state: ``state`` before this step.
        previous_action: The action of the step before; zeros in the first.
        step_count: Steps since the reset.
        done: What ``_is_done`` said in this step.
        after_end: Whether this step began after the end of the episode.
        parameters: The parameters of this episode by name.
        variables: The episode variables by name; ``_update`` may write them.
        logger: The logger of the class.

    Raises:
        ConfigError: If the config does not fit the FMU.
        FMULoadError: If the FMU cannot be used on this machine.
    """

    fmi_version: ClassVar[int | None] = None
    """The FMI version that the FMU must have; None for any."""

    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012  (Gymnasium's own form)

    steps_after_end: ClassVar[bool] = False
    """Whether ``step`` may go on after the end of an episode, as some of Gymnasium's own do."""

    reset_options: ClassVar[tuple[str, ...]] = ("model_parameters",)
    """The keys that ``reset`` takes in its options."""

    state: Any
    previous_state: Any
    inputs: Any
    action: Any
    previous_action: Any
    step_count: Any
    done: Any
    after_end: Any
    _values: Any
    _constructor_arguments: tuple[tuple[Any, ...], dict[str, Any]]
    render_size: ClassVar[tuple[int, int]] = (600, 400)
    """Width and height of the pictures in pixels."""

    _per_env_attributes: Mapping[str, Any] = MappingProxyType({})
    """In a vector environment: attributes that hold one value for each environment."""

    _has_info: bool
    _pool: Pool | None = None
    _renderer: Renderer[Any] | None = None

    def __new__(cls, *args: Any, **kwargs: Any) -> FMUEnv:
        """Keep the arguments: an environment pickles as its class and them."""
        env = super().__new__(cls)
        env._constructor_arguments = args, kwargs
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
    ) -> None:
        self.logger = logging.getLogger(f"fmugym.{type(self).__name__}")
        self.logger.setLevel(log_level)
        self.config = EnvConfig.from_dict(config)
        self.render_mode = self._checked_render_mode(render_mode)
        self.fmu = self._open_fmu(fmu_path)
        self._require_fmi_version()
        self._interface = resolve(self.config, self.fmu.description)
        self._spec = self._interface.pool_spec()
        self._warn_of_peculiarities()
        self._prepare_values()
        self._prepare_spaces()
        self._prepare_hooks()
        self._pool = self._make_pool(backend, isolation)
        self._step_pool = self._pool.step_own
        self._input_row, self._output_row = self._pool.inputs[:, 0], self._pool.outputs[:, 0]
        self._observation_row = self._pool.observations[0]
        self._halt = self._pool.halt
        self._pool_tells = bool(self._pool.info())
        self._has_info = self._has_info or self._pool_tells

    def _checked_render_mode(self, mode: str | None) -> str | None:
        if mode is not None and mode not in self.metadata["render_modes"]:
            raise unknown_name("render mode", mode, self.metadata["render_modes"])
        return mode

    def _open_fmu(self, path: str | os.PathLike[str]) -> FMU:
        cls, config = type(self), self.config
        return FMU(
            _find_file(cls, path),
            limits=config.archive_limits,
            preload=[_find_file(cls, p) if os.path.dirname(p) else p for p in config.preload],
            probe_timeout=config.probe_timeout,
        )

    def _make_pool(self, backend: Any, isolation: str | None) -> Pool:
        num_instances, requested = _pool_request.get()
        options: dict[str, Any] = {
            "isolation": self.config.isolation if isolation is None else isolation,
            "call_timeout": self.config.call_timeout,
            **requested,
        }
        if backend is not None:
            options["backend"] = backend
        return make_pool(self.fmu, self._spec, num_instances, self.logger, **options)

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
        interface, config = self._interface, self.config
        names = [variable.name for variable in interface.outputs + interface.monitors]
        self.metadata = {**self.metadata, "render_fps": max(1, round(1 / interface.time_step))}
        self._output_count = len(interface.outputs)
        self._no_monitors = not interface.monitors
        self._values = (math.nan,) * len(names)
        self.out = NamedValues("output", names, lambda: self._values)
        self.state = self._values[: self._output_count]
        self.previous_state = self.state
        self._start_inputs = [(v.name, v.start_number) for v in interface.inputs]
        self.inputs = tuple(start for _, start in self._start_inputs)
        self.action = None
        self.previous_action = None
        self.parameters: Mapping[str, Any] = MappingProxyType({})
        self.variables = EpisodeVariables(config.episode_variables)
        self._plan = self._plan_episode({})
        self._step_limit = _step_limit(config, self._spec)
        self.step_count = 0
        self.done = False
        self.after_end = False
        self._ended = True
        self._in_hooks = False
        self._was_reset = False
        self._last_reward: float | None = None
        self._return = 0.0

    def _prepare_spaces(self) -> None:
        self.action_space = self._get_action_space()
        self.observation_space = self._get_observation_space()
        for name, space in (("action", self.action_space), ("observation", self.observation_space)):
            if not isinstance(space, spaces.Space):
                raise ConfigError(
                    f"{type(self).__name__}._get_{name}_space returned {space!r}, "
                    "expected a gymnasium.spaces.Space"
                )
        self._no_action = _no_action(self.action_space)
        self._elements = _elements(self.action_space) if type(self).step is FMUEnv.step else None

    def _prepare_hooks(self) -> None:
        """Settle what depends on the hooks that the class has of its own."""
        interface, cls = self._interface, type(self)
        derived = cls._get_action_space is FMUEnv._get_action_space
        values = fmu_spaces.discrete_values(interface, interface.inputs) if derived else None
        self._action_values = values
        default = cls._get_observation is FMUEnv._get_observation
        space = self.observation_space
        # Then the pool makes the observation in the same pass.
        self._pool_observes = (
            default and isinstance(space, spaces.Box) and space.dtype == np.float32
        )
        if default:
            self._observe = fmu_spaces.default_observation(interface, self.observation_space)
        self._is_goal_task = cls._goal_reward is not FMUEnv._goal_reward
        self._has_update = cls._update is not FMUEnv._update
        self._has_truncation = cls._is_truncated is not FMUEnv._is_truncated
        self._has_info = cls._get_info is not FMUEnv._get_info
        self._real_inputs = all(v.kind == "real" for v in interface.inputs)
        self._takes_one_real = [v.kind for v in interface.inputs] == ["real"]

    # Hooks, in the order of a step.

    def _get_inputs(self) -> Any:
        """Turn ``self.action`` into the values of the inputs, in the order of the config.

        Returns:
            One number for each input. By default the action's own elements; for a ``Discrete``
            made from an Enumeration or Integer, the value that the element stands for.
        """
        values = self._action_values
        if values is None:
            return self.action
        if isinstance(values, range):  # of an Integer; it may be a wide one
            return values[0] + self.action
        return np.array(values)[self.action]

    def _update(self) -> None:
        """Advance what the task itself integrates or filters; called once after each FMU step."""

    @abstractmethod
    def _is_done(self) -> bool:
        """Whether the task has ended, by success or by failure: ``terminated``."""

    def _is_truncated(self) -> bool:
        """Whether the episode is to be cut short for a reason outside of the task."""
        return False

    def _reward_policy(self) -> Any:
        """The reward of this step.

        Returns:
            By default ``negative_reward`` where the task has ended and ``positive_reward``
            otherwise; for a goal task ``_goal_reward`` of this observation.
        """
        positive, negative = self.config.positive_reward, self.config.negative_reward
        if self._is_goal_task:
            return self._reward_for_goals(self._get_observation())
        if isinstance(self.done, bool):
            return negative if self.done else positive
        return np.where(self.done, negative, positive)

    def _reward_for_goals(self, observation: Mapping[str, Any]) -> Any:
        """Goals have environments first, as whoever calls ``compute_reward`` has them."""
        achieved, desired = observation["achieved_goal"], observation["desired_goal"]
        if not isinstance(self.done, bool):
            achieved, desired = np.moveaxis(achieved, -1, 0), np.moveaxis(desired, -1, 0)
        return self._goal_reward(achieved, desired)

    def _get_observation(self) -> Any:
        """The observation, a new array (or dict of new arrays).

        Returns:
            By default the outputs in the type of the observation space.
        """
        return self._observe(self.state)

    def _get_info(self) -> dict[str, Any]:
        """What else is worth knowing of this step, a new dict."""
        return {}

    def _get_action_space(self) -> spaces.Space[Any]:
        """The action space; by default from the inputs' types, min and max."""
        return fmu_spaces.action_space(self._interface)

    def _get_observation_space(self) -> spaces.Space[Any]:
        """The observation space; by default from the outputs' types, min and max."""
        return fmu_spaces.observation_space(self._interface)

    def _goal_reward(self, achieved_goal: Any, desired_goal: Any) -> Any:
        """The reward for having reached one goal when another was wanted, element-wise.

        Override it for a goal task, whose observations are dicts with ``achieved_goal`` and
        ``desired_goal``: the default reward and ``compute_reward`` are then made from it.
        """
        raise SimulationError(f"{type(self).__name__} is no goal task: it has no _goal_reward")

    def _get_scene(self) -> Scene[Any]:
        """What ``render`` draws; see ``fmugym.rendering``. Called once."""
        raise SimulationError(f"{type(self).__name__} has render modes, but no _get_scene")

    def _get_frame(self) -> Any:
        """What the scene needs to know of this moment; by default ``out``."""
        return self.out

    def _describe_action(self) -> str:
        """The action as text for the picture."""
        return ", ".join(f"{value:+.3g}" for value in self.inputs)

    def _get_episode_parameters(self, options: Mapping[str, Any]) -> Mapping[str, Any]:
        """The parameters that the options of ``reset`` override for one episode, by name."""
        overrides = options.get("model_parameters", {})
        if not isinstance(overrides, Mapping):
            raise ConfigError(f"option 'model_parameters' must be a dict, got {overrides!r}")
        return overrides

    # Gymnasium's interface.

    def reset(
        self, *, seed: int | None = None, options: Mapping[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Start a new episode with the FMU instance at hand.

        What is random is drawn from this environment's own generator: the parameters in the order
        of the config, then those only in the options, then the episode variables.

        Args:
            seed: Seeds the generator; None goes on with it.
            options: ``{"model_parameters": {name: value or distribution}}`` overrides parameters
                for this episode; an environment may take more, see its ``reset_options``.

        Returns:
            The first observation, and the info with the values that were drawn or overridden
            under ``"drawn"``.

        Raises:
            ConfigError: If an option is unknown or does not fit.
            SimulationError: If the FMU cannot be initialized, or the environment is closed.
        """
        pool = self._open_pool("reset")
        super().reset(seed=seed)
        plan = self._plan_of_reset(options)
        episode = plan.draw(self.np_random)
        self._ended = True  # should the FMU fail in what follows
        try:
            pool.reset(plan.model_variables, episode.start_values)
            if pool.statuses.item(0) > Status.WARNING:
                raise SimulationError(pool.failure(0))
            self._begin_episode(episode)
            observation, info = self._observation_and_info()
        except BaseException:
            self._halt()
            raise
        info["drawn"] = episode.drawn
        if self.render_mode == "human":
            self.render()
        return observation, info

    def _plan_of_reset(self, options: Mapping[str, Any] | None) -> EpisodePlan:
        if not options:
            return self._plan
        if not isinstance(options, Mapping):
            raise ConfigError(f"the options of reset must be a dict, got {options!r}")
        for name in options:
            if name not in self.reset_options:
                raise unknown_name("reset option", name, self.reset_options)
        return self._plan_episode(self._get_episode_parameters(options))

    def _plan_episode(self, overrides: Mapping[str, Any]) -> EpisodePlan:
        """Prepare the draws of episodes whose parameters are the config's and these instead."""
        parameters = dict(self._interface.parameters)
        for name, value in overrides.items():
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
        """Take the pool's outputs over: hooks get floats, which are faster than numpy's."""
        self._values = values = tuple(self._output_row.tolist())
        self.state = values if self._no_monitors else values[: self._output_count]

    def _observation_and_info(self) -> tuple[Any, dict[str, Any]]:
        self._in_hooks = True
        try:
            observation = _given(self._get_observation(), "_get_observation")
            return observation, self._info()
        finally:
            self._in_hooks = False

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Write the action to the FMU, simulate one time step and evaluate the hooks.

        Args:
            action: An element of the action space, or whatever ``_get_inputs`` takes.

        Returns:
            Observation, reward, terminated, truncated, info. After a fault of the FMU the
            observation is the last good one and the info has ``"fault"``, the reason, and
            ``"fault_rate"``, the part of the episodes until now that ended so.

        Raises:
            ConfigError: If the action does not fit the inputs, or is not finite.
            SimulationError: Before the first reset, after the end of an episode, after ``close``,
                and, with ``on_fault="raise"``, if the FMU fails.
        """
        pool = self._pool
        if pool is None or self._ended:
            pool = self._checked_before_step()
        self._in_hooks = True
        try:
            self._take_action(action)
            troubled = self._step_pool()
            self.step_count += 1
            result = self._evaluate(pool, pool.statuses.item(0) if troubled else 0)
        except BaseException:  # whatever is real must not go on without its controller
            self._halt()
            raise
        finally:
            self._in_hooks = False
        if self.render_mode is not None:
            self._note_for_picture(result[1])
        return result

    def _note_for_picture(self, reward: float) -> None:
        self._last_reward, self._return = reward, self._return + reward
        if self.render_mode == "human":
            self.render()

    def _checked_before_step(self) -> Pool:
        pool = self._open_pool("step")
        if not self._was_reset:
            raise SimulationError("step was called before the first reset")
        if not self.steps_after_end:
            raise SimulationError("step was called after the end of the episode; call reset first")
        if not self.after_end:
            gymnasium.logger.warn("step was called after the end of the episode; call reset first")
        return pool

    def _open_pool(self, method: str) -> Pool:
        if self._pool is None:
            raise SimulationError(f"{method} was called on a closed {type(self).__name__}")
        return self._pool

    def _take_action(self, action: Any) -> None:
        elements = self._elements
        if elements is not None and not _is_element(action, elements):
            raise ConfigError(f"action {action!r} is not in {self.action_space}")
        before = self.action, self.previous_action, self.previous_state
        self.previous_action, self.action, self.previous_state = self.action, action, self.state
        try:
            self._write_inputs(self._get_inputs())
        except BaseException:  # the FMU was not touched: a better action may follow
            self.action, self.previous_action, self.previous_state = before
            raise

    def _write_inputs(self, values: Any) -> None:
        if self._takes_one_real and isinstance(values, float) and math.isfinite(values):
            self._input_row[0] = values
            self.inputs = (float(values),)
            return
        inputs = tuple(self._flat_inputs(values).tolist())
        if not all(map(math.isfinite, inputs)):
            self._raise_for_inputs(inputs, "every input must be finite")
        self._input_row[:] = inputs
        self.inputs = inputs

    def _flat_inputs(self, values: Any) -> npt.NDArray[np.float64]:
        if values is None:
            raise ConfigError("_get_inputs returned None, expected a number for each input")
        try:
            raw = np.asarray(values)
            flat = raw.astype(np.float64, casting="unsafe" if raw.dtype == object else "same_kind")
        except (TypeError, ValueError, OverflowError):
            raise ConfigError(f"action {self.action!r} does not make numbers") from None
        flat = flat.ravel()
        variables = self._interface.inputs
        if flat.size != len(variables):
            names = ", ".join(variable.name for variable in variables)
            raise ConfigError(
                f"action {self.action!r} makes {flat.size} values, "
                f"expected {len(variables)}, one for each input ({names})"
            )
        return flat if self._real_inputs else fmu_spaces.to_input_types(variables, flat)

    def _raise_for_inputs(self, inputs: tuple[float, ...], why: str) -> None:
        pairs = zip(self.config.model_input_names, inputs, strict=True)
        listing = ", ".join(f"{name} = {value}" for name, value in pairs)
        raise ConfigError(f"action {self.action!r} makes {listing}; {why}")

    def _evaluate(self, pool: Pool, status: int) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        stopped = status == _TERMINATED
        if status > _WARNING and not stopped:
            return self._fault(pool.failure(0))
        self.after_end = self._ended
        self._set_values()
        if self._has_update:
            self._update()
        done = self._is_done()
        self.done = terminated = stopped or bool(done)
        truncated = self.step_count >= self._step_limit
        if self._has_truncation:
            truncated = bool(_given(self._is_truncated(), "_is_truncated")) or truncated
        reward = self._reward_policy()
        if self._pool_observes:
            observation: Any = self._observation_row.copy()
        else:
            observation = _given(self._get_observation(), "_get_observation")
        info = self._info() if self._has_info else {}
        if stopped:
            info["fmu_terminated"] = True
        if terminated or truncated:
            self._ended = True
        if done is None or reward is None:
            _given(done, "_is_done")
            _given(reward, "_reward_policy")
        return observation, float(reward), terminated, truncated, info

    def _info(self) -> dict[str, Any]:
        """What the hook tells, and the pool."""
        info: dict[str, Any] = _given(self._get_info(), "_get_info")
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

    def _fault(self, reason: str) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self._ended = True
        policy = self.config.on_fault
        if policy == "raise":
            raise SimulationError(reason)
        self.logger.warning("%s", reason)
        self.done = policy == "terminate"
        info = self._info() | {"fault": reason, "fault_rate": self._fault_rate()}
        reward = float(self.config.fault_reward)
        return self._get_observation(), reward, self.done, not self.done, info

    def _fault_rate(self) -> float:
        return float(fault_rates(self._open_pool("health").health())[0])

    @property
    def health(self) -> dict[str, int]:
        """What was counted of the FMU since the environment was made, by name.

        ``resets``; ``steps`` (communication steps); faults by kind: ``discards``, ``errors``,
        ``fatals``, ``not_finite``, ``deaths`` (of its worker process); ``retries`` of discarded
        steps; ``replacements`` of the instance, and of these ``recyclings`` because of leaks; and
        ``memory_growth``, the bytes that resets have taken from this process (in worker processes:
        that the worker has grown by).

        Raises:
            SimulationError: If the environment is closed.
        """
        counts = self._open_pool("health").health()
        return {name: int(values[0]) for name, values in counts.items()}

    def render(self) -> Any:
        """Draw the present state.

        Returns:
            In the mode ``rgb_array`` an array of shape (height, width, 3) and type uint8, in the
            mode ``human`` None: the picture is in a window.
        """
        if self.render_mode is None:
            gymnasium.logger.warn("render was called, but no render_mode was given at construction")
            return None
        if not self._was_reset:
            raise SimulationError("render was called before the first reset")
        from fmugym.rendering import Overlay, Renderer  # pygame takes a while to import

        if self._renderer is None:
            fps = 1 / self._interface.time_step
            title = type(self).__name__
            scene = self._get_scene()
            self._renderer = Renderer(scene, self.render_size, fps, self.render_mode, title)
        action = self._describe_action() if self.step_count else ""
        overlay = Overlay(self.time, action, self._last_reward, self._return)
        return self._renderer.render(self._get_frame(), overlay)

    @property
    def compute_reward(self) -> Callable[[Any, Any, Any], Any]:
        """The goal reward in the form that hindsight replay calls; see ``_goal_reward``.

        Raises:
            AttributeError: If this is no goal task: that is how Stable-Baselines3 tells.
        """
        if not self._is_goal_task:
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
        """The environment's generator; not for hooks, whose results must not depend on it."""
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
        if self._pool is not None:
            self._pool.close()
            self._pool = None
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None
        super().close()

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


def _given(value: Any, hook: str) -> Any:
    if value is None:
        raise ConfigError(f"{hook} returned None; is its return statement missing?")
    return value


def _rebuild(cls: type[FMUEnv], args: tuple[Any, ...], kwargs: dict[str, Any]) -> FMUEnv:
    return cls(*args, **kwargs)


def _step_limit(config: EnvConfig, spec: PoolSpec) -> int:
    """The number of steps after which an episode is truncated."""
    limit = sys.maxsize if config.max_episode_steps is None else config.max_episode_steps
    if config.stop_time is None:
        return limit
    span = (config.stop_time - spec.start_time) / spec.time_step
    steps = math.floor(span + 1e-9) - spec.warm_up_steps
    if steps < 1:
        raise ConfigError(
            f"stop_time = {config.stop_time} s leaves no time for a step of {spec.time_step} s "
            f"after start_time = {spec.start_time} s and the warm-up"
        )
    return min(limit, steps)


def _no_action(space: spaces.Space[Any]) -> Any:
    """What hooks read where there was no action yet; None for spaces that have no zero."""
    if isinstance(space, spaces.Discrete):
        return space.dtype.type(space.start)
    if isinstance(space, spaces.Box | spaces.MultiBinary | spaces.MultiDiscrete):
        return np.zeros(space.shape, space.dtype)
    return None


def _elements(space: spaces.Space[Any]) -> range | None:
    """The elements of a ``Discrete``; a subclass that overrides ``step`` may take other actions."""
    if isinstance(space, spaces.Discrete):
        return range(int(space.start), int(space.start + space.n))
    return None


def _is_element(action: Any, elements: range) -> bool:
    if type(action) is int:
        return action in elements
    try:
        return operator.index(action) in elements
    except TypeError:
        return False


def _find_file(cls: type, file: str | os.PathLike[str]) -> Path:
    """Find a relative path beside the file of the class, or of a class that it derives from."""
    path = Path(file).expanduser()
    if path.is_absolute():
        return path
    folders = [Path(inspect.getfile(c)).parent for c in cls.__mro__ if _has_file(c)]
    candidates = [folder / path for folder in folders] or [Path.cwd() / path]
    return next((c for c in candidates if c.exists()), candidates[0])


def _has_file(cls: type) -> bool:
    """Classes of a notebook or the interactive interpreter have none."""
    try:
        return Path(inspect.getfile(cls)).is_file() and cls.__module__ != __name__
    except (TypeError, OSError):
        return False
