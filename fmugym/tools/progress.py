"""Progress bars on the error stream of a terminal."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib import import_module

__all__ = ["Advance", "no_progress", "progress"]

Advance = Callable[..., None]
"""Is told how many steps were done since the last call, and perhaps a text to show beside."""


def no_progress(steps: float, text: str = "") -> None:
    """An ``Advance`` that shows nothing."""


@contextmanager
def progress(total: int | None, what: str, unit: str = "steps") -> Iterator[Advance]:
    """Show a bar, if the error stream is a terminal and tqdm is installed (extra ``sb3``).

    Args:
        total: The number of steps; None if it is not known.
        what: A word for what is done.
        unit: What is counted.
    """
    if not sys.stderr.isatty():
        yield no_progress
        return
    try:
        tqdm = import_module("tqdm").tqdm
    except ImportError:
        yield no_progress
        return
    with tqdm(total=total, desc=what, unit=f" {unit}", ascii=True, leave=False, delay=1) as bar:

        def advance(steps: float, text: str = "") -> None:
            bar.set_postfix_str(text, refresh=False)
            bar.update(steps)

        yield advance
