"""The construction of an environment: its FMU, names, spaces, hooks and pool."""

from __future__ import annotations

import logging
import os
import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from functools import cache
from inspect import getattr_static
from math import floor, isfinite, nan
from types import MappingProxyType
from typing import Any, ClassVar, Final, Self
from weakref import WeakSet

import numpy as np
from gymnasium import spaces

from fmugym.archive.fmu import FMU
from fmugym.checks import check_mapping, check_option
from fmugym.config import EnvConfig
from fmugym.distributions import as_distribution, support_of
from fmugym.errors import ConfigError, SimulationError, shown, unknown_name, warn_once
from fmugym.expressions.by_numpy import hooks_of
from fmugym.expressions.formulas import Formulas
from fmugym.expressions.quantities import KEPT
from fmugym.expressions.value import Value
from fmugym.pool import ISOLATIONS, Pool, PoolSpec
from fmugym.systems import FMUSystem
from fmugym.task import spaces as fmu_spaces
from fmugym.task.actions import elements_of, no_action
from fmugym.task.class_formulas import class_formulas, with_monitors
from fmugym.task.episode import EpisodeDraws
from fmugym.task.hooks import AssignedHook, Hooks, misspelt_hooks
from fmugym.task.input_writer import InputWriter
from fmugym.task.inside import Inside, OwnHooks, is_overridden
from fmugym.task.interface import resolve
from fmugym.task.pictures import Pictured
from fmugym.task.plain import plain_attributes
from fmugym.task.pool_opening import (
    env_numbers,
    open_env_pool,
    open_fmu,
    pools_are_deferred,
)
from fmugym.task.readings import READINGS, Readings
from fmugym.task.results import finiteness_of
from fmugym.task.step import ORDER
from fmugym.task.values import EpisodeVariables, NamedValues
from fmugym.task.warm_up import WarmUp, WarmUps

__all__ = ["Constructed", "draws_of", "draws_of_reset", "prepare_hooks", "require_construction"]

_FASTEST_FPS: Final = 1_000_000

_NOTHING: Final[Mapping[str, Any]] = MappingProxyType({})


class Constructed(Pictured):
    """The part of ``FMUEnv`` that is done once: it makes and frees everything that a step needs."""

    fmi_version: ClassVar[int | None]
    fmi_interface: ClassVar[str | None]
    reset_options: ClassVar[tuple[str, ...]]
    metadata: dict[str, Any]

    _constructor_arguments: tuple[tuple[Any, ...], dict[str, Any]]

    _warm_up: WarmUp | None = None
    """What happens in warm-ups with moving inputs; the pool knows of others only."""

    def __new__(cls, *args: Any, **kwargs: Any) -> Self:
        """Keep the arguments, because an environment pickles as its class and arguments."""
        env = super().__new__(cls)
        env._constructor_arguments = args, kwargs
        env.inside = Inside(next(env_numbers))
        return env

    def _construct(
        self,
        base: type,
        fmu_path: str | os.PathLike[str] | FMUSystem,
        config: Mapping[str, Any] | EnvConfig,
        log_level: int,
        render_mode: str | None,
    ) -> None:
        """Do everything that a constructor does before there is a pool."""
        foreign, self.inside.base = set(vars(self)), base
        _require_readings(type(self))
        self.logger = logging.getLogger(f"fmugym.{type(self).__name__}")
        _set_level(self.logger, log_level)
        self.config = EnvConfig.from_dict(config)
        self.render_mode = self._checked_render_mode(render_mode)
        self.fmu = open_fmu(type(self), fmu_path, self.config, self.fmi_interface)
        self._require_fmi_version()
        self.config = with_monitors(self.config, self.fmu.description)
        self.inside.interface = resolve(self.config, self.fmu.description)
        self.inside.spec = self.inside.interface.pool_spec()
        self.inside.warm_up_steps = self.inside.spec.warm_up_steps
        if self._warm_up is not None:
            self.inside.spec = replace(self.inside.spec, warm_up_steps=0)
            self.inside.warm_ups = WarmUps(self, self._warm_up)
        self._warn_of_peculiarities()
        self._prepare_values()
        self._prepare_episodes()
        self._prepare_spaces()
        self._prepare_formulas()
        prepare_hooks(self)
        self.inside.own_names = _names_of(self.inside.base) | vars(self).keys() - foreign

    def _open(self, backend: Any, isolation: str | None) -> None:
        """Open the pool, unless a vector environment is going to give one."""
        if isolation is not None:
            check_option("isolation", isolation, ISOLATIONS)
        self.inside.backend, self.inside.isolation = backend, isolation
        if not pools_are_deferred():
            self.inside.use(open_env_pool(self))

    def _open_pool(self, method: str) -> Pool:
        """The pool, which is opened now if that has been deferred."""
        if not self.inside.is_open:
            require_construction(self)
            if self.inside.is_closed:
                raise SimulationError(f"{method} was called on a closed {type(self).__name__}")
            self.fmu = FMU.of(self.fmu)  # which others may share
            self.inside.use(open_env_pool(self))
        return self.inside.pool

    @property
    def reset_method(self) -> str:
        """How episodes begin; see ``EnvConfig``."""
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
        if internal is not None and self.inside.spec.communication_step_size < 0.999999 * internal:
            self.logger.warning(
                "the communication step of %g s is smaller than the internal step of %g s of %s: "
                "some of the steps will do nothing",
                self.inside.spec.communication_step_size,
                internal,
                self.fmu.path.name,
            )
        for method, hook in _misspelt(type(self), self.inside.base):
            self.logger.warning(
                "%s has a method %r, but no hook %r: is its name misspelt?",
                *(type(self).__name__, method, hook),
            )
        if self.fmu.description.capabilities.needs_execution_tool:
            name = self.fmu.path.name
            warn_once(self.logger, f"{name} needs the tool that exported it to run")

    def _prepare_values(self) -> None:
        """Set what hooks may read to what it is before the first reset."""
        interface = self.inside.interface
        names = [variable.name for variable in interface.outputs + interface.monitors]
        fps = min(1 / interface.time_step, _FASTEST_FPS)
        self.metadata = {**self.metadata, "render_fps": max(1, round(fps))}
        self.inside.output_count = len(interface.outputs)
        self.inside.no_monitors = not interface.monitors
        self.inside.start_inputs = [(v.name, v.start_number) for v in interface.inputs]
        self.inside.readings = self._first_readings(names)

    def _first_readings(self, names: Sequence[str]) -> Readings:
        inside = self.inside
        start = {"start_time": inside.spec.start_time} if self.config.draws_start_time else {}
        values = {
            "outputs": (nan,) * len(names),
            "states": (nan,) * inside.output_count,
            "inputs": tuple(start for _, start in inside.start_inputs),
            "action": None,
        }
        return Readings(
            NamedValues("output", names, lambda: inside.readings.outputs),
            inside.output_count,
            parameters=MappingProxyType(start),
            variables=EpisodeVariables(self.config.variable_starts),
            **{one.attribute: values.get(one.shape, one.dtype.type().item()) for one in KEPT},
        )

    def _prepare_episodes(self) -> None:
        self.inside.draws = draws_of(self)
        self.inside.step_limit = _step_limit(
            self.config, self.inside.spec, self.inside.warm_up_steps
        )

    def _prepare_spaces(self) -> None:
        self.action_space = self._get_action_space()
        self.observation_space = self._get_observation_space()
        for name, space in (("action", self.action_space), ("observation", self.observation_space)):
            if not isinstance(space, spaces.Space):
                raise ConfigError(
                    f"{type(self).__name__}._get_{name}_space returned {shown(space)}, "
                    "expected a gymnasium.spaces.Space"
                )
        self.inside.no_action = no_action(self.action_space)

    def _prepare_formulas(self) -> None:
        inside = self.inside
        if inside.formulas is None:
            has_inputs = is_overridden(self, inside.base, "_get_inputs")
            inside.formulas = class_formulas(
                self.config, inside.interface, self.action_space, has_inputs
            )
            if self.config.terminated is None and not is_overridden(self, inside.base, "_is_done"):
                raise ConfigError(
                    f"{type(self).__name__} does not say when the task has ended: give the config "
                    "key 'terminated', such as 'abs(x) > 1' or 'false', or override _is_done"
                )
        if inside.formulas is None:
            return
        if self.config.draws_start_time and self.config.stop_time is not None:
            inside.formulas = _until_stop_time(inside.formulas, self.config, inside.spec)
        inside.expressed = hooks_of(inside.formulas)


def require_construction(env: Constructed) -> None:
    """Refuse an environment whose class has not called the constructor of its base class.

    Raises:
        ConfigError: If it has not.
    """
    if not hasattr(env.inside, "backend"):
        name = type(env).__name__
        raise ConfigError(f"{name}.__init__ must call super().__init__(fmu_path, config)")


def prepare_hooks(env: Constructed) -> None:
    """Find out which hooks an environment overrides, and prepare the defaults of the others.

    Raises:
        ConfigError: If a hook of a step is an attribute of the environment.
    """
    inside, space, base = env.inside, env.observation_space, env.inside.base
    _require_methods(env)
    if env.config.draws_start_time and env.config.stop_time is not None:
        _let_stop_time_end_episodes(env)
    inside.own = own = OwnHooks.of(env, base, inside.expressed)
    # A subclass with its own step may take other actions.
    inside.elements = None if own.step else elements_of(env.action_space)
    interface, derived = inside.interface, not own.get_action_space
    values = fmu_spaces.discrete_values(interface.chosen_inputs) if derived else None
    inside.action_values = values
    if own.get_action_space and not own.get_inputs:
        fmu_spaces.check_choices(interface.inputs, env.action_space)
    default = not own.get_observation
    make = fmu_spaces.default_observation if default else fmu_spaces.outputs_observation
    inside.observe = make(interface, space)
    inside.is_finite = finiteness_of(space)
    # The pool writes this observation in the pass that steps the FMU.
    inside.pool_observes = default and isinstance(space, spaces.Box) and space.dtype == np.float32
    inside.has_info = own.get_info or inside.pool_tells
    inside.input_writer = InputWriter(interface.inputs)
    inside.as_constructed = plain_attributes(vars(env), inside.own_names)


def _require_methods(env: Constructed) -> None:
    for name in (*ORDER, "_goal_reward"):
        if not isinstance(vars(env).get(name), AssignedHook | None):
            raise ConfigError(
                f"{name} was assigned to an environment of {type(env).__name__}; write this hook "
                "as a method of the class"
            )


def _let_stop_time_end_episodes(env: Constructed) -> None:
    """Each episode has its own last step, as each has its own start time."""
    inside, name = env.inside, "_is_truncated"
    hook, stop_time = env._is_truncated, env.config.stop_time or 0.0
    is_expressed = name in inside.expressed and not is_overridden(env, inside.base, name)
    if is_expressed or isinstance(hook, AssignedHook):
        return

    def is_truncated() -> Any:
        rest: Any = stop_time - env.time
        return hook() | (rest < inside.spec.time_step * (1 - 1e-9))

    env._is_truncated = AssignedHook(is_truncated)  # type: ignore[method-assign]


def draws_of(env: Constructed, overrides: Mapping[str, Any] = _NOTHING) -> EpisodeDraws:
    """Prepare the draws of an environment's episodes.

    Args:
        env: The environment.
        overrides: Parameters by name that replace those of the config, values or distributions.

    Raises:
        ConfigError: If a parameter does not fit.
    """
    interface = env.inside.interface
    given = {name: as_distribution(repr(name), value) for name, value in overrides.items()}
    own = interface.start_values(given)
    given_variables = {name: interface.parameter(name, value) for name, value in own.items()}
    return EpisodeDraws(
        tuple((interface.parameter_variables | given_variables).values()),
        {**interface.parameters, **own},
        env.config.variable_starts | env.inside.variable_starts,
        own.keys(),
    )


def draws_of_reset(
    env: Constructed, options: Mapping[str, Any] | None, *also_known: str
) -> EpisodeDraws:
    """Prepare the draws of the episodes that a reset with options begins.

    Args:
        env: The environment.
        options: Those of ``reset``.
        also_known: Names of options that are dealt with elsewhere.

    Raises:
        ConfigError: If an option does not fit.
    """
    if options is None:
        return env.inside.draws
    options = check_mapping("the options of reset", options)
    for name in options:
        if name not in env.reset_options:
            raise unknown_name("reset option", name, (*env.reset_options, *also_known))
    if not options:
        return env.inside.draws
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


def _require_readings(cls: type[Any]) -> None:
    """Refuse classes with attributes of their own in the places of what hooks read."""
    for name in READINGS:
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
