"""Messages of an FMU before a call failed: the few that tell the cause.

FMUs say much, and the cause is rarely in the last line. An error that quotes everything is not
read, so a text quotes the messages that report something bad, or the last ones if none does.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from typing import Final

from fmugym.errors import printable

__all__ = ["Message", "as_messages", "asked_for", "quoted", "telling", "unpacked"]

Message = tuple[int, str]
"""An FMI status, ``UNKNOWN`` for a line of output, and a text."""

_UNKNOWN: Final = -1
_BAD: Final = range(1, 5)
"""Warning, Discard, Error and Fatal."""

_MOST: Final = 3
_LONGEST: Final = 300

_SOUNDS_BAD: Final = re.compile(
    r"error|fatal|severe|fail|exception|abort|cannot|can't|could not|unable|not found|no such"
    r"|missing|invalid|illegal|denied|refuse|licen[cs]e|expired|out of|singular|converge|diverge"
    r"|overflow|divi(de|sion)|not finite|\bnan\b",
    re.IGNORECASE,
)
_EMPTY_NAME: Final = re.compile(r"^\W*(?:[\w.]+\.)?Exception: *(?=\S)")
"""The name of the exception type that says nothing."""

_LACKS: Final = re.compile(
    r"\bneed|\brequir|\bmust\b|\bmissing\b|\bmandatory\b|\bexpect|\black|\bha(s|ve) to\b"
    r"|\bshould\b|\bplease\b|\bundefined\b|\bunset\b|\bunspecified\b|\bwithout\b"
    r"|\bnot? (been |yet )?(set|defined|given|specified|provided|known|available|passed)\b"
    r"|\bno (\w+ )?(stop|end|final|tolerance|rtol|step|communication)",
    re.IGNORECASE,
)
"""Patterns of requests for something."""

_REACHED: Final = re.compile(r"exceed|beyond|\bpast\b|greater|larger|later|reached", re.IGNORECASE)
"""Pattern of a message about a given time or tolerance."""

_KEYS: Final = {
    "stop_time": re.compile(r"\b(stop|end|final)[ _-]?time|\btstop\b", re.IGNORECASE),
    "tolerance": re.compile(r"\btoleran|\brtol\b", re.IGNORECASE),
    "time_step": re.compile(
        r"step[ _-]?(size|length)|\btime[ _-]?step|\bsample[ _-]?time", re.IGNORECASE
    ),
}
"""Patterns of requests, by the key of a config that answers them."""

_END: Final = "\x1e"
"""Ends a message in the texts of ``fmugym._native``; see ``native/log.h``."""


def as_messages(lines: Iterable[str]) -> list[Message]:
    """Make messages of lines of output."""
    return [(_UNKNOWN, line) for line in lines]


def unpacked(text: str) -> list[Message]:
    """Read the messages that ``fmugym._native`` gives in one text."""
    parts = [part for part in text.split(_END) if part]
    return [(int(p[0]), p[1:]) if p[0] in "0123456789" else (_UNKNOWN, p) for p in parts]


def telling(messages: Sequence[Message]) -> list[str]:
    """Choose the messages that tell why a call failed.

    Args:
        messages: From the oldest to the newest.

    Returns:
        At most three printable lines, each of at most 300 characters.
    """
    bad = [text for status, text in messages if status in _BAD or _SOUNDS_BAD.search(text)]
    chosen = bad or [text for _, text in messages]
    lines = dict.fromkeys(filter(None, map(_line, chosen)))  # each of them once
    return list(lines)[-_MOST:]


def asked_for(text: str) -> str:
    """Key of a config that gives a value for which an FMU asks; "" if there is none."""
    if not _LACKS.search(text):
        return ""
    is_given = _REACHED.search(text)
    found = (key for key, pattern in _KEYS.items() if pattern.search(text))
    return next((key for key in found if key == "time_step" or not is_given), "")


def quoted(messages: Sequence[Message], speaker: str = "the FMU said") -> str:
    """Quote the telling messages, to end an error's text; "" if there are none.

    What the FMU asks for follows by the name of its key.
    """
    lines = telling(messages)
    keys = dict.fromkeys(filter(None, map(asked_for, lines)))
    cure = f"; cure: set {' and '.join(keys)} in the config" if keys else ""
    return f"; {speaker}: {' | '.join(lines)}{cure}" if lines else ""


def _line(text: str) -> str:
    line = _EMPTY_NAME.sub("", printable(" ".join(text.split())))
    return line if len(line) <= _LONGEST else f"{line[: _LONGEST - 3]}..."
