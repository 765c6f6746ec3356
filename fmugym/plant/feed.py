"""Feed of a plant: a read-only backend that waits for ticks and reads the tags."""

from __future__ import annotations

import datetime
import time
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, Final

import numpy as np

from fmugym.declared.dates import moment_of_year
from fmugym.errors import ConfigError, SimulationError
from fmugym.fmi.status import Status
from fmugym.plant.live import Live
from fmugym.plant.polling import Poller
from fmugym.plant.tags import Plant
from fmugym.pool.backend.clocks import Clock, speed_of
from fmugym.pool.base import FloatArray

__all__ = ["Feed"]

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
