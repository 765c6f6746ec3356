"""Reports of the C code in words: failures, refusals to load, and messages of FMUs."""

from __future__ import annotations

import logging
import math
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np

from fmugym.archive.description import ModelDescription
from fmugym.archive.temporary import is_plain_path
from fmugym.archive.variable import Variable
from fmugym.errors import printable
from fmugym.fmi.status import failed_call
from fmugym.fmi.words import quoted, unpacked
from fmugym.pool.licences import speaks_of_licence
from fmugym.pool.spec import PoolSpec
from fmugym.systems.system_description import SystemDescription

__all__ = [
    "FRESH_PROCESSES",
    "MORE_PROCESSES",
    "REFUSED_ANEW",
    "Failure",
    "Receiver",
    "as_log_record",
    "describe_failure",
    "loading_failed",
]

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
"""How a failure of an instance begins that could not be made again; see ``native/instances.c``."""

FRESH_PROCESSES: Final = (
    '; if it makes only so many instances in one process, isolation="process" goes on in fresh '
    "worker processes, and a vector environment may have several of them (workers)"
)
"""What helps against refusals in the caller's process."""

MORE_PROCESSES: Final = "; if it makes only so many instances in one process, give more workers"
"""What helps against refusals in a worker process that makes several instances."""

_REFUSED: Final = "it refused to be instantiated"
"""How an error of the extension begins if an instance cannot be made; see ``native/pools.c``."""

_SAID: Final = "\x1d"
"""Stands before the FMU's messages in an error of the extension; see ``native/log.h``."""


class Failure(NamedTuple):
    """Why the last status of an instance was bad; see ``Failure`` of ``native/pool.h``."""

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
