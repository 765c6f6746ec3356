"""Log of a plant, played through a task: rewards, observations and ends without the FMU.

::

    log = fmugym.records.plant_log.PlantLog.read("week.csv")
    recordings = fmugym.records.plant_log.play_log(log, partial(fmugym.load, "house.toml"))

A log is a table with a column of times. ``play_log`` puts it in the place of the FMU, and finds the
actions that write the logged inputs.
"""

from __future__ import annotations

import datetime
import math
import os
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Final

import gymnasium
import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from fmugym.checks import Spellings, by_own_names, check_number, normal_form
from fmugym.environment.actions import flat_inputs
from fmugym.environment.distributions import Uniform
from fmugym.environment.env import FMUEnv
from fmugym.errors import ConfigError, reading_file, shown, unknown_name
from fmugym.fmi.status import Status
from fmugym.fmi.units import Conversion, conversion_of
from fmugym.fmi.variable import Variable
from fmugym.pool.pool import FloatArray
from fmugym.records.recording import Recorder, Recording
from fmugym.task import Task
from fmugym.task.data_files import read_tables
from fmugym.task.data_rows import standard_time, usual_distance
from fmugym.task.data_tables import DataColumn, DataTable
from fmugym.task.dates import HOUR, LOCAL_TIME_ADVICE, YEAR, zone_of
from fmugym.task.series import read_data
from fmugym.task.task_entries import Entry

__all__ = [
    "Actions",
    "LogColumns",
    "PlantLog",
    "as_logged",
    "declared_as",
    "on_time_of_year",
    "play_log",
]

_HEADING: Final = re.compile(r"\s*(?P<name>.*?)\s*(?:\[(?P<unit>[^\[\]]+)\])?\s*$")
_INDEXED: Final = re.compile(r"\d+(,\s*\d+)*$")
_SAME_TIME: Final = 1e-9
"""Times that differ by less, in seconds, are the same."""

_PROPOSED: Final = "proposed."
"""Beginning of the names of columns of proposals."""

_MOST_ACTIONS: Final = 10_000
"""The most actions of discrete spaces that are tried out for a row."""


@dataclass(frozen=True)
class PlantLog:
    """Measurements of a plant.

    Columns are also found by names whose letters only look other; see ``find``.

    Attributes:
        times: In seconds, rising within an episode, shape (n,).
        columns: The values by name, each of shape (n,).
        units: The units by name, of the columns that tell one.
        episodes: Numbers of the episodes, shape (n,).
        inputs_before: Whether inputs in a row are those that led to it, from the row before;
            otherwise they hold until the next row.

    Raises:
        ConfigError: If the names of two columns look the same.
    """

    times: FloatArray
    columns: Mapping[str, FloatArray]
    units: Mapping[str, str]
    episodes: FloatArray
    inputs_before: bool = False

    def __post_init__(self) -> None:
        by_own_names("the columns of the log", self.columns, normal_form)

    @classmethod
    def read(
        cls,
        path: str | os.PathLike[str],
        *,
        inputs_before: bool | None = None,
        timezone: str | None = None,
        standard: int | None = None,
    ) -> PlantLog:
        """Read a CSV or Parquet file.

        The first row names the columns, with or without a unit: ``T [degC]``. There must be a
        column ``time``, in seconds or with dates. A column ``episode`` tells episodes apart;
        without it, an episode begins where the time goes back, or after a gap in regular rows. An
        empty cell was not measured. Files of ``RecordSeries`` are such logs.

        Args:
            path: The file.
            inputs_before: As the attribute. By default it is True for files with a column
                ``step``, as ``RecordSeries`` writes them.
            timezone: The zone of dates that have no offset from UTC, such as ``"Europe/Berlin"``.
            standard: The offset of the task's standard time in seconds east of UTC, on which times
                are; by default the smallest offset of the dates.

        Raises:
            ConfigError: If the file cannot be read, two columns have the same name, a cell that is
                needed is no number, or times do not rise.
        """
        zone = None if timezone is None else zone_of("timezone", timezone)
        columns, units = _columns(path)
        time = DataTable([*columns.values()]).find_time()
        if time is None or units.pop(time.name, "s") != "s":
            raise ConfigError(f"{shown(str(path))} has no column 'time' of seconds or dates")
        del columns[time.name]
        values = {name: one.numbers for name, one in columns.items() if one.is_numeric}
        times, is_known = _times(time, zone, standard)
        known = Spellings("column of the log", values)
        episode, step = known.find("episode"), known.find("step")
        numbers = _episodes(times, is_known) if episode is None else values.pop(episode)[is_known]
        _require_rising(time, np.flatnonzero(is_known), times, numbers)
        before = step is not None if inputs_before is None else inputs_before
        values = {name: one[is_known] for name, one in values.items()}
        units = {name: unit for name, unit in units.items() if name in values}
        return cls(times, values, units, numbers.astype(np.float64), before)

    @property
    def proposed(self) -> PlantLog | None:
        """The same with the inputs that were proposed in the shadow of a plant; None for others."""
        given = {
            acted: np.where(np.isnan(values), self.columns[acted], values)
            for name, values in self.columns.items()
            if (plain := normal_form(name)).startswith(_PROPOSED)
            if (acted := self.find(plain.removeprefix(_PROPOSED))) is not None
        }
        return replace(self, columns={**self.columns, **given}) if given else None

    def find(self, name: str) -> str | None:
        """The name of a column in the log, also by letters that look the same; None if none is."""
        return self._spellings.find(name)

    @cached_property
    def _spellings(self) -> Spellings:
        return Spellings("column of the log", self.columns)

    def parts(self, needed: Sequence[str] = ()) -> Iterator[PlantLog]:
        """The episodes, one by one.

        Args:
            needed: The columns without which a row is none: an episode ends before it.

        Raises:
            ConfigError: If there is no such column.
        """
        lacks = np.zeros(len(self.times), np.bool_)
        for name in needed:
            lacks |= np.isnan(self.columns[self._spellings.require(name)])
        is_new = (np.diff(self.episodes) != 0.0) | (np.diff(lacks) != 0)
        ends = np.flatnonzero(is_new) + 1
        for rows in np.split(np.arange(len(self.times)), ends):
            if lacks[rows[0]]:
                continue
            columns = {name: values[rows] for name, values in self.columns.items()}
            yield replace(
                self,
                times=self.times[rows],
                columns=columns,
                episodes=self.episodes[rows],
            )


def _heading(text: str) -> tuple[str, str | None]:
    """A column's name and its unit; ``v[2]`` is a name."""
    match = _HEADING.match(text)
    unit = match and match["unit"]
    if not match or not unit or (_INDEXED.match(unit) and " [" not in text):
        return text.strip(), None
    return match["name"], unit


def _columns(path: str | os.PathLike[str]) -> tuple[dict[str, DataColumn], dict[str, str]]:
    """The columns of a log by name, and their units."""
    with reading_file(f"{shown(str(path))} cannot be read"):
        (table,) = read_tables(Path(path)).values()
    columns: dict[str, DataColumn] = {}
    units: dict[str, str] = {}
    numbers: dict[str, int] = {}
    for number, column in enumerate(table.columns, 1):
        name, unit = _heading(column.name)
        if name or not column.is_numeric:
            first = numbers.setdefault(normal_form(name), number)
            if first != number:
                raise ConfigError(
                    f"{shown(str(path))} has two columns {shown(name)}: number {first}, "
                    f"{table.names[first - 1]!a}, and number {number}, {column.name!a}"
                )
            columns[name] = replace(column, name=name)
        if unit:
            units[name] = unit
    return columns, units


def _times(
    time: DataColumn, zone: datetime.tzinfo | None, standard: int | None
) -> tuple[FloatArray, npt.NDArray[np.bool_]]:
    """Times in seconds without 29 February, and the rows of these times."""
    if time.is_numeric:
        return time.numbers, np.ones(len(time.rows), np.bool_)
    dates = time.dates_in(zone)
    seconds = dates.at(dates.smallest_offset if standard is None else standard).seconds()
    falls = np.diff(dates.walls)
    back = np.flatnonzero((falls <= 0) & (falls >= -HOUR * 1e6))
    if dates.offsets is None and len(back):
        row = int(back[0])
        raise ConfigError(
            f"the times must rise, but in {time.table} {time.when(row + 1)} is not above "
            f"{time.when(row)}. {LOCAL_TIME_ADVICE}"
        )
    is_known = ~np.isnan(seconds)
    return seconds[is_known], is_known


def _episodes(times: FloatArray, is_known: npt.NDArray[np.bool_]) -> FloatArray:
    """Numbers of the episodes, which end at gaps, and at times that go back."""
    usual, distances = usual_distance(times), np.diff(times, prepend=times[:1])
    is_gap = distances > (math.inf if usual is None else 2 * usual * (1 + 1e-6))
    left_out = np.diff(np.cumsum(~is_known)[is_known], prepend=0) > 0
    return np.cumsum((distances < 0.0) | is_gap | left_out).astype(np.float64)


def _require_rising(
    time: DataColumn, rows: npt.NDArray[Any], times: FloatArray, episodes: FloatArray
) -> None:
    wrong = (~(np.diff(times) > 0.0)) & (np.diff(episodes) == 0)
    if not np.isfinite(times).all():
        row = int(rows[~np.isfinite(times)][0])
        raise ConfigError(f"{time.told(row)}: the time must be finite, got {time.cells[row]!r}")
    if wrong.any():
        before, after = rows[np.flatnonzero(wrong)[0] + np.arange(2)]
        raise ConfigError(
            f"the time must rise within an episode, but in {time.table} {time.when(after)} is not "
            f"above {time.when(before)}"
        )


def play_log(
    log: PlantLog,
    make_env: Callable[..., gymnasium.Env[Any, Any]],
    *,
    columns: Mapping[str, str] | None = None,
    tolerance: float = 1e-3,
    seed: int = 0,
) -> list[Recording]:
    """Play a log through a task.

    The log is read at the communication points of the task. Reals are interpolated between its
    rows; everything else, and inputs, hold their value until the next row. The actions are those
    that make the task write the logged inputs. Rewards, observations and ends are the task's own.
    Where an episode ends, the next one begins in the same row. Where an input or output was not
    measured, an episode is truncated. So is the last one by the end of the log. An episode of the
    log shorter than one time step is left out. A start time that the task draws is that of the log.

    Args:
        log: The log. It needs a column for each input and output of the task.
        make_env: Makes an ``FMUEnv``, or wrappers around one; it must pass the argument
            ``backend`` on. The hook ``_get_inputs`` must be free of side effects.
        columns: The names of the FMU by the names of columns that differ. Aliases of a task file
            are known.
        tolerance: How far an input may be from the logged one, as a part of the range of values
            that the log has of it.
        seed: The episodes have this seed and the following ones.

    Returns:
        The episodes.

    Raises:
        ConfigError: If a column is missing, its unit does not fit, or no action makes the logged
            inputs.
    """
    check_number("tolerance", tolerance, minimum=0.0)
    plant = _Plant()
    env = make_env(backend=plant)
    try:
        return _Player(env, plant, log, dict(columns or {}), tolerance).play(seed)
    finally:
        env.close()


class _Plant:
    """The log in the place of the FMU: a ``Backend``."""

    samples_outputs = True  # whoever has written the log

    def __init__(self) -> None:
        self.rows: list[dict[str, float]] = []
        self.row = 0

    @property
    def left(self) -> int:
        """Number of steps that are left."""
        return len(self.rows) - 1 - self.row

    def reset(self, start_values: Mapping[str, Any]) -> dict[str, float]:
        """Begin at the present row."""
        return self.rows[self.row]

    def step(self, inputs: Mapping[str, float]) -> tuple[dict[str, float], int]:
        """Go on by a row."""
        self.row += 1
        return self.rows[self.row], Status.OK

    def stop(self) -> None:
        """Do nothing."""


class _Player:
    """Plays a log through an environment whose backend is the plant of the log."""

    def __init__(
        self, env: Any, plant: _Plant, log: PlantLog, columns: dict[str, str], tolerance: float
    ) -> None:
        self._recorder = Recorder(env)
        inner: FMUEnv = env.unwrapped
        if inner.warm_up_steps:
            raise ConfigError("the task has a warm-up, which a log cannot repeat: leave it out")
        self._plant, self._log, self._time_step = plant, log, inner.pool_spec.time_step
        self._needed = *inner.pool_spec.outputs, *inner.pool_spec.inputs
        self._columns = LogColumns(inner, log, columns)
        for variable in inner.pool_spec.outputs:
            self._columns.require(variable)
        self._actions = Actions(inner, self._columns.range_of, tolerance)
        self._has_drawn_start = inner.config.draws_start_time

    def play(self, seed: int) -> list[Recording]:
        episodes: list[Recording] = []
        for part in self._log.parts(self._columns.of(*self._needed)):
            times, rows = self._columns.rows(part, self._time_step)
            self._plant.rows, self._plant.row = rows, 0
            while self._plant.left > 0:
                now = float(times[self._plant.row])
                options = {"model_parameters": {"start_time": now}} if self._has_drawn_start else {}
                self._recorder.reset(seed=seed + len(episodes), options=options)
                episodes.append(self._episode(times, rows))
        if not episodes:
            raise ConfigError(
                f"the log has no time step of {self._time_step:g} s in which "
                f"{', '.join(one.name for one in self._needed)} were all measured"
            )
        return episodes

    def _episode(self, times: FloatArray, rows: Sequence[Mapping[str, float]]) -> Recording:
        over = False
        while self._plant.left > 0 and not over:
            now, row = times[self._plant.row], rows[self._plant.row]
            _, _, terminated, truncated, info = self._recorder.step(self._actions.of(row, now))
            if "fault" in info:
                raise ConfigError(f"the log at {now:g} s: {info['fault']}")
            over = terminated or truncated
        recording = self._recorder.recording
        recording.truncated[-1] |= not over
        return recording


def on_time_of_year(task: Task, start_time: Any) -> Task:
    """Return the task on the time of a plant: seconds of the year, from any time on.

    Args:
        task: The task. Its clock, start time and warm-up are left out.
        start_time: When episodes begin.
    """
    left_out = "clock", "warm_up", "start_time"
    document = {key: value for key, value in task.document.items() if key not in left_out}
    return replace(task, document={**document, "start_time": start_time})


def as_logged(task: Task, log: PlantLog) -> Task:
    """Return the task on the time of a log of seconds of the year, and with the data in it."""
    task = on_time_of_year(task, Uniform(0.0, YEAR))
    root = task.root
    entries, standard = root.child("data").items().items(), standard_time(root).offset
    data = {
        name: _as_logged(entry, log, column, standard)
        for name, entry in entries
        if (column := log.find(name)) is not None
    }
    own = task.document.get("data", {})
    return replace(task, document={**task.document, "data": {**own, **data}}) if data else task


def _as_logged(entry: Entry, log: PlantLog, column: str, standard: int | None) -> dict[str, Any]:
    """Data with the values of a log while there are some, and their own at other times."""
    series, known = read_data(entry, standard), ~np.isnan(log.columns[column])
    times, values = log.times[known], log.columns[column][known]
    if series.period == YEAR and len(times):
        own = series.start + series.times
        others = (own - times[0]) % YEAR > np.ptp(times)
        times, values = np.append(times, own[others]), np.append(values, series.values[others])
    times, first = np.unique(times % YEAR, return_index=True)
    values = values[first]
    left_out = "file", "column", "table", "time", "step", "timezone"
    kept = {key: value for key, value in entry.value.items() if key not in left_out}
    found: dict[str, Any] = {"values": values.tolist(), "times": times.tolist(), "period": YEAR}
    found["gaps"] = "interpolate"  # between its own rows and those of the log
    return dict(zip(("min", "max"), series.limits, strict=True)) | kept | found


def declared_as(env: FMUEnv, alias: str) -> tuple[str, str | None]:
    """The name in the FMU of a variable of a task, and the unit that the task declares for it."""
    section = _section(env, "variables")
    declared = section.get(Spellings("name of the task", section).find(alias) or alias, {})
    return declared.get("name", alias), declared.get("unit")


def _section(env: FMUEnv, key: str) -> Mapping[str, Any]:
    """A section of the task file of an environment; empty if there is none."""
    task = getattr(env, "task", None)
    section: Mapping[str, Any] = task.document.get(key, {}) if isinstance(task, Task) else {}
    return section


class LogColumns:
    """The columns of a log as variables of an FMU, in the units of the FMU."""

    def __init__(self, env: FMUEnv, log: PlantLog, columns: Mapping[str, str]) -> None:
        self._columns, self._data = log.columns, Spellings("data", _section(env, "data"))
        columns = by_own_names("columns", columns, lambda name: log.find(name) or name)
        self._variables = env.fmu.description.variables
        self._from: dict[str, tuple[str, Conversion]] = {}
        for column in log.columns:
            name, unit = declared_as(env, columns.get(column, column))
            variable = env.fmu.description.find(name)
            if variable is not None:
                units = env.fmu.description.units
                try:
                    to_log = conversion_of(variable, log.units.get(column) or unit, units)
                    self._from[variable.name] = column, to_log
                except ConfigError as error:
                    raise ConfigError(f"column {column!r} of the log: {error}") from None

    def has(self, variable: Variable) -> bool:
        """Whether the log has a column for this variable."""
        return variable.name in self._from

    def require(self, variable: Variable) -> None:
        """Refuse a log without a column for this variable."""
        if not self.has(variable):
            raise unknown_name("column of the log", variable.name, self._columns)

    def range_of(self, variable: Variable) -> float:
        """Width of the range of a variable; 1 if all values are the same."""
        self.require(variable)
        column, to_log = self._from[variable.name]
        values = to_log.inverse(self._columns[column])
        known = values[~np.isnan(values)]
        return float(np.ptp(known) if known.size else 0.0) or 1.0

    def values(self, variable: Variable, part: PlantLog) -> FloatArray:
        """The values of a variable in the rows of an episode, which must be finite."""
        column, to_log = self._from[variable.name]
        values = to_log.inverse(part.columns[column])
        wrong = ~np.isfinite(values)
        if wrong.any():
            raise ConfigError(
                f"the log at {part.times[wrong][0]:g} s: expected a number in column {column!r}, "
                f"got {part.columns[column][wrong][0]}; leave such rows out"
            )
        return values

    def held(self, variable: Variable, part: PlantLog) -> FloatArray:
        """Values of an input from each row to the next, as ``values``.

        A log with the inputs before each row has them one row later. Data of the task have those of
        the row's time in any log.
        """
        values, column = self.values(variable, part), self._from[variable.name][0]
        if not part.inputs_before or self._data.find(column) is not None:
            return values
        return np.append(values[1:], values[-1])

    def of(self, *variables: Variable) -> list[str]:
        """The names of the columns of variables, as far as there are some."""
        return [self._from[variable.name][0] for variable in variables if self.has(variable)]

    def rows(self, part: PlantLog, time_step: float) -> tuple[FloatArray, list[dict[str, float]]]:
        """The communication points of an episode, and the values of the variables there."""
        count = int((part.times[-1] - part.times[0]) / time_step + 1e-6)
        times = part.times[0] + np.arange(count + 1) * time_step
        values = {
            name: to_log.inverse(self._at(name, part, column, times))
            for name, (column, to_log) in self._from.items()
        }
        rows = np.transpose([*values.values()]).tolist()
        return times, [dict(zip(values, row, strict=True)) for row in rows]

    def _at(self, name: str, part: PlantLog, column: str, times: FloatArray) -> FloatArray:
        """The values of a variable from communication points on."""
        variable, values = self._variables[name], part.columns[column]
        is_input = variable.causality == "input"
        if variable.kind == "real" and not is_input:
            interpolated: FloatArray = np.interp(times, part.times, values)
            return interpolated
        after = np.searchsorted(part.times, times + _SAME_TIME, side="right")
        if is_input and part.inputs_before:
            return values[np.minimum(after, len(values) - 1)]
        return values[after - 1]


class Actions:
    """Finds the action that makes an environment write given inputs.

    Args:
        env: The environment. Its hook ``_get_inputs`` is called as it is now.
        range_of: Returns how far apart the values of an input are, or refuses one of which nothing
            is known.
        tolerance: How far an input may be from the given one, as a part of its range.
    """

    def __init__(
        self, env: FMUEnv, range_of: Callable[[Variable], float], tolerance: float
    ) -> None:
        self._env, self._tolerance, self._get_inputs = env, tolerance, env._get_inputs
        self._space: Any = env.action_space
        self._candidates = _candidates(self._space)
        self._range_of = range_of
        self._written: list[int] = []
        self._scales = np.empty(0)

    def of(self, row: Mapping[str, float], time: float) -> Any:
        """Find the action for the inputs in a row.

        Raises:
            ConfigError: If a column is missing, or no action makes these inputs.
        """
        tried = [self.inputs(action) for action in self._candidates]
        self._find_written(np.array(tried))
        wanted = np.array([row[self._env.pool_spec.inputs[place].name] for place in self._written])
        action = self._nearest(np.array(tried), wanted)
        self._require_near(action, wanted, time)
        return action

    def inputs(self, action: Any) -> FloatArray:
        """Inputs that the environment would write for an action, one number for each."""
        env, before = self._env, self._env.action
        env.action = action
        try:
            return flat_inputs(self._get_inputs(), env.pool_spec.inputs, shown)
        finally:
            env.action = before

    def _find_written(self, tried: FloatArray) -> None:
        """Note which inputs actions change; data and schedules write the others."""
        changes = set(np.flatnonzero(np.ptp(tried, axis=0) > 0.0).tolist())
        if changes - set(self._written):
            self._written = sorted(changes.union(self._written))
            inputs = self._env.pool_spec.inputs
            self._scales = np.array([self._range_of(inputs[i]) for i in self._written])

    def _nearest(self, tried: FloatArray, wanted: FloatArray) -> Any:
        if not isinstance(self._space, spaces.Box):
            distances = np.abs((tried[:, self._written] - wanted) / self._scales).sum(axis=1)
            return self._candidates[int(distances.argmin())]
        middle, *others = (np.ravel(action).astype(np.float64) for action in self._candidates)
        moved = np.array([(other - middle).sum() for other in others])
        slopes = (tried[1:, self._written] - tried[0, self._written]).T / moved
        moves = np.linalg.lstsq(slopes, wanted - tried[0, self._written], rcond=None)[0]
        flat = np.clip(middle + moves, self._space.low.ravel(), self._space.high.ravel())
        return flat.reshape(self._space.shape).astype(self._space.dtype)

    def _require_near(self, action: Any, wanted: FloatArray, time: float) -> None:
        made = self.inputs(action)[self._written]
        off = np.abs(made - wanted) > self._tolerance * self._scales
        if off.any():
            place = int(np.flatnonzero(off)[0])
            name = self._env.pool_spec.inputs[self._written[place]].name
            raise ConfigError(
                f"the log at {time:g} s: no action of {self._space} makes {name} = "
                f"{wanted[place]:g}; the nearest makes {made[place]:g}. If that is near enough, "
                "raise the tolerance"
            )


def _candidates(space: spaces.Space[Any]) -> list[Any]:
    """All actions of a discrete space; of a box, its middle and one more along each axis.

    Raises:
        ConfigError: If the space is neither, or has too many actions.
    """
    if isinstance(space, spaces.Box):
        return _corners(space)
    if not isinstance(space, spaces.Discrete | spaces.MultiDiscrete):
        raise ConfigError(f"a log can be played with actions of numbers, not of {space}")
    counts = np.ravel(space.n if isinstance(space, spaces.Discrete) else space.nvec).tolist()
    if math.prod(counts) > _MOST_ACTIONS:
        raise ConfigError(f"{space} has more than {_MOST_ACTIONS} actions, too many to try out")
    places = (np.reshape(place, np.shape(space.start)) for place in np.ndindex(*counts))
    return [(space.start + place).astype(space.dtype)[()] for place in places]


def _corners(space: spaces.Box) -> list[Any]:
    bounded = np.isfinite(space.low) & np.isfinite(space.high)
    low, high = np.where(bounded, space.low, -2.0), np.where(bounded, space.high, 2.0)
    middle, quarter = ((low + high) / 2).ravel(), ((high - low) / 4).ravel()
    moves = [np.zeros_like(middle), *np.diag(quarter)]
    return [(middle + move).reshape(space.shape).astype(space.dtype) for move in moves]
