"""The construction of an environment: its FMU, names, spaces, hooks and pool."""

from __future__ import annotations

import logging
import os
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import replace
from functools import cache
from inspect import getattr_static
from math import floor, isfinite, nan
from threading import RLock
from types import MappingProxyType
from typing import Any, ClassVar, Final, Self
from weakref import WeakSet

from gymnasium import spaces

from fmugym.checks import check_mapping, check_option
from fmugym.environment.class_formulas import class_formulas, with_monitors
from fmugym.environment.config import EnvConfig
from fmugym.environment.distributions import as_distribution, support_of
from fmugym.environment.episode import READABLE, Episode, NoEpisode
from fmugym.environment.episode_start import EpisodeStart
from fmugym.environment.hooks import (
    ORDER,
    AssignedHook,
    Conversions,
    Hooks,
    OwnHooks,
    is_overridden,
    misspelt_hooks,
)
from fmugym.environment.interface import Interface, resolve
from fmugym.environment.pictures import Pictured
from fmugym.environment.pool_opening import (
    Instance,
    env_numbers,
    open_env_pool,
    open_fmu,
    pools_are_deferred,
)
from fmugym.environment.reset import WarmUp, WarmUps
from fmugym.environment.snapshots import Scope, plain_attributes
from fmugym.environment.value_mappings import EpisodeVariables, NamedValues
from fmugym.errors import ConfigError, SimulationError, shown, unknown_name, warn_once
from fmugym.expressions.graph import Formulas, Value
from fmugym.expressions.numpy_evaluation import hooks_of
from fmugym.expressions.quantities import KEPT
from fmugym.fmi.fmu import FMU
from fmugym.fmi.systems import FMUSystem
from fmugym.pool import ISOLATIONS, Pool, PoolSpec

__all__ = ["Constructed", "draws_of", "draws_of_reset", "prepare_hooks", "require_construction"]

_FASTEST_FPS: Final = 1_000_000

_NOTHING: Final[Mapping[str, Any]] = MappingProxyType({})


class Constructed(Pictured):
    """Construction of ``FMUEnv``: everything that a step needs is made and freed here.

    Attributes:
        interface: The variables of the config, as the FMU has them.
        pool_spec: The work of the pool at each reset and step: step sizes, variables, solver.
        given_backend: The argument ``backend``; None for a pool of the FMU.
        given_isolation: The argument ``isolation``; None for that of the config.
        pool: The pool that has the FMU.
        episode_start: The values with which episodes start, constant or drawn.
        formulas: The expressions of the task as values of a graph; None without expressions.
        resolved: The task file, resolved (``TaskEnv``); None for other tasks.
        step_limit: The number of steps after which an episode is truncated.
        warm_up: The warm-up with moving inputs; None if there is none.
        warm_up_steps: The steps of a warm-up.
        planning_model: Makes an environment to plan with, where a plant stands in for the FMU; or
            None.
    """

    fmi_version: ClassVar[int | None]
    fmi_interface: ClassVar[str | None]
    reset_options: ClassVar[tuple[str, ...]]
    metadata: dict[str, Any]

    _constructor_arguments: tuple[tuple[Any, ...], dict[str, Any]]

    _base: ClassVar[type]
    """``FMUEnv``, with whose methods those of a class are compared."""

    # The task.

    interface: Interface
    pool_spec: PoolSpec
    episode_start: EpisodeStart
    step_limit: int
    warm_up_steps: int
    warm_up: WarmUp | None = None
    formulas: Formulas | None = None
    resolved: Any = None
    planning_model: Callable[[], Any] | None = None

    _own_hooks: OwnHooks
    _conversions: Conversions
    _expressed: Mapping[str, Callable[[Any], Any]] = MappingProxyType({})
    """By name, functions of the environment that evaluate its formulas; defaults of hooks."""

    _compiled_step: Any = None
    """The step by programs, if the hooks are expressions and a native pool steps the FMU."""

    _has_compiled: bool = False
    """Whether it is known if there is such a step."""

    _warm_ups: WarmUps | None = None
    _variable_starts: dict[str, Any] = {}  # noqa: RUF012  (replaced, never written)
    """By name, what episode variables start with in the place of what the config says."""

    # The FMU and its episode.

    given_backend: Any
    given_isolation: str | None
    _instance: Instance
    """While the pool is open."""

    _episode: Episode = NoEpisode()  # type: ignore[assignment]  # until there is one
    _standing_in: AbstractContextManager[Any]
    """Held while other values stand in for those that hooks read: threads that do so at once would
    put back each other's."""

    _ended: bool = True
    _is_closed: bool = False

    # Attributes of the class.

    _number: int
    """Tells which environments are newer."""

    _own_names: frozenset[str] = frozenset()
    """The attributes that are not a subclass's own."""

    _as_constructed: Mapping[str, Any]
    """The plain attributes of a subclass when its hooks were prepared."""

    _scope: Scope | None = None
    """What snapshots of it fit; see ``scope_of``."""

    def __new__(cls, *args: Any, **kwargs: Any) -> Self:
        """Keep the arguments, because an environment pickles as its class and arguments."""
        env = super().__new__(cls)
        env._constructor_arguments = args, kwargs
        env._number, env._standing_in = next(env_numbers), RLock()
        return env

    def _construct(
        self,
        fmu_path: str | os.PathLike[str] | FMUSystem,
        config: Mapping[str, Any] | EnvConfig,
        log_level: int,
        render_mode: str | None,
    ) -> None:
        """Do everything that a constructor does before there is a pool."""
        foreign = set(vars(self))
        _require_own_names_free(type(self))
        self.logger = logging.getLogger(f"fmugym.{type(self).__name__}")
        _set_level(self.logger, log_level)
        self.config = EnvConfig.from_dict(config)
        self.render_mode = self._checked_render_mode(render_mode)
        self.fmu = open_fmu(type(self), fmu_path, self.config, self.fmi_interface)
        self._require_fmi_version()
        self.config = with_monitors(self.config, self.fmu.description)
        self.interface = resolve(self.config, self.fmu.description)
        self.pool_spec = self.interface.pool_spec()
        self.warm_up_steps = self.pool_spec.warm_up_steps
        if self.warm_up is not None:
            self.pool_spec = replace(self.pool_spec, warm_up_steps=0)
            self._warm_ups = WarmUps(self, self.warm_up)
        self._warn_of_peculiarities()
        self._prepare_values()
        self._prepare_episodes()
        self._prepare_spaces()
        self._prepare_formulas()
        prepare_hooks(self)
        self._own_names = _names_of(self._base) | vars(self).keys() - foreign

    def _open(self, backend: Any, isolation: str | None) -> None:
        """Open the pool, unless a vector environment is going to give one."""
        if isolation is not None:
            check_option("isolation", isolation, ISOLATIONS)
        self.given_backend, self.given_isolation = backend, isolation
        if not pools_are_deferred():
            self._use(open_env_pool(self))

    @property
    def _is_open(self) -> bool:
        return "_instance" in vars(self)

    def held_outputs(self) -> Sequence[str]:
        """The outputs that a plant has not told now, whose last values go on."""
        return ()

    def _use(self, pool: Pool) -> None:
        """Let a pool of one step the FMU, or one of N if a vector environment does it."""
        self._instance = Instance(pool)

    def _close_pool(self) -> None:
        """Close the pool, if one is open; hooks then read the quantities of the latest step."""
        if self._is_open:
            self._episode, self._ended = self._episode.copy(), True
            self._compiled_step, self._has_compiled = None, False
            self._instance.pool.close()
            del self._instance

    @property
    def pool(self) -> Pool:
        """The pool that has the FMU.

        Raises:
            SimulationError: If the environment is closed.
        """
        return self._open_pool("pool")

    def _open_pool(self, method: str) -> Pool:
        """The pool, which is opened now if that has been deferred."""
        if not self._is_open:
            require_construction(self)
            if self._is_closed:
                raise SimulationError(f"{method} was called on a closed {type(self).__name__}")
            self.fmu = FMU.of(self.fmu)  # which others may share
            self._use(open_env_pool(self))
        return self._instance.pool

    @property
    def reset_method(self) -> str:
        """Method by which episodes begin; see ``EnvConfig``."""
        return str(self._open_pool("reset_method").reset_method)

    def _require_fmi_version(self) -> None:
        found = self.fmu.description.fmi_major_version
        if self.fmi_version is not None and found != self.fmi_version:
            kind = "CS" if self.fmu.description.interface == "co_simulation" else "ME"
            raise ConfigError(
                f"{type(self).__name__} is made for FMI {self.fmi_version}.0, but "
                f"{self.fmu.path.name} is an FMU of FMI {self.fmu.description.fmi_version}; "
                f"derive from FMI{found}{kind}Env instead"
            )

    def _warn_of_peculiarities(self) -> None:
        internal = self.fmu.description.fixed_internal_step_size
        if internal is not None and self.pool_spec.communication_step_size < 0.999999 * internal:
            self.logger.warning(
                "the communication step of %g s is smaller than the internal step of %g s of %s: "
                "some of the steps will do nothing",
                self.pool_spec.communication_step_size,
                internal,
                self.fmu.path.name,
            )
        for method, hook in _misspelt(type(self), self._base):
            self.logger.warning(
                "%s has a method %r, but no hook %r: is its name misspelt?",
                *(type(self).__name__, method, hook),
            )
        if self.fmu.description.capabilities.needs_execution_tool:
            name = self.fmu.path.name
            warn_once(self.logger, f"{name} needs the tool that exported it to run")

    def _prepare_values(self) -> None:
        """Set the quantities to their values before the first reset."""
        interface = self.interface
        names = [variable.name for variable in interface.outputs + interface.monitors]
        fps = min(1 / interface.time_step, _FASTEST_FPS)
        self.metadata = {**self.metadata, "render_fps": max(1, round(fps))}
        self._episode = self._first_episode(names)

    def _first_episode(self, names: Sequence[str]) -> Episode:
        start = {"start_time": self.pool_spec.start_time} if self.config.draws_start_time else {}
        values = {
            "outputs": (nan,) * len(names),
            "states": (nan,) * self.interface.output_count,
            "inputs": tuple(start for _, start in self.interface.start_inputs),
            "action": None,
        }
        return Episode(
            NamedValues("output", names, lambda: self._episode.outputs),
            self.interface.output_count,
            parameters=MappingProxyType(start),
            variables=EpisodeVariables(self.config.variable_starts),
            **{one.attribute: values.get(one.shape, one.zero) for one in KEPT},
        )

    def _prepare_episodes(self) -> None:
        self.episode_start = draws_of(self)
        self.step_limit = _step_limit(self.config, self.pool_spec, self.warm_up_steps)

    def _prepare_spaces(self) -> None:
        self.action_space = self._get_action_space()
        self.observation_space = self._get_observation_space()
        for name, space in (("action", self.action_space), ("observation", self.observation_space)):
            if not isinstance(space, spaces.Space):
                raise ConfigError(
                    f"{type(self).__name__}._get_{name}_space returned {shown(space)}, "
                    "expected a gymnasium.spaces.Space"
                )

    def _prepare_formulas(self) -> None:
        if self.formulas is None:
            has_inputs = is_overridden(self, "_get_inputs")
            self.formulas = class_formulas(
                self.config, self.interface, self.action_space, has_inputs
            )
            if self.config.terminated is None and not is_overridden(self, "_is_done"):
                raise ConfigError(
                    f"{type(self).__name__} does not say when the task has ended: give the config "
                    "key 'terminated', such as 'abs(x) > 1' or 'false', or override _is_done"
                )
        if self.formulas is None:
            return
        if self.config.draws_start_time and self.config.stop_time is not None:
            self.formulas = _until_stop_time(self.formulas, self.config, self.pool_spec)
        self._expressed = hooks_of(self.formulas)


def require_construction(env: Constructed) -> None:
    """Refuse an environment whose class has not called the constructor of its base class.

    Raises:
        ConfigError: If it has not.
    """
    if "given_backend" not in vars(env):
        name = type(env).__name__
        raise ConfigError(f"{name}.__init__ must call super().__init__(fmu_path, config)")


def prepare_hooks(env: Constructed) -> None:
    """Find out which hooks an environment overrides, and prepare the defaults of the others.

    Raises:
        ConfigError: If a hook of a step is an attribute of the environment.
    """
    _require_methods(env)
    if env.config.draws_start_time and env.config.stop_time is not None:
        _let_stop_time_end_episodes(env)
    env._own_hooks = own = OwnHooks.of(env, env._expressed)
    env._conversions = Conversions.of(
        env.interface,
        env.action_space,
        env.observation_space,
        own,
        tells=env._is_open and env._instance.tells,
    )
    env._as_constructed = plain_attributes(vars(env), env._own_names)


def _require_methods(env: Constructed) -> None:
    for name in (*ORDER, "_goal_reward"):
        if not isinstance(vars(env).get(name), AssignedHook | None):
            raise ConfigError(
                f"{name} was assigned to an environment of {type(env).__name__}; write this hook "
                "as a method of the class"
            )


def _let_stop_time_end_episodes(env: Constructed) -> None:
    """Each episode has its own last step, as each has its own start time."""
    name = "_is_truncated"
    hook, stop_time = env._is_truncated, env.config.stop_time or 0.0
    is_expressed = name in env._expressed and not is_overridden(env, name)
    if is_expressed or isinstance(hook, AssignedHook):
        return

    def is_truncated() -> Any:
        rest: Any = stop_time - env.time
        return hook() | (rest < env.pool_spec.time_step * (1 - 1e-9))

    env._is_truncated = AssignedHook(is_truncated)  # type: ignore[method-assign]


def draws_of(env: Constructed, overrides: Mapping[str, Any] = _NOTHING) -> EpisodeStart:
    """Prepare the draws of an environment's episodes.

    Args:
        env: The environment.
        overrides: Parameters by name that replace those of the config, values or distributions.

    Raises:
        ConfigError: If a parameter does not fit.
    """
    interface = env.interface
    given = {name: as_distribution(repr(name), value) for name, value in overrides.items()}
    own = interface.start_values(given)
    given_variables = {name: interface.parameter(name, value) for name, value in own.items()}
    return EpisodeStart(
        tuple((interface.parameter_variables | given_variables).values()),
        {**interface.parameters, **own},
        env.config.variable_starts | env._variable_starts,
        own.keys(),
    )


def draws_of_reset(
    env: Constructed, options: Mapping[str, Any] | None, *also_known: str
) -> EpisodeStart:
    """Prepare the draws of the episodes that a reset with options begins.

    Args:
        env: The environment.
        options: Those of ``reset``.
        also_known: Names of options that are dealt with elsewhere.

    Raises:
        ConfigError: If an option does not fit.
    """
    if options is None:
        return env.episode_start
    options = check_mapping("the options of reset", options)
    for name in options:
        if name not in env.reset_options:
            raise unknown_name("reset option", name, (*env.reset_options, *also_known))
    if not options:
        return env.episode_start
    parameters = env._get_episode_parameters(options)
    return draws_of(env, check_mapping("what _get_episode_parameters returned", parameters))


_checked: Final[WeakSet[type[Any]]] = WeakSet()


def _misspelt(cls: type[Any], base: type[Any]) -> Iterable[tuple[str, str]]:
    """The misspelt hooks of a class, but only the first time that a process makes one of it."""
    if cls in _checked:
        return ()
    _checked.add(cls)
    return misspelt_hooks(cls, base).items()


@cache
def _names_of(base: type) -> frozenset[str]:
    """The attributes that a class has or announces."""
    announced = (name for cls in base.__mro__ for name in vars(cls).get("__annotations__", ()))
    return frozenset(dir(base)).union(announced)


def _require_own_names_free(cls: type[Any]) -> None:
    """Refuse classes with attributes of their own in the places of quantities."""
    for name in READABLE:
        if getattr_static(cls, name) is not vars(Hooks)[name]:
            raise ConfigError(
                f"{cls.__name__} has an attribute {name!r} of its own, but hooks read the "
                "environment's there; give it another name"
            )


def _set_level(logger: logging.Logger, level: Any) -> None:
    try:
        logger.setLevel(level)
    except Exception:  # a TypeError or ValueError; or the object's own method fails
        raise ConfigError(f"log_level must be a level of logging, got {shown(level)}") from None


def _step_limit(config: EnvConfig, spec: PoolSpec, warm_up_steps: int) -> int:
    """The number of steps after which an episode is truncated."""
    limit = sys.maxsize if config.max_episode_steps is None else config.max_episode_steps
    if config.stop_time is None:
        return limit
    drawn = config.draws_start_time
    start = support_of(config.start_time)[1] if drawn else spec.start_time
    span = (config.stop_time - start) / spec.time_step
    if span > limit or not isfinite(start):
        return limit
    steps = floor(span + 1e-9) - warm_up_steps
    if steps < 1:
        raise ConfigError(
            f"stop_time = {config.stop_time} s leaves no time for a step of {spec.time_step} s "
            f"after start_time = {start} s and the warm-up"
        )
    return limit if drawn else min(limit, steps)


def _until_stop_time(formulas: Formulas, config: EnvConfig, spec: PoolSpec) -> Formulas:
    """The same with the end of episodes that begin at different times."""
    own = formulas.truncated
    time, stop_time = Value.read(formulas.graph, "time"), config.stop_time
    rest: Any = time.beside(stop_time) - time
    is_over = rest < spec.time_step * (1 - 1e-9)
    return replace(formulas, truncated=is_over if own is None else own | is_over)
