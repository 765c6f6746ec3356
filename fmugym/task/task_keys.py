"""The keys of task files."""

from __future__ import annotations

import datetime
import math
import re
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Final, cast

import numpy as np

from fmugym.checks import (
    check_flag,
    check_integer,
    check_number,
    check_option,
    check_text,
    duration,
    integer_of,
)
from fmugym.environment.config import CONFIG, EXPRESSION, FOREIGN
from fmugym.environment.distributions import DISTRIBUTIONS, Choice, Normal, Uniform, is_distribution
from fmugym.errors import ConfigError, shown
from fmugym.expressions.language import Expression
from fmugym.fmi.systems.components import Component
from fmugym.fmi.systems.wiring import SYSTEM
from fmugym.keys import COUNT as INTEGER
from fmugym.keys import (
    FLAG,
    REQUIRED,
    TEXT,
    Either,
    Entries,
    Key,
    Kind,
    Listed,
    Table,
    option,
    table_of_fields,
)
from fmugym.pool.pool_spec import SAMPLINGS
from fmugym.task.dates import moment_of_year, zone_of
from fmugym.task.task_entries import constant_of, finite, number, number_or_distribution

__all__ = ["AGENT", "DEVICE", "KPI", "PLANT", "SCHEMA", "SETPOINT", "TASK", "VERSION"]

SCHEMA: Final = Path(__file__).parent / "task.schema.json"
"""JSON Schema of the keys, for editors; ``docs/_site/keys.py`` writes it."""

VERSION: Final = 1
"""The version of the format; it is raised when a key changes its meaning."""

_DATE: Final = re.compile(r"(?:\d{4}-)?(\d{2})-(\d{2})(?:[T ](\d{2}):(\d{2}))?")
_LIKE_A_DATE: Final = re.compile(r"\d+-\d+")
_FULL_DATE: Final = re.compile(r"\s*\d{4}-\d\d")
_ANY_YEAR: Final = 2001  # without a leap day
_DAY: Final = 86400.0
_MOST_LEVELS: Final = 10_000
_MOST_NAMES: Final = 5000
_NORMALIZATIONS: Final = ("limits", "nominal")


# Checks of single values.


def _within(read: Callable[[str, Any], float], **limits: Any) -> Callable[[str, Any], float]:
    """Make a check of limits for the result of another check, as in ``check_number``."""
    return lambda what, value: check_number(what, read(what, value), **limits)


def _probability(what: str, value: Any) -> float:
    found = number(what, value)
    if not 0 < found < 1:
        raise ConfigError(f"expected a probability between 0 and 1, got {shown(value)}")
    return found


def _levels(what: str, value: Any) -> tuple[float, ...]:
    if isinstance(value, list | tuple) and len(value) > _MOST_LEVELS:
        raise ConfigError(
            f"an action has at most {_MOST_LEVELS} levels, got {len(value)}; with 'min' and 'max' "
            "it is continuous"
        )
    values = tuple(_numbers(what, value).tolist())
    if len(set(values)) < max(2, len(values)) or not all(map(math.isfinite, values)):
        raise ConfigError(f"expected two or more different numbers, got {shown(value)}")
    return values


def _saturation(what: str, value: Any) -> tuple[float, float]:
    limits = tuple(_numbers(what, value).tolist())
    if len(limits) != 2 or not limits[0] < limits[1]:
        raise ConfigError(
            f"expected the lowest and the highest value, such as [0, 40], got {shown(value)}"
        )
    return limits


def _bias(what: str, value: Any) -> Any:
    found = number_or_distribution(what, value)
    is_limited = isinstance(found, Normal) and math.isfinite(found.high - found.low)
    if is_distribution(found) and (is_limited or not isinstance(found, Uniform | Normal)):
        raise ConfigError(
            "a bias is a number, or drawn from a uniform or normal distribution without limits, "
            f"got {shown(found)}"
        )
    return found


def _values(what: str, value: Any) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Finite numbers; None is a value that is missing, and becomes NaN."""
    is_missing = [one is None for one in value] if isinstance(value, list | tuple) else []
    if any(is_missing):
        value = [0.0 if one is None else one for one in value]
    numbers = _numbers(what, value)
    if not np.isfinite(numbers).all():
        place = int(np.flatnonzero(~np.isfinite(numbers))[0])
        raise ConfigError(f"{what} must be finite, but number {place + 1} is {numbers[place]}")
    return np.where(is_missing, np.nan, numbers) if any(is_missing) else numbers


def _times(what: str, value: Any) -> Any:
    """Numbers of seconds, or dates, which ``fmugym.task.dates`` reads."""
    is_list = isinstance(value, list | tuple) and len(value) > 0
    return value if is_list and _is_date(value[0]) else _numbers(what, value)


def _is_date(value: Any) -> bool:
    is_text = isinstance(value, str) and _FULL_DATE.match(value) is not None
    return is_text or isinstance(value, datetime.date)


def _gaps(what: str, value: Any) -> float:
    if value == "interpolate":
        return math.inf
    try:
        return check_number(what, _time(what, value), positive=True)
    except ConfigError:
        raise ConfigError(
            f"{what} must be a positive time such as '6h', or 'interpolate', got {shown(value)}"
        ) from None


def _numbers(what: str, value: Any) -> np.ndarray[Any, np.dtype[np.float64]]:
    if not isinstance(value, list | tuple):
        raise ConfigError(f"{what} must be a list of numbers, got {shown(value)}")
    if value and all(type(one) is float for one in value):
        return np.array(value)  # long arrays take a while element by element
    return np.array([number(what, one) for one in value], np.float64)


def _time(what: str, value: Any) -> float:
    """Seconds: a duration, or an expression of constants."""
    try:
        return duration(what, value)
    except ConfigError as error:
        refusal = error
    try:
        expression = Expression.parse(value)
    except ConfigError:
        raise refusal from None
    if not isinstance(value, str) or expression.names:
        raise refusal
    return check_number(what, expression.constant(), minimum=0)


def _moment(what: str, value: Any) -> float:
    """Seconds since the beginning of a year of 365 days, of a duration or of a date."""
    if isinstance(value, datetime.date):  # TOML has dates of its own
        return _moment_of(what, value)
    if not isinstance(value, str) or not _LIKE_A_DATE.match(value):
        return _time(what, value)
    match = _DATE.fullmatch(value)
    month, day, hour, minute = map(int, match.groups(default="0")) if match else (0, 0, 0, 0)
    try:
        date = datetime.datetime(_ANY_YEAR, month, day, hour, minute)
    except ValueError:
        raise ConfigError(
            f"expected a date such as '01-15' or '01-15 06:00', got {shown(value)}"
        ) from None
    return (date - datetime.datetime(_ANY_YEAR, 1, 1)).total_seconds()


def _moment_of(what: str, date: datetime.date) -> float:
    if getattr(date, "tzinfo", None) is not None:
        raise ConfigError(
            f"{what} is on the standard time of the task: leave the offset out, got "
            f"{shown(str(date))}"
        )
    if (date.month, date.day) == (2, 29):
        raise ConfigError(f"the year of {what} has 365 days, got {shown(str(date))}")
    day = datetime.datetime(date.year, date.month, date.day)
    return moment_of_year(date if isinstance(date, datetime.datetime) else day)


def _moments(what: str, value: Any) -> Any:
    if isinstance(value, list | tuple):
        return Choice([_moment(what, one) for one in value])
    return _moment(what, value)


def _normalization(what: str, value: Any) -> Any:
    return (
        check_option(what, value, _NORMALIZATIONS)
        if isinstance(value, str)
        else check_flag(what, value)
    )


def _version(what: str, value: Any) -> int:
    if integer_of(value) != VERSION:
        raise ConfigError(f"this fmugym reads version {VERSION} of the format, got {shown(value)}")
    return VERSION


def _column(what: str, value: Any) -> Any:
    if isinstance(value, str) or integer_of(value) is not None:
        return value
    raise ConfigError(f"{what} must be a name or a number, got {shown(value)}")


def _path(what: str, value: Any) -> str:
    text = check_text(what, value)
    if "\0" in text:
        raise ConfigError(f"{what} must be a path, and no path has a NUL, got {shown(value)}")
    return text


_NUMERIC: Final = {"title": "number", "type": ["number", "string", "boolean"]}
_TIME: Final = {"title": "time", "type": ["number", "string"]}
_DISTRIBUTION: Final = {
    "type": "object",
    "required": ["distribution"],
    "properties": {"distribution": {"enum": [*DISTRIBUTIONS]}},
}
_DRAWN: Final = {"title": "number, distribution", "anyOf": [_NUMERIC, _DISTRIBUTION]}
_NUMBERS: Final = {"title": "list of numbers", "type": "array", "items": _NUMERIC}
_MOMENT: Final = {**_TIME, "title": "time, date"}

ANYTHING: Final = Kind(lambda _, value: value, {"title": "anything"})
NUMERIC: Final = Kind(number, _NUMERIC)
FINITE: Final = Kind(finite, _NUMERIC)
POSITIVE_NUMBER: Final = Kind(
    _within(number, positive=True), {**_NUMERIC, "title": "positive number"}
)
TIME: Final = Kind(_time, _TIME)
POSITIVE_TIME: Final = Kind(_within(_time, positive=True), {**_TIME, "title": "positive time"})
DEVIATION: Final = Kind(_within(number, minimum=0), {**_NUMERIC, "title": "number from 0 on"})
DRAWN: Final = Kind(number_or_distribution, _DRAWN)
TIME_OR_DRAWN: Final = Kind(
    partial(number_or_distribution, read=_time), {**_DRAWN, "title": "time, distribution"}
)
NUMBER_LIST: Final = Kind(_numbers, _NUMBERS)
VALUES: Final = Kind(_values, _NUMBERS)
NAMES: Final = Listed(TEXT, or_one=True, most=_MOST_NAMES)
PATH: Final = Kind(_path, {"title": "path", **TEXT.schema}, "path")
CONTROLLER: Final = Kind(
    lambda _, value: value, {"title": "text, number", "type": ["string", "number"]}
)
MOMENT: Final = Kind(_moment, _MOMENT)
TIMES: Final = Kind(
    _times,
    {"title": "list of numbers, dates", "type": "array", "items": {"type": ["number", "string"]}},
)
TIMEZONE: Final = Kind(zone_of, TEXT.schema)
GAPS: Final = Kind(_gaps, {"title": '"interpolate", time', "type": ["number", "string"]})

_LIMITS: Final = {
    "min": Key(NUMERIC, "Lower limit for the observation space.", None, "no limit"),
    "max": Key(NUMERIC, "Upper limit for the observation space.", None, "no limit"),
}
_DESCRIPTION: Final = {"description": Key(TEXT, "A description for readers.")}


def _evaluated(check: Callable[[str, Any], Any], what: str, value: Any) -> Any:
    if isinstance(value, str):
        number = constant_of(what, value)
        value = int(number) if number.is_integer() else number
    return check(what, value)


def _taking_expressions(kind: Any) -> Any:
    """Let a kind, or all kinds of a table, take expressions of constants for numbers."""
    match kind:
        case Kind() if kind.schema.get("type") in ("number", "integer"):
            schema = {**kind.schema, "type": [kind.schema["type"], "string"]}
            return replace(kind, check=partial(_evaluated, kind.check), schema=schema)
        case Listed() | Entries():
            return replace(kind, kind=_taking_expressions(kind.kind))
        case Either():
            parts = map(_taking_expressions, (kind.table, kind.other))
            return Either(*parts)
        case Table():
            keys = kind.keys.items()
            taking = {n: one._replace(kind=_taking_expressions(one.kind)) for n, one in keys}
            return replace(kind, keys=taking)
    return kind


_COUNT: Final = _taking_expressions(INTEGER)


# Variables.

DEVICE: Final = {
    "delay": Key(POSITIVE_TIME, "How late the value arrives; a multiple of the time step."),
    "bias": Key(
        Kind(_bias, _DRAWN),
        "This is added: a number, or one that is drawn in each episode from a uniform or normal "
        "distribution.",
    ),
    "noise": Key(
        POSITIVE_NUMBER, "The standard deviation of normally distributed noise that is added."
    ),
    "saturation": Key(
        Kind(_saturation, {**_NUMBERS, "title": "list of two numbers"}),
        "The lowest and the highest value, such as `[0, 40]`.",
    ),
    "quantum": Key(
        POSITIVE_NUMBER, "The value is a multiple of this, as of a converter with few digits."
    ),
    "rate": Key(POSITIVE_NUMBER, "The value changes by at most this much in a second."),
    "drop_out": Key(
        Table(
            {
                "probability": Key(
                    Kind(_probability, {**_NUMERIC, "title": "number between 0 and 1"}),
                    "That there is no new value in a step.",
                    REQUIRED,
                ),
                "value": Key(FINITE, "The value of such a step.", None, "the value before"),
            },
            short="probability",
        ),
        "The probability that a step brings no new value. The value before then holds, or, with "
        "`{ probability = 0.1, value = -40 }`, the value is -40.",
    ),
}
"""The keys of sensors and actuators, in the order in which they take effect."""

VARIABLE: Final = Table(
    {
        "name": Key(TEXT, 'Name in the FMU, such as `"zone[1].TAir"`.', None, "the alias"),
        "unit": Key(
            TEXT,
            "Unit in the task. Observations, expressions, actions, `min`, `max` and parameters are "
            "in this unit.",
            None,
            "the FMU's",
        ),
        "fmu_unit": Key(
            TEXT,
            "The unit in which the FMU [computes](task-file.md#units), where the FMU declares none "
            "or a wrong one.",
            None,
            "the FMU's",
        ),
        "min": Key(
            NUMERIC,
            "Lower limit for the spaces, and for the [range](config.md#ranges) of parameters and "
            "start values. It clips nothing.",
            None,
            "the FMU's",
        ),
        "max": Key(NUMERIC, "Upper limit, as `min`.", None, "the FMU's"),
        "nominal": Key(
            POSITIVE_NUMBER,
            "The usual size of the values, for observations that are "
            "[normalized](task-file.md#agent) by it.",
            None,
            "the FMU's",
        ),
        "levels": Key(
            Kind(_levels, _NUMBERS),
            "The values from which an action chooses; of an Enumeration, the values of its items. "
            "If all actions have levels, the action space is `Discrete` or `MultiDiscrete`. If "
            "some have none, the space is a `Box`, in which equal parts of the range stand for "
            "the levels in ascending order. "
            "[Controllers](task-file.md#what-controllers-see-and-write) write values.",
        ),
        "delta": Key(
            POSITIVE_NUMBER,
            "An action changes by at most this much in each step. The agent chooses the change "
            "instead of the value.",
        ),
        "min_on": Key(
            POSITIVE_TIME,
            "The least time for which an action stays on, at a value other than 0. Within this "
            "time, the old value stays.",
        ),
        "min_off": Key(POSITIVE_TIME, "The least time for which an action stays off."),
        "sample": Key(
            option(*SAMPLINGS),
            "How a step makes one value of those after its substeps. The unit of an integral is "
            'the unit of the variable times seconds: `"kWh"` for W.',
            "last",
        ),
        **DEVICE,
        **_DESCRIPTION,
    }
)


# The agent.

FORECAST: Final = Table(
    {
        "of": Key(NAMES, "Data, set points and expressions of `time`.", REQUIRED),
        "horizon": Key(POSITIVE_TIME, "How far ahead the last value is.", REQUIRED),
        "step": Key(POSITIVE_TIME, "Time from one value to the next.", None, "the time step"),
        "error": Key(
            Table(
                {
                    "std": Key(DEVIATION, "The standard deviation at the horizon.", 0.0),
                    "bias": Key(
                        DEVIATION,
                        "The standard deviation, at the horizon, of an error that stays the same "
                        "in an episode.",
                        0.0,
                    ),
                    "growth": Key(
                        option("sqrt", "linear", "none"),
                        "How errors grow with the time ahead.",
                        "sqrt",
                    ),
                    "relative": Key(
                        FLAG, "Whether errors are parts of the value instead of differences.", False
                    ),
                },
                short="std",
            ),
            "[Errors](task-file.md#errors-of-forecasts): the standard deviation at the horizon, or "
            "a table.",
        ),
    }
)

HISTORY: Final = Table(
    {
        "of": Key(NAMES, "Variables, actions, data and schedules.", REQUIRED),
        "length": Key(POSITIVE_TIME, "How far back the last value is.", REQUIRED),
    }
)

AGENT: Final = Table(
    {
        "actions": Key(NAMES, "Variables that the agent writes.", REQUIRED),
        "observations": Key(NAMES, "Variables, expressions, memory, data, set points.", REQUIRED),
        "forecast": Key(
            Listed(FORECAST, or_one=True),
            '`{ of = ["price"], horizon = "24h", step = "1h", error = 0.1 }`: the values at later '
            "times, of data, set points and expressions of `time`.",
        ),
        "history": Key(
            HISTORY,
            '`{ of = ["T", "u"], length = "2h" }`: the values of variables, actions, data and '
            "schedules before the present one, the latest first. The history of an action begins "
            "with the last action.",
        ),
        "rescale": Key(FLAG, "Whether actions go from -1 to 1 for `min` to `max`.", False),
        "normalize": Key(
            Kind(_normalization, {"enum": [False, True, "limits", "nominal"]}),
            '`true` or `"limits"`: observations are mapped to -1 to 1 by `min` and `max`. '
            '`"nominal"`: they are divided by their nominal value, or by the larger one of their '
            "limits if there is none.",
            False,
        ),
    }
)


# Data and set points.

_MOST_FILES: Final = 1000

DATA: Final = Table(
    {
        "file": Key(
            Listed(PATH, or_one=True, most=_MOST_FILES),
            "The file, [several, or a pattern](task-file.md#several-files). Commas, semicolons or "
            "tabs separate cells of a CSV file. A file whose name ends with `.parquet` needs the "
            "extra `parquet`. [Weather](task-file.md#weather) of EnergyPlus and [tables of "
            "Modelica](task-file.md#tables-of-modelica) are known by their first line.",
        ),
        "draw": Key(
            option("shared", "own"),
            'How an episode chooses one of several files. `"shared"`: the same place in all lists '
            'of files. `"own"`: a place drawn for this list alone.',
            "shared",
        ),
        "column": Key(
            Kind(_column, {"title": "text, positive integer", "type": ["string", "integer"]}),
            "The name of its column, or the number from 1 on.",
        ),
        "table": Key(
            TEXT,
            "The name of the table, in a file of Modelica with several.",
            None,
            "the only one",
        ),
        "time": Key(
            TEXT,
            "The column with the times: seconds, or dates such as `2023-12-31 15:00`, which count "
            "from the beginning of the year.",
            None,
            "a column called time, datetime, timestamp or date",
        ),
        "timezone": Key(
            TIMEZONE,
            "[The zone](task-file.md#time-zones-and-leap-years) of dates that have no offset from "
            'UTC: `"Europe/Berlin"`, or `"+01:00"`.',
            None,
            "the task's standard time",
        ),
        "values": Key(
            VALUES,
            "Values, instead of a file; in a dict, an array of numpy, or a column or a frame of "
            "pandas. These alone are short for the table.",
        ),
        "times": Key(
            TIMES,
            "Their times: seconds, or dates, unless there is a `step`; in a dict, also an index of "
            "pandas.",
        ),
        "step": Key(POSITIVE_TIME, "Time between rows, instead of a column with times."),
        "period": Key(
            TIME,
            "Time after which the rows repeat.",
            None,
            "the first row follows one row distance after the last; [weather](task-file.md#weather)"
            ": whole days; [Modelica](task-file.md#tables-of-modelica): from the first to the last "
            "row",
        ),
        "interpolation": Key(
            option("linear", "previous"),
            'How values between rows are found; `"previous"`: a value holds until the next row.',
            "linear",
        ),
        "gaps": Key(
            GAPS,
            'The longest time from a value to the next one, such as `"6h"`; `"interpolate"` for no '
            "limit.",
            None,
            "[twice the distance](task-file.md#gaps) of rows that are regular; weather: a day",
        ),
        "unit": Key(TEXT, "Unit of the values."),
        "input": Key(
            TEXT,
            "An input of the FMU that is set to the value at the beginning of each step, in its "
            "own unit.",
        ),
        "min": Key(NUMERIC, _LIMITS["min"].text, None, "the smallest value"),
        "max": Key(NUMERIC, _LIMITS["max"].text, None, "the largest value"),
    }
)

RAMP: Final = Table(
    {
        "from": Key(DRAWN, "The value before it.", REQUIRED),
        "to": Key(DRAWN, "The value after it.", REQUIRED),
        "begin": Key(TIME_OR_DRAWN, "When it begins, after the reset.", 0.0),
        "duration": Key(TIME_OR_DRAWN, "How long it takes.", REQUIRED),
    }
)

SINE: Final = Table(
    {
        "mean": Key(DRAWN, "The value in the middle.", 0.0),
        "amplitude": Key(DRAWN, "The largest distance from it.", REQUIRED),
        "period": Key(TIME_OR_DRAWN, "The time of an oscillation.", REQUIRED),
        "phase": Key(DRAWN, "Where it begins, in radians.", 0.0),
    }
)

STEPS: Final = Table(
    {
        "low": Key(NUMERIC, "The lowest value.", REQUIRED),
        "high": Key(NUMERIC, "The highest value.", REQUIRED),
        "every": Key(POSITIVE_TIME, "Time from one value to the next.", REQUIRED),
    }
)

SETPOINT: Final = Table(
    {
        "value": Key(DRAWN, "Constant, or drawn if it is a distribution. `21` is short for this."),
        "schedule": Key(
            Entries(NUMERIC),
            '`{ "06:00" = 21, "22:00" = 17 }`: the values from these times of a day on.',
        ),
        "steps": Key(
            STEPS, '`{ low = 18, high = 22, every = "2h" }`: a new random value now and then.'
        ),
        "ramp": Key(
            RAMP,
            '`{ from = 0, to = 1, begin = "1s", duration = "5s" }`: from one value to another, '
            "over the time since the reset.",
        ),
        "sine": Key(
            SINE,
            '`{ mean = 0, amplitude = 1, period = "10s", phase = 0 }`: a sine over the time since '
            "the reset.",
        ),
        "data": Key(TEXT, '`"profile"`: the values of data with this name, or of an expression.'),
        "of": Key(
            TEXT,
            "The variable of the set point, which gets a [deviation](task-file.md#set-points).",
        ),
        **_LIMITS,
    },
    short="value",
    one_of=("value", "schedule", "steps", "ramp", "sine", "data"),
)


# Beginnings of episodes, and warm-ups.


SEASON: Final = Table(
    {
        "from": Key(MOMENT, "The first possible beginning.", REQUIRED),
        "to": Key(MOMENT, "The last one.", REQUIRED),
        "step": Key(POSITIVE_TIME, "Time from one to the next.", _DAY, '`"1d"`'),
        "exclude": Key(
            NAMES,
            'Scenarios with which an episode shares no time; `"scenarios"` stands for all.',
            (),
            "none",
        ),
    }
)

_BEGIN: Final = Either(
    SEASON,
    Kind(
        partial(number_or_distribution, read=_moments),
        {
            "title": "time, date, list of them, distribution",
            "anyOf": [_MOMENT, _DISTRIBUTION, {"type": "array", "items": _MOMENT}],
        },
    ),
)

SCENARIO: Final = Table(
    {
        "start": Key(MOMENT, "When it begins.", REQUIRED),
        "length": Key(TIME, "How long it is.", REQUIRED),
        "file": Key(NAMES, "Its files of data, of [several](task-file.md#several-files), by name."),
        **_DESCRIPTION,
    }
)

SIGNAL: Final = Table(
    {
        "controller": Key(TEXT, "The controller whose action is the signal.", REQUIRED),
        "min": Key(NUMERIC, "Its lowest value.", REQUIRED),
        "max": Key(NUMERIC, "Its highest value.", REQUIRED),
    },
    what="key of a signal",
)

WARM_UP: Final = Table(
    {
        "period": Key(TIME, "The time, a multiple of the time step.", REQUIRED),
        "controller": Key(
            Either(Entries(Either(SIGNAL, CONTROLLER)), CONTROLLER),
            "A text as [on the command line](baselines.md#on-the-command-line), a name from "
            '`controllers`, or a number. `"thermostat"` alone gives the highest action below the '
            "set point and the lowest above it, if the task has one set point `of` something, or "
            "one set point and one observed variable. With several actions, a "
            "[table](task-file.md#several-actions), in which some may be left out.",
        ),
        "cache": Key(
            FLAG,
            "Whether to keep the FMU's state after the warm-up, for later episodes that begin in "
            "the same way. It is kept in memory, and on disk for later runs, where the FMU's "
            "[states](planning.md#which-way-is-used) can be serialized.",
            False,
        ),
    },
    short="period",
)


# Computed values.


def _named(**more: Key) -> Table:
    """The table of a named expression, which an expression alone may stand for."""
    expression = {"expr": Key(EXPRESSION, "The expression.", REQUIRED)}
    return Table({**expression, **more}, short="expr")


NAMED: Final = _named(**_LIMITS)

REWARD: Final = _named(weight=Key(FINITE, "Factor of the reward.", 1.0))

COST: Final = _named(limit=Key(NUMERIC, "The largest sum of this cost in an episode."))

MEMORY: Final = Table(
    {
        "start": Key(DRAWN, "Set, or drawn, at each reset.", REQUIRED),
        "update": Key(EXPRESSION, "The value after each step.", None, "it stays"),
        **_LIMITS,
    },
    short="start",
)

KPI: Final = Table(
    {
        "sum": Key(EXPRESSION, "The sum of an expression over the steps."),
        "mean": Key(EXPRESSION, "Its mean over the steps."),
        "min": Key(EXPRESSION, "Its smallest value."),
        "max": Key(EXPRESSION, "Its largest value."),
        "last": Key(EXPRESSION, "Its value in the last step."),
        "expr": Key(EXPRESSION, "An expression of other figures; it alone is short for this."),
        **_DESCRIPTION,
    },
    short="expr",
    one_of=("sum", "mean", "min", "max", "last", "expr"),
)


# A plant.


def _of_width(lowest: int, highest: int) -> Kind:
    """An integer of a protocol."""
    kind = Kind(
        lambda what, value: check_integer(what, value, lowest, highest),
        {"type": "integer", "minimum": lowest, "maximum": highest},
    )
    return cast("Kind", _taking_expressions(kind))


_UNIT_ID: Final = _of_width(0, 255)

_ADDRESSES: Final = {
    "node": Key(TEXT, 'OPC UA: the id of its node, such as `"ns=2;s=House.T"`.'),
    "register": Key(_of_width(0, 65535), "Modbus: its first register, or its bit, from 0 on."),
    "kind": Key(
        option("holding", "input", "coil", "discrete"), "Modbus: where that register is.", "holding"
    ),
    "type": Key(
        option(
            *(f"{kind}{bits}" for kind in ("int", "uint") for bits in (16, 32, 64)),
            "float32",
            "float64",
        ),
        "Modbus: how registers make a number; bits make 0 or 1.",
        "float32",
    ),
    "word_order": Key(
        option("big", "little"),
        "Modbus: whether the first register is the most significant.",
        "big",
    ),
    "unit_id": Key(_UNIT_ID, "Modbus: the device behind the address.", None, "the plant's"),
    "scale": Key(NUMERIC, "The factor by which the plant's number is multiplied.", 1.0),
    "offset": Key(NUMERIC, "The number that is added after that.", 0.0),
}

TAG: Final = Table(
    {
        **_ADDRESSES,
        "unit": Key(TEXT, "The unit of the result.", None, "the task's"),
    },
    short="node",
    one_of=("node", "register"),
)

_NOT_LIVE: Final = ("input", "min", "max", "values", "file", "draw")

LIVE: Final = Table(
    {
        **{n: one for n, one in DATA.keys.items() if n not in _NOT_LIVE},
        "file": DATA.keys["file"]._replace(kind=PATH, text="The file."),
        **_ADDRESSES,
        "count": Key(
            _COUNT,
            "How many values a tag has: the present one, then one for each `step` ahead. If there "
            "is only one, it holds for all times ahead.",
            1,
        ),
    },
    short="node",
    one_of=("node", "register", "file"),
)

PLANT: Final = Table(
    {
        "protocol": Key(option("modbus", "opcua"), "Modbus TCP or OPC UA.", REQUIRED),
        "address": Key(TEXT, 'Such as `"10.0.0.5:502"`, or `"opc.tcp://10.0.0.5:4840"`.', REQUIRED),
        "unit_id": Key(_UNIT_ID, "Modbus: the device behind the address.", 1),
        "tags": Key(
            Entries(TAG),
            "The tag of each variable that the task reads of the FMU, and of each action, by name.",
            REQUIRED,
        ),
        "clock": Key(
            TAG,
            "The plant's time, in seconds since the beginning of the year.",
            None,
            "the time of this machine: the task's "
            "[standard time](task-file.md#time-zones-and-leap-years), or else local time",
        ),
        "poll": Key(POSITIVE_TIME, "Time from one reading to the next.", None, "a tenth of a step"),
        "stale_after": Key(
            POSITIVE_TIME,
            "The age from which a value counts as missing. The age is the time since the request "
            "that brought the value.",
            None,
            "three polls",
        ),
        "hold": Key(
            TIME,
            "How long an agent goes on with the last good value where one is missing. After that "
            "it repeats its last action.",
            None,
            "a step",
        ),
        "timeout": Key(
            POSITIVE_TIME, "How long an answer may take, in seconds of real time.", 5.0, '`"5s"`'
        ),
        "data": Key(
            Entries(LIVE),
            "The live source of each series of data that the agent sees, by name: a tag, or a file "
            "that another program refreshes (keys as in `data`; times are dates, or seconds of the "
            "year).",
        ),
        "encryption": Key(FLAG, "OPC UA: whether messages are signed and encrypted.", True),
        "certificate": Key(PATH, "OPC UA: this client's certificate."),
        "key": Key(PATH, "OPC UA: its private key, a file of mode 600."),
        "server_certificate": Key(
            PATH, "OPC UA: the only certificate that the server may have.", None, "any"
        ),
        "credentials": Key(
            PATH,
            "A file of mode 600 with a line for the user's name and one for the password.",
            None,
            "the environment variables `FMUGYM_PLANT_USER` and `FMUGYM_PLANT_PASSWORD`",
        ),
    },
    what="key of [plant]",
    elsewhere=dict.fromkeys(("user", "password"), ": no task file has secrets; see 'credentials'"),
)


# Systems, the config, and all of a task.

_VERSION_OF_FMI: Final = {"fmi_version": Key(TEXT, "Version of FMI of a bundled FMU.", "2.0")}

BUNDLED: Final = Table(
    {
        "bundled": Key(TEXT, 'Name of an FMU of fmugym, such as `"Pendulum"`.', REQUIRED),
        **_VERSION_OF_FMI,
    }
)
_FMU: Final = Either(BUNDLED, PATH)

COMPONENT: Final = Table(
    {
        **_taking_expressions(table_of_fields(Component)).keys,
        "fmu": Key(_FMU, "Path of the FMU; it alone is short for this."),
        "bundled": Key(TEXT, 'Or the name of an FMU of fmugym, such as `"House"`.'),
        **_VERSION_OF_FMI,
    },
    short="fmu",
    one_of=("fmu", "bundled"),
)

_SYSTEM: Final = _taking_expressions(SYSTEM)

SYSTEM_OF_TASK: Final = Table(
    {
        **{n: one for n, one in _SYSTEM.keys.items() if n not in {"start_time", "stop_time"}},
        "components": Key(
            Entries(COMPONENT),
            'By name: the path of an FMU, `{ bundled = "House" }`, or a '
            "[component](systems.md#connect-fmus).",
            REQUIRED,
        ),
        "step_size": SYSTEM.keys["step_size"]._replace(kind=POSITIVE_TIME),
    }
)

_OF_SECTIONS: Final = {
    **dict.fromkeys(("time_step", "substeps", "warm_up", "start_time"), "it stands above [config]"),
    "foreign": "give its keys in [foreign]",
    "model_input_names": "name the inputs in 'actions' of [agent]",
    "model_output_names": "name the outputs in 'observations' of [agent]",
    "model_parameters": "give them in [parameters]",
    "monitor_names": "a name in an expression is read from the FMU",
    "samplings": "give variables the key 'sample' in [variables]",
    "episode_variables": "give them in [memory] or [setpoints]",
    "bounds": "give variables 'min' and 'max' in [variables]",
    "units": "give variables the key 'fmu_unit' in [variables]",
    "max_episode_steps": "it follows from 'episode_length', which stands above [config]",
    "positive_reward": "give an expression for 'reward'",
    "negative_reward": "give an expression for 'reward'",
    "observations": "name them in 'observations' of [agent]",
    "info": "name the figure in [kpis]",
    **dict.fromkeys(
        ("inputs", "terminated", "truncated", "reward", "memory", "costs"),
        "it stands above [config]",
    ),
}
"""Keys of a config that other sections of a task determine, with the section to use."""

CONFIG_OF_TASK: Final = _taking_expressions(
    Table(
        {n: one._replace(default=None) for n, one in CONFIG.keys.items() if n not in _OF_SECTIONS},
        what="key of [config]",
        elsewhere={name: f": {text}" for name, text in _OF_SECTIONS.items()},
    )
)

TASK: Final = Table(
    {
        "version": Key(Kind(_version, {"const": VERSION}), "Version of this format.", VERSION),
        "extends": Key(
            PATH,
            "Another task file. Its values hold where this file gives none; tables are merged.",
        ),
        **_DESCRIPTION,
        "fmu": Key(
            _FMU,
            "Path of the FMU or of an [SSP archive](systems.md#ssp-archives), or "
            '`{ bundled = "Pendulum", fmi_version = "2.0" }`. Required unless there is a `system`.',
        ),
        "system": Key(
            SYSTEM_OF_TASK,
            "In place of `fmu`: [a system of several FMUs](systems.md#in-a-task-file).",
        ),
        "class": Key(
            Kind(ANYTHING.check, TEXT.schema),
            "[A class](task-file.md#add-hooks-in-python) with hooks in Python, as "
            '`"module:Class"`.',
        ),
        "arguments": Key(Entries(ANYTHING), "Arguments of that class."),
        "time_step": Key(POSITIVE_TIME, "Length of a step.", None, "the FMU's"),
        "substeps": Key(_COUNT, "Number of communication steps in one step.", None, "`1`"),
        "episode_length": Key(
            TIME,
            "Time after which an episode is truncated; a multiple of the time step.",
            None,
            "no limit",
        ),
        "warm_up": Key(
            WARM_UP,
            "Time simulated before the first observation, or a table that also names the "
            "[controller](task-file.md#warm-up) of this time.",
            None,
            "`0`",
        ),
        "start_time": Key(
            _BEGIN,
            "First communication point, [drawn or not](task-file.md#clock-and-scenarios).",
            None,
            "the FMU's",
        ),
        "clock": Key(
            _BEGIN,
            "The [time of data](task-file.md#clock-and-scenarios) at the beginning of an episode.",
            None,
            "the FMU's time",
        ),
        "file": Key(
            NAMES,
            "The files that all episodes take where the data have "
            "[several](task-file.md#several-files), by name.",
            None,
            "drawn",
        ),
        "timezone": Key(
            TIMEZONE,
            "The [standard time](task-file.md#time-zones-and-leap-years) of the clock: an offset "
            'from UTC such as `"+01:00"`, or a zone, whose winter time it is.',
            None,
            "the offset of the weather file, or else the smallest one in the data",
        ),
        "scenarios": Key(
            Entries(SCENARIO, _MOST_NAMES), "[Scenarios](task-file.md#clock-and-scenarios) by name."
        ),
        "variables": Key(
            Entries(VARIABLE, _MOST_NAMES), "[Variables](task-file.md#variables) by name."
        ),
        "parameters": Key(
            Entries(ANYTHING),
            "Start values and parameters: numbers, [distributions](config.md#distributions), items "
            "of an Enumeration, texts.",
        ),
        "fitted": Key(
            PATH,
            "The file of [`fmugym fit`](fit.md), from which each episode draws a row of "
            "parameters. These win over `parameters`.",
        ),
        "data": Key(
            Entries(DATA, _MOST_NAMES),
            "[Columns](task-file.md#data-and-set-points) of CSV and Parquet files, of "
            "[weather](task-file.md#weather), of Modelica's tables, or lists of values, by name.",
        ),
        "setpoints": Key(
            Entries(SETPOINT, _MOST_NAMES), "[Set points](task-file.md#set-points) by name."
        ),
        "controllers": Key(
            Entries(Either(Entries(Either(SIGNAL, CONTROLLER)), CONTROLLER), _MOST_NAMES),
            "[Controllers](task-file.md#controllers) by name, for comparison with agents, for the "
            "warm-up, and for `--controller` on the command line.",
        ),
        "inputs": Key(
            Entries(EXPRESSION, _MOST_NAMES),
            "Expressions that write other inputs of the FMU before each step, by input.",
        ),
        "memory": Key(
            Entries(MEMORY, _MOST_NAMES),
            "Values that the [task remembers](task-file.md#memory), by name.",
        ),
        "expressions": Key(
            Entries(NAMED, _MOST_NAMES),
            '[Expressions](task-file.md#expressions) by name: `error = "T - T_set"`, or '
            '`{ expr = "...", min = ..., max = ... }`.',
        ),
        "agent": Key(
            AGENT,
            "Actions and observations of the [agent](task-file.md#agent). Required unless there is "
            "a class.",
        ),
        "reward": Key(
            Either(Entries(REWARD, _MOST_NAMES), EXPRESSION),
            "An expression, or named ones that are [added up](task-file.md#rewards-and-costs). "
            "Required unless a class has a reward of its own.",
        ),
        "costs": Key(Entries(COST, _MOST_NAMES), 'Expressions for `info["cost"]`, by name.'),
        "kpis": Key(
            Entries(KPI, _MOST_NAMES),
            "[Figures of an episode](task-file.md#figures-of-an-episode) by name.",
        ),
        "terminated": Key(EXPRESSION, "A condition: the task has ended.", None, "never"),
        "truncated": Key(
            EXPRESSION,
            "A condition: cut the episode short, in addition to `episode_length`.",
            None,
            "never",
        ),
        "plant": Key(
            PLANT,
            "The [plant's address and tags](plant.md), for `simulate --plant` and `serve`.",
        ),
        "foreign": Key(
            _taking_expressions(Table(FOREIGN.keys)),
            "[Keys for experts](config.md#keys-for-experts), about FMUs of unknown quality.",
        ),
        "config": Key(
            CONFIG_OF_TASK, "More keys of the [config](config.md#config-keys), such as `on_fault`."
        ),
    },
    elsewhere={
        **dict.fromkeys(CONFIG_OF_TASK.keys, ": it stands in [config]"),
        **dict.fromkeys(FOREIGN.keys, ": it stands in [foreign]"),
        **CONFIG_OF_TASK.elsewhere,
    },
)
"""The keys of a task file."""
