"""The config of an environment: a dict as the user writes it, checked once and frozen."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from numbers import Real
from typing import Any

import numpy as np

from fmugym.distributions import is_distribution
from fmugym.errors import ConfigError, unknown_name
from fmugym.model_description import ModelDescription, Variable
from fmugym.pool_spec import (
    DEFAULT_CALL_TIMEOUT,
    DEFAULT_LEAK_LIMIT,
    ISOLATIONS,
    PoolSpec,
    whole_number_of_steps,
)
from fmugym.probing import DEFAULT_TIMEOUT
from fmugym.safe_zip import ArchiveLimits

__all__ = ["EnvConfig"]

_LARGEST_FLOAT32 = float(np.finfo(np.float32).max)
_LARGEST_EXACT_INTEGER = 2.0**53

ON_FAULT = ("truncate", "terminate", "raise")
MOST_RETRIES = 10
"""The last one is 1024 steps instead of one."""


@dataclass(frozen=True)
class EnvConfig:
    """How an environment drives its FMU. All times are in simulated seconds.

    Attributes:
        model_input_names: The variables the action is written to; a bare name is fine for one.
        model_output_names: The variables ``state`` holds, in this order.
        model_parameters: Start values by name: numbers, or distributions drawn at each reset.
        time_step: Length of one ``step``; by default the FMU's own default step size.
        positive_reward: Default reward of a step.
        negative_reward: Default reward of a step that ends the task (``_is_done``).
        max_episode_steps: Steps after which an episode is truncated; None for no limit.
        start_time: First communication point; by default the FMU's own default start time.
        stop_time: Given to the FMU where it is not None; the episode is truncated there.
        tolerance: For the FMU's solver; by default the FMU's own.
        substeps: Communication steps within one ``step``.
        warm_up: Time simulated at each reset before the first observation, a multiple of
            ``time_step``, with the inputs at their start values.
        monitor_names: Variables read along with the outputs, found in ``out`` but not in ``state``.
        episode_variables: Values of the task itself by name (targets, integrals): numbers, or
            distributions drawn at each reset. ``_update`` may write them.
        bounds: ``(low, high)`` by name, used for the spaces instead of the FMU's own min and max.
        on_fault: What a failed step does: truncate or terminate the episode, or raise.
        fault_retries: How often a step that the FMU discards is repeated, as 2, 4, 8 ... smaller
            ones, before ``on_fault`` holds.
        fault_reward: Reward of a step that failed.
        leak_limit: Bytes of memory that resets may take for good before the FMU's instances are
            freed and made anew; None for ever.
        archive_limits: What is too large to be opened; by default ``ArchiveLimits()``.
        preload: Shared libraries to be loaded before the FMU's; a relative path is relative to the
            class's file.
        probe_timeout: Seconds of real time that an FMU which is not known yet may take for a first
            load and step in a process of its own; None to go without.
        isolation: Where the FMU runs: ``"process"`` or ``"none"``; see ``fmugym.pool.make_pool``.
        call_timeout: Seconds of real time that a call of an FMU may take where it runs in a worker
            process; None for ever.
    """

    model_input_names: tuple[str, ...]
    model_output_names: tuple[str, ...]
    model_parameters: Mapping[str, Any] = field(default_factory=dict)
    time_step: float | None = None
    positive_reward: float = 1.0
    negative_reward: float = -100.0
    max_episode_steps: int | None = None
    start_time: float | None = None
    stop_time: float | None = None
    tolerance: float | None = None
    substeps: int = 1
    warm_up: float = 0.0
    monitor_names: tuple[str, ...] = ()
    episode_variables: Mapping[str, Any] = field(default_factory=dict)
    bounds: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    on_fault: str = "truncate"
    fault_retries: int = 0
    fault_reward: float = 0.0
    leak_limit: int | None = DEFAULT_LEAK_LIMIT
    archive_limits: ArchiveLimits | None = None
    preload: tuple[str, ...] = ()
    probe_timeout: float | None = DEFAULT_TIMEOUT
    isolation: str | None = None
    call_timeout: float | None = DEFAULT_CALL_TIMEOUT

    @classmethod
    def from_dict(cls, config: Mapping[str, Any] | EnvConfig) -> EnvConfig:
        """Check a config as the user gave it.

        Args:
            config: The dict; the keys are the attributes of this class.

        Returns:
            The checked config.

        Raises:
            ConfigError: For an unknown or missing key, or a value of the wrong type or range.
        """
        if isinstance(config, EnvConfig):
            return config
        if not isinstance(config, Mapping):
            raise ConfigError(f"config must be a dict, got {type(config).__name__}")
        known = [f.name for f in fields(cls)]
        for key in config:
            if key not in known:
                raise unknown_name("config key", key, known)
        for key in ("model_input_names", "model_output_names"):
            if key not in config:
                raise ConfigError(f"config key {key!r} is missing")
        return cls(**config)

    def __post_init__(self) -> None:
        for key in ("model_input_names", "model_output_names", "monitor_names", "preload"):
            object.__setattr__(self, key, _names(key, getattr(self, key)))
        for key in ("model_parameters", "episode_variables", "bounds"):
            object.__setattr__(self, key, _mapping(key, getattr(self, key)))
        self._check_numbers()
        self._check_names()
        for name, value in self.episode_variables.items():
            _check_value(f"episode variable {name!r}", value)
        if self.on_fault not in ON_FAULT:
            raise unknown_name("on_fault policy", self.on_fault, ON_FAULT)
        if self.isolation not in (None, *ISOLATIONS):
            raise unknown_name("isolation", self.isolation, ISOLATIONS)

    def _check_numbers(self) -> None:
        for key in ("positive_reward", "negative_reward", "fault_reward"):
            _check_number(key, getattr(self, key))
        _check_number("warm_up", self.warm_up, minimum=0)
        times = ("time_step", "start_time", "stop_time", "probe_timeout", "call_timeout")
        for key in (*times, "tolerance"):
            value = getattr(self, key)
            if value is not None:
                _check_number(key, value, positive=key not in {"start_time", "stop_time"})
        _check_count("substeps", self.substeps)
        for key in ("max_episode_steps", "leak_limit"):
            if getattr(self, key) is not None:
                _check_count(key, getattr(self, key))
        retries = self.fault_retries
        if isinstance(retries, bool) or retries not in range(MOST_RETRIES + 1):
            raise ConfigError(
                f"fault_retries must be an integer from 0 to {MOST_RETRIES}, got {retries!r}"
            )

    def _check_names(self) -> None:
        read = self.model_output_names + self.monitor_names
        for key, names in (("model_input_names", self.model_input_names), ("outputs", read)):
            twice = sorted({name for name in names if names.count(name) > 1})
            if twice:
                raise ConfigError(f"{key}: {twice[0]!r} is named twice")
        if not self.model_output_names:
            raise ConfigError("config key 'model_output_names' names no output")
        for name in self.episode_variables:
            if name in self.model_parameters:
                raise ConfigError(f"{name!r} is both a model parameter and an episode variable")
        for name, limits in self.bounds.items():
            _check_bounds(name, limits)

    def resolve(self, description: ModelDescription) -> Interface:
        """Look all names up in the FMU and settle what the config left to it.

        Raises:
            ConfigError: If a name is unknown, or its variable cannot be used so.
        """
        given = [
            (start_variable(description, name, value), value)
            for name, value in self.model_parameters.items()
        ]
        interface = Interface(
            inputs=tuple(input_variable(description, n) for n in self.model_input_names),
            outputs=tuple(output_variable(description, n) for n in self.model_output_names),
            monitors=tuple(output_variable(description, n) for n in self.monitor_names),
            parameters={v.name: checked(v, value) for v, value in given if v.numeric},
            strings=tuple((v, value) for v, value in given if not v.numeric),
            config=self,
            description=description,
        )
        for name in self.bounds:
            if name not in self.model_input_names + self.model_output_names:
                raise unknown_name(
                    "input or output in 'bounds'",
                    name,
                    self.model_input_names + self.model_output_names,
                )
        return interface


@dataclass(frozen=True)
class Interface:
    """A config with its names looked up in one FMU."""

    inputs: tuple[Variable, ...]
    outputs: tuple[Variable, ...]
    monitors: tuple[Variable, ...]
    parameters: Mapping[str, Any]
    strings: tuple[tuple[Variable, str], ...]
    config: EnvConfig
    description: ModelDescription

    @property
    def time_step(self) -> float:
        """Length of one step in seconds."""
        step = self.config.time_step or self.description.step_size
        if step is None:
            raise ConfigError(
                f"config key 'time_step' is missing, and {self.description.model_name} "
                "has no default step size"
            )
        return step

    def bounds(self, variable: Variable) -> tuple[float, float]:
        """The limits of a variable: the config's, or else the FMU's.

        Raises:
            ConfigError: If the FMU's contradict each other.
        """
        low, high = self.config.bounds.get(variable.name, (variable.minimum, variable.maximum))
        if not low <= high:
            raise ConfigError(
                f"{variable.name!r} has min = {low} and max = {high} in the FMU; give it 'bounds'"
            )
        return low, high

    def pool_spec(self) -> PoolSpec:
        """What the pool has to do.

        Raises:
            ConfigError: If the warm-up is not a whole number of steps.
        """
        config, description = self.config, self.description
        self._require_retries()
        warm_up_steps = whole_number_of_steps(config.warm_up, self.time_step)
        if warm_up_steps is None:
            raise ConfigError(
                f"warm_up must be a multiple of the time step of {self.time_step} s, "
                f"got {config.warm_up}"
            )
        start = config.start_time
        return PoolSpec(
            inputs=self.inputs,
            outputs=self.outputs + self.monitors,
            time_step=self.time_step,
            num_observed=len(self.outputs),
            substeps=config.substeps,
            start_time=description.start_time if start is None else start,
            stop_time=config.stop_time,
            tolerance=config.tolerance,
            warm_up_steps=warm_up_steps,
            strings=self.strings,
            fault_retries=config.fault_retries,
            leak_limit=config.leak_limit,
        )

    def _require_retries(self) -> None:
        able = self.description.capabilities
        if not self.config.fault_retries or (
            able.can_handle_variable_communication_step_size and able.can_get_and_set_fmu_state
        ):
            return
        raise ConfigError(
            f"config key 'fault_retries': {self.description.model_name} must be able to get and "
            "set its FMU state and to handle variable communication step sizes, and is not"
        )


def input_variable(description: ModelDescription, name: str) -> Variable:
    """Find a variable that can be written before every step.

    Raises:
        ConfigError: If there is none of this name, or it must not be written then.
    """
    variable = description.variable(name)
    _require_numeric(variable, "an input")
    if not variable.settable_in_step:
        raise ConfigError(
            f"{name!r} cannot be an input: it is a {variable.variability} {variable.causality}; "
            "only inputs and tunable parameters may be set between steps"
        )
    return variable


def output_variable(description: ModelDescription, name: str) -> Variable:
    """Find a variable that can be read after every step.

    Raises:
        ConfigError: If there is none of this name, or a float cannot carry its value.
    """
    variable = description.variable(name)
    _require_numeric(variable, "an output")
    return variable


def _require_numeric(variable: Variable, role: str) -> None:
    if not variable.numeric:
        what = "an array" if variable.shape else f"of type {variable.type}"
        raise ConfigError(
            f"{variable.name!r} cannot be {role}: it is {what}; expected a scalar Real, "
            "Integer, Boolean or Enumeration"
        )


def start_variable(description: ModelDescription, name: str, value: Any) -> Variable:
    """Find a variable that can be set before initialization.

    Raises:
        ConfigError: If there is none of this name, or it cannot be set or not be carried.
    """
    variable = description.variable(name)
    if not variable.settable_at_start:
        raise ConfigError(
            f"{name!r} cannot be set: it is a {variable.variability} {variable.causality} "
            f"with initial={variable.initial!r}"
        )
    if variable.kind == "string" and not variable.shape:
        if not isinstance(value, str):
            raise ConfigError(f"{name!r} is a String, got {value!r}")
        return variable
    _require_numeric(variable, "given a start value")
    return variable


def checked(variable: Variable, value: Any) -> Any:
    """Check a start value of a numeric variable; a distribution is left for what it draws."""
    return value if is_distribution(value) else checked_value(variable, value)


def checked_value(variable: Variable, value: Any) -> float:
    """Convert a value for a numeric variable, without loss.

    Raises:
        ConfigError: If the value is not finite, not of the variable's kind, or out of its type's
            range.
    """
    if variable.type in {"Real", "Float64"} and isinstance(value, float) and math.isfinite(value):
        return value
    if isinstance(value, str) and variable.items:
        return _item_value(variable, value)
    _check_number(repr(variable.name), value)
    number = float(value)
    if variable.type == "Float32" and abs(number) > _LARGEST_FLOAT32:
        raise ConfigError(f"{variable.name!r} is a Float32, too narrow for {value!r}")
    if variable.kind == "boolean" and number not in {0.0, 1.0}:
        raise ConfigError(f"{variable.name!r} is a Boolean, got {value!r}")
    if variable.kind in {"integer", "enumeration"}:
        _check_integer(variable, number)
    return number


def _item_value(variable: Variable, name: str) -> float:
    items = dict(variable.items)
    if name not in items:
        raise unknown_name(f"item of {variable.name!r}", name, items)
    return float(items[name])


def _check_integer(variable: Variable, number: float) -> None:
    low, high = variable.integer_limits
    if not number.is_integer() or not low <= number <= high:
        raise ConfigError(
            f"{variable.name!r} is of type {variable.type}: expected an integer from {low} to "
            f"{high}, got {number}"
        )
    if abs(number) > _LARGEST_EXACT_INTEGER:
        raise ConfigError(f"{variable.name!r}: integers beyond 2**53 are not exact, got {number}")
    values = [value for _, value in variable.items]
    if values and number not in values:
        listing = ", ".join(f"{value} ({name})" for name, value in variable.items)
        raise ConfigError(f"{variable.name!r}: expected one of {listing}, got {number:g}")


def _names(key: str, value: Any) -> tuple[str, ...]:
    """A bare name stands for one: ModelicaGym split it into its letters."""
    names = (value,) if isinstance(value, str) else value
    if not isinstance(names, Sequence) or not all(isinstance(name, str) for name in names):
        raise ConfigError(f"{key} must be a name or a list of names, got {value!r}")
    return tuple(names)


def _mapping(key: str, value: Any) -> dict[str, Any]:
    if not isinstance(value, Mapping) or not all(isinstance(name, str) for name in value):
        raise ConfigError(f"{key} must be a dict with names as keys, got {value!r}")
    return dict(value)


def _check_value(what: str, value: Any) -> None:
    if not is_distribution(value):
        _check_number(what, value)


def _check_number(
    what: str, value: Any, minimum: float = -math.inf, *, positive: bool = False
) -> None:
    number = _number(what, value)
    if not math.isfinite(number) or number < minimum or (positive and number <= 0):
        wanted = "positive and finite" if positive else "finite and not negative"
        raise ConfigError(
            f"{what} must be {wanted if positive or minimum == 0 else 'finite'}, got {value!r}"
        )


def _number(what: str, value: Any) -> float:
    if isinstance(value, Real) or (hasattr(value, "__float__") and np.shape(value) == ()):
        try:
            return float(value)
        except (TypeError, ValueError, OverflowError):
            pass
    raise ConfigError(f"{what} must be a number, got {value!r}")


def _check_count(what: str, value: Any) -> None:
    if isinstance(value, bool) or not isinstance(value, int) or value < 1:
        raise ConfigError(f"{what} must be a positive integer, got {value!r}")


def _check_bounds(name: str, limits: Any) -> None:
    try:
        low, high = (_number("limit", limit) for limit in limits)
    except (ConfigError, TypeError, ValueError):
        low = high = math.nan
    if not low < high:
        raise ConfigError(f"bounds of {name!r} must be (low, high) with low < high, got {limits!r}")
