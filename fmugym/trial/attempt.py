"""A worker process in which an FMU is tried: what it is asked, and how that ended."""

from __future__ import annotations

import contextlib
import functools
import json
import logging
import os
import pickle
import re
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Any, BinaryIO, Final, cast

from fmugym.archive.fmu import DEFAULT_PROBE_TIMEOUT
from fmugym.fmi.words import as_messages, quoted
from fmugym.pool.process.last_words import OutputTail, describe_exit, lines_of_echo
from fmugym.pool.progress import INITIALIZATION
from fmugym.pool.spec import INITIALIZATION_FACTOR, ResetMethod
from fmugym.signals import Ignoring, ordinary
from fmugym.trial.candidate import Candidate

__all__ = ["ECHO", "Outcome", "Request", "Stage", "patience", "run"]

logger = logging.getLogger(__name__)

_WORKER = "fmugym.trial.worker"
ECHO: Final = "echo"
"""The file of a worker's folder that has the last messages of its FMU."""

_LOOK: Final = 0.1
"""Seconds between two looks at a worker."""

_EVERY: Final = 10.0
"""Seconds between two messages about a worker that takes long."""

_MEMORY_ERROR: Final = re.compile(r"(free|malloc|realloc|calloc|memalign|munmap_chunk)\w*\(\)")
"""How glibc begins its messages about memory errors."""


class Stage(StrEnum):
    """What a worker does after a lone instance has survived."""

    REFERENCE = "the episode of a fresh instance"
    RESTORE = "the rehearsal of state restores"
    RESET = "the rehearsal of resets"
    INSTANCE = "the rehearsal of new instances"
    LIBRARY = "the rehearsal of libraries loaded anew"
    HALFWAY = "the rehearsal of a state in the middle of an episode"
    SECOND = "the comparison with a second instance"
    COPIES = "the comparison with a second copy of the library"
    SHARED_DATA = "the search for data that steps share"
    THREADS = "the comparison with an instance in another thread"
    THREADS_OF_COPIES = "the comparison with a copy of the library in another thread"
    TURNS = "the comparison with an instance in another thread, initialized in turn"

    @classmethod
    def of(cls, method: ResetMethod) -> Stage:
        """The stage in which a reset method is tried."""
        return cls[method.name]


@dataclass(frozen=True)
class Request:
    """The request to a worker.

    Attributes:
        candidate: The FMU.
        spec: The ``PoolSpec`` with which resets and several instances are tried, or None.
        starts: The ``Starts`` of two episodes, or None for the FMU's own start values.
        several: Whether to try several instances.
        alone: Whether it is known that instances must not share a copy of the library.
        known: The ``Verdict`` of an earlier trial if it lacks only what several instances need.
        skip: The stages in which an earlier worker died.
        resume: Whether to try a state in the middle of an episode; or a ``Halfway`` that another
            worker has made.
        check_memory: Whether the C library checks for memory errors (glibc only).
    """

    candidate: Candidate
    spec: Any = None
    starts: Any = None
    several: bool = False
    alone: bool = False
    skip: frozenset[str] = frozenset()
    known: Any = None
    resume: Any = None
    check_memory: bool = True


@dataclass(frozen=True)
class Outcome:
    """How a trial ended.

    ``stage`` is what the worker was doing; None before it touched the FMU. If the process survived
    one instance, ``answer`` has the key ``complete``, which tells whether the FMU went far enough
    to be known. ``answer`` also has the fields of a verdict that the worker reached, and
    ``finished``.
    """

    stage: str | None
    answer: dict[str, Any]
    end: str
    last_lines: list[str]
    sample: bytes | None = None

    @property
    def shows_memory_error(self) -> bool:
        """Whether the C library ended the process, which might have lived on without the checks."""
        return any(map(_MEMORY_ERROR.match, self.last_lines))

    @property
    def said(self) -> str:
        """The telling ones of the last lines of output, to end an error's text."""
        return quoted(as_messages(self.last_lines), "its last lines")


def run(request: Request) -> Outcome:
    """Let a worker try what is requested; returns how that ended."""
    with tempfile.TemporaryDirectory(prefix="fmugym-probe-", ignore_cleanup_errors=True) as name:
        folder = Path(name)
        (folder / "request").write_bytes(pickle.dumps(request))
        try:
            end, last_lines = _watch(folder, request)
        except ordinary(OSError) as error:
            end, last_lines = f"found no Python to start: {error}", []
        last_lines = _echoed(folder) + last_lines
        return Outcome(_stage(folder), _answer(folder), end, last_lines, _sample(folder))


def _stage(folder: Path) -> str | None:
    try:
        return (folder / "stage").read_text()
    except ordinary(OSError):
        return None


def _echoed(folder: Path) -> list[str]:
    try:
        return lines_of_echo((folder / ECHO).read_bytes())
    except ordinary(OSError):
        return []


def _sample(folder: Path) -> bytes | None:
    try:
        return (folder / "sample").read_bytes()
    except ordinary(OSError):
        return None


def _answer(folder: Path) -> dict[str, Any]:
    """Read the worker's answer so far."""
    try:
        return dict(json.loads((folder / "answer").read_text()))
    except ordinary(OSError, ValueError, TypeError):
        return {}


def _watch(folder: Path, request: Request) -> tuple[str, list[str]]:
    """Run the worker; the FMU's standard output counts among its last lines."""
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
        end = _wait(process, _Watch(folder, request.candidate.path.name, timeout))
    finally:
        _end(process)
    return end, tail.lines()


def patience(call: str, timeout: float) -> float:
    """How many seconds a call may take in a trial: an initialization may take ten times as long."""
    return timeout * INITIALIZATION_FACTOR if call == INITIALIZATION else timeout


class _Watch:
    """Looks at what a worker does, and for how long.

    Args:
        folder: Where it writes down its stage and the call it makes.
        name: The FMU.
        timeout: Seconds that a call may take.
    """

    def __init__(self, folder: Path, name: str, timeout: float) -> None:
        self._file, self._folder = folder / "call", folder
        self._name, self._timeout = name, timeout
        self._change = 0
        self._call = INITIALIZATION
        self._begin = self._told = time.monotonic()

    def look(self) -> str:
        """Look at the worker, and log every ten seconds what takes so long.

        Returns:
            How it ended, if a call has taken too long; otherwise "".
        """
        self._notice_call()
        seconds = time.monotonic() - self._begin
        if time.monotonic() - self._told >= _EVERY:
            self._told = time.monotonic()
            stage = _stage(self._folder) or "its start"
            doing = f"{stage}; {self._call}"
            logger.info("%s: the trial is in %s has taken %.0f s", self._name, doing, seconds)
        limit = patience(self._call, self._timeout)
        if seconds < limit:
            return ""
        if limit == self._timeout:
            return f"did not come back within {limit:g} s (probe_timeout)"
        return f"did not come back from {self._call} within {limit:g} s (ten times probe_timeout)"

    def _notice_call(self) -> None:
        with Ignoring(OSError):
            change = self._file.stat().st_mtime_ns
            if change != self._change:
                self._change, self._begin = change, time.monotonic()
                self._call = self._file.read_text() or self._call


def _wait(process: subprocess.Popen[bytes], watch: _Watch) -> str:
    """Wait for the end of a worker; return how it ended."""
    while True:
        try:
            return f"ended the process with {describe_exit(process.wait(_LOOK))}"
        except subprocess.TimeoutExpired:
            late = watch.look()
            if late:
                return late


def _environment(folder: Path, check_memory: bool) -> dict[str, str]:
    """Keep the FMU's temporary files in the folder, and let the worker find the same modules."""
    environment = {k: v for k, v in os.environ.items() if k != "PYTHONFAULTHANDLER"}
    environment |= dict.fromkeys(("TMPDIR", "TEMP", "TMP"), str(folder))
    checker = _memory_checker() if check_memory else None
    if checker is not None:
        loaded = environment.get("LD_PRELOAD", "")
        environment |= {"LD_PRELOAD": f"{checker} {loaded}".strip(), "MALLOC_CHECK_": "3"}
    return environment | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))}


@functools.cache
def _memory_checker() -> str | None:
    """The library that lets glibc end a process that wrote beyond an allocated block."""
    try:
        maps = Path("/proc/self/maps").read_text()
    except ordinary(OSError):
        return None
    found = re.search(r"(/\S*)/libc\.so\.6$", maps, re.MULTILINE)
    checker = Path(found[1]) / "libc_malloc_debug.so.0" if found else None
    return str(checker) if checker is not None and checker.exists() else None


def _end(process: subprocess.Popen[bytes]) -> None:
    """End the worker and, on Unix, the processes that the FMU has started."""
    if sys.platform == "win32":
        process.kill()
    else:
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(process.pid, signal.SIGKILL)
    process.wait()
