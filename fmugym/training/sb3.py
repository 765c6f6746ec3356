"""Vector environment for Stable-Baselines3: a ``VecEnv`` over ``FMUVectorEnv``.

Needs the extra ``sb3``. See ``docs/libraries.md``.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Mapping
from copy import copy
from itertools import repeat
from typing import Any

import numpy as np
import numpy.typing as npt
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorWrapper

from fmugym.checks import check_seed
from fmugym.environment.actions import scaled_space, unscaled
from fmugym.environment.env import FMUEnv
from fmugym.environment.vector import FMUVectorEnv
from fmugym.environment.vector.infos import handed_out, observation_of
from fmugym.environment.vector.vector_env import require_open
from fmugym.errors import ConfigError
from fmugym.extras import lacking
from fmugym.pool.pool import MaskArray
from fmugym.training.rl_library_envs import make_vector_env, require_vector_env

try:
    from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper, VecMonitor
except ImportError as error:
    raise ImportError(
        lacking("fmugym.training.sb3", "Stable-Baselines3", "sb3"), name=error.name
    ) from error

__all__ = ["FMUVecEnv", "ResidualActions", "ScaledActions", "make_sb3_env"]


Indices = int | Iterable[int] | None
_StepReturn = tuple[Any, npt.NDArray[np.float32], MaskArray, list[dict[str, Any]]]

_NOTHING_ENDED: dict[str, Any] = {"TimeLimit.truncated": False}
"""The info of a step after which the episode goes on."""


def make_sb3_env(
    env: str | Callable[..., FMUEnv],
    num_envs: int = 1,
    *,
    seed: int | None = None,
    monitor: bool = True,
    overlap: bool = False,
    wrap: Callable[[FMUVectorEnv], Any] = lambda envs: envs,
    **kwargs: Any,
) -> VecEnv:
    """Make N environments for Stable-Baselines3, as its own ``make_vec_env`` does.

    Args:
        env: A registered id, or a class; ids bring their ``max_episode_steps``.
        num_envs: N.
        seed: Environment i is seeded with ``seed + i`` at the first reset.
        monitor: Whether to wrap them in a ``VecMonitor``, which writes returns and lengths to the
            log of the training.
        overlap: As for ``FMUVecEnv``.
        wrap: Puts wrappers of Gymnasium around the ``FMUVectorEnv``, such as
            ``RecordVectorSeries``.
        kwargs: Arguments of ``FMUVectorEnv`` (``max_episode_steps``, ``hooks``, ``threads``, ...)
            and of the environment.

    Raises:
        ConfigError: If the environment is unknown or not one of fmugym, or an argument does not
            fit.
    """
    seed = check_seed(seed)
    kwargs = {"autoreset_mode": AutoresetMode.SAME_STEP, **kwargs}
    envs = make_vector_env(env, num_envs, kwargs)
    try:
        venv = FMUVecEnv(wrap(envs), overlap)
    except BaseException:
        envs.close()
        raise
    if seed is not None:
        venv.seed(seed)
        venv.action_space.seed(seed)
    return VecMonitor(venv) if monitor else venv


class FMUVecEnv(VecEnv):
    """N environments in the form that Stable-Baselines3 trains on.

    It returns, step by step, what SB3's ``DummyVecEnv`` with N single environments returns, at the
    speed of ``FMUVectorEnv``. All arrays and dicts that it returns are new.

    Args:
        env: The vector environment, made with ``autoreset_mode="same_step"``, or a wrapper around
            it that returns observations and infos as it does, such as ``RecordVectorSeries``.
        overlap: Whether the FMUs step between ``step_async`` and ``step_wait``, while the caller
            computes; otherwise they step in ``step_wait``. The algorithms of Stable-Baselines3 call
            both at once, and handing a step to a thread takes some 50 us. So this is of use for
            loops of your own.

    Attributes:
        vector_env: The vector environment, without wrappers.

    Raises:
        ConfigError: If ``env`` is something else, or has another autoreset mode.
    """

    def __init__(self, env: FMUVectorEnv | VectorWrapper, overlap: bool = False) -> None:
        self._outer: Any = env
        inner: Any = env.unwrapped if isinstance(env, VectorWrapper) else env
        self.vector_env = inner = require_vector_env(inner, AutoresetMode.SAME_STEP)
        self._overlap = overlap
        self.spec = inner.spec
        self._set_parameters: dict[str, list[Any]] = {}
        super().__init__(inner.num_envs, inner.single_observation_space, inner.single_action_space)
        self.metadata = dict(inner.metadata)

    # Episodes and steps.

    def reset(self) -> Any:
        """Start new episodes, with the seeds of ``seed`` and the options of ``set_options``.

        Returns:
            The observations; the infos are in ``reset_infos``.
        """
        groups = self._groups_of_options()
        if len(groups) > 1 and not self.vector_env.episodes.started:
            self._outer.reset()
        self.reset_infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        for mask, options in groups:
            options = {**options, "reset_mask": mask}
            observations, infos = self._outer.reset(seed=self._seeds, options=options)
            handed_out(infos, self.reset_infos)
        self._reset_seeds()
        self._reset_options()
        return observations

    def _groups_of_options(self) -> list[tuple[MaskArray, dict[str, Any]]]:
        """Group the environments by their options; most often all are in one group."""
        kinds: list[dict[str, Any]] = []
        for options in self._options:
            if options not in kinds:
                kinds.append(options)
        return [(np.array([o == kind for o in self._options]), kind) for kind in kinds]

    def step_async(self, actions: npt.NDArray[Any]) -> None:
        """Begin a step, or keep the actions for ``step_wait``; see ``overlap``."""
        self._actions = actions
        if self._overlap:
            self._outer.step_async(actions)

    def step_wait(self) -> _StepReturn:
        """Step all environments; an environment whose episode ends starts the next one.

        Returns:
            Observations, rewards, dones and infos in SB3's form. Where an episode ended, the
            observation is the first of the next episode, and the info has
            ``"terminal_observation"``.
        """
        env = self._outer
        result = env.step_wait() if self._overlap else env.step(self._actions)
        observations, rewards, terminated, truncated, infos = result
        dones = terminated | truncated
        listed = list(map(dict.copy, repeat(_NOTHING_ENDED, self.num_envs)))
        if dones.any():
            self._end_episodes(dones, truncated & ~terminated, infos, listed)
        elif infos:
            handed_out(infos, listed)
        return observations, rewards.astype(np.float32), dones, listed

    def _end_episodes(
        self,
        dones: MaskArray,
        cut_short: MaskArray,
        infos: dict[str, Any],
        listed: list[dict[str, Any]],
    ) -> None:
        """Separate the infos of the last step from the infos of the reset after it."""
        last, last_infos = infos.pop("final_obs"), infos.pop("final_info")
        handed_out(last_infos, listed)
        others = list(listed)
        for index in np.flatnonzero(dones).tolist():
            listed[index]["TimeLimit.truncated"] = bool(cut_short[index])
            listed[index]["terminal_observation"] = observation_of(last, index)
            others[index] = self.reset_infos[index] = {}
        handed_out(infos, others)

    def close(self) -> None:
        """Free the FMU instances."""
        self._outer.close()

    # Single environments.

    def get_attr(self, attr_name: str, indices: Indices = None) -> list[Any]:
        """Return an attribute, or a parameter of this episode, of some environments.

        Raises:
            ConfigError: If there is none of this name (it is an ``AttributeError``, too).
        """
        read = self.vector_env.attributes.read
        require_open(self.vector_env, "get_attr")
        return read(attr_name, self._numbers(indices))

    def set_attr(self, attr_name: str, value: Any, indices: Indices = None) -> None:
        """Set an attribute, or a parameter of the FMU from the next episode on.

        Args:
            attr_name: An attribute that hooks read, or the name of a parameter.
            value: A number, for each of the environments.
            indices: The environments, by default all.

        Raises:
            ConfigError: If there is nothing of this name, or it is a parameter that the other
                environments draw in each episode.
        """
        attributes = self.vector_env.attributes
        given = dict.fromkeys(self._numbers(indices), value)
        if not attributes.is_parameter(attr_name):
            require_open(self.vector_env, "set_attr")
            attributes.set_attribute(attr_name, given)
            return
        complete = self._all_values(attr_name, given)
        self.vector_env.set_attr(attr_name, complete)
        self._set_parameters[attr_name] = complete

    def _all_values(self, name: str, given: Mapping[int, Any]) -> list[Any]:
        """Values of a parameter for all environments: given ones, and present ones for the rest."""
        present = [] if len(given) == self.num_envs else self._present_values(name)
        return [given[i] if i in given else present[i] for i in range(self.num_envs)]

    def _present_values(self, name: str) -> list[Any]:
        if name in self._set_parameters:
            return self._set_parameters[name]
        env = self.vector_env.prototype
        if name in env.episode_start.drawn_names:
            raise ConfigError(f"{name!r} is drawn in each episode: set it for all environments")
        variable = env.fmu.variable(name)
        start = variable.start or "" if variable.kind == "string" else variable.start_number
        return [env.episode_start.constants_shown.get(name, start)] * self.num_envs

    def env_method(
        self, method_name: str, *method_args: Any, indices: Indices = None, **method_kwargs: Any
    ) -> list[Any]:
        """Call a method of some environments.

        Numbers that the method assigns to attributes and to episode variables take effect.

        Raises:
            ConfigError: If the method cannot be called for single environments, or changes what
                they cannot have each for itself.
        """
        numbers = self._numbers(indices)
        call = self.vector_env.attributes.call
        require_open(self.vector_env, "env_method")
        return call(method_name, numbers, method_args, method_kwargs)

    def env_is_wrapped(self, wrapper_class: Any, indices: Indices = None) -> list[bool]:
        """Return False for each: single environments have no wrappers."""
        return [False for _ in self._numbers(indices)]

    def _numbers(self, indices: Indices) -> list[int]:
        return [range(self.num_envs)[index] for index in self._get_indices(indices)]

    def get_images(self) -> list[Any]:
        """Return a picture of each environment, or None without the render mode ``rgb_array``."""
        if self.render_mode != "rgb_array":
            warnings.warn(f"no pictures in the render mode {self.render_mode}", stacklevel=2)
            return [None] * self.num_envs
        return self.env_method("render")


class ScaledActions(VecEnvWrapper):
    """Gives each action the range from -1 to 1, which algorithms expect.

    Agents that were trained so act in the task itself: all of fmugym that takes them, such as
    ``export`` and ``evaluate``, brings actions from -1 to 1 to the ranges of the task.

    Args:
        venv: Environments with a bounded Box of actions.
    """

    def __init__(self, venv: VecEnv) -> None:
        super().__init__(venv, action_space=scaled_space(venv.action_space))

    def reset(self) -> Any:
        """See ``FMUVecEnv.reset``."""
        return self.venv.reset()

    def step_async(self, actions: npt.NDArray[Any]) -> None:
        """See ``FMUVecEnv.step_async``."""
        self.venv.step_async(unscaled(actions, self.venv.action_space))

    def step_wait(self) -> Any:
        """See ``FMUVecEnv.step_wait``."""
        return self.venv.step_wait()


class ResidualActions(VecEnvWrapper):
    """Lets an algorithm add to the actions of a controller.

    Args:
        venv: Environments in the physical form of a task, with a Box of observations and a bounded
            Box of actions.
        residual: The ``fmugym.training.residual.Residual``, without a model.
    """

    def __init__(self, venv: VecEnv, residual: Any) -> None:
        self._residual = residual.bind(venv.unwrapped.vector_env)
        if not isinstance(venv.observation_space, spaces.Box):
            raise ConfigError(
                f"a residual policy needs a Box of observations, got {venv.observation_space}"
            )
        width = len(residual.names) + residual.acting
        seen = spaces.Box(-np.inf, np.inf, (width,), np.float32)
        super().__init__(venv, seen, scaled_space(venv.action_space))
        self.memory: dict[str, Any] = {}

    def reset(self) -> Any:
        """See ``FMUVecEnv.reset``."""
        observations = self.venv.reset()
        self._residual.reset()
        return self._seen(observations)

    def _seen(self, observations: Any) -> npt.NDArray[np.float32]:
        seen: npt.NDArray[np.float32] = self._residual.seen(observations)
        self.memory = self._residual.memory  # a checkpoint keeps it
        return seen

    def step_async(self, actions: npt.NDArray[Any]) -> None:
        """See ``FMUVecEnv.step_async``."""
        self._residual.memory = self.memory
        self.venv.step_async(self._residual.actions(actions))

    def step_wait(self) -> Any:
        """See ``FMUVecEnv.step_wait``; the last observations have the controller's actions, too."""
        observations, rewards, dones, infos = self.venv.step_wait()
        if dones.any():
            last, ended = observations.copy(), np.flatnonzero(dones).tolist()
            for index in ended:
                last[index] = infos[index]["terminal_observation"]
            seen = self._aside().seen(last)
            for index in ended:
                infos[index]["terminal_observation"] = seen[index]
            self._residual.reset(dones)
        return self._seen(observations), rewards, dones, infos

    def _aside(self) -> Any:
        """A copy whose decisions leave the controller as it is."""
        other = copy(self._residual)
        other.baseline = copy(other.baseline)
        return other
