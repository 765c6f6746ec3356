"""Reports of the C code in words: failures, refusals to load, and messages of FMUs.

FMUs say much, and the cause is rarely in the last line. An error that quotes everything is not
read, so a text quotes the messages that report something bad, or the last ones if none does.
"""

from __future__ import annotations

import logging
import math
import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np

from fmugym.errors import printable
from fmugym.fmi.description import ModelDescription
from fmugym.fmi.status import failed_call
from fmugym.fmi.systems.system_description import SystemDescription
from fmugym.fmi.temporary import is_plain_path
from fmugym.fmi.variable import Variable
from fmugym.pool.licences import speaks_of_licence
from fmugym.pool.pool_spec import PoolSpec

__all__ = [
    "FRESH_PROCESSES",
    "MORE_PROCESSES",
    "REFUSED_ANEW",
    "Failure",
    "Message",
    "Receiver",
    "as_log_record",
    "as_messages",
    "asked_for",
    "describe_failure",
    "loading_failed",
    "quoted",
    "telling",
    "unpacked",
]

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
"""Ends a message in the texts of ``fmugym._native``; see ``native/fmi/log.h``."""


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


_LEVELS: Final = (
    logging.INFO,
    logging.WARNING,
    logging.WARNING,
    logging.ERROR,
    logging.CRITICAL,
)
_NO_REFERENCE: Final = 2**32 - 1
_DERIVATIVES: Final = "the derivative by", "the derivative of"
_ADVICE: Final = (
    "; it is in {}, which is long, or has spaces or special letters, and some FMUs do not find "
    "their files there: set TMPDIR to a short path without such letters"
)

REFUSED_ANEW: Final = "the FMU refused to be instantiated anew"
"""How a failure begins if an instance cannot be made again; see ``native/pool/instances.c``."""

FRESH_PROCESSES: Final = (
    '; if it makes only so many instances in one process, isolation="process" goes on in fresh '
    "worker processes, and a vector environment may have several of them (workers)"
)
"""What helps against refusals in the caller's process."""

MORE_PROCESSES: Final = "; if it makes only so many instances in one process, give more workers"
"""What helps against refusals in a worker process that makes several instances."""

_REFUSED: Final = "it refused to be instantiated"
"""How the extension's error begins if an instance cannot be made; see ``native/pool/pools.c``."""

_SAID: Final = "\x1d"
"""Stands before the FMU's messages in an error of the extension; see ``native/fmi/log.h``."""


class Failure(NamedTuple):
    """Why the last status of an instance was bad; see ``Failure`` of ``native/pool/pool.h``."""

    doing: str
    in_warm_up: bool
    status: int
    time: float
    reference: int
    said: str
    has_values: bool
    values: bytes
    part: str


def describe_failure(
    failure: Failure, description: ModelDescription, spec: PoolSpec, name: str
) -> str:
    """Say in a sentence why an instance of this name failed."""
    if failure.has_values:
        variables = spec.inputs if "inputs" in failure.doing else spec.outputs
        return f"{failure.doing}: {_not_finite(variables, failure.values)}"
    text = _sentence(failure, description, name) + quoted(unpacked(failure.said))
    return f"the warm-up failed: {text}" if failure.in_warm_up else text


def _sentence(failure: Failure, description: ModelDescription, name: str) -> str:
    doing = failure.doing
    if not math.isnan(failure.time):
        doing = f"the step at t = {failure.time:g} s"
    elif failure.reference != _NO_REFERENCE:
        is_string = doing not in _DERIVATIVES
        name_of = _name_of(description, failure.reference, "string" if is_string else "real")
        doing = f"{'setting' if is_string else doing} {name_of!r}"
    if failure.status < 0:  # the call was refused, and the text is a whole sentence
        return doing
    return f"{name}: {failed_call(doing, failure.status, failure.part)}"


def _name_of(description: ModelDescription, reference: int, kind: str) -> str:
    some = (v for v in description.everything if v.kind == kind)
    return next(v.name for v in some if v.value_reference == reference)


def _not_finite(variables: tuple[Variable, ...], values: bytes) -> str:
    pairs = zip(variables, np.frombuffer(values).tolist(), strict=True)
    bad = (f"{v.name} = {value}" for v, value in pairs if not math.isfinite(value))
    return printable(", ".join(bad))


def loading_failed(fmu: str, error: str, folder: Path, processes: str) -> str:
    """Explain why an FMU of this name cannot be loaded from a folder, with its messages.

    What helps if there are too many instances in a process is said of one that is not the first,
    and where the FMU gave no reason.
    """
    reason, _, said = error.partition(_SAID)
    advice = "" if is_plain_path(folder) else _ADVICE.format(folder)
    text = f"{fmu} cannot be loaded: {reason}{quoted(unpacked(said))}{advice}"
    is_full = reason.startswith(_REFUSED) and not (reason == _REFUSED and said)
    return text + processes if is_full and not speaks_of_licence(text) else text


def as_log_record(name: str, status: int, category: str, message: str) -> tuple[int, str]:
    """The logging level and the text for a message of an instance of this name."""
    level = _LEVELS[status] if 0 <= status < len(_LEVELS) else logging.INFO
    return level, f"{name}: [{printable(category)}] {printable(message)}"


class Receiver:
    """Passes on the FMU's messages; the C extension calls it.

    It may not refer to the pool, or the pool would live for ever.

    Args:
        log: Gets them.
        description: Of the FMU, or of a system, whose components are named.
        first: The number of the first instance.
    """

    def __init__(self, log: logging.Logger, description: ModelDescription, first: int = 0) -> None:
        self._log, self._model, self._first_index = log, description.model_identifier, first
        self._parts = [""]
        if isinstance(description, SystemDescription):
            self._parts = [f".{component.name}" for component in description.plan.components]

    def __call__(self, index: int, status: int, category: str, message: str) -> None:
        """Log a message of an instance, or of a component of one."""
        instance, part = divmod(index, len(self._parts))
        name = f"{self._model}_{self._first_index + instance}{self._parts[part]}"
        level, text = as_log_record(name, status, category, message)
        self._log.log(level, "%s", text)

    @property
    def sources(self) -> int:
        """Number of the sources of messages of an instance: its components, or itself."""
        return len(self._parts)
