"""Config of an environment: a dict of the user, checked once and frozen."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from fmugym.checks import (
    KnownArguments,
    Spellings,
    check_integer,
    check_mapping,
    check_number,
    flattened,
    number_of,
)
from fmugym.environment.distributions import Choice, as_distribution, is_distribution
from fmugym.errors import ConfigError, shown, unknown_name
from fmugym.expressions.language import Expression
from fmugym.fmi.description import INTERFACES
from fmugym.fmi.fmu import DEFAULT_PROBE_TIMEOUT
from fmugym.fmi.safe_zip import ArchiveLimits
from fmugym.keys import (
    COUNT,
    LARGE_COUNT,
    NUMBER,
    POSITIVE,
    REQUIRED,
    TEXT,
    Either,
    Entries,
    Key,
    Kind,
    Listed,
    Table,
    check_fields,
    checked_entry,
    key,
    option,
    or_none,
    table_of_fields,
)
from fmugym.pool.pool_spec import (
    DEFAULT_CALL_TIMEOUT,
    DEFAULT_LEAK_LIMIT,
    ISOLATIONS,
    SAMPLINGS,
    SOLVERS,
    ResetMethod,
)

__all__ = ["CONFIG", "EXPRESSION", "FOREIGN", "EnvConfig", "Foreign"]

ON_FAULT: Final = ("truncate", "terminate", "raise")
_INFOS: Final = frozenset(
    {"cost", "costs", "drawn", "fault", "fault_rate", "fmu_terminated", "reward_terms"}
)
"""Keys that infos have of their own."""

_MOST_RETRIES: Final = 10
"""The last retry makes 1024 steps of one."""


def _names(key: str, value: Any) -> tuple[str, ...]:
    """Return names as a tuple; a bare name stands for one."""
    names = [value] if isinstance(value, str) else _listed(value)
    if names is None or not all(isinstance(name, str) for name in names):
        raise ConfigError(f"{key} must be a name or a list of names, got {shown(value)}")
    return tuple(str.__str__(name) for name in names)


def _listed(value: Any) -> list[Any] | None:
    try:
        return list(value) if isinstance(value, Sequence) else None
    except Exception:  # a sequence of the caller's that fails
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
    except Exception:  # no array, distributions, or objects that are no numbers
        array = _drawn_array(what, value)
    is_float = array.dtype != object
    if not array.size or (is_float and not np.isfinite(array).all()):
        raise ConfigError(f"{what} must be an array of finite numbers, got {shown(value)}")
    array.setflags(write=False)
    return array


def _drawn_array(what: str, value: Any) -> npt.NDArray[Any]:
    """Return an array of objects for an array with distributions in it."""
    try:
        shape, elements = flattened(value)
    except Exception:  # a list of the caller's that fails
        shape, elements = None, []
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


def _bounds(name: str, limits: Any) -> tuple[float, float]:
    try:
        low, high = (number_of("limit", one, may_be_boolean=True) for one in limits)
    except Exception:  # no pair of numbers, or an object whose own methods fail
        low = high = math.nan
    if not low < high:
        raise ConfigError(
            f"bounds of {name!r} must be (low, high) with low < high, got {shown(limits)}"
        )
    return low, high


def _start_time(what: str, value: Any) -> Any:
    given = Choice(value) if isinstance(value, list | tuple) else value
    return _number(what, as_distribution(what, given))


def _expression(what: str, value: Any) -> Expression:
    if isinstance(value, Expression):
        return value
    try:
        return Expression.parse(value)
    except ConfigError as error:
        raise ConfigError(f"{what!r}: {error}") from None


_EXPRESSION: Final = {"title": "expression", "type": ["number", "string", "boolean"]}

EXPRESSION: Final = Kind(lambda _, value: Expression.parse(value), _EXPRESSION)
"""Kind of an expression; the caller adds its key to messages."""

_NAMED_EXPRESSION: Final = Kind(_expression, _EXPRESSION)

_TERM: Final = Table(
    {
        "expr": Key(_NAMED_EXPRESSION, "The expression.", REQUIRED),
        "weight": Key(NUMBER, "Factor of the reward.", 1.0),
    },
    what="key of a reward",
    short="expr",
)

_REMEMBERED: Final = Table(
    {
        "start": Key(Kind(_variable), "Set, or drawn, at each reset.", REQUIRED),
        "update": Key(_NAMED_EXPRESSION, "The value after each step.", REQUIRED),
    },
    what="key of 'memory'",
)

_NAMES: Final = Kind(
    _names, {"title": "name, list of names", "type": ["string", "array"], "items": TEXT.schema}
)
_NOT_NEGATIVE: Final = Kind(partial(check_number, minimum=0), {"type": "number", "minimum": 0})


@dataclass(frozen=True)
class Foreign(KnownArguments):
    """How an FMU of unknown quality is opened and run; see ``docs/config.md`` for the keys.

    Raises:
        ConfigError: For values of the wrong type or range; it names all of them.
    """

    probe_timeout: float | None = key(
        or_none(POSITIVE),
        "Real seconds that the first step of an unknown FMU may take in its "
        "[trial](reliability.md#the-trial); the first initialization may take ten times as long. "
        "`None`: no trial.",
        DEFAULT_PROBE_TIMEOUT,
    )
    call_timeout: float | None = key(
        or_none(POSITIVE),
        "Real seconds that a call may take in a worker process; a reset or an instantiation may "
        "take ten times as long. `None`: no limit.",
        DEFAULT_CALL_TIMEOUT,
    )
    reset_method: str | None = key(
        option(*map(str, ResetMethod)),
        "How episodes begin.",
        None,
        "the fastest way that is [found to be right](reliability.md#resets)",
    )
    leak_limit: int | None = key(
        or_none(LARGE_COUNT),
        "Bytes by which a worker process may grow before it is [replaced](reliability.md#leaks). "
        "`None`: no limit.",
        DEFAULT_LEAK_LIMIT,
    )
    max_instances: int | None = key(
        LARGE_COUNT,
        "How many instances of the FMU this process and its workers may have at once; see "
        "[Licences](failures.md#it-needs-a-licence).",
        None,
        "no limit",
    )
    licence_wait: float = key(
        _NOT_NEGATIVE,
        "Real seconds to wait for a licence that the FMU does not get. `0`: give up at once.",
        0.0,
    )
    preload: tuple[str, ...] = key(
        Kind(_names, _NAMES.schema, "libraries"),
        "Shared libraries that are [loaded before](foreign-fmus.md#missing-libraries) "
        "the FMU's own. A relative path is relative to the file of the class or of the task.",
        (),
    )
    archive_limits: ArchiveLimits | None = key(
        table_of_fields(ArchiveLimits, what="archive limit", make=ArchiveLimits),
        "The [largest FMU](reliability.md#archive-limits) that is opened, as a dict or a "
        "`fmugym.fmi.ArchiveLimits`.",
        None,
        "`ArchiveLimits()`",
    )

    def __post_init__(self) -> None:
        check_fields(self)


FOREIGN: Final = table_of_fields(Foreign, what="key of 'foreign'", make=Foreign)
"""The keys of ``Foreign``."""


@dataclass(frozen=True)
class EnvConfig:
    """Config of an environment. All times are in simulated seconds.

    Numbers may be given in any type; the attributes are Python floats and integers. Attributes are
    the keys of a config; ``docs/config.md`` lists them.

    Raises:
        ConfigError: For values of the wrong type or range; it names all of them.
    """

    model_input_names: tuple[str, ...] = key(
        _NAMES,
        "Variables to which the action is written: inputs or tunable parameters. "
        "[Arrays](fmi.md#arrays) go by their name, or by elements as `v[3]`.",
    )
    model_output_names: tuple[str, ...] = key(
        _NAMES, "Variables that `state` holds, in this order."
    )
    model_parameters: Mapping[str, Any] = key(
        Entries(Kind(as_distribution)),
        "Start values and parameters by name: numbers or [distributions](config.md#distributions). "
        "An array takes nested lists, or one value for all its elements; an Enumeration also the "
        "name of an item; a String text, or a [`Choice`](fmi.md#strings) of texts.",
        {},
    )
    time_step: float | None = key(
        POSITIVE, "Length of one step in seconds.", None, "the default step size of the FMU"
    )
    positive_reward: float = key(NUMBER, "Default reward of a step.", 1.0)
    negative_reward: float = key(
        NUMBER, "Default reward of a step that ends the task (`_is_done`).", -100.0
    )
    max_episode_steps: int | None = key(
        LARGE_COUNT, "Number of steps after which an episode is truncated.", None, "no limit"
    )
    start_time: Any = key(
        Kind(_start_time, {"title": "number, distribution, list of numbers"}),
        "First communication point of an episode in seconds, or a distribution or list from which "
        "each reset [draws](config.md#step-sizes-and-times) one.",
        None,
        "the default of the FMU",
    )
    stop_time: float | None = key(
        NUMBER, "Passed on to the FMU; the episode is truncated there.", None, "no stop time"
    )
    tolerance: float | None = key(
        POSITIVE,
        "Tolerance of the FMU's solver, or of [fmugym's](fmi.md#choose-a-solver) in "
        "model exchange.",
        None,
        "from the FMU's default experiment",
    )
    substeps: int = key(COUNT, "Number of communication steps in one step.", 1)
    warm_up: float = key(
        _NOT_NEGATIVE,
        "Seconds simulated at each reset before the first observation, with the inputs at their "
        "start values; a multiple of `time_step`.",
        0.0,
    )
    monitor_names: tuple[str, ...] = key(
        _NAMES,
        "Variables that are read along with the outputs: in `out`, not in `state`.",
        (),
    )
    episode_variables: Mapping[str, Any] = key(
        Entries(Kind(_variable)),
        "Variables of the task itself by name, such as targets, integrals and histories: numbers, "
        "distributions, or [arrays](hooks.md#remember-something-during-an-episode) of both. "
        "`_update` may write them; it assigns new arrays.",
        {},
    )
    inputs: Mapping[str, Expression] = key(
        Entries(_NAMED_EXPRESSION),
        "[Expressions](class.md#expressions) by the names of inputs, which write them before each "
        "step. The action has no elements for these inputs.",
        {},
    )
    terminated: Expression | None = key(
        _NAMED_EXPRESSION,
        "A condition: the task has ended. Takes the place of `_is_done`.",
        None,
        "the hook `_is_done`",
    )
    truncated: Expression | None = key(
        _NAMED_EXPRESSION,
        "A condition: cut the episode short, in addition to `max_episode_steps`.",
        None,
        "never",
    )
    reward: Any = key(
        Either(Entries(_TERM), _NAMED_EXPRESSION),
        "An expression, or named ones that are added up, in the place of `positive_reward` and "
        "`negative_reward`: `{name: expression}`, or `{name: {'expr': ..., 'weight': 0.1}}`. Terms "
        "with names are in `info['reward_terms']`.",
        None,
        "`positive_reward` and `negative_reward`",
    )
    observations: Sequence[Expression] = key(
        Listed(_NAMED_EXPRESSION, or_one=True),
        "A list of expressions: the elements of the observation.",
        (),
        "the outputs",
    )
    memory: Mapping[str, Any] = key(
        Entries(_REMEMBERED),
        "Episode variables that expressions update after each step of the FMU: "
        "`{name: {'start': 0, 'update': expression}}`.",
        {},
    )
    costs: Mapping[str, Expression] = key(
        Entries(_NAMED_EXPRESSION), "Expressions for `info['cost']`, by name.", {}
    )
    info: Mapping[str, Expression] = key(
        Entries(_NAMED_EXPRESSION), "Expressions for more entries of `info`, by name.", {}
    )
    bounds: Mapping[str, tuple[float, float]] = key(
        Entries(Kind(_bounds)),
        "`(low, high)` by name, used instead of the FMU's min and max: limits for the spaces, and "
        "the [range](config.md#ranges) of parameters and start values.",
        {},
    )
    units: Mapping[str, str] = key(
        Entries(TEXT),
        "Units of the FMU's variables by name, where the FMU declares none or a wrong one.",
        {},
    )
    on_fault: str = key(
        option(*ON_FAULT),
        "The [consequence](config.md#what-a-failed-step-does) of a failed step.",
        "truncate",
    )
    fault_retries: int = key(
        Kind(
            partial(check_integer, minimum=0, maximum=_MOST_RETRIES),
            {"type": "integer", "minimum": 0, "maximum": _MOST_RETRIES},
        ),
        "How often a step that the FMU discards is [repeated](reliability.md#retries), as 2, 4, "
        "8 ... smaller steps, before `on_fault` applies.",
        0,
    )
    fault_reward: float = key(NUMBER, "Reward of a failed step.", 0.0)
    isolation: str | None = key(
        option(*ISOLATIONS),
        'Where the FMU runs: `"process"`: in [worker processes](failures.md#it-crashes-or-'
        'hangs), `"none"`: in your process.',
        None,
        "in your process where possible",
    )
    foreign: Foreign = key(
        FOREIGN,
        "[Keys for experts](config.md#keys-for-experts): trials, time limits, licences, leaks, "
        "libraries.",
        Foreign(),
        "see below",
    )
    samplings: Mapping[str, str] = key(
        Entries(option(*SAMPLINGS)),
        "How a step makes one value of those after its substeps, by output or monitored variable: "
        '`"last"`, `"mean"`, `"integral"` over time, `"min"` or `"max"`. After a reset an integral '
        "is 0.",
        {},
    )
    interface: str | None = key(
        option(*INTERFACES),
        "How the FMU is run.",
        None,
        "co-simulation where the FMU offers it, or as the class says",
    )
    solver: str = key(
        option(*SOLVERS),
        "The [solver](fmi.md#choose-a-solver) for model exchange.",
        SOLVERS[0],
    )
    max_step: float | None = key(
        POSITIVE,
        "The longest step of this solver in seconds.",
        None,
        "see [its page](fmi.md#choose-a-solver)",
    )

    @classmethod
    def from_dict(cls, config: Mapping[str, Any] | EnvConfig) -> EnvConfig:
        """Check a config as the user gave it.

        Args:
            config: The dict; the keys are the attributes of this class.

        Returns:
            The checked config.

        Raises:
            ConfigError: For unknown or missing keys, or values of the wrong type or range; it names
                all of them.
        """
        if isinstance(config, EnvConfig):
            return config
        if not isinstance(config, Mapping):
            raise ConfigError(f"config must be a dict, got {type(config).__name__}")
        given = check_mapping("config", config)
        for name in ("positive_reward", "negative_reward"):
            if name in given and given.get("reward") is not None:
                raise ConfigError(f"config keys 'reward' and {name!r} contradict each other")
        return cls(**checked_entry(CONFIG, given))

    def __post_init__(self) -> None:
        check_fields(self)
        self._check_names()

    @property
    def variable_starts(self) -> dict[str, Any]:
        """Start values of episode variables, the memory among them."""
        return {name: one["start"] for name, one in self.memory.items()} | dict(
            self.episode_variables
        )

    @property
    def reward_terms(self) -> dict[str, dict[str, Any]]:
        """The terms of the reward by name; one without a name has the name ``""``."""
        if isinstance(self.reward, Expression):
            return {"": {"expr": self.reward, "weight": 1.0}}
        return dict(self.reward or {})

    @property
    def expressions(self) -> list[Expression]:
        """All expressions."""
        conditions = (self.terminated, self.truncated)
        return [
            *self.inputs.values(),
            *(one for one in conditions if one is not None),
            *(term["expr"] for term in self.reward_terms.values()),
            *self.observations,
            *(one["update"] for one in self.memory.values()),
            *self.costs.values(),
            *self.info.values(),
        ]

    @property
    def draws_start_time(self) -> bool:
        """Whether each episode has a start time of its own."""
        return is_distribution(self.start_time)

    def _check_names(self) -> None:
        read = self.model_output_names + self.monitor_names
        for what, names in (("model_input_names", self.model_input_names), ("outputs", read)):
            twice = sorted({name for name in names if names.count(name) > 1})
            if twice:
                raise ConfigError(f"{what}: {twice[0]!r} is named twice")
        if not self.model_output_names:
            raise ConfigError("config key 'model_output_names' names no output")
        for name in self.samplings:
            if (
                Spellings("output", read).find(name) is None and "[" not in name
            ):  # an element of an array may be meant
                raise unknown_name("output in 'samplings'", name, read)
        self._check_names_of_task()

    def _check_names_of_task(self) -> None:
        for name in self.memory.keys() & self.episode_variables.keys():
            raise ConfigError(f"{name!r} is in 'memory' and in 'episode_variables'")
        for name in self.variable_starts:
            if name in self.model_parameters:
                raise ConfigError(f"{name!r} is both a model parameter and an episode variable")
        for name in _INFOS & self.info.keys():
            raise ConfigError(f"config key 'info': {name!r} has a meaning of its own in infos")
        taken = "start_time" in {*self.model_parameters, *self.variable_starts}
        if taken and self.draws_start_time:
            raise ConfigError(
                "'start_time' is the name of the start time that is drawn for each episode; no "
                "model parameter and no episode variable may have this name, too"
            )


CONFIG: Final = table_of_fields(
    EnvConfig,
    what="config key",
    elsewhere={
        "seed": ", but an argument of reset",
        **dict.fromkeys(
            ("render_mode", "backend", "log_level"),
            ", but an argument of the environment's constructor",
        ),
    },
)
"""The keys of a config."""
