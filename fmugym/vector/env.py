"""The vector environment: N environments of one class over one pool."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from gymnasium.envs.registration import load_env_creator
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from fmugym.env import FMUEnv
from fmugym.errors import ConfigError, SimulationError, unknown_name
from fmugym.pool.base import FloatArray, MaskArray
from fmugym.task.interface import checked_value
from fmugym.task.opening import request_pool
from fmugym.vector.engines.batch import BatchEngine, Engine, StepResult
from fmugym.vector.engines.compiled import CompiledEngine, find_programs
from fmugym.vector.engines.per_env import PerEnvEngine
from fmugym.vector.hooks.check import CURE, find_difference
from fmugym.vector.views import column

__all__ = ["FMUVectorEnv", "attribute", "vectorized"]

HOOKS = ("auto", "compiled", "array", "per_env")
POOL_OPTIONS = ("threads", "private_libraries", "isolation", "workers", "call_timeout")

logger = logging.getLogger(__name__)


class FMUVectorEnv(VectorEnv[Any, Any, Any]):
    """N environments of one class, whose FMU instances step in one call.

    Environment i started with ``reset(seed=s)`` gives, step by step and episode after episode,
    what a single environment started with ``reset(seed=s + i)`` gives.

    Args:
        make_env: Returns one environment, the prototype; wrappers are refused.
        num_envs: N.
        max_episode_steps: Truncates episodes; ``gymnasium.make_vec`` passes the spec's.
        autoreset_mode: What follows the end of an episode: ``NEXT_STEP`` (its next step starts an
            episode instead), ``SAME_STEP`` (the same step does; the last observation and info are
            ``infos["final_obs"]`` and ``["final_info"]``) or ``DISABLED`` (``reset`` with
            ``options["reset_mask"]`` must follow).
        hooks: ``"auto"`` takes the fastest of three ways in which the hooks give what they give in
            a single environment: compiled for the native pool where they are plain arithmetic, on
            arrays, or one environment at a time. ``"compiled"``, ``"array"`` and ``"per_env"`` ask
            for one of them; where it is not possible, that is an error.
        pool_options: Passed to ``fmugym.trial.opening.make_pool``: ``backend``, ``threads``,
            ``private_libraries``, ``isolation``, ``workers``, ``call_timeout``.

    Raises:
        ConfigError: If an argument does not fit, or with ``hooks="array"`` if a hook does not
            work on arrays.
    """

    metadata: dict[str, Any] = {"autoreset_mode": AutoresetMode.NEXT_STEP}  # noqa: RUF012  (as in FMUEnv)

    def __init__(
        self,
        make_env: Callable[[], Any],
        num_envs: int = 1,
        *,
        max_episode_steps: int | None = None,
        autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
        hooks: str = "auto",
        **pool_options: Any,
    ) -> None:
        if not isinstance(num_envs, int | np.integer) or num_envs < 1:
            raise ConfigError(f"num_envs must be a positive integer, got {num_envs!r}")
        if hooks not in HOOKS:
            raise unknown_name("way of calling hooks", hooks, HOOKS)
        self.num_envs = num_envs
        self._mode = _autoreset_mode(autoreset_mode)
        with request_pool(num_envs, **pool_options):
            self._prototype = _checked_prototype(make_env())
        try:
            self._set_up(hooks, max_episode_steps)
        except BaseException:
            self._prototype.close()
            raise

    def _set_up(self, hooks: str, max_episode_steps: int | None) -> None:
        env, count = self._prototype, self.num_envs
        self.metadata = {**env.metadata, "autoreset_mode": self._mode}
        self.render_mode = env.render_mode
        self.single_action_space = env.action_space
        self.single_observation_space = env.observation_space
        self.action_space = batch_space(env.action_space, count)
        self.observation_space = batch_space(env.observation_space, count)
        self._started = False
        self._engine = self._make_engine(hooks, max_episode_steps)
        env._open_pool("a vector environment").forget_health()  # of the trials of hooks

    def _make_engine(self, hooks: str, max_episode_steps: int | None) -> Engine:
        env, count = self._prototype, self.num_envs
        if not self._use_arrays(hooks):
            return PerEnvEngine(env, count, max_episode_steps, self.action_space, self._add_info)
        if hooks != "array":
            programs = find_programs(env, required=hooks == "compiled")
            if programs is not None:
                return CompiledEngine(env, count, max_episode_steps, programs)
        return BatchEngine(env, count, max_episode_steps)

    def _use_arrays(self, hooks: str) -> bool:
        if hooks == "per_env":
            return False
        difference = find_difference(self._prototype)
        if difference is None:
            return True
        name = type(self._prototype).__name__
        text = f"{name}: {difference}, so that its hooks cannot be called on arrays. {CURE}"
        if hooks != "auto":
            raise ConfigError(text)
        logger.warning("%s; until then they are called one environment at a time, slower", text)
        return False

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: Mapping[str, Any] | None = None,
    ) -> tuple[Any, dict[str, Any]]:
        """Start new episodes.

        Args:
            seed: Environment i is seeded with ``seed + i``, or with ``seed[i]`` of a list.
            options: As for a single environment, and ``"reset_mask"``, a Boolean array of the
                environments to be reset; the others go on.

        Returns:
            The observations of all environments, and the infos.

        Raises:
            ConfigError: If seeds or options do not fit.
            SimulationError: If an FMU cannot be initialized, or the environment is closed.
        """
        self._require_open("reset")
        remaining = dict(options or {})
        mask = self._checked_mask(remaining.pop("reset_mask", None))
        seeds = self._seeds(seed)
        try:
            observations, infos = self._engine.reset(mask, seeds, remaining)
        except BaseException:
            self._prototype._halt()
            raise
        self._started = True
        return observations, infos

    def _seeds(self, seed: int | Sequence[int | None] | None) -> Sequence[int | None]:
        if seed is None:
            return [None] * self.num_envs
        if isinstance(seed, int | np.integer):
            return [int(seed) + index for index in range(self.num_envs)]
        if not isinstance(seed, Iterable):
            raise ConfigError(f"seed must be an integer or a list of them, got {seed!r}")
        seeds = [None if one is None else int(one) for one in seed]
        if len(seeds) != self.num_envs:
            raise ConfigError(f"there are {len(seeds)} seeds, expected {self.num_envs}")
        return seeds

    def _checked_mask(self, mask: Any) -> MaskArray:
        if mask is None:
            return np.ones(self.num_envs, np.bool_)
        array = np.asarray(mask)
        if array.shape != (self.num_envs,) or array.dtype != np.bool_ or not array.any():
            raise ConfigError(
                f"options['reset_mask'] must be a Boolean array of shape ({self.num_envs},) with "
                f"at least one True, got {mask!r}"
            )
        if not self._started and not array.all():
            raise ConfigError("the first reset must be of all environments")
        return array.copy()

    def step(self, actions: Any) -> StepResult:
        """Step all environments.

        Args:
            actions: A batch of actions, environments first.

        Returns:
            Observations, rewards (float64), terminated, truncated, infos; all new arrays.

        Raises:
            ConfigError: If the actions do not fit.
            SimulationError: Before the first reset, after ``close``, in mode ``DISABLED`` after an
                end, and, with ``on_fault="raise"``, if an FMU fails.
        """
        engine = self._engine
        if not self._started or self.closed:
            self._refuse_step()
        if engine.any_ended and self._mode is AutoresetMode.DISABLED:
            index = int(np.flatnonzero(engine.ended)[0])
            raise SimulationError(f"the episode of environment {index} has ended: reset it first")
        try:
            result = engine.step(actions, engine.ended.copy() if engine.any_ended else None)
            if engine.any_ended and self._mode is AutoresetMode.SAME_STEP:
                return self._start_again(result, engine.ended.copy())
        except BaseException:  # as in a single environment
            self._prototype._halt()
            raise
        return result

    def _refuse_step(self) -> None:
        self._require_open("step")
        raise SimulationError("step was called before the first reset")

    def _require_open(self, method: str) -> None:
        if self.closed:
            raise SimulationError(f"{method} was called on a closed {type(self).__name__}")

    def _start_again(self, result: StepResult, ended: MaskArray) -> StepResult:
        """Reset in the step that ended the episodes, as the mode ``SAME_STEP`` wants it."""
        last = _objects(result.observations, ended)
        observations, infos = self._engine.reset(ended, [None] * self.num_envs, {})
        final_info = _restricted(result.infos, ended)
        merged = _merged(_restricted(result.infos, ~ended), infos)
        merged |= {"final_obs": last, "_final_obs": ended.copy()}
        merged |= {"final_info": final_info, "_final_info": ended.copy()}
        return result._replace(observations=observations, infos=merged)

    def _singles(self) -> list[FMUEnv]:
        if isinstance(self._engine, PerEnvEngine):
            return self._engine.envs
        return [column(self._prototype, index) for index in range(self.num_envs)]

    def render(self) -> tuple[Any, ...] | None:
        """The pictures of all environments, or None without a render mode."""
        self._require_open("render")
        if self.render_mode is None:
            return None
        if not self._started:
            raise SimulationError("render was called before the first reset")
        pictures = []
        for env in self._singles():
            if env._renderer is None:
                env._renderer = self._prototype._renderer
            pictures.append(env.render())
            self._prototype._renderer = env._renderer
        return tuple(pictures)

    def get_attr(self, name: str) -> tuple[Any, ...]:
        """An attribute, or else a parameter of the FMU, of each environment.

        Compiled steps do not keep ``action``, ``done`` and what hooks read of the step before.
        """
        return tuple(attribute(env, name) for env in self._singles())

    def set_attr(self, name: str, values: Any) -> None:
        """Set an attribute, or a parameter of the FMU, of each environment.

        Args:
            name: An attribute that hooks read, or the name of a parameter; that takes effect with
                the next episode.
            values: A list or array of one value for each environment, or one value for all.

        Raises:
            ConfigError: If there is nothing of this name, the number of values is wrong, or they do
                not fit.
        """
        if _is_one_each(values) and len(values) != self.num_envs:
            raise ConfigError(
                f"there are {len(values)} values of {name!r}, expected {self.num_envs}"
            )
        if self._is_parameter(name):
            self._engine.set_parameter(name, self._parameter_values(name, values))
        else:
            self._require_attribute(name)
            self._set_attribute(name, values)

    def _is_parameter(self, name: str) -> bool:
        env = self._prototype
        return not hasattr(env, name) and name in env.fmu.description.variables

    def _parameter_values(self, name: str, values: Any) -> FloatArray:
        start_values = np.broadcast_to(np.asarray(values, object), self.num_envs).tolist()
        self._prototype._plan_episode({name: start_values[0]})
        variable = self._prototype.fmu.variable(name)
        return np.array([checked_value(variable, value) for value in start_values])

    def _require_attribute(self, name: str) -> None:
        """Refuse to make an attribute that no hook can know of: its name is misspelt."""
        engine = self._engine
        env = engine.envs[0] if isinstance(engine, PerEnvEngine) else self._prototype
        if not hasattr(env, name):
            public = [known for known in dir(env) if not known.startswith("_")]
            names = public + list(env.fmu.description.variables)
            raise unknown_name("attribute or parameter", name, names)

    def _set_attribute(self, name: str, values: Any) -> None:
        """Set or make an attribute, of one value for each environment or one for all."""
        each = _is_one_each(values)
        if isinstance(self._engine, PerEnvEngine):
            for index, env in enumerate(self._engine.envs):
                setattr(env, name, values[index] if each else values)
            return
        values = _row_of(name, values) if each else values
        prototype = self._prototype
        attributes = {n: v for n, v in prototype._per_env_attributes.items() if n != name}
        setattr(prototype, name, values)
        prototype._per_env_attributes = {**attributes, name: values} if each else attributes
        self._engine.note_attributes()

    @property
    def health(self) -> dict[str, npt.NDArray[np.int64]]:
        """What was counted of each environment's FMU, arrays of shape (N,); see ``FMUEnv``."""
        return self._prototype._open_pool("health").health()

    def call(self, name: str, *args: Any, **kwargs: Any) -> tuple[Any, ...]:
        """Call a method of each environment, or get an attribute."""
        attributes = self.get_attr(name)
        return tuple(a(*args, **kwargs) if callable(a) else a for a in attributes)

    def close_extras(self, **kwargs: Any) -> None:
        """Free the pool."""
        self._prototype.close()

    def __repr__(self) -> str:
        return f"FMUVectorEnv({type(self._prototype).__name__}, num_envs={self.num_envs})"


def vectorized(env_class: Callable[..., Any] | str) -> Callable[..., FMUVectorEnv]:
    """Make the vector entry point of a class.

    Args:
        env_class: The class, or ``"module:Class"``; its arguments are those of the entry point
            that are not ``FMUVectorEnv``'s.

    Returns:
        A function that makes a ``FMUVectorEnv`` of it.
    """

    def make(
        num_envs: int = 1,
        max_episode_steps: int | None = None,
        autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
        hooks: str = "auto",
        backend: Any = "auto",
        **kwargs: Any,
    ) -> FMUVectorEnv:
        """Make a vector environment; see ``FMUVectorEnv``."""
        pool_options = {name: kwargs.pop(name) for name in POOL_OPTIONS if name in kwargs}
        creator: Any = load_env_creator(env_class) if isinstance(env_class, str) else env_class
        if not isinstance(backend, str):  # no name of a pool: the class knows what to do with it
            kwargs["backend"], backend = backend, "auto"
        return FMUVectorEnv(
            lambda: creator(**kwargs),
            num_envs,
            max_episode_steps=max_episode_steps,
            autoreset_mode=autoreset_mode,
            hooks=hooks,
            backend=backend,
            **pool_options,
        )

    return make


def _autoreset_mode(mode: str | AutoresetMode) -> AutoresetMode:
    by_name = {m.name.lower(): m for m in AutoresetMode}
    if isinstance(mode, AutoresetMode):
        return mode
    name = str(mode).lower().replace("-", "_")
    if name not in by_name:
        raise unknown_name("autoreset mode", mode, by_name)
    return by_name[name]


def _checked_prototype(env: Any) -> FMUEnv:
    if not isinstance(env, FMUEnv):
        raise ConfigError(
            f"make_env must return an unwrapped environment of fmugym, got {type(env).__name__}"
        )
    return env


def _is_one_each(values: Any) -> bool:
    return isinstance(values, list | tuple) or np.ndim(values) > 0


def attribute(env: FMUEnv, name: str) -> Any:
    """An attribute of an environment, or else a parameter of its episode.

    Raises:
        AttributeError: If there is none of this name.
    """
    if not hasattr(env, name) and name in env.parameters:
        return env.parameters[name]
    return getattr(env, name)


def _row_of(name: str, values: Any) -> npt.NDArray[Any]:
    row = np.array(values)
    if row.ndim != 1:
        raise ConfigError(f"{name!r} can hold one number for each environment, got {values!r}")
    return row


def _objects(observations: Any, mask: MaskArray) -> npt.NDArray[Any]:
    """One observation for each environment in the mask, None for the others."""
    objects = np.full(len(mask), None, dtype=object)
    for index in np.flatnonzero(mask).tolist():
        objects[index] = _one(observations, index)
    return objects


def _one(observations: Any, index: int) -> Any:
    if isinstance(observations, Mapping):
        return {name: _one(value, index) for name, value in observations.items()}
    return observations[index].copy()


def _restricted(infos: dict[str, Any], mask: MaskArray) -> dict[str, Any]:
    """The infos of some of the environments."""
    result = {}
    for name, value in infos.items():
        if name.startswith("_") and name[1:] in infos and (value & mask).any():
            inner = infos[name[1:]]
            result[name] = value & mask
            result[name[1:]] = _restricted(inner, mask) if isinstance(inner, dict) else inner.copy()
    return result


def _merged(first: dict[str, Any], second: dict[str, Any]) -> dict[str, Any]:
    """Infos of different environments, in one."""
    result = dict(first)
    for name, value in second.items():
        if name not in result:
            result[name] = value
        elif isinstance(value, dict):
            result[name] = _merged(result[name], value)
        elif name.startswith("_") and name[1:] in second:
            result[name] = result[name] | value
        else:
            mask = second[f"_{name}"]
            result[name] = result[name].copy()
            result[name][mask] = value[mask]
    return result
