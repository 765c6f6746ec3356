"""What the C code reports, in words: failures, refusals to load, and messages of FMUs."""

from __future__ import annotations

import logging
import math
from typing import Final, NamedTuple

import numpy as np

from fmugym.archive.description import ModelDescription
from fmugym.archive.variable import Variable
from fmugym.errors import printable
from fmugym.fmi.status import failed_call
from fmugym.fmi.words import quoted, unpacked
from fmugym.pool.spec import PoolSpec

__all__ = ["Failure", "as_record", "describe_failure", "loading_failed"]

_LEVELS: Final = (
    logging.INFO,
    logging.WARNING,
    logging.WARNING,
    logging.ERROR,
    logging.CRITICAL,
)
_NO_STRING: Final = 2**32 - 1
_SAID: Final = "\x1d"
"""Stands before the FMU's messages in an error of the extension; see ``native/log.h``."""


class Failure(NamedTuple):
    """Why the last status of an instance was bad; see ``Failure`` of ``native/pool.h``."""

    doing: str
    in_warm_up: bool
    status: int
    time: float
    string: int
    said: str
    values: bytes | None
    part: str | None = None


def describe_failure(
    failure: Failure, description: ModelDescription, spec: PoolSpec, name: str
) -> str:
    """Say in a sentence why an instance of this name failed."""
    if failure.values is not None:
        variables = spec.inputs if "inputs" in failure.doing else spec.outputs
        return f"{failure.doing}: {_not_finite(variables, failure.values)}"
    text = _sentence(failure, description, name) + quoted(unpacked(failure.said))
    return f"the warm-up failed: {text}" if failure.in_warm_up else text


def _sentence(failure: Failure, description: ModelDescription, name: str) -> str:
    doing = failure.doing
    if not math.isnan(failure.time):
        doing = f"the step at t = {failure.time:g} s"
    elif failure.string != _NO_STRING:
        doing = f"setting {_string_name(description, failure.string)!r}"
    if failure.status < 0:  # the call was refused, and the text is a whole sentence
        return doing
    return f"{name}: {failed_call(doing, failure.status, failure.part or '')}"


def _string_name(description: ModelDescription, reference: int) -> str:
    strings = (v for v in description.variables.values() if v.kind == "string")
    return next(v.name for v in strings if v.value_reference == reference)


def _not_finite(variables: tuple[Variable, ...], values: bytes) -> str:
    pairs = zip(variables, np.frombuffer(values).tolist(), strict=True)
    bad = (f"{v.name} = {value}" for v, value in pairs if not math.isfinite(value))
    return printable(", ".join(bad))


def loading_failed(fmu: str, error: str) -> str:
    """Say why an FMU of this name cannot be loaded, with what it said."""
    reason, _, said = error.partition(_SAID)
    return f"{fmu} cannot be loaded: {reason}{quoted(unpacked(said))}"


def as_record(name: str, status: int, category: str, message: str) -> tuple[int, str]:
    """The logging level and the text for a message of an instance of this name."""
    level = _LEVELS[status] if 0 <= status < len(_LEVELS) else logging.INFO
    return level, f"{name}: [{printable(category)}] {printable(message)}"
