"""What hooks read that the state of an episode does not tell: data, and random numbers to come."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, Final, NamedTuple

import numpy as np

from fmugym.errors import ConfigError, shown
from fmugym.pool.base import FloatArray

__all__ = ["Future", "Lookup", "assumed"]

_YEAR: Final = 365 * 86400.0


class Lookup(NamedTuple):
    """A periodic series, and where hooks look its values up.

    Attributes:
        tables: Those that hooks look values up in.
        key: That of the series: the times of a period from 0 on, the values there, and those before
            the first time and after the last one.
        start: The time in seconds of its first row.
        period: Seconds after which it repeats.
        is_stepped: Whether a value holds until the next one.
    """

    tables: dict[Hashable, FloatArray]
    key: str
    start: float
    period: float
    is_stepped: bool

    @property
    def table(self) -> FloatArray:
        """What hooks look values up in now."""
        return self.tables[self.key]

    def mean(self, held_out: Sequence[tuple[float, float]] = ()) -> float:
        """The mean over a period.

        Args:
            held_out: Beginnings and lengths in seconds of parts of each year that are left out. If
                nothing else is there, such as in the data of a day, nothing is left out.
        """
        times, values = np.split(self.table[:-2], 2)
        widths = np.diff(times)
        is_seen = np.ones(len(widths), np.bool_)
        for begin, length in held_out:
            since = self.start + times[:-1] - begin
            is_seen &= np.remainder(since, _YEAR) >= length
            is_seen &= np.remainder(-since, _YEAR) > widths
        middles = (values[1:] + values[:-1]) / 2
        return float(np.average(middles, weights=widths * is_seen if is_seen.any() else widths))

    def table_of(self, what: str, rows: Any) -> FloatArray:
        """The table of other rows, which repeat after the same period.

        Args:
            what: Their name, for the error.
            rows: Times in seconds, on the clock of the data, and values.

        Raises:
            ConfigError: If the rows make no function of time.
        """
        try:
            times, values = (np.asarray(part, np.float64) for part in rows)
        except Exception:  # no pair, or no numbers
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

    def _in_period(self, places: FloatArray, values: FloatArray) -> FloatArray:
        order = np.argsort(places, kind="stable")
        places, values = places[order], values[order]
        places = np.concatenate([places[-1:] - self.period, places, places[:1] + self.period])
        values = np.concatenate([values[-1:], values, values[:1]])
        if self.is_stepped:
            ends = np.maximum(places[:-1], np.nextafter(places[1:], -np.inf))
            places = np.stack([places[:-1], ends], axis=1).ravel()
            values = np.repeat(values[:-1], 2)
        return np.concatenate([places, values, self.table[-2:-1], values[-1:]])


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


@contextmanager
def assumed(
    futures: Iterable[Future | None], tables: Mapping[str, FloatArray]
) -> Iterator[dict[bytes, FloatArray]]:
    """Let hooks look other tables up inside of a ``with`` block.

    Args:
        futures: Those of the environments.
        tables: See ``Lookup.table_of``; by the names of series.

    Yields:
        The tables by the bytes of those whose place they take.
    """
    changes = [
        (one.lookups[name], one.lookups[name].table, table)
        for one in futures
        if one is not None
        for name, table in tables.items()
    ]
    for lookup, _, table in changes:
        lookup.tables[lookup.key] = table
    try:
        yield {own.tobytes(): table for _, own, table in changes}
    finally:
        for lookup, own, _ in changes:
            lookup.tables[lookup.key] = own
