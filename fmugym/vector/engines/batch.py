"""N environments whose hooks are evaluated once, on arrays."""

from __future__ import annotations

import sys
from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from fmugym.env import FMUEnv
from fmugym.errors import ConfigError, SimulationError
from fmugym.fmi.status import Status
from fmugym.pool.base import FloatArray, MaskArray, StatusArray
from fmugym.pool.health import fault_rates
from fmugym.task import spaces as fmu_spaces
from fmugym.task.episode import EpisodePlan
from fmugym.vector.streams import EpisodeStreams
from fmugym.vector.views import batched, envs_first

__all__ = ["BatchEngine", "Engine", "StepResult"]

IndexArray = npt.NDArray[np.intp]


class StepResult(NamedTuple):
    """What a step of N environments gives; all arrays are new ones."""

    observations: Any
    rewards: FloatArray
    terminated: MaskArray
    truncated: MaskArray
    infos: dict[str, Any]


class Engine(ABC):
    """What drives N environments, without the question of when an ended one starts again.

    Attributes:
        ended: Whether the last step ended the episode, shape (N,); always the same array.
        any_ended: Whether it did so for any.
    """

    def __init__(self, num_envs: int) -> None:
        self.ended = np.zeros(num_envs, np.bool_)
        self.any_ended = False

    def note_ends(self, terminated: MaskArray, truncated: MaskArray) -> None:
        """Keep which episodes a step has ended."""
        np.logical_or(terminated, truncated, out=self.ended)
        self.any_ended = bool(np.count_nonzero(self.ended))

    def note_starts(self, mask: MaskArray) -> None:
        """Keep which episodes have been started again."""
        self.ended[mask] = False
        self.any_ended = bool(np.count_nonzero(self.ended))

    @abstractmethod
    def reset(
        self, mask: MaskArray, seeds: Sequence[int | None], options: Mapping[str, Any]
    ) -> tuple[Any, dict[str, Any]]:
        """Start episodes of those in the mask; the observations are those of all."""

    @abstractmethod
    def step(self, actions: Any, resetting: MaskArray | None) -> StepResult:
        """Step all environments, but start episodes of those in the mask instead."""

    @abstractmethod
    def set_parameter(self, name: str, values: npt.NDArray[Any]) -> None:
        """Give a parameter one value for each environment, from its next episode on."""

    def note_attributes(self) -> None:  # noqa: B027  (most engines need not know)
        """Take notice that attributes that hooks read have changed."""


class BatchEngine(Engine):
    """Turns a prototype into N environments: what its hooks read holds arrays from now on.

    Args:
        env: The prototype, made with a pool of N instances.
        num_envs: N.
        max_episode_steps: Truncates episodes, in addition to the config's own limit.
    """

    def __init__(self, env: FMUEnv, num_envs: int, max_episode_steps: int | None) -> None:
        super().__init__(num_envs)
        self.env = env
        self._n = num_envs
        self._pool = env._open_pool("a vector environment")
        self._streams = EpisodeStreams(num_envs, env._plan)
        self._limit = min(env._step_limit, max_episode_steps or sys.maxsize)
        self._longest = 0
        self._foreign = np.zeros(num_envs, np.bool_)
        batched(env, num_envs)
        env._values, env.inputs = self._pool.outputs, self._pool.inputs
        env.state = self._pool.outputs[: env._output_count]
        env._was_reset = True  # for the views of single environments
        self._given: dict[str, npt.NDArray[Any]] = {}
        self._make_parameters(env._plan)
        self._note_foreign(slice(None), False)

    def _make_parameters(self, plan: EpisodePlan) -> None:
        self._start_values = np.repeat(plan.constants[:, None], self._n, axis=1)
        names = [variable.name for variable in plan.model_variables]
        self._parameters = dict(zip(names, self._start_values, strict=True))
        self.env.parameters = MappingProxyType(self._parameters)

    def set_parameter(self, name: str, values: npt.NDArray[Any]) -> None:
        """See ``Engine.set_parameter``."""
        env, before = self.env, self._parameters
        self._given[name] = values
        parameters = {**env._interface.parameters, name: values[0]}
        env._interface = replace(env._interface, parameters=parameters)
        env._plan = env._plan_episode({})
        self._make_parameters(env._plan)
        for known in before.keys() & self._parameters.keys():
            self._parameters[known][:] = before[known]
        self._note_foreign(slice(None), True)

    def _note_foreign(self, indices: IndexArray | slice, foreign: bool) -> None:
        """Keep whose rows of constants are those of another plan: of options, or of before."""
        self._foreign[indices] = foreign
        self._any_foreign = bool(self._foreign.any())

    # Episodes.

    def reset(
        self, mask: MaskArray, seeds: Sequence[int | None], options: Mapping[str, Any]
    ) -> tuple[Any, dict[str, Any]]:
        """See ``Engine.reset``."""
        indices = np.flatnonzero(mask)
        self._streams.seed(seeds, indices)
        drawn = self._begin(mask, indices, self.env._plan_of_reset(options))
        self.env._in_hooks = True
        try:
            return self._observe(None), self._infos(mask) | _masked(drawn, mask)
        finally:
            self.env._in_hooks = False
            self.note_starts(mask)

    def _begin(
        self, mask: MaskArray, indices: IndexArray, plan: EpisodePlan
    ) -> dict[str, FloatArray]:
        """Draw and start episodes; returns what is to be told of the draws."""
        values = self._draw(indices, plan)
        _, statuses = self._pool.reset(plan.model_variables, values, mask)
        if np.count_nonzero(statuses):
            self._require_started(indices, statuses)
        self._forget(indices, plan)
        return {name: self._row(name).copy() for name in [*plan.told, *plan.drawn_names]}

    def _forget(self, indices: IndexArray, plan: EpisodePlan) -> None:
        """Let hooks read after a reset what they read in a single environment."""
        env = self.env
        env.step_count[indices] = 0
        env.previous_state[:, indices] = env.state[:, indices]
        no_action = np.reshape(env._no_action, (*env.action.shape[:-1], 1))
        env.action[..., indices] = env.previous_action[..., indices] = no_action
        env.done = env.done.copy()  # it was given away
        env.done[indices] = False
        for row, (name, start) in zip(env.inputs, env._start_inputs, strict=True):
            row[indices] = (
                self._parameters[name][indices] if name in plan.parameter_names else start
            )

    def _require_started(self, indices: IndexArray, statuses: StatusArray) -> None:
        for index in indices.tolist():
            if statuses[index] > Status.WARNING:
                raise SimulationError(f"environment {index}: {self._pool.failure(index)}")

    def _draw(self, indices: IndexArray, plan: EpisodePlan) -> FloatArray:
        """Draw episodes into the rows of the parameters and variables.

        Returns:
            The parameters in the order of the plan, shape (P, N).
        """
        default = plan is self.env._plan
        if plan.num_uniform is not None and plan.num_uniform == self._streams.num_draws:
            drawn = plan.scaled(self._streams.fractions(indices))
            self._place(plan.drawn_names, drawn, indices)
        else:
            self._place_each(indices, plan)
        if not default or self._any_foreign:
            constants = plan.constant_parameters
            self._place(constants, constants.values(), indices)
            self._note_foreign(indices, not default)
        self._place(plan.constant_variables, plan.constant_variables.values(), indices)
        constant = plan.constant_parameters.keys() - plan.told.keys()
        given = {name: self._given[name][indices] for name in self._given if name in constant}
        self._place(given, given.values(), indices)
        if default:
            return self._start_values
        return np.stack([self._parameters[variable.name] for variable in plan.model_variables])

    def _place_each(self, indices: IndexArray, plan: EpisodePlan) -> None:
        episodes = [plan.draw(self._streams.generator(index)) for index in indices.tolist()]
        for name in plan.drawn_names:
            values = [{**e.parameters, **e.variables}[name] for e in episodes]
            self._place([name], [values], indices)

    def _place(self, names: Iterable[str], values: Iterable[Any], indices: IndexArray) -> None:
        for name, value in zip(names, values, strict=True):
            self._row(name)[..., indices] = value

    def _row(self, name: str) -> FloatArray:
        """The values of a parameter or an episode variable, one for each environment."""
        variables = self.env.variables
        if name in variables:
            if np.shape(variables[name])[-1:] != (self._n,):
                variables[name] = np.array(np.broadcast_to(variables[name], self._n))
            row: FloatArray = variables[name]
        else:
            row = self._parameters.setdefault(name, np.full(self._n, np.nan))
        return row

    # Steps.

    def step(self, actions: Any, resetting: MaskArray | None) -> StepResult:
        """See ``Engine.step``."""
        env, pool = self.env, self._pool
        actions = self._checked(actions)
        env._in_hooks = True
        try:
            self._take_actions(actions)
            drawn: dict[str, FloatArray] = {}
            if resetting is not None:
                drawn = self._begin(resetting, np.flatnonzero(resetting), env._plan)
            observed = self._new_observations()
            pool.step(None, resetting, observed)
            env.step_count += 1
            if resetting is None:
                return self._evaluate(observed, None)
            env.step_count[resetting] = 0
            result = self._evaluate(observed, resetting)
            result.infos.update(_masked(drawn, resetting))
            return result
        finally:
            env._in_hooks = False

    def _take_actions(self, actions: npt.NDArray[Any]) -> None:
        env = self.env
        before = env.action, env.previous_action, env.previous_state
        env.previous_action, env.action = env.action, actions
        env.previous_state = env.state.copy()
        try:
            self._write_inputs(env._get_inputs())
        except BaseException:  # no FMU was touched: better actions may follow
            env.action, env.previous_action, env.previous_state = before
            raise

    def _checked(self, actions: Any) -> npt.NDArray[Any]:
        """Copy the actions, environments last as hooks want them."""
        space: Any = self.env.action_space
        try:
            array = np.array(actions, dtype=space.dtype if space.dtype.kind == "f" else None)
        except (TypeError, ValueError):
            raise ConfigError(f"the actions do not make an array: {actions!r}") from None
        if array.shape != (self._n, *space.shape):
            raise ConfigError(
                f"the actions have shape {array.shape}, expected {(self._n, *space.shape)}"
            )
        if space.dtype.kind != "f":
            self._check_elements(space, array)
            array = array.astype(space.dtype, copy=False)
        return array if array.ndim == 1 else np.ascontiguousarray(np.moveaxis(array, 0, -1))

    def _check_elements(self, space: Any, array: npt.NDArray[Any]) -> None:
        if array.dtype.kind not in "iub":
            raise ConfigError(f"the actions are of type {array.dtype}, expected integers")
        if isinstance(space, spaces.Discrete):
            low, high = int(space.start), int(space.start + space.n - 1)
            if array.min() < low or array.max() > high:
                index = int(np.flatnonzero((array < low) | (array > high))[0])
                raise ConfigError(f"action {array[index]} of environment {index} is not in {space}")

    def _write_inputs(self, values: Any) -> None:
        inputs = self._pool.inputs
        if values is None:
            raise ConfigError("_get_inputs returned None, expected a number for each input")
        is_sequence = isinstance(values, list | tuple)
        if not is_sequence and np.ndim(values) < (2 if len(inputs) == 1 else 1):
            values = [values]
        if len(values) != len(inputs):
            raise ConfigError(f"_get_inputs returned {len(values)} values, expected {len(inputs)}")
        for row, value in zip(inputs, values, strict=True):
            row[:] = value
        if not self.env._real_inputs:
            for index in range(self._n):
                inputs[:, index] = fmu_spaces.to_input_types(
                    self.env._interface.inputs, inputs[:, index]
                )
        self._require_finite_inputs(None)

    def _require_finite_inputs(self, ignored: MaskArray | None) -> None:
        inputs = self._pool.inputs
        finite = np.isfinite(inputs)
        if finite.all():
            return
        for index in np.flatnonzero(~finite.all(axis=0)).tolist():
            if ignored is None or not ignored[index]:
                raise ConfigError(
                    f"an input of environment {index} is not finite: {inputs[:, index]}"
                )

    def _new_observations(self) -> npt.NDArray[np.float32] | None:
        if not self.env._pool_observes:
            return None
        return np.empty((self._n, self.env._output_count), np.float32)

    def _evaluate(self, observed: Any, resetting: MaskArray | None) -> StepResult:
        env = self.env
        if env._has_update:
            self._update(resetting, self._failed(self._pool.statuses))
        terminated = self._flags("_is_done", env._is_done())
        statuses = self._pool.statuses
        has_faults = bool(np.count_nonzero(statuses))
        if has_faults:
            terminated |= self._stopped(statuses)
        env.done = terminated
        truncated = self._reached_limit()
        if env._has_truncation:
            truncated |= self._flags("_is_truncated", env._is_truncated())
        rewards = self._rewards(env._reward_policy())
        if resetting is not None:
            terminated[resetting] = truncated[resetting] = False
            rewards[resetting] = 0.0
        infos = self._infos(np.ones(self._n, np.bool_)) if env._has_info else {}
        result = StepResult(self._observe(observed), rewards, terminated, truncated, infos)
        if has_faults:
            self._take_faults(result, statuses)
        self.note_ends(terminated, truncated)
        return result

    def _update(self, resetting: MaskArray | None, failed: MaskArray) -> None:
        """Call the hook, but keep the variables of environments that did not step.

        What it assigns is copied: it may be part of an array that the next step writes again.
        """
        variables = self.env.variables
        keep = failed if resetting is None else failed | resetting
        before = {name: self._row(name) for name in variables}
        kept = {name: row[..., keep] for name, row in before.items()} if keep.any() else {}
        self.env._update()
        for name, row in before.items():
            if variables[name] is not row:
                variables[name] = np.array(variables[name])
        for name, values in kept.items():
            self._row(name)[..., keep] = values

    def _flags(self, hook: str, values: Any) -> MaskArray:
        if values is None:
            raise ConfigError(f"{hook} returned None, expected True or False")
        flags = np.empty(self._n, np.bool_)
        flags[:] = values
        return flags

    def _rewards(self, values: Any) -> FloatArray:
        if values is None:
            raise ConfigError("_reward_policy returned None, expected a number")
        rewards = np.empty(self._n)
        rewards[:] = values
        return rewards

    def _reached_limit(self) -> MaskArray:
        """Compare only when the longest episode may have got there."""
        self._longest += 1
        if self._longest < self._limit:
            return np.zeros(self._n, np.bool_)
        self._longest = int(self.env.step_count.max())
        reached: MaskArray = self.env.step_count >= self._limit
        return reached

    def _observe(self, observed: Any) -> Any:
        if observed is not None:
            return observed
        observation = self.env._get_observation()
        if observation is None:
            raise ConfigError("_get_observation returned None; is its return statement missing?")
        return envs_first(observation, self.env.observation_space)

    def _infos(self, mask: MaskArray) -> dict[str, Any]:
        if not self.env._has_info:
            return {}
        info = self.env._get_info()
        if self.env._pool_tells:
            info = info | self._pool.info()
        return self._info_arrays(info, mask)

    def _info_arrays(self, info: Mapping[str, Any], mask: MaskArray) -> dict[str, Any]:
        values = {name: self._info_array(value, mask) for name, value in info.items()}
        return values | {f"_{name}": mask.copy() for name in values}

    def _info_array(self, value: Any, mask: MaskArray) -> Any:
        if isinstance(value, Mapping):
            return self._info_arrays(value, mask)
        if np.ndim(value) == 0:
            return np.full(self._n, value, object if isinstance(value, str) else None)
        return envs_first(value)

    def _stopped(self, statuses: StatusArray) -> MaskArray:
        stopped: MaskArray = statuses == Status.TERMINATED
        return stopped

    def _failed(self, statuses: StatusArray) -> MaskArray:
        failed: MaskArray = (statuses > Status.WARNING) & (statuses != Status.TERMINATED)
        return failed

    def _take_faults(self, result: StepResult, statuses: StatusArray) -> None:
        env, config = self.env, self.env.config
        stopped = self._stopped(statuses)
        if stopped.any():
            result.infos.update({"fmu_terminated": stopped, "_fmu_terminated": stopped.copy()})
        failed = self._failed(statuses)
        indices = np.flatnonzero(failed).tolist()
        if not indices:
            return
        reasons = {index: self._pool.failure(index) for index in indices}
        if config.on_fault == "raise":
            raise SimulationError(f"environment {indices[0]}: {reasons[indices[0]]}")
        for index, reason in reasons.items():
            env.logger.warning("environment %d: %s", index, reason)
        texts = np.full(self._n, None, dtype=object)
        texts[indices] = list(reasons.values())
        result.infos.update({"fault": texts, "_fault": failed})
        rates = fault_rates(self._pool.health())
        result.infos.update({"fault_rate": rates, "_fault_rate": failed.copy()})
        result.rewards[failed] = config.fault_reward
        result.terminated[failed] = config.on_fault == "terminate"
        result.truncated[failed] = config.on_fault == "truncate"


def _masked(drawn: dict[str, FloatArray], mask: MaskArray) -> dict[str, Any]:
    """The info of a reset in the form of Gymnasium's vector environments."""
    values: dict[str, Any] = {}
    for name, value in drawn.items():
        values[name], values[f"_{name}"] = value, mask.copy()
    return {"drawn": values, "_drawn": mask.copy()}
