"""What earlier trials of an FMU have shown, kept in the cache folder."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from fmugym.archive.fmu import FMU
from fmugym.caching import cache_folder
from fmugym.pool.bundle import SaveMethod
from fmugym.signals import ordinary
from fmugym.trial.cache import recall, remember
from fmugym.trial.candidate import Candidate, content_key, verdict_key
from fmugym.trial.verdict import Verdict

__all__ = [
    "known_resuming",
    "known_verdict",
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
