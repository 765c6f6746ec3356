"""Observations of the agent: values, forecasts and histories."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from hashlib import blake2b
from typing import Any, Final, NamedTuple

import numpy as np

from fmugym.expressions.graph import Value, where
from fmugym.task.declarations import Declarations
from fmugym.task.section_entries import Limits
from fmugym.task.sensors import first_step, noise_in
from fmugym.task.task_entries import Entry, nearest_steps, steps_in
from fmugym.task.task_keys import DEVICE
from fmugym.task.task_names import Moment, Naming, queue_name
from fmugym.task.task_variables import TaskVariable

__all__ = [
    "History",
    "NoiseKey",
    "Seen",
    "has_errors",
    "histories",
    "normalized",
    "observed_values",
    "remembered",
    "scaled",
]


_MOST_VALUES: Final = 2000
"""A history or a forecast has at most so many values of a name."""

_CHANNELS_OF_FORECASTS: Final = 10_000
_CHANNELS_OF_BIASES: Final = 5_000

_GROWTHS: Final = {"sqrt": 0.5, "linear": 1.0, "none": 0.0}


@dataclass(frozen=True)
class NoiseKey:
    """The distribution of the keys of noise.

    Args:
        draws: Whether to draw a number. If not, the key follows from the state of the generator,
            which stays as it is: noise then changes no other draw. That needs other draws, for the
            generator to move on from episode to episode.
    """

    draws: bool

    def sample(self, rng: np.random.Generator) -> float:
        """Return a whole number below 2**52."""
        if self.draws:
            return float(rng.integers(2**52))
        state = repr(rng.bit_generator.state["state"]).encode()
        return float(int.from_bytes(blake2b(state, digest_size=8).digest(), "little") >> 12)


class Seen(NamedTuple):
    """A number that the agent observes.

    Attributes:
        entry: Entry of the task.
        name: Name of the value.
        value: Its value.
        limits: Its limits.
        place: Which value of a forecast or history it is, such as ``"[+3600 s]"``.
    """

    entry: Entry
    name: str
    value: Value
    limits: Limits
    place: str = ""


class History(NamedTuple):
    """The last values of a name.

    Attributes:
        name: The name.
        variable: The episode variable that holds them, the latest first.
        length: Number of the values.
        now: The value that is added when the FMU has stepped.
        fill: The other values in the first step.
        first: All values at the beginning of an episode.
    """

    name: str
    variable: str
    length: int
    now: Value
    fill: Value
    first: Value


def histories(naming: Naming) -> list[History]:
    """The histories that the agent sees, of values that no function of time gives.

    The history of a variable holds its values before the present one. That of an action begins with
    the action of the step that has just ended. A name without a value before the step is noted as a
    mistake.
    """
    declared = naming.declared
    entry = declared.root.child("agent").child("history")
    lengths = dict.fromkeys(declared.remembered, _kept_steps(naming))
    for name in declared.measured:
        variable = _sensor_of(declared, name)
        if variable is None:
            continue
        with variable.entry.noting():
            late = naming.delay_of(variable) + variable.device.remembers
            if late or name in lengths:
                lengths[name] = lengths.get(name, 0) + late
    kept: list[History] = []
    for name, count in lengths.items():
        with entry.noting():
            if name not in declared.series:
                kept.append(_history(entry, naming, name, count))
    for variable in declared.actions:
        with variable.entry.noting():
            if variable.device.delay:
                kept.append(_queue(naming, variable))
    return kept


def _kept_steps(naming: Naming) -> int:
    """Number of past values of a name that the agent observes."""
    entry, steps = naming.declared.root.child("agent").child("history").child("length"), 0
    with entry.noting():
        if entry.value is not None:
            steps = steps_in(entry, entry.value, naming.time_step, _MOST_VALUES)
    return steps


def _queue(naming: Naming, variable: TaskVariable) -> History:
    """Chosen actions that a delay still keeps."""
    name, start = queue_name(variable), naming.start(variable)
    chosen = naming.action(variable, "action")
    return History(name, name, naming.delay_of(variable), chosen, start, start)


def _history(entry: Entry, naming: Naming, name: str, length: int) -> History:
    present, values = naming.value_of(name, Moment.SEEN), naming.kept(name)
    if present is None or values is None:
        raise entry.error(
            f"there is no history of {name!r}: it is kept for variables of the FMU, actions, "
            "data and schedules"
        )
    return History(name, f"history of {name}", length, *values, present)


def _sensor_of(declared: Declarations, name: str) -> TaskVariable | None:
    """Variable of a measured name; None for a name that the agent knows without a sensor."""
    return declared.variables.get(name) if declared.is_output(name) else None


def observed_values(naming: Naming, kept: list[History]) -> tuple[list[Seen], list[History]]:
    """Observed numbers in their order, and the memories of sensors.

    Args:
        naming: Gives names their values.
        kept: The histories.

    Constants, and names without a forecast or history, are noted as mistakes.
    """
    _check_sensors(naming.declared)
    past = _Past(naming, kept)
    seen = [*_present(naming, past), *_forecasts(naming), *_remembered(naming, past)]
    return seen, past.memories


def _check_sensors(declared: Declarations) -> None:
    """Refuse a sensor of a variable that the agent does not observe, which has no effect."""
    seen, mistakes = set(declared.measured), declared.root.mistakes
    if any(mistakes.explain(("agent", key)) for key in ("actions", "observations", "history")):
        return
    for variable in declared.variables.declared():
        is_used = variable.alias in seen or variable in declared.actions
        if not variable.device.is_ideal and not is_used:
            text = (
                f"{', '.join(map(repr, DEVICE))} are for actions and for what the agent "
                f"observes, and {variable.alias!r} is not in its observations"
            )
            variable.entry.note(variable.entry.error(text))


class _Past:
    """Gives values now and some steps ago, as the agent measures them."""

    def __init__(self, naming: Naming, kept: list[History]) -> None:
        self._naming, self._declared = naming, naming.declared
        self._measured: dict[str, History] = {}
        self._histories = {history.name: history for history in kept}

    def measured(self, entry: Entry, name: str, ago: int) -> Value:
        """Value that the agent measured some steps ago."""
        variable = _sensor_of(self._declared, name)
        deviation = self._declared.deviations.get(name)
        if deviation is not None:
            setpoint, of = (self.measured(entry, one, ago) for one in deviation)
            return setpoint - of
        if variable is None:
            return self._true(entry, name, ago)
        fresh = self._fresh(entry, variable, ago)
        if not variable.device.remembers:
            return fresh
        past = self._naming.read("variables", self._kept(entry, variable, ago), ago)
        return self._unless_first(fresh, past)

    def _unless_first(self, first: Value, past: Value) -> Value:
        """A value of the past; another one at the beginning of an episode, which has no past."""
        is_filled = self._naming.warm_steps > 0  # histories, by a warm-up
        return past if is_filled else where(self._naming.step_count == 0, first, past)

    def _fresh(self, entry: Entry, variable: TaskVariable, ago: int) -> Value:
        """A measurement, whatever was measured before."""
        name, device = variable.alias, variable.device
        value = self._true(entry, name, ago + self._naming.delay_of(variable))
        return device.distorted(value, self._naming.step_count - ago, self._naming.channel_of(name))

    def _kept(self, entry: Entry, variable: TaskVariable, ago: int) -> str:
        """Variable that keeps the readings of a sensor with a memory, the latest first."""
        name, kept = variable.alias, f"measured {variable.alias}"
        naming, fill = self._naming, self._fresh(entry, variable, 1)
        length = max(ago + 1, self._measured[name].length if name in self._measured else 0)
        first = self._fresh(entry, variable, 0)
        is_first = naming.step_count == naming.first_step
        before = where(is_first, fill, naming.read("variables", kept, 0))
        step_count, channel = naming.step_count, naming.channel_of(name)
        now = variable.device.following(first, before, step_count, channel, naming.time_step)
        self._measured[name] = History(name, kept, length, now, fill, first)
        return kept

    @property
    def memories(self) -> list[History]:
        """Variables that keep what sensors with a memory read; updated after the histories."""
        return list(self._measured.values())

    def _true(self, entry: Entry, name: str, ago: int) -> Value:
        if ago == 0:
            value = self._naming.value_of(name, Moment.SEEN)
            if value is None or value.constant is not None:
                raise entry.error(f"{name!r} is a constant, which an agent need not observe")
            return value.number
        if name in self._histories:
            history = self._histories[name]
            past = self._naming.read("variables", history.variable, ago - 1)
            return self._unless_first(history.first, past)
        return self._naming.forecast(entry, name, -ago * self._naming.time_step)


def _present(naming: Naming, past: _Past) -> Iterator[Seen]:
    declared = naming.declared
    for entry, name in declared.observed:
        with entry.noting():
            yield Seen(entry, name, past.measured(entry, name, 0), declared.limits_of(name))


def _forecasts(naming: Naming) -> Iterator[Seen]:
    declared, time_step = naming.declared, naming.time_step
    for entry in _forecasts_in(declared):
        step, count = entry.value.get("step", time_step), 1
        with entry.child("horizon").noting():
            horizon = entry.required("horizon")
            count = steps_in(horizon, horizon.value, step, _MOST_VALUES)
        errors = entry.child("error").value if _errs(entry) else None
        for channel, one in enumerate(entry.child("of").elements(), _CHANNELS_OF_FORECASTS):
            with one.noting():
                for index in range(1, count + 1):
                    ahead = index * step
                    value = naming.forecast(one, one.value, ahead)
                    if errors is not None:
                        later = naming.step_count + nearest_steps(ahead, time_step)
                        value = _with_error(value, errors, index / count, later, channel)
                    limits = declared.limits_of(one.value)
                    yield Seen(one, one.value, value, limits, f"[+{ahead:g} s]")


def _with_error(
    value: Value, errors: Mapping[str, Any], part: float, count: Value, channel: int
) -> Value:
    """A forecast with errors.

    The errors belong to the time that the forecast is made for: forecasts of one time err in the
    same direction, and less and less as the time comes near.

    Args:
        value: The true value.
        errors: Errors of forecasts, by the keys of the format.
        part: The time ahead as a part of the horizon.
        count: The number of the step that the forecast is made for.
        channel: The number of the forecast.
    """
    size: float = part ** _GROWTHS[errors["growth"]]
    error: Value = errors["std"] * size * noise_in(count, channel)
    if errors["bias"]:
        lasting = noise_in(first_step(value.graph), channel + _CHANNELS_OF_BIASES)
        error = error + errors["bias"] * size * lasting
    return value + value * error if errors["relative"] else value + error


def _errs(forecast: Entry) -> bool:
    errors = forecast.child("error").value
    return errors is not None and bool(errors["std"] or errors["bias"])


def has_errors(declared: Declarations) -> bool:
    """Whether a forecast has errors."""
    return any(map(_errs, _forecasts_in(declared)))


def _forecasts_in(declared: Declarations) -> list[Entry]:
    section = declared.root.child("agent").child("forecast")
    return [] if section.value is None else section.elements()


def _remembered(naming: Naming, past: _Past) -> Iterator[Seen]:
    declared = naming.declared
    entry = declared.root.child("agent").child("history")
    for name in declared.remembered:
        limits = declared.limits_of(name)
        for ago in range(1, 1 + _kept_steps(naming)):
            value = past.measured(entry, name, ago)
            yield Seen(entry, name, value, limits, f"[-{ago * naming.time_step:g} s]")


def normalized(seen: Seen, nominal: float | None) -> Seen:
    """Normalize a value by its usual size.

    Raises:
        ConfigError: If that is not known.
    """
    if nominal is None:
        raise seen.entry.error(
            f"{seen.name!r} has no nominal value: give it 'nominal', or 'min' and 'max'"
        )
    low, high = seen.limits
    return seen._replace(value=seen.value / nominal, limits=(low / nominal, high / nominal))


def scaled(seen: Seen) -> Seen:
    """Scale a value from its limits to the range from -1 to 1.

    Raises:
        ConfigError: If a limit is infinite.
    """
    if not np.isfinite(seen.limits).all():
        raise seen.entry.error(
            f"{seen.name!r} needs 'min' and 'max' so that observations can be normalized"
        )
    low, high = seen.limits
    middle, half = (low + high) / 2, (high - low) / 2
    return seen._replace(value=(seen.value - middle) / half, limits=(-1.0, 1.0))


def remembered(naming: Naming, kept: list[History]) -> dict[str, list[Value]]:
    """The new values of histories: the latest one is added, the oldest one goes."""
    is_first = naming.step_count == naming.first_step
    values: dict[str, list[Value]] = {}
    for one in kept:
        older = (naming.read("variables", one.variable, place) for place in range(one.length - 1))
        values[one.variable] = [one.now, *(where(is_first, one.fill, before) for before in older)]
    return values
