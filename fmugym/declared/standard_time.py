"""Standard time of a task: the offset from UTC of its clock, throughout the year."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from typing import NamedTuple

from fmugym.declared.data_rows import utc_offsets_of
from fmugym.declared.dates import HOUR, offset_text, standard_offset
from fmugym.declared.entries import Entry
from fmugym.declared.file_lists import files_of
from fmugym.errors import ConfigError

__all__ = ["StandardTime", "standard_time"]


class StandardTime(NamedTuple):
    """The standard time of a task.

    Attributes:
        offset: Its offset in seconds east of UTC; None if nothing tells it.
        origin: Source of the offset.
    """

    offset: int | None
    origin: str

    def __str__(self) -> str:
        if self.offset is None:
            return f"not given: {self.origin}"
        return f"{offset_text(self.offset)} ({self.origin})"


def standard_time(root: Entry) -> StandardTime:
    """Find the standard time of a task.

    It is what the key ``timezone`` says, or else the offset in the header of its weather, or else
    the smallest offset in its data.

    Args:
        root: The table of all keys.

    Raises:
        ConfigError: If only files tell it, and they differ.
    """
    given = root.child("timezone")
    if given.value is not None:
        return StandardTime(standard_offset(given.value), "by the key 'timezone'")
    told = [*_told(_data(root))]
    headers = [(file, header) for file, header, _ in told if header is not None]
    if headers:
        return _agreed(given, headers, "by the header of {}")
    smallest = [(file, min(offsets)) for file, _, offsets in told if offsets]
    for file, _, offsets in told:
        if offsets and max(offsets) - min(offsets) > HOUR:  # more than daylight saving time
            smallest.append((f"{file}, in some rows,", max(offsets)))
    if not smallest:
        return StandardTime(None, "dates have no offset from UTC")
    return _agreed(given, smallest, "the smallest offset in {}")


def _data(root: Entry) -> Iterator[Entry]:
    for entry in root.child("data").items().values():
        with suppress(ConfigError):  # whoever reads the data says what is wrong with them
            yield from files_of(entry)
    live = root.child("plant").child("data").items().values()
    yield from (entry for entry in live if "file" in entry.value)


def _told(data: Iterable[Entry]) -> Iterator[tuple[str, int | None, tuple[int, ...]]]:
    """Offsets that files tell; mistakes are reported by the reader of their data."""
    for entry in data:
        with suppress(ConfigError):
            yield utc_offsets_of(entry)


def _agreed(key: Entry, offsets: Sequence[tuple[str, int]], origin: str) -> StandardTime:
    """The standard time that all files tell."""
    file, offset = offsets[0]
    if len({one for _, one in offsets}) == 1:
        return StandardTime(offset, origin.format(file))
    listed = ", ".join(f"{name} has {offset_text(one)}" for name, one in dict.fromkeys(offsets))
    raise key.error(
        f"files differ in their offset from UTC (time zone): {listed}. Say which one is the "
        f'standard time: timezone = "{offset_text(offset)}"'
    )
