"""The config of an environment: a dict as the user writes it, checked once and frozen."""

from __future__ import annotations

import math
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from fmugym.archive.description import INTERFACES
from fmugym.archive.fmu import DEFAULT_PROBE_TIMEOUT
from fmugym.archive.safe_zip import ArchiveLimits
from fmugym.checks import (
    check_count,
    check_mapping,
    check_number,
    check_option,
    flattened,
    integer_of,
    number_of,
)
from fmugym.distributions import Choice, as_distribution, is_distribution
from fmugym.errors import ConfigError, shown, unknown_name
from fmugym.pool.spec import (
    DEFAULT_CALL_TIMEOUT,
    DEFAULT_LEAK_LIMIT,
    ISOLATIONS,
    SAMPLINGS,
    SOLVERS,
    ResetMethod,
)
from fmugym.retired import without_retired
from fmugym.signals import ordinary

__all__ = ["EnvConfig"]

ON_FAULT: Final = ("truncate", "terminate", "raise")
MOST_RETRIES: Final = 10
"""The last retry makes 1024 steps of one."""

_REWARDS: Final = ("positive_reward", "negative_reward", "fault_reward")
_TIMES: Final = ("stop_time",)
_POSITIVE: Final = (
    "time_step",
    "probe_timeout",
    "call_timeout",
    "tolerance",
    "max_step",
)
_NAMES: Final = ("model_input_names", "model_output_names", "monitor_names", "preload")

_ELSEWHERE: Final = dict.fromkeys(
    ("render_mode", "backend", "hooks", "log_level"), "the environment's constructor"
) | {"seed": "reset"}
"""What is not said in a config, and where it is."""


@dataclass(frozen=True)
class EnvConfig:
    """How an environment drives its FMU. All times are in simulated seconds.

    Numbers may be given in any type; the attributes are Python floats and integers.

    Attributes:
        model_input_names: The variables that the action is written to; a bare name is fine for one.
            The name of an array stands for its elements in row-major order; ``v[3]`` is one.
        model_output_names: The variables that ``state`` holds, in this order.
        model_parameters: Start values by name: numbers, or distributions drawn at each reset; for
            an array, nested lists of them, or one for all elements.
        time_step: Length of one ``step``; by default the FMU's own default step size.
        positive_reward: Default reward of a step.
        negative_reward: Default reward of a step that ends the task (``_is_done``).
        max_episode_steps: Steps after which an episode is truncated; None for no limit.
        start_time: First communication point of an episode: a time, or a distribution or a list of
            times from which it is drawn at each reset; by default the FMU's own default start time.
        stop_time: Given to the FMU unless it is None; the episode is truncated there.
        tolerance: For the solver of the FMU, or the one that integrates it in model exchange; by
            default that of the FMU's default experiment.
        substeps: Communication steps within one ``step``.
        warm_up: Time simulated at each reset before the first observation, a multiple of
            ``time_step``, with the inputs at their start values.
        monitor_names: Variables that are read along with the outputs; they are in ``out`` but not
            in ``state``.
        episode_variables: Values of the task itself by name (targets, integrals, histories):
            numbers, distributions drawn at each reset, or arrays of both. ``_update`` may write
            them; it assigns new arrays.
        bounds: ``(low, high)`` by name, used instead of the FMU's own min and max for the spaces,
            and as the range of parameters and start values.
        on_fault: What a failed step does: truncate or terminate the episode, or raise.
        fault_retries: How often a step that the FMU discards is repeated, as 2, 4, 8 ... smaller
            ones, before ``on_fault`` applies.
        fault_reward: Reward of a step that failed.
        leak_limit: Bytes of memory that resets may leak, and by which a worker process may
            grow. Beyond it, the worker is replaced; in this process, the log says so once. None
            for no limit.
        reset_method: How episodes begin: ``"restore"``, ``"reset"``, ``"instance"``, ``"library"``
            or ``"process"``; by default the fastest one that a trial has found to be right.
        archive_limits: How large an FMU may be, an ``ArchiveLimits`` or a dict of its arguments; by
            default ``ArchiveLimits()``.
        preload: Shared libraries to load before the FMU's; a relative path is relative to the file
            of the class or of the task.
        probe_timeout: Seconds of real time that a call of an unknown FMU may take in its trial in a
            process of its own. An initialization may take ten times as long. None to skip the
            trial.
        isolation: Where the FMU runs: ``"process"`` or ``"none"``; see
            ``fmugym.trial.opening.make_pool``.
        call_timeout: Seconds of real time that a call of an FMU may take in a worker process. A
            reset or an instantiation may take ten times as long. None for no limit.
        max_instances: How many instances of the FMU this process and its workers may have at once,
            for FMUs with licences: each instance may take a seat. None for no limit.
        licence_wait: Seconds of real time to wait for a licence that the FMU does not get; 0 to
            give up at once.
        samplings: What a step gives of outputs and monitored variables by name: ``"last"`` (the
            default), or the ``"mean"``, ``"integral"`` over time, ``"min"`` or ``"max"`` of the
            values after each substep. After a reset an integral is 0.
        interface: How the FMU is run: ``"co_simulation"`` or ``"model_exchange"``; by default
            co-simulation where the FMU offers it, or as the class says.
        solver: The method of integration for model exchange: ``"dormand_prince"``, ``"euler"``,
            ``"rk4"``, or ``"rosenbrock"`` for stiff models.
        max_step: The longest step of this solver; by default a step of ``"euler"`` and ``"rk4"``
            is the FMU's own default step size, and the others choose their steps by the tolerance.

    Raises:
        ConfigError: For a value of the wrong type or range.
    """

    model_input_names: tuple[str, ...]
    model_output_names: tuple[str, ...]
    model_parameters: Mapping[str, Any] = field(default_factory=dict)
    time_step: float | None = None
    positive_reward: float = 1.0
    negative_reward: float = -100.0
    max_episode_steps: int | None = None
    start_time: Any = None
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
    reset_method: str | None = None
    archive_limits: ArchiveLimits | None = None
    preload: tuple[str, ...] = ()
    probe_timeout: float | None = DEFAULT_PROBE_TIMEOUT
    isolation: str | None = None
    call_timeout: float | None = DEFAULT_CALL_TIMEOUT
    max_instances: int | None = None
    licence_wait: float = 0.0
    samplings: Mapping[str, str] = field(default_factory=dict)
    interface: str | None = None
    solver: str = SOLVERS[0]
    max_step: float | None = None

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
        items = without_retired(check_mapping("config", config))
        known = [f.name for f in fields(cls)]
        for key in items:
            if key in _ELSEWHERE:
                raise ConfigError(f"{key!r} is no config key, but an argument of {_ELSEWHERE[key]}")
            if key not in known:
                raise unknown_name("config key", key, known)
        for key in ("model_input_names", "model_output_names"):
            if key not in items:
                raise ConfigError(f"config key {key!r} is missing")
        return cls(**items)

    def __post_init__(self) -> None:
        for key in _NAMES:
            self._set(key, _names(key, getattr(self, key)))
        self._take_start_time()
        self._take_mappings()
        self._take_floats()
        self._take_integers()
        self._set("on_fault", check_option("on_fault policy", self.on_fault, ON_FAULT))
        if self.isolation is not None:
            self._set("isolation", check_option("isolation", self.isolation, ISOLATIONS))
        if self.interface is not None:
            self._set("interface", check_option("interface", self.interface, INTERFACES))
        self._set("solver", check_option("solver", self.solver, SOLVERS))
        if self.reset_method is not None:
            methods = list(map(str, ResetMethod))
            self._set("reset_method", check_option("reset method", self.reset_method, methods))
        if self.archive_limits is not None:
            self._set("archive_limits", _archive_limits(self.archive_limits))
        self._check_names()

    def _set(self, key: str, value: Any) -> None:
        object.__setattr__(self, key, value)

    def _take_start_time(self) -> None:
        start = self.start_time
        if isinstance(start, list | tuple):
            start = Choice(start)
        if start is not None:
            self._set("start_time", _number("start_time", as_distribution("start_time", start)))

    @property
    def draws_start_time(self) -> bool:
        """Whether each episode has a start time of its own."""
        return is_distribution(self.start_time)

    def _take_mappings(self) -> None:
        for key in ("model_parameters", "episode_variables", "bounds"):
            self._set(key, check_mapping(key, getattr(self, key)))
        parameters = {
            name: as_distribution(repr(name), value)
            for name, value in self.model_parameters.items()
        }
        self._set("model_parameters", parameters)
        variables = {name: _variable(name, v) for name, v in self.episode_variables.items()}
        self._set("episode_variables", variables)
        self._set("bounds", {name: _bounds(name, limits) for name, limits in self.bounds.items()})
        samplings = check_mapping("samplings", self.samplings).items()
        checked = {name: check_option("sampling", value, SAMPLINGS) for name, value in samplings}
        self._set("samplings", checked)

    def _take_floats(self) -> None:
        for key in _REWARDS:
            self._set(key, check_number(key, getattr(self, key)))
        for key in ("warm_up", "licence_wait"):
            self._set(key, check_number(key, getattr(self, key), minimum=0))
        for key in _TIMES + _POSITIVE:
            value = getattr(self, key)
            if value is not None:
                self._set(key, check_number(key, value, positive=key in _POSITIVE))

    def _take_integers(self) -> None:
        self._set("substeps", check_count("substeps", self.substeps))
        for key in ("max_episode_steps", "leak_limit", "max_instances"):
            value = getattr(self, key)
            if value is not None:
                self._set(key, check_count(key, value, sys.maxsize))
        retries = integer_of(self.fault_retries)
        if retries not in range(MOST_RETRIES + 1):
            raise ConfigError(
                f"fault_retries must be an integer from 0 to {MOST_RETRIES}, "
                f"got {shown(self.fault_retries)}"
            )
        self._set("fault_retries", retries)

    def _check_names(self) -> None:
        read = self.model_output_names + self.monitor_names
        for key, names in (("model_input_names", self.model_input_names), ("outputs", read)):
            twice = sorted({name for name in names if names.count(name) > 1})
            if twice:
                raise ConfigError(f"{key}: {twice[0]!r} is named twice")
        if not self.model_output_names:
            raise ConfigError("config key 'model_output_names' names no output")
        for name in self.samplings:
            if name not in read and "[" not in name:  # an element of an array may be meant
                raise unknown_name("output in 'samplings'", name, read)
        for name in self.episode_variables:
            if name in self.model_parameters:
                raise ConfigError(f"{name!r} is both a model parameter and an episode variable")
        taken = "start_time" in {*self.model_parameters, *self.episode_variables}
        if taken and self.draws_start_time:
            raise ConfigError(
                "'start_time' is the name of the start time that is drawn for each episode; no "
                "model parameter and no episode variable may have this name, too"
            )


def _names(key: str, value: Any) -> tuple[str, ...]:
    """Return names as a tuple; a bare name stands for one."""
    names = [value] if isinstance(value, str) else _listed(value)
    if names is None or not all(isinstance(name, str) for name in names):
        raise ConfigError(f"{key} must be a name or a list of names, got {shown(value)}")
    return tuple(str.__str__(name) for name in names)


def _listed(value: Any) -> list[Any] | None:
    try:
        return list(value) if isinstance(value, Sequence) else None
    except ordinary(Exception):  # a sequence of the caller's that fails
        return None


def _variable(name: str, value: Any) -> Any:
    """Return an episode variable as a float, a distribution of floats or an array of floats."""
    what = f"episode variable {name!r}"
    if isinstance(value, list | tuple) or (isinstance(value, np.ndarray) and value.ndim):
        return _variable_array(what, value)
    return _number(what, as_distribution(what, value), may_be_boolean=True)


def _variable_array(what: str, value: Any) -> npt.NDArray[Any]:
    """Return an array that cannot be changed, because all episodes start with it.

    It is of floats, or of floats and distributions as objects.
    """
    try:
        array: npt.NDArray[Any] = np.array(value, np.float64)
    except ordinary(Exception):  # no array, distributions, or objects that are no numbers
        array = _drawn_array(what, value)
    is_float = array.dtype != object
    if not array.size or (is_float and not np.isfinite(array).all()):
        raise ConfigError(f"{what} must be an array of finite numbers, got {shown(value)}")
    array.setflags(write=False)
    return array


def _drawn_array(what: str, value: Any) -> npt.NDArray[Any]:
    """Return an array of objects for an array with distributions in it."""
    shape, elements = flattened(value)
    elements = [as_distribution(what, one) for one in elements]
    if shape is None or not any(map(is_distribution, elements)):
        raise ConfigError(f"{what} must be an array of numbers, got {shown(value)}")
    array = np.empty(len(elements), object)
    for place, one in enumerate(elements):
        array[place] = _number(f"element {place} of {what}", one, may_be_boolean=True)
    return array.reshape(shape)


def _number(what: str, value: Any, *, may_be_boolean: bool = False) -> Any:
    """Return a number or a distribution of numbers."""
    if isinstance(value, Choice) and any(isinstance(one, str) for one in value.values):
        raise ConfigError(f"{what} must be a number, got {shown(value)}")
    if is_distribution(value):
        return value
    return check_number(what, value, may_be_boolean=may_be_boolean)


def _archive_limits(limits: Any) -> ArchiveLimits:
    if isinstance(limits, ArchiveLimits):
        return limits
    known = [f.name for f in fields(ArchiveLimits)]
    if not isinstance(limits, Mapping):
        raise ConfigError(f"archive_limits must be ArchiveLimits or a dict, got {shown(limits)}")
    items = check_mapping("archive_limits", limits)
    for name in items:
        if name not in known:
            raise unknown_name("archive limit", name, known)
    return ArchiveLimits(**items)


def _bounds(name: str, limits: Any) -> tuple[float, float]:
    try:
        low, high = (number_of("limit", one, may_be_boolean=True) for one in limits)
    except ordinary(Exception):  # no pair of numbers, or an object whose own methods fail
        low = high = math.nan
    if not low < high:
        raise ConfigError(
            f"bounds of {name!r} must be (low, high) with low < high, got {shown(limits)}"
        )
    return low, high
