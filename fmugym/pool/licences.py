"""Licences of FMUs: wait for one, or raise an error that quotes the FMU.

Resets of demanding FMUs are repeated while licences are refused. Messages tell the progress of
calls that may take minutes.
"""

from __future__ import annotations

import contextlib
import logging
import re
import threading
import time
from abc import abstractmethod
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Final, TypeVar

import numpy as np

from fmugym.errors import FMUGymError, LicenceError, SimulationError
from fmugym.fmi.status import WARNING_CODE
from fmugym.fmi.variable import Variable
from fmugym.pool.health import CountedPool
from fmugym.pool.pool import FloatArray, MaskArray, Pool, StatusArray
from fmugym.pool.states import IndexArray

__all__ = [
    "RetryingPool",
    "licence_errors",
    "progress",
    "refusals",
    "require_licence",
    "require_started",
    "speaks_of_licence",
    "wait_for_licence",
]

_EVERY: Final = 10.0
"""Seconds between two messages."""


@contextmanager
def progress(log: logging.Logger, call: str) -> Iterator[None]:
    """Log the duration of a call in this context every ten seconds, at INFO.

    Args:
        log: The logger.
        call: What takes so long: the FMU and the call.
    """
    if not log.isEnabledFor(logging.INFO):
        yield
        return
    over = threading.Event()
    thread = threading.Thread(target=_tell, args=[log, call, over], daemon=True)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()


def _tell(log: logging.Logger, call: str, over: threading.Event) -> None:
    start = time.monotonic()
    while not over.wait(_EVERY):
        log.info("%s has taken %.0f s so far", call, time.monotonic() - start)


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


class RetryingPool(CountedPool):
    """A pool whose resets may be tried again while licences are refused."""

    _patience: tuple[str, logging.Logger] | None = None
    """The FMU's name, and a logger that is told what takes long; None if resets are done once."""

    _release: Callable[[], None] | None = None

    @property
    def retries_resets(self) -> bool:
        """See ``Pool.retries_resets``."""
        return self._patience is not None

    def hold(self, release: Callable[[], None]) -> None:
        """Keep the claim of the instances until ``close``, which releases it."""
        self._release = release

    def _release_claim(self) -> None:
        if self._release is not None:
            self._release()

    def reset(
        self, variables: tuple[Variable, ...], values: FloatArray, mask: MaskArray | None = None
    ) -> tuple[FloatArray, StatusArray]:
        """See ``Pool.reset``."""
        if self._patience is None:
            self._reset_some(variables, values, mask)
        else:
            self._reset_patiently(*self._patience, variables, values, mask)
        return self.outputs, self.statuses

    def _reset_some(
        self, variables: tuple[Variable, ...], values: FloatArray, mask: MaskArray | None
    ) -> None:
        """Reset instances; those that have failed without files of the FMU are reset with them."""
        if self._spec.makes_anew:
            self.extract()
        if self._reset_once(variables, values, mask) and self.extract():
            failed = self._as_mask(mask) & (self.statuses > WARNING_CODE)
            self._reset_once(variables, values, failed)

    @abstractmethod
    def _reset_once(
        self, variables: tuple[Variable, ...], values: FloatArray, mask: MaskArray | None
    ) -> int:
        """Reset once; return the number of troubled instances."""

    def _reset_patiently(
        self,
        name: str,
        log: logging.Logger,
        variables: tuple[Variable, ...],
        values: FloatArray,
        mask: MaskArray | None,
    ) -> None:
        """Reset instances; those that get no licence are reset again."""
        chosen = self._as_mask(mask)
        what = f"{name}: the initialization of {np.count_nonzero(chosen)} instance(s)"

        def attempt() -> None:
            nonlocal chosen
            with progress(log, what):
                self._reset_some(variables, values, chosen)
            refused = refusals(self, chosen)
            if refused:
                chosen = np.isin(np.arange(self.num_instances), list(refused))
                raise LicenceError(next(iter(refused.values())))

        with contextlib.suppress(LicenceError):  # the statuses tell, as for every failure
            wait_for_licence(self._spec.licence_wait, log, attempt)
