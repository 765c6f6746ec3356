"""Licences of FMUs: wait for one, or raise an error that quotes the FMU."""

from __future__ import annotations

import contextlib
import logging
import re
import time
from collections.abc import Callable, Iterator
from typing import Final, TypeVar

import numpy as np

from fmugym.errors import FMUGymError, LicenceError, SimulationError
from fmugym.fmi.status import WARNING_CODE
from fmugym.pool.base import MaskArray, Pool
from fmugym.pool.bundle import IndexArray

__all__ = [
    "licence_errors",
    "refusals",
    "require_licence",
    "require_started",
    "speaks_of_licence",
    "wait_for_licence",
]

R = TypeVar("R")

_WORDS: Final = re.compile(
    r"licen[cs]|\bseats?\b|\bcheck(ed|ing)?[ -]?out\b|flex(lm|net)|\blmgrd\b|\bdongles?\b"
    r"|codemeter",
    re.IGNORECASE,
)
"""What FMUs call a licence."""

_REFUSAL: Final = re.compile(
    r"\b(no|not|none|all|cannot|unable|without)\b|n't|fail|error|denied|deny|expired|taken|in use"
    r"|unavailable|invalid|missing|exceed|refuse|reject|limit|lost|wait",
    re.IGNORECASE,
)
"""How they say that they did not get it; most tell of a licence that they got, too."""

_SAID: Final = re.compile(r"(?:the FMU said|its last lines|it printed): ")
"""What comes before an FMU's words in the texts of errors."""

_EXTRACTED: Final = (
    "; files of the FMU were missing in its temporary folder and are there again: reset once more"
)

_FIRST_PAUSE: Final = 0.5
_LONGEST_PAUSE: Final = 10.0
"""Seconds between two attempts to get a licence."""


def speaks_of_licence(text: str) -> bool:
    """Whether the FMU's words in the text of an error say that it got no licence."""
    said = _SAID.split(text, maxsplit=1)[1:]
    lines = " | ".join(said).split(" | ")
    return any(_WORDS.search(line) and _REFUSAL.search(line) for line in lines)


@contextlib.contextmanager
def licence_errors() -> Iterator[None]:
    """Turn errors in this context whose FMU speaks of a licence into a ``LicenceError``.

    It is meant for calls that make or initialize instances.
    """
    try:
        yield
    except FMUGymError as error:
        if isinstance(error, LicenceError) or not speaks_of_licence(str(error)):
            raise
        raise LicenceError(str(error)) from None


def require_licence(pool: Pool) -> None:
    """Look at the instances of a pool after a reset.

    Raises:
        LicenceError: If one of them got no licence.
    """
    for failure in refusals(pool).values():
        raise LicenceError(failure)


def refusals(pool: Pool, chosen: MaskArray | bool = True) -> dict[int, str]:
    """The texts of the instances among the chosen ones that got no licence, by their index."""
    failed = np.flatnonzero(chosen & (pool.statuses > WARNING_CODE)).tolist()
    texts = {index: pool.failure(index) for index in failed}
    return {index: text for index, text in texts.items() if speaks_of_licence(text)}


def require_started(pool: Pool, indices: IndexArray, doing: str = "") -> None:
    """Refuse an instance whose reset or warm-up has failed.

    Args:
        pool: Has the instances.
        indices: Those that were to start, shape (M,).
        doing: What comes before the failure in the text of the error.

    Raises:
        SimulationError: If one has failed; a ``LicenceError`` if the FMU speaks of a licence.
    """
    for index in indices[pool.statuses[indices] > WARNING_CODE].tolist():
        failure = f"{doing}{pool.failure(index)}{_EXTRACTED if pool.extract() else ''}"
        error = LicenceError if speaks_of_licence(failure) else SimulationError
        raise error(failure if pool.num_instances == 1 else f"environment {index}: {failure}")


def wait_for_licence(seconds: float, log: logging.Logger, function: Callable[[], R]) -> R:
    """Call a function, again and again while it raises a ``LicenceError``.

    Args:
        seconds: The real time in seconds to wait for a licence; 0 to give up at once.
        log: Is told of each refusal.
        function: What to call.

    Raises:
        LicenceError: If the time is over. The text says how long this has waited.
    """
    deadline, pause = time.monotonic() + seconds, _FIRST_PAUSE
    while True:
        try:
            return function()
        except LicenceError as error:
            left = deadline - time.monotonic()
            if left <= 0.0:
                raise LicenceError(f"{error}; {_advice(seconds)}") from None
            log.warning("%s; waiting for %.0f s more at most (licence_wait)", error, left)
        time.sleep(min(pause, left))
        pause = min(2.0 * pause, _LONGEST_PAUSE)


def _advice(seconds: float) -> str:
    if seconds:
        return f"no licence came within {seconds:g} s (licence_wait)"
    return "'licence_wait' of the table 'foreign' gives the seconds to wait for a licence"
