"""Progress of a command: a bar in a terminal, otherwise a line now and then."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from time import monotonic
from typing import Final

from fmugym.episodes.progress_bars import Advance, no_progress, progress_bar
from fmugym.tools.options import tell

__all__ = ["watched"]

_BETWEEN_LINES: Final = 10.0
_MINUTE: Final = 60.0
_HOUR: Final = 3600.0


@contextmanager
def watched(
    total: float | None, what: str, unit: str = "", clock: Callable[[], float] | None = None
) -> Iterator[Advance]:
    """Show the progress of a command, and the time that the rest may take.

    Args:
        total: All that is to be done; None if that is not known.
        what: A word for it.
        unit: Name of the counted things; "" if only parts are shown.
        clock: Tells seconds; that of the system by default.

    Yields:
        A function that is told what was done since the last call, and perhaps a text to show.
    """
    with progress_bar(total, what, unit) as advance:
        yield advance if advance is not no_progress else _lines(total, what, clock or monotonic)


def _lines(total: float | None, what: str, clock: Callable[[], float]) -> Advance:
    """Print progress every ten seconds: a text, or the part that is done."""
    begin = last = clock()
    done = 0.0

    def show(steps: float, text: str = "") -> None:
        nonlocal last, done
        done += steps
        now = clock()
        if now - last > _BETWEEN_LINES:
            last = now
            tell(text or _text(what, done, total, now - begin))

    return show


def _text(what: str, done: float, total: float | None, seconds: float) -> str:
    if not total or not done:
        return f"{what}: {_duration(seconds)}"
    part = min(done / total, 1.0)
    return f"{what}: {100 * part:.0f} %, about {_duration(seconds * (1 - part) / part)} left"


def _duration(seconds: float) -> str:
    if seconds < 2 * _MINUTE:
        return f"{seconds:.0f} s"
    return f"{seconds / _MINUTE:.0f} min" if seconds < 2 * _HOUR else f"{seconds / _HOUR:.1f} h"
