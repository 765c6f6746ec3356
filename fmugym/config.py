"""The config of an environment: a dict as the user writes it, checked once and frozen."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from typing import Any

from fmugym.archive.fmu import DEFAULT_PROBE_TIMEOUT
from fmugym.archive.safe_zip import ArchiveLimits
from fmugym.checks import check_count, check_number, number_of
from fmugym.distributions import is_distribution
from fmugym.errors import ConfigError, unknown_name
from fmugym.pool.spec import (
    DEFAULT_CALL_TIMEOUT,
    DEFAULT_LEAK_LIMIT,
    ISOLATIONS,
)

__all__ = ["EnvConfig"]

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
        isolation: Where the FMU runs: ``"process"`` or ``"none"``; see
            ``fmugym.trial.opening.make_pool``.
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
    probe_timeout: float | None = DEFAULT_PROBE_TIMEOUT
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
            check_number(key, getattr(self, key))
        check_number("warm_up", self.warm_up, minimum=0)
        times = ("time_step", "start_time", "stop_time", "probe_timeout", "call_timeout")
        for key in (*times, "tolerance"):
            value = getattr(self, key)
            if value is not None:
                check_number(key, value, positive=key not in {"start_time", "stop_time"})
        check_count("substeps", self.substeps)
        for key in ("max_episode_steps", "leak_limit"):
            if getattr(self, key) is not None:
                check_count(key, getattr(self, key))
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
        check_number(what, value)


def _check_bounds(name: str, limits: Any) -> None:
    try:
        low, high = (number_of("limit", limit) for limit in limits)
    except (ConfigError, TypeError, ValueError):
        low = high = math.nan
    if not low < high:
        raise ConfigError(f"bounds of {name!r} must be (low, high) with low < high, got {limits!r}")
