"""Results of earlier trials, kept in the cache folder under the identity of the FMU.

If the folder cannot be read or written, nothing is kept, and no error is raised.
"""

from __future__ import annotations

import functools
import hashlib
import logging
import os
from dataclasses import replace
from importlib.metadata import PackageNotFoundError, version
from typing import Any, Final

import fmpy

from fmugym.archive.fmu import FMU
from fmugym.caching import cache_folder, read_file, replace_file
from fmugym.checks import check_option
from fmugym.pool.bundle import SaveMethod
from fmugym.pool.spec import PoolSpec
from fmugym.trial.verdict import Verdict

__all__ = [
    "content_key",
    "is_exempt",
    "known_resuming",
    "known_verdict",
    "note_resuming",
    "recall",
    "remember",
    "state_files",
    "verdict_key",
    "with_harm",
]

logger = logging.getLogger(__name__)

_LARGEST: Final = 2**20
"""The largest size of a text in bytes."""


def recall(key: str) -> str | None:
    """Read the text that was kept under a key; None if there is none."""
    try:
        return read_file(cache_folder() / key, _LARGEST).decode()
    except (OSError, ValueError):
        return None


def remember(key: str, text: str) -> None:
    """Keep a text under a key, which is a file name."""
    try:
        replace_file(cache_folder() / key, text.encode())
    except OSError as error:
        logger.debug("nothing is remembered: %s", error)


def known_verdict(fmu: FMU) -> Verdict | None:
    """The verdict of the last trial of an FMU on this machine; None if there was none."""
    return Verdict.from_text(recall(content_key(fmu)))


def with_harm(verdict: Verdict, fmu: FMU) -> Verdict:
    """Add the harm to its process that the FMU has done with any other config."""
    known = known_verdict(fmu)
    if known is None or verdict.harm:
        return verdict
    return replace(verdict, harm=known.harm).finding(known.harm)


def state_files(fmu: FMU) -> str:
    """Folder of the states of an FMU; see ``fmugym.pool.state_files``."""
    try:
        return str(cache_folder("states") / content_key(fmu))
    except OSError:  # there is no folder for caches
        return ""


def known_resuming(fmu: FMU, spec: PoolSpec, starts: Any, length: int | None) -> SaveMethod | None:
    """Method of saving states in the middle of an episode; None if that was not tried."""
    try:
        return SaveMethod(recall(_resuming_key(fmu, spec, starts, length)) or "")
    except ValueError:
        return None


def note_resuming(
    fmu: FMU, spec: PoolSpec, starts: Any, length: int | None, method: SaveMethod
) -> None:
    """Keep the result of a trial."""
    remember(_resuming_key(fmu, spec, starts, length), str(method))


def _resuming_key(fmu: FMU, spec: PoolSpec, starts: Any, length: int | None) -> str:
    return f"{verdict_key(fmu, spec, starts)}-resuming-{length}"


# What an FMU is known by

_ON: Final = ("on", "1", "yes", "true")
_OFF: Final = ("off", "0", "no", "false")
"""The values of ``FMUGYM_PROBE``; an empty one is none."""


def is_exempt(fmu: FMU) -> bool:
    """Whether to skip the trial: trials are turned off, or this package bundles the FMU.

    Raises:
        ConfigError: If the environment variable ``FMUGYM_PROBE`` has an unknown value.
    """
    return _trials_are_off() or fmu.probe_timeout is None or fmu.bundled


def _trials_are_off() -> bool:
    given = os.environ.get("FMUGYM_PROBE", "").strip().lower()
    if given:
        check_option("value of the environment variable FMUGYM_PROBE", given, (*_ON, *_OFF))
    return given in _OFF


def verdict_key(fmu: FMU, spec: PoolSpec, starts: Any) -> str:
    """The scope of a verdict on resets and neighbours."""
    tried = replace(spec, max_instances=None, licence_wait=0.0)
    return f"{content_key(fmu)}-{_digest(repr((tried, starts, fmu.preload)))}"


def content_key(fmu: FMU) -> str:
    """The scope of a verdict: content, interface, sizes, platform, and version of the package."""
    scope = f"{fmu.content} {fmpy.platform_tuple} {_version()} {fmu.description.interface}"
    return _digest(f"{scope} {sorted(fmu.sizes.items())}")


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()[:32]


@functools.cache
def _version() -> str:
    try:
        return version("fmugym-toolbox")
    except PackageNotFoundError:
        return "unknown"
