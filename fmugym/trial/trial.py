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
import re
import signal
import subprocess
import sys
import tempfile
from dataclasses import dataclass, replace
from enum import StrEnum
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, BinaryIO, Final, cast

import fmpy

from fmugym.archive.bundled import is_bundled
from fmugym.archive.fmu import DEFAULT_PROBE_TIMEOUT, FMU
from fmugym.archive.safe_zip import ArchiveLimits
from fmugym.errors import FMULoadError
from fmugym.pool.process.last_words import OutputTail, describe_exit
from fmugym.pool.spec import ResetMethod
from fmugym.trial.cache import recall, remember
from fmugym.trial.verdict import Grade, Neighbours, Verdict

__all__ = [
    "Candidate",
    "Request",
    "Stage",
    "examine",
    "known_verdict",
    "meet",
]

logger = logging.getLogger(__name__)

_WORKER = "fmugym.trial.worker"

_ALONE: Final = {"loading and instantiation", "initialization", "the first step", "closing"}
"""The stages of one instance; a worker that ends there only where memory is checked has shown that
the FMU writes where it must not."""


_MEMORY_ERROR: Final = re.compile(r"(free|malloc|realloc|calloc|memalign|munmap_chunk)\w*\(\)")
"""How glibc begins what it says of a memory error."""


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


class Stage(StrEnum):
    """What a worker does after an instance alone has survived."""

    REFERENCE = "the episode of a fresh instance"
    RESTORE = "the rehearsal of state restores"
    RESET = "the rehearsal of resets"
    INSTANCE = "the rehearsal of new instances"
    LIBRARY = "the rehearsal of libraries loaded anew"
    SECOND = "the comparison with a second instance"
    COPIES = "the comparison with a second copy of the library"
    THREADS = "the comparison with an instance in another thread"

    @classmethod
    def of(cls, method: ResetMethod) -> Stage:
        """The stage in which a reset method is tried."""
        return cls[method.name]


@dataclass(frozen=True)
class Request:
    """What the worker is asked.

    Attributes:
        candidate: The FMU.
        spec: The ``PoolSpec`` with which resets and several instances are tried, or None.
        starts: The ``Starts`` of two episodes, or None for the FMU's own start values.
        several: Whether to try several instances.
        alone: Whether it is known that instances must not share a copy of the library.
        skip: The stages that have ended a worker before.
        check_memory: Whether the C library looks for memory errors (glibc only).
    """

    candidate: Candidate
    spec: Any = None
    starts: Any = None
    several: bool = False
    alone: bool = False
    skip: frozenset[str] = frozenset()
    check_memory: bool = True


@dataclass(frozen=True)
class _Outcome:
    """How a trial ended.

    ``stage`` is what the worker was doing, None before it touched the FMU. ``answer`` has the key
    ``complete`` (whether the FMU went so far that it is known) if the process survived one
    instance, the fields of a verdict as far as the worker came, and ``finished``.
    """

    stage: str | None
    answer: dict[str, Any]
    end: str
    last_lines: list[str]

    @property
    def shows_memory_error(self) -> bool:
        """Whether the C library has ended the process, which may live on where it looks away."""
        return any(map(_MEMORY_ERROR.match, self.last_lines))

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
    if not candidate.exempt and known_verdict(fmu) is None:
        _examine(Request(candidate), must_survive=True)


def known_verdict(fmu: FMU) -> Verdict | None:
    """The verdict of the last trial of an FMU on this machine; None if there was none."""
    return Verdict.from_text(recall(_content_key(fmu.path)))


def examine(
    candidate: Candidate,
    spec: Any,
    starts: Any = None,
    *,
    several: bool = False,
    alone: bool = False,
    must_survive: bool = True,
) -> Verdict:
    """Find out in worker processes how an FMU has to be treated; ``meet`` included.

    Args:
        candidate: The FMU, exempt or not.
        spec: The ``PoolSpec`` to try it with.
        starts: The ``Starts`` of two episodes, or None.
        several: Whether to try several instances.
        alone: Whether it is known that instances must not share a copy of the library.
        must_survive: Whether it is an error if an instance alone ends the process; otherwise that
            asks for isolation.

    Returns:
        The verdict, from the cache where the same was asked before.

    Raises:
        FMULoadError: As ``meet``, with ``must_survive``.
    """
    key = f"{_content_key(candidate.path)}-{_digest(repr((spec, starts)).encode())}"
    known = Verdict.from_text(recall(key))
    if known is not None and (known.neighbours is not None or not several):
        return known
    found = _examine(Request(candidate, spec, starts, several, alone), must_survive)
    if found.complete:
        remember(key, found.to_text())
    return found


def _examine(request: Request, must_survive: bool) -> Verdict:
    """Ask workers until one has come to the end; each crash is a stage that the next one skips."""
    name, notes = request.candidate.path.name, _Notes()
    while True:
        outcome = _run(request)
        if outcome.stage is None:
            logger.warning("%s could not be tried before: it %s%s", name, outcome.end, outcome.said)
            return Verdict()
        notes.add(outcome)
        if "finished" in outcome.answer:
            break
        if "complete" not in outcome.answer:
            if not (request.check_memory and outcome.shows_memory_error):
                return notes.died_alone(name, must_survive)
            request = replace(request, check_memory=False)
        elif outcome.stage in request.skip:  # it dies where it is not asked anything
            break
        else:
            request = replace(request, skip=request.skip | {outcome.stage})
    verdict = notes.verdict
    if verdict.complete:
        remember(_content_key(request.candidate.path), verdict.to_text())
    return verdict


class _Notes:
    """What the workers of one trial have found."""

    def __init__(self) -> None:
        self._answer: dict[str, Any] = {}
        self._deaths: list[_Outcome] = []

    def add(self, outcome: _Outcome) -> None:
        """Take the answer of a worker, and its end if it did not finish."""
        self._answer |= outcome.answer
        if "finished" not in outcome.answer:
            self._deaths.append(outcome)

    @property
    def verdict(self) -> Verdict:
        """The verdict as far as it is known."""
        answer = self._answer
        neighbours = answer.get("neighbours")
        return Verdict(
            complete=bool(answer.get("complete")),
            deterministic=bool(answer.get("deterministic", True)),
            resets={ResetMethod(m): Grade(g) for m, g in answer.get("resets", {}).items()},
            neighbours=None if neighbours is None else Neighbours(neighbours),
            isolate=any(death.stage in _ALONE for death in self._deaths),
            reasons=tuple(f"in {d.stage} it {d.end}{d.said}" for d in self._deaths),
        )

    def died_alone(self, name: str, must_survive: bool) -> Verdict:
        """Say that not even one instance survives, or that it needs a process.

        Raises:
            FMULoadError: With ``must_survive``.
        """
        last = self._deaths[-1]
        if must_survive:
            raise FMULoadError(
                f"{name} cannot be used: in {last.stage} it {last.end}{last.said}. That was a "
                "trial in a process of its own; probe_timeout=None turns it off"
            )
        return replace(self.verdict, isolate=True, neighbours=Neighbours.PROCESSES)


def _run(request: Request) -> _Outcome:
    with tempfile.TemporaryDirectory(prefix="fmugym-probe-", ignore_cleanup_errors=True) as name:
        folder = Path(name)
        (folder / "request").write_bytes(pickle.dumps(request))
        try:
            end, last_lines = _watch(folder, request)
        except OSError as error:
            end, last_lines = f"found no Python to start: {error}", []
        return _Outcome(_stage(folder), _answer(folder), end, last_lines)


def _stage(folder: Path) -> str | None:
    try:
        return (folder / "stage").read_text()
    except OSError:
        return None


def _answer(folder: Path) -> dict[str, Any]:
    """What the worker has answered so far."""
    try:
        return dict(json.loads((folder / "answer").read_text()))
    except (OSError, ValueError, TypeError):
        return {}


def _watch(folder: Path, request: Request) -> tuple[str, list[str]]:
    """Run the worker; what the FMU writes to standard output is taken for its last words."""
    timeout = request.candidate.timeout or DEFAULT_PROBE_TIMEOUT
    process = subprocess.Popen(
        [sys.executable, "-P", "-m", _WORKER, folder],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        env=_environment(folder, request.check_memory),
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


def _environment(folder: Path, check_memory: bool) -> dict[str, str]:
    """What the FMU leaves behind goes with the folder; the worker finds the modules we found."""
    environment = {k: v for k, v in os.environ.items() if k != "PYTHONFAULTHANDLER"}
    environment |= dict.fromkeys(("TMPDIR", "TEMP", "TMP"), str(folder))
    checker = _memory_checker() if check_memory else None
    if checker is not None:
        loaded = environment.get("LD_PRELOAD", "")
        environment |= {"LD_PRELOAD": f"{checker} {loaded}".strip(), "MALLOC_CHECK_": "3"}
    return environment | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))}


@functools.cache
def _memory_checker() -> str | None:
    """The library with which glibc ends a process that has written beyond an allocated block."""
    try:
        maps = Path("/proc/self/maps").read_text()
    except OSError:
        return None
    found = re.search(r"(/\S*)/libc\.so\.6$", maps, re.MULTILINE)
    checker = Path(found[1]) / "libc_malloc_debug.so.0" if found else None
    return str(checker) if checker is not None and checker.exists() else None


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
