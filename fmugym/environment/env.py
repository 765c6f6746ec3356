"""The environment: episodes around a pool of one FMU instance."""

from __future__ import annotations

import copy
import logging
import os
import sys
from collections.abc import Callable, Mapping
from functools import partial
from importlib import import_module
from typing import Any, ClassVar, Final, Never

import gymnasium
from gymnasium import logger as gymnasium_logger
from gymnasium.envs.registration import EnvSpec

from fmugym.checks import check_seed, refuse_positional
from fmugym.environment.actions import take_action
from fmugym.environment.config import EnvConfig
from fmugym.environment.construction import Constructed, draws_of_reset, prepare_hooks
from fmugym.environment.episode import Episode
from fmugym.environment.episode_limit import EpisodeLimit, limit_of_make
from fmugym.environment.fmu_variables import start_time_of
from fmugym.environment.interface import readable_named
from fmugym.environment.pictures import note_for_picture
from fmugym.environment.reset import FIRST, EpisodeReset
from fmugym.environment.saved_episode import columns_of, place_columns, require_saving, scope_of
from fmugym.environment.snapshots import Snapshot, checked_snapshot
from fmugym.environment.step_result import Result, conclude, first_observation
from fmugym.errors import (
    ConfigError,
    SimulationError,
    first_of,
    unknown_argument,
)
from fmugym.fmi.status import WARNING_CODE
from fmugym.fmi.systems import FMUSystem
from fmugym.pool import Pool

__all__ = [
    "FMI1CSEnv",
    "FMI1MEEnv",
    "FMI2CSEnv",
    "FMI2MEEnv",
    "FMI3CSEnv",
    "FMI3MEEnv",
    "FMUEnv",
    "inner_env",
]

_ARGUMENTS: Final = (*("fmu_path", "config", "log_level", "render_mode", "backend", "isolation"),)

_COMPILED: Final = "fmugym.environment.vector.compiled_step"
"""The module of compiled steps is imported late: it needs this one, and takes a while."""


class FMUEnv(Constructed):
    """An FMU as a Gymnasium environment.

    A class for your own FMU derives from ``FMI1CSEnv``, ``FMI2CSEnv`` or ``FMI3CSEnv``, or from
    ``FMI1MEEnv``, ``FMI2MEEnv`` or ``FMI3MEEnv`` for model exchange, and supplies ``_is_done``;
    every other hook of ``fmugym.environment.hooks.Hooks`` has a default. A step calls the hooks
    once each, in the order in which they stand there. All but ``_get_inputs`` and ``_update`` must
    be free of side effects. None should draw random numbers, which no snapshot and no vector
    environment would repeat; random values are distributions in the config.

    A hook that returns something unusable raises ``ConfigError`` with the hook's name. A reward or
    an observation that is not finite is a fault of the episode, like a failure of the FMU.

    An environment is for one thread. Where several use one, their calls may fail and their episodes
    may be mixed up; the next reset by one thread alone begins a sound episode.

    An exception that a hook raises reaches the caller of ``step`` unchanged. If the FMU has stepped
    already, the episode is over, and ``reset`` must follow. An exception of ``_get_inputs`` leaves
    the episode as it was; it becomes a ``ConfigError`` if it comes from an action that is not in
    the action space. Inputs of expressions that are not finite end the episode.

    Args:
        fmu_path: The FMU, or a system: the path of an ``.ssp`` file, or an ``FMUSystem``. A
            relative path is relative to the file of the class.
        config: See ``EnvConfig``.
        log_level: Level of this class's logger, which gets the FMU's messages.
        render_mode: One of the class's ``metadata["render_modes"]``, or None. For another mode of
            Gymnasium there is a warning, and no pictures.
        backend: What stands in for the FMU, which then only describes the variables: an object
            with ``reset``, ``step`` and ``stop`` (``fmugym.pool.Backend``), or
            ``fmugym.pool.Paced`` around it. Or the name of a way to step the FMU, see
            ``fmugym.pool.opening.PoolOptions``.
        isolation: Where the FMU runs; by default where the config says.

    Attributes:
        fmu: The FMU; ``fmu.description`` is its model description.
        config: The checked config.
        state: The outputs in the order of the config, floats.
        out: The outputs and the monitored variables by name, a read-only mapping.
        action: The action of this step as it was given, or, where there are expressions, in the
            type of the action space; zeros after a reset.
        inputs: The FMU's inputs in this step, floats.
        previous_state: ``state`` before this step.
        previous_inputs: ``inputs`` of the step before; in the first, their start values.
        previous_action: The action of the step before; zeros in the first.
        step_count: Steps since the reset.
        fmu_status: The status of the FMU's last step; see ``fmugym.fmi.status.Status``.
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

    fmi_interface: ClassVar[str | None] = None
    """How the FMU is run, ``"co_simulation"`` or ``"model_exchange"``; None for as the config says.
    """

    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012  (Gymnasium's own form)

    vectorized: ClassVar[bool] = False
    """Whether the hooks of this class body work on the arrays of N environments.

    What a hook reads then has the environments on its last axis, and so has what it returns;
    ``fmugym.environment.env_checker.check_hooks`` finds out whether they do. A vector environment
    calls them once a step, and other hooks once for each environment. A subclass that overrides
    hooks says it again.
    """

    steps_after_end: ClassVar[bool] = False
    """Whether ``step`` may go on after the end of an episode, as some of Gymnasium's own do."""

    reset_options: ClassVar[tuple[str, ...]] = ("model_parameters",)
    """The keys that ``reset`` takes in its options."""

    unphysical_keys: tuple[str, ...] = ()
    """The keys of a task for which observations or actions are not in its units."""

    def __init__(
        self,
        fmu_path: str | os.PathLike[str] | FMUSystem,
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
        self._construct(fmu_path, config, log_level, render_mode)
        self._open(backend, isolation)
        if self.formulas is not None:
            import_module(_COMPILED)  # so that the first reset does not wait for it

    # Gymnasium's interface.

    def __repr__(self) -> str:
        if "pool_spec" not in vars(self):  # the constructor has not come that far
            return object.__repr__(self)
        inputs, outputs = self.config.model_input_names, self.config.model_output_names
        return (
            f"<{type(self).__name__} of {self.fmu.path.name}: {first_of(inputs)} -> "
            f"{first_of(outputs)} every {self.pool_spec.time_step:g} s>"
        )

    def reset(
        self,
        *misplaced: object,
        seed: int | None = None,
        options: Mapping[str, Any] | None = None,
    ) -> tuple[Any, dict[str, Any]]:
        """Start a new episode with the FMU instance at hand.

        Random values are drawn from this environment's own generator: first the parameters in the
        order of the config, then the start time, then those that only the options have, then the
        episode variables.

        Args:
            misplaced: None: the others are given by name.
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
        refuse_positional(misplaced)
        pool = self._open_pool("reset")
        if not self._was_reset:
            prepare_hooks(self)  # the constructor of the class may have changed the spaces
        seed, draws = check_seed(seed), draws_of_reset(self, options)
        super().reset(seed=seed)
        generator = self._np_random
        rng = self.np_random if generator is None else generator
        values = draws.draw(rng, natively=pool.plays_alone)
        self._ended = True  # there is no episode if the FMU fails
        try:
            EpisodeReset(self, self._episode, draws, values).run()
            self._pictured = None, 0.0
            self._was_reset, self._ended = True, False
            observation, info = first_observation(self)
            if not self._has_compiled:
                self._compile(pool)
        except BaseException:
            self._ended = True
            self._instance.halt()
            raise
        info["drawn"] = values.drawn
        if self.render_mode == "human":
            self.render()
        return observation, info

    def _compile(self, pool: Pool) -> None:
        """Compile the expressions that the hooks are, where a native pool can run them."""
        own, self._has_compiled = self._own_hooks, True
        is_alone = pool.num_instances == 1 and pool.plays_alone
        if self.formulas is not None and is_alone and not (own.step or own.reset):
            self._compiled_step = import_module(_COMPILED).expression_step_of(self)

    def step(self, action: Any) -> Result:
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
        if self._ended:
            self._check_before_step()
        if self._compiled_step is None or self._ended:
            result = self._step_in_python(action)
        else:
            result = self._compiled_step.step(self, action)
        if self.render_mode is not None:
            note_for_picture(self, result[1])
        return result

    def _step_in_python(self, action: Any) -> Result:
        try:
            take_action(self, action)
            try:
                self._instance.step()
                self._episode.step_count += 1
                return conclude(self, self._instance.pool.statuses.item(0))
            except BaseException:  # the FMU has moved, so that the step cannot be tried again
                self._ended = True
                raise
        except BaseException:  # a real system must not go on without its controller
            self._instance.halt()
            raise

    def _check_before_step(self) -> None:
        self._open_pool("step")
        if not self._was_reset:
            raise SimulationError("step was called before the first reset")
        if not self.steps_after_end:
            raise SimulationError("step was called after the end of the episode; call reset first")
        if not self.after_end:
            gymnasium_logger.warn("step was called after the end of the episode; call reset first")
        self.after_end = True

    @property
    def time(self) -> float:
        """The FMU's time in seconds."""
        steps = (self.warm_up_steps + self.step_count) * self.pool_spec.substeps
        return self.pool_spec.communication_point(steps, start_time_of(self))

    @property
    def spec(self) -> EnvSpec | None:
        """Gymnasium's spec, whose ``max_episode_steps`` is at most that of the config."""
        return vars(self).get("spec")

    @spec.setter
    def spec(self, value: EnvSpec | None) -> None:
        limit = EpisodeLimit.of(self)
        try:
            limit.require(limit_of_make(sys._getframe(1)))
            vars(self)["spec"] = limit.told_by(value)
        except ConfigError:
            self.close()  # nobody gets this environment
            raise

    # Snapshots.

    def save_state(self) -> Snapshot:
        """Save the episode at this moment.

        The first call for an FMU that is not bundled may take some seconds: a trial in two other
        processes shows whether its serialized states work. If they do not, or if the FMU offers
        none, the snapshot holds the inputs of the episode; see ``Snapshot.method``.

        Returns:
            A value that this environment, and every other one with the same FMU and config, can
            restore, also in another process.

        Raises:
            ConfigError: If hooks have assigned to attributes of the class.
            SimulationError: Before the first reset, after ``close``, if a real system stands in
                for the FMU, or if the FMU fails.
        """
        pool = self._open_pool("save_state")
        if not self._was_reset:
            raise SimulationError("save_state was called before the first reset")
        bundle = pool.save_instances(FIRST)
        return Snapshot(scope_of(self), columns_of(self), bundle)

    def restore_state(self, snapshot: Snapshot) -> Any:
        """Go on from a snapshot, with its random generator, too; no reset is needed before.

        Args:
            snapshot: Of one environment with the same FMU and config.

        Returns:
            The observation at the moment of the snapshot.

        Raises:
            ConfigError: If the snapshot is of another FMU or config, or not of one environment.
            SimulationError: If the FMU fails, or if a real system stands in for it.
        """
        pool = self._open_pool("restore_state")
        columns = checked_snapshot(snapshot, length=1).columns_for(scope_of(self))
        if not self._was_reset:
            prepare_hooks(self)  # as in ``reset``
        require_saving(pool)
        self._ended = True  # there is no episode if the FMU fails
        if pool.restore_instances(snapshot.bundle, FIRST, FIRST)[0] > WARNING_CODE:
            raise SimulationError(pool.failure(0))
        place_columns(self, columns, 0)
        observation = first_observation(self)[0]
        if not self._has_compiled:
            self._compile(pool)
        return observation

    def __deepcopy__(self, memo: dict[int, Any]) -> FMUEnv:
        """Make a new environment in the middle of the same episode, if there is one."""
        args, kwargs = copy.deepcopy(self._constructor_arguments, memo)
        twin = type(self)(*args, **kwargs)
        twin.spec = copy.deepcopy(self.spec, memo)
        if self._was_reset and self._is_open:
            twin.restore_state(self.save_state())
        return twin

    @property
    def episode(self) -> Episode:
        """The quantities of the episode, as hooks read them."""
        return self._episode

    @property
    def is_compiled(self) -> bool:
        """Whether a native pool does the step by programs of the expressions.

        That is known after the first reset.
        """
        return self._compiled_step is not None

    @property
    def health(self) -> dict[str, int]:
        """Counts of events since the environment was made, by name.

        ``resets``; ``steps`` (communication steps); faults by kind: ``discards``, ``errors``,
        ``fatals``, ``not_finite``, ``deaths`` (of its worker process); ``retries`` of discarded
        steps; and ``replacements`` of the instance, of these ``recyclings`` of a worker process
        that had grown.

        Raises:
            SimulationError: If the environment is closed.
        """
        counts = self._open_pool("health").health()
        return {name: int(values[0]) for name, values in counts.items()}

    @property
    def observation_names(self) -> tuple[str, ...] | None:
        """The names of the observation's elements; None if a hook of the class makes it."""
        if type(self)._get_observation is not FMUEnv._get_observation:
            return None
        expressions = tuple(one.text for one in self.config.observations)
        return expressions or tuple(v.name for v in self.interface.outputs)

    @property
    def action_names(self) -> tuple[str, ...] | None:
        """The names of the action's elements; None if a hook of the class makes inputs of it."""
        if type(self)._get_inputs is not FMUEnv._get_inputs:
            return None
        return tuple(variable.name for variable in self.interface.chosen_inputs)

    @property
    def compute_reward(self) -> Callable[[Any, Any, Any], Any]:
        """The goal reward in the form that hindsight replay calls; see ``_goal_reward``.

        Raises:
            AttributeError: If this is no goal task, as Stable-Baselines3 expects it.
        """
        if not self._own_hooks.goal_reward:
            raise AttributeError(f"{type(self).__name__} is no goal task: it has no _goal_reward")
        return lambda one, other, _: self._goal_reward(one, other)

    def read_variables(self, *names: str) -> dict[str, Any]:
        """Read any variables of the FMU now, for inspection outside of an episode's loop.

        The name of an array stands for its elements, which come by their own names.

        Raises:
            ConfigError: If a name is unknown or its variable is not numeric.
            SimulationError: If the environment is closed or was never reset.
        """
        pool = self._open_pool("read_variables")
        if not self._was_reset:
            raise SimulationError("read_variables was called before the first reset")
        variables = readable_named(self.fmu.description, names)
        values = pool.read(variables)[:, 0].tolist()
        return {one.name: value for one, value in zip(variables, values, strict=True)}

    @property
    def np_random_seed(self) -> int:
        """The seed of the generator; -1 if it was given as a whole."""
        return super().np_random_seed

    def close(self) -> None:
        """Free the FMU and its temporary folder; more than one call is fine."""
        self._is_closed = True
        self._close_pool()
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None
        super().close()

    def __reduce__(self) -> tuple[Callable[..., FMUEnv], tuple[Any, ...]]:
        args, kwargs = self._constructor_arguments
        return _rebuilt, (partial(type(self), *args, **kwargs), self.spec)


FMUEnv._base = FMUEnv


def _rebuilt(make: Callable[[], FMUEnv], spec: EnvSpec | None) -> FMUEnv:
    env = make()
    env.spec = spec
    return env


def inner_env(env: Any) -> FMUEnv:
    """The environment of fmugym inside of wrappers.

    Raises:
        ConfigError: If there is none.
    """
    inner = env.unwrapped if isinstance(env, gymnasium.Env) else env
    if not isinstance(inner, FMUEnv):
        got = f"the class {inner.__name__}" if isinstance(inner, type) else type(inner).__name__
        raise ConfigError(f"expected an environment of fmugym, got {got}")
    return inner


class FMI1CSEnv(FMUEnv):
    """Base class for FMUs of FMI 1.0 co-simulation; see ``FMUEnv``."""

    fmi_version = 1
    fmi_interface = "co_simulation"


class FMI2CSEnv(FMUEnv):
    """Base class for FMUs of FMI 2.0 co-simulation; see ``FMUEnv``."""

    fmi_version = 2
    fmi_interface = "co_simulation"


class FMI3CSEnv(FMUEnv):
    """Base class for FMUs of FMI 3.0 co-simulation; see ``FMUEnv``."""

    fmi_version = 3
    fmi_interface = "co_simulation"


class FMI1MEEnv(FMUEnv):
    """Base class for FMUs of FMI 1.0 model exchange; see ``FMUEnv``.

    The equations are integrated by the ``solver`` of the config, one of fmugym's own.
    """

    fmi_version = 1
    fmi_interface = "model_exchange"


class FMI2MEEnv(FMUEnv):
    """Base class for FMUs of FMI 2.0 model exchange; see ``FMUEnv``.

    The equations are integrated by the ``solver`` of the config, one of fmugym's own.
    """

    fmi_version = 2
    fmi_interface = "model_exchange"


class FMI3MEEnv(FMUEnv):
    """Base class for FMUs of FMI 3.0 model exchange; see ``FMUEnv``.

    The equations are integrated by the ``solver`` of the config, one of fmugym's own.
    """

    fmi_version = 3
    fmi_interface = "model_exchange"
