"""What hooks read that the state of an episode does not tell: data, and random numbers to come."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, Final, NamedTuple

import numpy as np

from fmugym.errors import ConfigError, shown
from fmugym.pool.base import FloatArray
from fmugym.signals import ordinary

__all__ = ["Future", "Lookup", "Table", "assumed"]

_YEAR: Final = 365 * 86400.0


class Table(NamedTuple):
    """Values between which lines are drawn.

    Attributes:
        times: Seconds since the first row of a series, rising.
        values: The values at these times.
    """

    times: FloatArray
    values: FloatArray


class Lookup:
    """Looks the values of a periodic series up, or those that candidates assume in its place.

    Args:
        number: The number of the series, which tells equal ones apart.
        start: The time in seconds of its first row.
        period: Seconds after which it repeats.
        is_stepped: Whether a value holds until the next one.
        table: Its values in one period.

    Attributes:
        own: The table of the series.
        present: The table that is looked up: the same, or an assumed one.
    """

    def __init__(
        self, number: int, start: float, period: float, is_stepped: bool, table: Table
    ) -> None:
        self._number, self.start, self.period, self.is_stepped = number, start, period, is_stepped
        self.own = self.present = table

    def __call__(self, place: Any) -> Any:
        """The values at places from 0 to the period; to the left of them, nobody looks."""
        return np.interp(place, *self.present, left=self._number)

    def mean(self, held_out: Sequence[tuple[float, float]] = ()) -> float:
        """The mean over a period.

        Args:
            held_out: Beginnings and lengths in seconds of parts of each year that are left out. If
                nothing else is there, such as in the data of a day, nothing is left out.
        """
        times, values = self.own
        widths = np.diff(times)
        is_seen = np.ones(len(widths), np.bool_)
        for begin, length in held_out:
            since = self.start + times[:-1] - begin
            is_seen &= np.remainder(since, _YEAR) >= length
            is_seen &= np.remainder(-since, _YEAR) > widths
        middles = (values[1:] + values[:-1]) / 2
        return float(np.average(middles, weights=widths * is_seen if is_seen.any() else widths))

    def table_of_program(self, table: Table) -> FloatArray:
        """A table as programs have it: times, values, and the values beyond both ends."""
        return np.concatenate([*table, [self._number, table.values[-1]]])

    def tobytes(self) -> bytes:
        """The bytes of its own table, as those of an array."""
        return self.table_of_program(self.own).tobytes()

    def table_of(self, what: str, rows: Any) -> Table:
        """The table of other rows, which repeat after the same period.

        Args:
            what: Their name, for the error.
            rows: Times in seconds, on the clock of the data, and values.

        Raises:
            ConfigError: If the rows make no function of time.
        """
        try:
            times, values = (np.asarray(part, np.float64) for part in rows)
        except ordinary(Exception):  # no pair, or no numbers
            times = values = np.empty((0, 0))
        if times.ndim != 1 or times.shape != values.shape or not len(times):
            raise ConfigError(
                f"expected times and values of {what!r} of one length, got {shown(rows)}"
            )
        if not np.isfinite([times, values]).all() or (np.diff(times) <= 0).any():
            raise ConfigError(f"the times of {what!r} must rise, and all numbers be finite")
        if times[-1] - times[0] >= self.period:
            raise ConfigError(
                f"the rows of {what!r} last {times[-1] - times[0]:g} s, expected less than the "
                f"period of {self.period:g} s"
            )
        return self._in_period(np.remainder(times - self.start, self.period), values)

    def _in_period(self, places: FloatArray, values: FloatArray) -> Table:
        order = np.argsort(places, kind="stable")
        places, values = places[order], values[order]
        around = np.concatenate([places[-1:] - self.period, places, places[:1] + self.period])
        values = np.concatenate([values[-1:], values, values[:1]])
        if not self.is_stepped:
            return Table(around, values)
        ends = np.maximum(around[:-1], np.nextafter(around[1:], -np.inf))
        return Table(np.stack([around[:-1], ends], axis=1).ravel(), np.repeat(values[:-1], 2))


class Future(NamedTuple):
    """What an environment reads of the future.

    Attributes:
        lookups: Those of the series by name.
        keys: The names of the episode variables from which random numbers of all steps follow.
        clock: Gives the time of the data in an environment, in seconds.
        held_out: When in a year no training is, beginnings and lengths in seconds.
    """

    lookups: Mapping[str, Lookup]
    keys: tuple[str, ...]
    clock: Callable[[Any], Any]
    held_out: tuple[tuple[float, float], ...] = ()

    def tables_of_programs(
        self, tables: Mapping[str, Table]
    ) -> list[tuple[FloatArray, FloatArray]]:
        """The tables of programs: those of series, and those in their place."""
        pairs = [(self.lookups[name], table) for name, table in tables.items()]
        return [(one.table_of_program(one.own), one.table_of_program(t)) for one, t in pairs]


@contextmanager
def assumed(futures: Iterable[Future | None], tables: Mapping[str, Table]) -> Iterator[None]:
    """Let hooks read other tables inside of a ``with`` block."""
    pairs = [
        (future.lookups[name], table)
        for future in futures
        if future is not None
        for name, table in tables.items()
    ]
    for lookup, table in pairs:
        lookup.present = table
    try:
        yield
    finally:
        for lookup, _ in pairs:
            lookup.present = lookup.own
