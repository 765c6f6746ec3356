"""What earlier trials of an FMU have shown, kept in the cache folder."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

from fmugym.archive.fmu import FMU
from fmugym.caching import cache_folder
from fmugym.pool.bundle import SaveMethod
from fmugym.signals import ordinary
from fmugym.trial.cache import recall, remember
from fmugym.trial.candidate import Candidate, content_key, verdict_key
from fmugym.trial.verdict import Verdict

__all__ = [
    "is_known_to_harm",
    "known_resuming",
    "known_verdict",
    "marks_of",
    "note_harm",
    "note_resuming",
    "state_files",
    "with_harm",
]


def known_verdict(fmu: FMU) -> Verdict | None:
    """The verdict of the last trial of an FMU on this machine; None if there was none."""
    return Verdict.from_text(recall(content_key(Candidate.of(fmu))))


def state_files(fmu: FMU) -> str:
    """Where states of an FMU are kept; see ``fmugym.pool.states``."""
    try:
        return str(cache_folder("states") / content_key(Candidate.of(fmu)))
    except ordinary(OSError):  # there is no folder for caches
        return ""


def marks_of(candidate: Candidate) -> tuple[Path, str]:
    """The folder and the key of an FMU's marks; see ``fmugym.pool.mark``.

    Raises:
        OSError: If there is no folder for caches.
    """
    return cache_folder("marks"), content_key(candidate)


def is_known_to_harm(candidate: Candidate) -> bool:
    """Whether the cache says that an FMU harms its process."""
    known = Verdict.from_text(recall(content_key(candidate)))
    return known is not None and known.isolate


def with_harm(verdict: Verdict, candidate: Candidate) -> Verdict:
    """Add the harm to its process that the FMU has done with any other config."""
    known = Verdict.from_text(recall(content_key(candidate)))
    if known is None or not known.isolate or verdict.isolate:
        return verdict
    reasons = dict.fromkeys((*verdict.reasons, *known.reasons))
    return replace(verdict, isolate=True, reasons=tuple(reasons))


def known_resuming(candidate: Candidate, spec: Any, starts: Any) -> SaveMethod | None:
    """How states in the middle of an episode can be saved; None if that was not tried."""
    try:
        return SaveMethod(recall(_resuming_key(candidate, spec, starts)) or "")
    except ValueError:
        return None


def note_resuming(candidate: Candidate, spec: Any, starts: Any, method: SaveMethod) -> None:
    """Keep the result of a trial."""
    remember(_resuming_key(candidate, spec, starts), str(method))


def _resuming_key(candidate: Candidate, spec: Any, starts: Any) -> str:
    return f"{verdict_key(candidate, spec, starts)}-resuming"


def revise(candidate: Candidate, spec: Any, starts: Any, verdict: Verdict) -> None:
    """Replace the verdict that ``examine`` has cached for the same arguments.

    An FMU that is found to harm its process counts as harmful with every other config, too.
    """
    verdict = with_harm(verdict, candidate)
    for key in (verdict_key(candidate, spec, starts), content_key(candidate)):
        remember(key, verdict.to_text())


def note_harm(
    candidate: Candidate, spec: Any, starts: Any, verdict: Verdict, reason: str
) -> Verdict:
    """Add to the cached verdict that an FMU harms its process.

    Args:
        candidate: As for ``examine``.
        spec: As for ``examine``.
        starts: As for ``examine``.
        verdict: The verdict if nothing is cached.
        reason: What the FMU has done, in one sentence.

    Returns:
        The new verdict.
    """
    known = Verdict.from_text(recall(verdict_key(candidate, spec, starts))) or verdict
    if known.isolate:
        return known
    harmful = replace(known, isolate=True, reasons=(*known.reasons, reason))
    revise(candidate, spec, starts, harmful)
    return harmful
