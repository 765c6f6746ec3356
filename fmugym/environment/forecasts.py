"""Forecasts that hooks read: data of later times, and random numbers to come."""

from __future__ import annotations

import math
from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt

from fmugym.errors import ConfigError, shown
from fmugym.pool.pool import FloatArray

__all__ = ["Future", "HeldOut", "Lookup", "Span", "assumed", "distance_of", "future_of"]

_YEAR: Final = 365 * 86400.0


HeldOut = tuple[float, float, Mapping[str, int]]
"""When in a year no training is: beginning and length in seconds, and the numbers of files."""


class Span(NamedTuple):
    """The rows of a file.

    Attributes:
        start: The time in seconds of the first one.
        period: Seconds after which they repeat.
    """

    start: float
    period: float


def distance_of(spans: Sequence[Span]) -> float:
    """Distance of the places of files in the table of a series.

    Rows may be given from a period before a file's first one to a period after its last one. The
    distance is a power of two, so that adding it to a place rounds least.
    """
    if len(spans) == 1:
        return 0.0
    return 2.0 ** math.ceil(math.log2(4 * max(one.period for one in spans)))


class Lookup(NamedTuple):
    """A periodic series, and where hooks look its values up.

    Attributes:
        tables: Those that hooks look values up in.
        key: That of the series: the times of a period from 0 on, the values there, and those before
            the first time and after the last one. Files follow each other, ``distance_of`` apart.
        spans: Those of its files, of which an episode has one.
        is_stepped: Whether a value holds until the next one.
        variable: The episode variable with the number of the file; "" if there is only one.
    """

    tables: dict[Hashable, FloatArray]
    key: str
    spans: tuple[Span, ...]
    is_stepped: bool
    variable: str = ""

    @property
    def period(self) -> float:
        """Seconds after which any of its files repeats."""
        return min(one.period for one in self.spans)

    @property
    def table(self) -> FloatArray:
        """Table in which hooks look values up."""
        return self.tables[self.key]

    def mean(self, held_out: Sequence[HeldOut] = ()) -> float:
        """The mean over a period of all files.

        Args:
            held_out: What is left out. If nothing else is there, such as in the data of a day,
                nothing is left out.
        """
        places, values = np.split(self.table[:-2], 2)
        numbers, distance = self._numbers_of(places), distance_of(self.spans)
        starts = np.array([one.start for one in self.spans])
        times = starts[numbers] + (places - numbers * distance)
        widths = np.where(np.diff(numbers) == 0, np.diff(places), 0.0)
        is_seen = np.ones(len(widths), np.bool_)
        for begin, length, files in held_out:
            since = times[:-1] - begin
            is_other = numbers[:-1] != files.get(self.variable, numbers[:-1])
            is_seen &= is_other | (np.remainder(since, _YEAR) >= length)
            is_seen &= is_other | (np.remainder(-since, _YEAR) > widths)
        seen, middles = widths * is_seen, (values[1:] + values[:-1]) / 2
        return float(np.average(middles, weights=seen if seen.any() else widths))

    def _numbers_of(self, places: FloatArray) -> npt.NDArray[np.int64]:
        """The numbers of the files to which places in the table belong."""
        distance = distance_of(self.spans)
        parts = places / distance + 0.25 if distance else 0 * places
        return np.floor(parts).astype(np.int64)

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
        distance = distance_of(self.spans)
        parts = [self._in_period(one, times, values) for one in self.spans]
        places = np.concatenate([own + i * distance for i, (own, _) in enumerate(parts)])
        values = np.concatenate([own for _, own in parts])
        return np.concatenate([places, values, self.table[-2:-1], values[-1:]])

    def _in_period(
        self, span: Span, times: FloatArray, values: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """The places of rows in the period of a file, in their order, and the values there."""
        places = np.remainder(times - span.start, span.period)
        order = np.argsort(places, kind="stable")
        places, values = places[order], values[order]
        places = np.concatenate([places[-1:] - span.period, places, places[:1] + span.period])
        values = np.concatenate([values[-1:], values, values[:1]])
        if self.is_stepped:
            ends = np.maximum(places[:-1], np.nextafter(places[1:], -np.inf))
            places = np.stack([places[:-1], ends], axis=1).ravel()
            values = np.repeat(values[:-1], 2)
        return places, values


class Future(NamedTuple):
    """Future of an environment: its data, and its noise to come.

    Attributes:
        lookups: Those of the series by name.
        keys: The names of the episode variables from which random numbers of all steps follow.
        clock: Gives the time of the data in an environment, in seconds.
        held_out: When, and in which files, no training is.
    """

    lookups: Mapping[str, Lookup]
    keys: tuple[str, ...]
    clock: Callable[[Any], Any]
    held_out: tuple[HeldOut, ...] = ()


def future_of(env: Any) -> Future | None:
    """The data of a declared task, and its noise to come; None for other tasks."""
    return None if env.resolved is None else env.resolved.future


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
