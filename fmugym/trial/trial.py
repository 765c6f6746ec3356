"""A first meeting with an FMU, in a process that may die of it.

An FMU is native code: a fault in it ends the process that loads it. So a worker process
(``fmugym.trial.worker``) loads, instantiates, initializes and steps an unknown FMU once before this
process touches it. Success is cached by the file's content. Failures are not cached: a missing
licence may return.

A process protects from accidents, not from malice: the worker has all the rights of its user.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import json
import logging
import os
import pickle
import signal
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, BinaryIO, cast

import fmpy

from fmugym.archive.bundled import is_bundled
from fmugym.archive.fmu import DEFAULT_PROBE_TIMEOUT, FMU
from fmugym.archive.safe_zip import ArchiveLimits
from fmugym.errors import FMULoadError
from fmugym.pool.process.last_words import OutputTail, describe_exit
from fmugym.trial.cache import recall, remember

__all__ = [
    "Candidate",
    "Request",
    "find_shared_globals",
    "meet",
]

logger = logging.getLogger(__name__)

_WORKER = "fmugym.trial.worker"


@dataclass(frozen=True)
class Candidate:
    """An FMU that may have to be tried; the attributes are those of ``fmugym.FMU``."""

    path: Path
    limits: ArchiveLimits
    preload: tuple[str, ...]
    timeout: float | None

    @classmethod
    def of(cls, fmu: FMU) -> Candidate:
        """Take over what an open FMU says of itself."""
        return cls(fmu.path, fmu.limits, fmu.preload, fmu.probe_timeout)

    def open(self) -> FMU:
        """Open the FMU without another trial."""
        return FMU(self.path, limits=self.limits, preload=self.preload, probe_timeout=None)

    @property
    def exempt(self) -> bool:
        """Whether it is never tried: turned off, or bundled with this package."""
        off = os.environ.get("FMUGYM_PROBE", "").lower() in {"0", "off", "no", "false"}
        return off or self.timeout is None or is_bundled(self.path)


@dataclass(frozen=True)
class Request:
    """What the worker is asked.

    Attributes:
        candidate: The FMU.
        spec: The ``PoolSpec`` with which a second instance is compared with one alone, or None.
        private_libraries: Whether each of the two has a copy of the library of its own.
    """

    candidate: Candidate
    spec: Any = None
    private_libraries: bool = False


@dataclass(frozen=True)
class _Outcome:
    """How a trial ended.

    ``stage`` is what the worker was doing, None before it touched the FMU. ``answer`` has the key
    ``complete`` (whether the FMU went so far that it is known) if the process survived one
    instance, and ``shares_globals`` if it survived two.
    """

    stage: str | None
    answer: dict[str, bool]
    end: str
    last_lines: list[str]

    @property
    def said(self) -> str:
        """The last lines as the end of an error's text."""
        return f"; its last lines: {' | '.join(self.last_lines)}" if self.last_lines else ""


def meet(fmu: FMU) -> None:
    """Make sure that a process has loaded and stepped an FMU and survived.

    Every way to load an FMU into this process begins here.

    Args:
        fmu: The FMU; it is not extracted.

    Raises:
        FMULoadError: If the process did not survive; with the reason and the last lines.
    """
    candidate = Candidate.of(fmu)
    if candidate.exempt:
        return
    key = _content_key(candidate.path)
    if recall(key) is None:
        _try(Request(candidate), key)


def find_shared_globals(
    candidate: Candidate,
    spec: Any,
    *,
    private_libraries: bool = False,
    must_survive: bool = True,
) -> bool:
    """Find out in a worker whether instances of an FMU disturb each other; ``probe`` included.

    Args:
        candidate: The FMU, exempt or not.
        spec: The ``PoolSpec`` to compare with.
        private_libraries: Whether each instance has a copy of the library of its own.
        must_survive: Whether it is an error if an instance alone ends the process; otherwise that
            counts as disturbing.

    Returns:
        What ``shared_globals.shares_globals`` says; True also if a second instance ends the
        process.

    Raises:
        FMULoadError: As ``probe``, with ``must_survive``.
    """
    key = _content_key(candidate.path)
    spec_key = f"{key}-{_digest(repr((spec, private_libraries)).encode())}"
    known = recall(spec_key)
    if known is None:
        answer = _try(Request(candidate, spec, private_libraries), key, must_survive)
        known = json.dumps(bool(answer.get("shares_globals", True)))
        if answer.get("complete"):
            remember(spec_key, known)
    return known == "true"


def _try(request: Request, key: str, must_survive: bool = True) -> dict[str, bool]:
    """Let a worker try an FMU, and remember that it survived; returns what the worker answered."""
    name = request.candidate.path.name
    outcome = _run(request)
    if outcome.stage is None:
        logger.warning("%s could not be tried before: it %s%s", name, outcome.end, outcome.said)
        return {"shares_globals": False}
    if "complete" not in outcome.answer and must_survive:
        raise FMULoadError(
            f"{name} cannot be used: in {outcome.stage} it {outcome.end}{outcome.said}. That was a "
            "trial in a process of its own; probe_timeout=None turns it off"
        )
    if outcome.answer.get("complete"):
        remember(key, "")
    return outcome.answer


def _run(request: Request) -> _Outcome:
    with tempfile.TemporaryDirectory(prefix="fmugym-probe-", ignore_cleanup_errors=True) as name:
        folder = Path(name)
        (folder / "request").write_bytes(pickle.dumps(request))
        try:
            end, last_lines = _watch(folder, request.candidate.timeout or DEFAULT_PROBE_TIMEOUT)
        except OSError as error:
            end, last_lines = f"found no Python to start: {error}", []
        return _Outcome(_stage(folder), _answer(folder), end, last_lines)


def _stage(folder: Path) -> str | None:
    try:
        return (folder / "stage").read_text()
    except OSError:
        return None


def _answer(folder: Path) -> dict[str, bool]:
    """What the worker has answered; nothing if it was ended while it wrote."""
    try:
        return dict(json.loads((folder / "answer").read_text()))
    except (OSError, ValueError, TypeError):
        return {}


def _watch(folder: Path, timeout: float) -> tuple[str, list[str]]:
    """Run the worker; what the FMU writes to standard output is taken for its last words."""
    process = subprocess.Popen(
        [sys.executable, "-P", "-m", _WORKER, folder],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        env=_environment(folder),
        start_new_session=True,
    )
    tail = OutputTail(cast(BinaryIO, process.stdout))
    try:
        end = f"ended the process with {describe_exit(process.wait(timeout))}"
    except subprocess.TimeoutExpired:
        end = f"did not come back within {timeout:g} s (probe_timeout)"
    finally:
        _end(process)
    return end, tail.lines()


def _environment(folder: Path) -> dict[str, str]:
    """What the FMU leaves behind goes with the folder; the worker finds the modules we found."""
    environment = {k: v for k, v in os.environ.items() if k != "PYTHONFAULTHANDLER"}
    environment |= dict.fromkeys(("TMPDIR", "TEMP", "TMP"), str(folder))
    return environment | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))}


def _end(process: subprocess.Popen[bytes]) -> None:
    """End the worker and, on Unix, what the FMU has started."""
    if sys.platform == "win32":
        process.kill()
    else:
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(process.pid, signal.SIGKILL)
    process.wait()


# Keys of the cache


def _content_key(path: Path) -> str:
    """What a verdict holds for: this content, on this platform, for this version of the package."""
    status = path.stat()
    content = _file_digest(path, status.st_mtime_ns, status.st_size, status.st_ino)
    return _digest(f"{content} {fmpy.platform_tuple} {_version()}".encode())


@functools.lru_cache(maxsize=256)
def _file_digest(path: Path, *_: int) -> str:
    """Read a file once for each of its modification times, sizes and inodes."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()[:32]


@functools.cache
def _version() -> str:
    try:
        return version("fmugym-toolbox")
    except PackageNotFoundError:
        return "unknown"
