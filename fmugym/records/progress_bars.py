"""Progress bars on the error stream."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from importlib import import_module
from typing import Final

__all__ = ["Advance", "no_progress", "progress_bar", "quiet"]

Advance = Callable[..., None]
"""Takes the number of steps since the last call, and perhaps a text to show beside."""


_PARTS: Final = "{desc}: {percentage:3.0f}%|{bar}| {elapsed}<{remaining}{postfix}"

_FINE: Final = 1000
"""Resolution of a bar in which nothing is counted."""

quiet: Final = ContextVar("quiet", default=False)
"""Whether to show results and errors only."""


def no_progress(steps: float, text: str = "") -> None:
    """An ``Advance`` that shows nothing."""


def _is_watched() -> bool:
    """Whether the error stream can show a bar: it is a terminal, or a notebook's."""
    return sys.stderr.isatty() or type(sys.stderr).__module__.startswith("ipykernel.")


@contextmanager
def progress_bar(total: float | None, what: str, unit: str = "steps") -> Iterator[Advance]:
    """Show a bar and the time left, in a terminal or a notebook, if tqdm is installed (``sb3``).

    Args:
        total: The number of steps; None if it is not known.
        what: A word for what is done.
        unit: Name of the counted things; "" if only parts are shown.
    """
    if quiet.get() or not _is_watched():
        yield no_progress
        return
    try:
        tqdm = import_module("tqdm").tqdm
    except ImportError:
        yield no_progress
        return
    scale = 1.0 if unit or not total else _FINE / total
    whole = None if total is None else round(total * scale)
    form = {"unit": f" {unit}"} if unit else {"bar_format": _PARTS}
    with tqdm(total=whole, desc=what, ascii=True, leave=False, delay=1, **form) as bar:
        done, shown = 0.0, 0

        def advance(steps: float, text: str = "") -> None:
            nonlocal done, shown
            done += steps * scale  # which may be parts of one, as those of averages
            if text:
                bar.set_postfix_str(text, refresh=False)
            before, shown = shown, round(done)
            bar.update(shown - before)

        yield advance
