"""Feed of a plant: a read-only backend that waits for ticks and reads the tags.

Live data of a task are told by a plant or a refreshed file while an episode runs.
"""

from __future__ import annotations

import datetime
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import partial
from typing import Any, Final

import numpy as np

from fmugym.deployment.plant.polling import Poller
from fmugym.deployment.plant.tags import DATA_PREFIX, Plant
from fmugym.errors import ConfigError, SimulationError, shown
from fmugym.fmi.status import Status
from fmugym.fmi.units import conversion_between
from fmugym.pool.pool import FloatArray
from fmugym.pool.rig.clocks import Clock, speed_of
from fmugym.records.plant_log import declared_as
from fmugym.task.data_rows import read_rows
from fmugym.task.dates import moment_of_year
from fmugym.task.declarations import as_declared
from fmugym.task.task_entries import Entry

__all__ = ["Feed", "Live", "forecasts", "horizon"]

_JUST = 1e-6


class Live:
    """The data of environments, as they are known at a tick.

    Args:
        envs: They read the data; the agent of the first one sees them.
        plant: Says where they come from.

    Raises:
        ConfigError: If the agent sees data that have no live source, or not far enough ahead.
    """

    def __init__(self, envs: Sequence[Any], plant: Plant) -> None:
        self._envs = envs
        root = as_declared(envs[0].task.root, envs[0].fmu.description)[0]
        self._standard, self._entries = plant.standard, plant.data
        self._ahead = {name: horizon(root, name) for name in self._entries}
        for name in sorted(_seen(root)):
            if name not in self._entries:
                text = f"the agent sees {name!r}: say in [plant.data] where it comes from"
                raise root.child("data").child(name).error(text)
        history = root.child("agent").child("history").value or {}
        self._kept = history.get("length", 0.0) + 3 * plant.step
        self._past: dict[str, list[tuple[float, float]]] = {name: [] for name in self._entries}
        self._require_tags()
        self._units = envs[0].fmu.description.units
        self._relative = set(_relative(envs[0], self._past))
        self._own = {name: root.child("data").child(name).value.get("unit") for name in self._past}

    def _require_tags(self) -> None:
        """Refuse tags that do not tell as much as the agent sees."""
        for name, entry in self._entries.items():
            count, step = entry.value.get("count", 1), entry.value.get("step")
            if "file" in entry.value or count == 1:
                continue
            ahead = self._ahead[name]
            if step is None or (count - 1) * step < ahead:
                raise entry.error(
                    f"the agent sees {ahead:g} s ahead: expected 'count' values that are "
                    f"'step' apart to go as far, got {count} and {step}"
                )

    def refresh(self, now: float, tags: dict[str, tuple[float, ...]]) -> dict[str, str]:
        """Let environments look up the data that are known now.

        Args:
            now: The plant's time, in seconds of the year.
            tags: The values of the tags.

        Returns:
            What is wrong with files, by the names of data.
        """
        faults: dict[str, str] = {}
        for name, entry in self._entries.items():
            try:
                rows = self._rows(name, entry, now, tags)
            except ConfigError as error:
                faults[DATA_PREFIX + name] = str(error)
            else:
                self._write(name, *rows)
        return faults

    def _rows(
        self, name: str, entry: Entry, now: float, tags: dict[str, tuple[float, ...]]
    ) -> tuple[FloatArray, FloatArray]:
        """Times from now on, in seconds of the year, and the values in the unit of the data."""
        if "file" not in entry.value:
            values = np.array(tags[DATA_PREFIX + name])
            return now + np.arange(len(values)) * (entry.value.get("step") or 1.0), values
        rows = read_rows(entry, self._standard)
        with entry.placing():
            rows.require_no_gap(None)
        times, values = rows.known()
        given, own = entry.value.get("unit"), self._own[name]
        unit: Any = conversion_between(given, own, self._units)
        values = unit.of_differences(name in self._relative)(values)
        holds = entry.value["interpolation"] == "previous"
        end = times[-1] + (times[-1] - times[-2] if holds and len(times) > 1 else 0.0)
        ahead = self._ahead[name]
        if not times[0] <= now + _JUST or end < now + ahead:
            raise ConfigError(
                f"{shown(entry.value['file'])} has {times[0]:.10g} s to {end:.10g} s, expected "
                f"{now:.10g} s and {ahead:g} s more"
            )
        first = np.searchsorted(times, now + _JUST, side="right")
        present = values[first - 1] if holds else np.interp(now, times, values)
        return np.append(now, times[first:]), np.append(present, values[first:])

    def _write(self, name: str, times: FloatArray, values: FloatArray) -> None:
        past, now = self._past[name], float(times[0])
        past[:] = [one for one in past if now - self._kept < one[0] < now]
        before = np.reshape(past, (-1, 2)).T
        past.append((now, float(values[0])))
        times, values = np.append(before[0], times), np.append(before[1], values)
        for env in self._envs:
            if lookup := env.resolved.future.lookups.get(name):
                fits = times < times[0] + lookup.period
                table = lookup.table_of(name, (times[fits], values[fits]))
                lookup.tables[lookup.key] = table


def forecasts(root: Entry, name: str) -> list[Any]:
    """The forecasts in which the agent sees some data."""
    return [one for one in root.child("agent").child("forecast").value or () if name in one["of"]]


def _relative(env: Any, names: Iterable[str]) -> Iterator[str]:
    """The data that an input gets which is a difference, whose unit has no offset."""
    for name in names:
        to = env.task.root.child("data").child(name).value.get("input")
        variable = env.fmu.description.find(declared_as(env, to)[0]) if to else None
        if variable is not None and variable.relative:
            yield name


def horizon(root: Entry, name: str) -> float:
    """Largest forecast horizon of some data, in seconds."""
    return max((float(one["horizon"]) for one in forecasts(root, name)), default=0.0)


def _seen(root: Entry) -> set[str]:
    """The data that the agent sees: now, ahead, in the past, and in expressions."""
    agent = root.child("agent").value or {}
    left = {*agent.get("observations", ()), *(agent.get("history") or {}).get("of", ())}
    left |= {name for one in agent.get("forecast") or () for name in one["of"]}
    data, expressions, setpoints = (
        root.child(key).value or {} for key in ("data", "expressions", "setpoints")
    )
    looked_at: set[str] = set()
    while left := left - looked_at:
        name = left.pop()
        looked_at.add(name)
        if name in expressions:
            left |= expressions[name]["expr"].names
        if (setpoints.get(name) or {}).get("data") is not None:
            raise (
                root.child("setpoints")
                .child(name)
                .error(
                    f"the agent sees {name!r}, which follows data: a plant has set points with a "
                    "schedule or a value"
                )
            )
    return looked_at & data.keys()


_LEAST_JUMP: Final = 60.0
"""Clocks that are apart by less, in seconds, have not jumped."""

_LATE: Final = 2.0
"""Tolerated lateness of a thread or an answer, in seconds of real time."""


def _time_of_year(now: datetime.datetime, offset: int | None) -> float:
    """Seconds since the beginning of the year, on a standard time or local time."""
    zone = None if offset is None else datetime.timezone(datetime.timedelta(seconds=offset))
    return moment_of_year(now.astimezone(zone))


def _now() -> datetime.datetime:
    return datetime.datetime.now(datetime.UTC)


class Feed:
    """The values of a plant at its ticks, which lie on multiples of the time step.

    It is a ``Backend``, whose ``reset`` sets nothing and whose ``step`` writes nothing, and the
    start time of episodes.

    Args:
        clock: The monotonic clock of ticks and readings.

    Attributes:
        plant: Has the tags; whoever makes the environment sets it.
        values: The present values of the tags, in the task's units.
        faults: Faults by the names of tags whose last value goes on.
        has_expired: Whether the last value of one has held for too long.
        time: The plant's time at the present tick.
        jump: By how much the plant's time has jumped, in seconds.
    """

    samples_outputs = True
    plant: Plant

    def __init__(self, clock: Clock) -> None:
        self.clock, self._begun = clock, (_now(), clock.time())
        self.values: dict[str, tuple[float, ...]] = {}
        self.faults: dict[str, str] = {}
        self.has_expired, self.time, self.jump = False, 0.0, 0.0

    def open(self, poller: Poller, live: Live) -> None:
        """Begin to read.

        Args:
            poller: Reads the tags of the plant.
            live: Gets the data of each tick.
        """
        self._poller, self._live = poller, live
        self._asked = dict.fromkeys(self.plant.tags, -np.inf)
        self._ahead, self._has_begun = 0.0, False

    def row(self) -> dict[str, float]:
        """Values of the FMU's variables at this tick, in its units, by name."""
        return {
            tag.own: tag.to_task.inverse(self.values[name][0])
            for name, tag in self.plant.tags.items()
            if tag.own
        }

    def held(self) -> list[str]:
        """The names of the FMU's variables whose last values go on."""
        return [tag.own for name, tag in self.plant.tags.items() if name in self.faults]

    def told(self) -> str:
        """Describe all faults; tags with the same fault stand together."""
        names: dict[str, list[str]] = {}
        for name, why in self.faults.items():
            names.setdefault(why, []).append(name)
        texts = [f"{', '.join(own)}: {why}" for why, own in names.items()]
        if self.jump:
            texts.append(f"the plant's clock has jumped by {self.jump:.6g} s")
        return "; ".join(texts)

    def sample(self, rng: np.random.Generator) -> float:
        """Return when an episode begins: at the present tick."""
        return self.time

    # The backend.

    def reset(self, start_values: Mapping[str, Any]) -> Mapping[str, float]:
        """Set nothing."""
        return self.row()

    def step(self, inputs: Mapping[str, float]) -> tuple[Mapping[str, float], int]:
        """Write nothing."""
        return self.row(), Status.OK

    def stop(self) -> None:
        """Do nothing: the plant goes on."""

    # Ticks.

    def begin(self) -> None:
        """Wait until all tags have good values, and for the next tick.

        Raises:
            ConfigError: If the server does not know a tag, or one has a wrong type.
            SimulationError: If there are none in time. Once there were some, it waits for ever.
        """
        self._wait_for_values()
        self._ahead, step = self._seen_ahead(), self.plant.step
        now = self.clock.time() + self._ahead
        self.time, self.jump = now + (-now % step), 0.0
        self._sleep()
        if self.has_expired and not self._has_begun:
            raise SimulationError(self._told())
        self._has_begun = True

    def _wait_for_values(self) -> None:
        deadline = time.monotonic() + 2.0 * self.plant["timeout"]
        poller = self._poller
        while True:
            has_answered, is_refused = bool(poller.answers), poller.is_refused
            self._look(self.clock.time() - self.plant.step, self.clock.time())
            if not self.faults:
                self._require_fit()
                return
            time.sleep(0.005)
            if self._has_begun:
                continue
            if has_answered and any(map(poller.trouble, self.plant.tags)):
                raise ConfigError(self._told())
            if is_refused or time.monotonic() > deadline:
                raise SimulationError(self._told())

    def _told(self) -> str:
        return f"the plant at {self.plant.address}: {self.told()}"

    def _require_fit(self) -> None:
        """Refuse values that a wrong type would make."""
        found = {n: tag.misfit(self.values[n][0]) for n, tag in self.plant.tags.items()}
        self.faults = {name: strange for name, strange in found.items() if strange}
        if self.faults:
            raise ConfigError(self._told())

    def advance(self) -> None:
        """Wait for the next tick, and take the answers until then."""
        self.time += self.plant.step
        self._sleep()
        off = self._seen_ahead() - self._ahead
        tolerance = max(min(_LEAST_JUMP, self.plant.step), _LATE * speed_of(self.clock))
        self.jump = off if abs(off) > tolerance else 0.0
        if not self.jump:
            self._ahead += min(off, 0.0)  # an answer is late, and never early

    def _sleep(self) -> None:
        tick = self.time - self._ahead
        self.clock.sleep(tick - self.clock.time())
        self._look(tick - self.plant.step, tick)
        faults = self._live.refresh(self.time, self.values)
        self.faults |= faults
        self.has_expired |= bool(faults)

    def _seen_ahead(self) -> float:
        """Time by which the plant's clock is ahead, by the latest answer, at the most."""
        if "clock" in self._asked:
            return self.values["clock"][0] - self._asked["clock"]
        if speed_of(self.clock) == 1.0:
            return _time_of_year(_now(), self.plant.standard) - self.clock.time()
        start, ticks = self._begun
        return (
            _time_of_year(start, self.plant.standard) - ticks
        )  # a clock that runs faster began with the time of this place

    def _look(self, begin: float, end: float) -> None:
        """Find the values at the end of a step."""
        self.faults, self.has_expired = {}, False
        rounds = self._poller.take(end)
        for name, asked in self._asked.items():
            good = [one for one in rounds if not one.answers[name].fault]
            fresh = [one for one in good if one.asked > begin] or good[-1:]
            if fresh:
                numbers = np.array([one.answers[name].numbers for one in fresh])
                self.values[name], asked = self._sampled(name, numbers), fresh[-1].asked
                self._asked[name] = asked
            age = end - asked
            if age > self.plant.stale_after:
                why = self._poller.trouble(name) or "no answer has come in time"
                self.faults[name] = f"{why} (for {age:.6g} s)" if name in self.values else why
            if age > self.plant.stale_after + self.plant.hold:
                self.has_expired = True

    def _sampled(self, name: str, numbers: FloatArray) -> tuple[float, ...]:
        """Sampled values of a step, a row for each reading."""
        how = self.plant.tags[name].sampling
        found = _SAMPLED[how](numbers, axis=0) * (self.plant.step if how == "integral" else 1.0)
        return tuple(found.tolist())


_SAMPLED: Final[Mapping[str, Callable[..., Any]]] = {
    "last": lambda rows, axis: rows[-1],
    "mean": np.mean,
    "integral": np.mean,
    "min": np.min,
    "max": np.max,
    "median": partial(np.quantile, q=0.5, method="higher"),  # one of the readings
}
