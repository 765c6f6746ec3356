"""The first trial of an FMU, in a process that it may crash.

An FMU is native code: a fault in it ends the process that loads it. So a worker process
(``fmugym.trial.worker``) loads, instantiates, initializes and steps an unknown FMU once before this
process touches it. Success is cached by the file's content. Failures are not cached: a missing
licence may return.

A process protects from accidents but not from malice: the worker has all the rights of its user.
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
import time
from dataclasses import dataclass, replace
from enum import StrEnum
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, BinaryIO, Final, cast

import fmpy

from fmugym.archive.bundled import is_bundled
from fmugym.archive.fmu import DEFAULT_PROBE_TIMEOUT, FMU
from fmugym.archive.safe_zip import ArchiveLimits
from fmugym.errors import ConfigError, FMULoadError, LicenceError, unknown_name
from fmugym.fmi.words import as_messages, quoted
from fmugym.pool.bundle import SaveMethod
from fmugym.pool.patience import speaks_of_licence
from fmugym.pool.process.last_words import OutputTail, describe_exit
from fmugym.pool.progress import INITIALIZATION
from fmugym.pool.seats import Seats, taking
from fmugym.pool.spec import INITIALIZATION_FACTOR, ResetMethod
from fmugym.systems.fmu import SystemFMU
from fmugym.systems.plan import SystemPlan
from fmugym.trial.cache import cache_folder, recall, remember
from fmugym.trial.verdict import Grade, Neighbours, Verdict

__all__ = [
    "FRUGAL",
    "Candidate",
    "Outcome",
    "Request",
    "Stage",
    "content_of",
    "examine",
    "is_known_to_harm",
    "known_resuming",
    "known_verdict",
    "locks_of",
    "marks_of",
    "meet",
    "note_harm",
    "note_resuming",
    "revise",
    "run",
]

logger = logging.getLogger(__name__)

_WORKER = "fmugym.trial.worker"

_ALONE: Final = {"loading and instantiation", "initialization", "the first step", "closing"}
"""The stages of a single instance. If a worker ends there only when memory is checked, the FMU
writes to memory that it must not touch."""


_ON: Final = ("on", "1", "yes", "true")
_OFF: Final = ("off", "0", "no", "false")
"""The values of ``FMUGYM_PROBE``; an empty one is none."""

_LOOK: Final = 0.1
"""Seconds between two looks at a worker."""

_EVERY: Final = 10.0
"""Seconds between two messages about a worker that takes long."""

FRUGAL: Final = (
    "its initializations are slow or need licences, so no episode returned to earlier start values"
)
"""What a trial leaves out to need fewer initializations."""

_MEMORY_ERROR: Final = re.compile(r"(free|malloc|realloc|calloc|memalign|munmap_chunk)\w*\(\)")
"""How glibc begins its messages about memory errors."""


@dataclass(frozen=True)
class Candidate:
    """An FMU that may have to be tried; the attributes are those of ``fmugym.FMU``."""

    path: Path
    limits: ArchiveLimits
    preload: tuple[str, ...]
    timeout: float | None
    interface: str = "co_simulation"
    plan: SystemPlan | None = None
    sizes: tuple[tuple[str, int], ...] = ()

    @classmethod
    def of(cls, fmu: FMU) -> Candidate:
        """Make a candidate from an open FMU."""
        sizes = tuple(fmu.sizes.items())
        interface, plan = fmu.description.interface, getattr(fmu, "plan", None)
        return cls(fmu.path, fmu.limits, fmu.preload, fmu.probe_timeout, interface, plan, sizes)

    def open(self) -> FMU:
        """Open the FMU without another trial."""
        if self.plan is not None:
            return SystemFMU(self.plan, probe_timeout=None)
        return FMU(
            self.path,
            limits=self.limits,
            preload=self.preload,
            probe_timeout=None,
            interface=self.interface,
            sizes=dict(self.sizes),
        )

    @property
    def exempt(self) -> bool:
        """Whether to skip the trial: trials are turned off, or this package bundles the FMU.

        Raises:
            ConfigError: If the environment variable ``FMUGYM_PROBE`` has an unknown value.
        """
        files = [self.path] if self.plan is None else [c.path for c in self.plan.components]
        return _trials_are_off() or self.timeout is None or all(map(is_bundled, files))


def _trials_are_off() -> bool:
    given = os.environ.get("FMUGYM_PROBE", "").strip().lower()
    if given not in (*_ON, *_OFF, ""):
        known = (*_ON, *_OFF)
        raise unknown_name("value of the environment variable FMUGYM_PROBE", given, known)
    return given in _OFF


class Stage(StrEnum):
    """What a worker does after a lone instance has survived."""

    REFERENCE = "the episode of a fresh instance"
    RESTORE = "the rehearsal of state restores"
    RESET = "the rehearsal of resets"
    INSTANCE = "the rehearsal of new instances"
    LIBRARY = "the rehearsal of libraries loaded anew"
    STATE = "the serialization of an initial state"
    RESUMED = "the rehearsal of an initial state from another process"
    HALFWAY = "the rehearsal of a state in the middle of an episode"
    SECOND = "the comparison with a second instance"
    COPIES = "the comparison with a second copy of the library"
    THREADS = "the comparison with an instance in another thread"
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
        sample: The ``Sample`` of an initial state that another worker has made, if this one has to
            try only that.
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
    sample: Any = None
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


def meet(fmu: FMU) -> None:
    """Make sure that a process has loaded and stepped an FMU and survived.

    Every function that loads an FMU into this process calls this first.

    Args:
        fmu: The FMU; this does not extract it.

    Raises:
        FMULoadError: If the process did not survive. The text has the reason and the last lines.
        LicenceError: If the FMU got no licence.
    """
    candidate = Candidate.of(fmu)
    if not candidate.exempt and known_verdict(fmu) is None:
        _examine(Request(candidate), must_survive=True)


def known_verdict(fmu: FMU) -> Verdict | None:
    """The verdict of the last trial of an FMU on this machine; None if there was none."""
    return Verdict.from_text(recall(_content_key(Candidate.of(fmu))))


def state_files(fmu: FMU) -> str:
    """Where the initial states of an FMU are kept; see ``fmugym.pool.states``."""
    try:
        return str(cache_folder() / "states" / _content_key(Candidate.of(fmu)))
    except RuntimeError:  # there is no folder for caches
        return ""


def marks_of(candidate: Candidate) -> tuple[Path, str]:
    """The folder and the key of an FMU's marks; see ``fmugym.pool.mark``.

    Raises:
        RuntimeError: If there is no folder for caches.
    """
    return cache_folder() / "marks", _content_key(candidate)


def locks_of(candidate: Candidate) -> str:
    """The place of the files by which environments of an FMU keep to the limits of a licence.

    They are in the cache folder, or in the user's own one for temporary files.

    Returns:
        The beginning of their paths.

    Raises:
        ConfigError: If there is no folder for them.
    """
    name = f"fmugym-{getattr(os, 'getuid', int)()}"
    try:
        folder = cache_folder() / "licences"
        folder.mkdir(parents=True, exist_ok=True)
    except (OSError, RuntimeError):
        folder = Path(tempfile.gettempdir()) / name / "licences"
    try:
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)
    except OSError as error:
        raise ConfigError(f"the limits of a licence need the folder {folder}: {error}") from None
    return str(folder / content_of(candidate))


def examine(
    candidate: Candidate,
    spec: Any,
    starts: Any = None,
    *,
    several: bool = False,
    alone: bool = False,
    must_survive: bool = True,
) -> Verdict:
    """Find out in worker processes how to treat an FMU; includes ``meet``.

    Args:
        candidate: The FMU, exempt or not.
        spec: The ``PoolSpec`` to try it with.
        starts: The ``Starts`` of two episodes, or None.
        several: Whether to try several instances.
        alone: Whether it is known that instances must not share a copy of the library.
        must_survive: Whether it is an error if a lone instance ends the process. If not, the
            verdict asks for isolation.

    Returns:
        The verdict, from the cache if the same request was made before.

    Raises:
        FMULoadError: As ``meet``, if ``must_survive``.
        LicenceError: If an instance got no licence.
    """
    key = _verdict_key(candidate, spec, starts)
    known = Verdict.from_text(recall(key))
    if known is not None and _answers(known, spec, several):
        return _with_harm(known, candidate)
    request = Request(candidate, spec, starts, several, alone)
    if known is not None and known.complete and _answers(known, spec, several=False):
        request = replace(request, known=known, check_memory=not known.isolate)
    with taking(Seats.of(candidate.path.name, spec), 2 if several else 1, "a trial"):
        found = _examine(request, must_survive)
    if found.complete:
        remember(key, found.to_text())
    return found


def _answers(verdict: Verdict, spec: Any, several: bool) -> bool:
    """Whether a verdict tells all that is asked."""
    knows_states = verdict.states is not None or not spec.keep_states
    return knows_states and (verdict.neighbours is not None or not several)


def is_known_to_harm(candidate: Candidate) -> bool:
    """Whether the cache says that an FMU harms its process."""
    known = Verdict.from_text(recall(_content_key(candidate)))
    return known is not None and known.isolate


def _with_harm(verdict: Verdict, candidate: Candidate) -> Verdict:
    """Add the harm to its process that the FMU has done with any other config."""
    known = Verdict.from_text(recall(_content_key(candidate)))
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
    return f"{_verdict_key(candidate, spec, starts)}-resuming"


def revise(candidate: Candidate, spec: Any, starts: Any, verdict: Verdict) -> None:
    """Replace the verdict that ``examine`` has cached for the same arguments.

    An FMU that is found to harm its process counts as harmful with every other config, too.
    """
    verdict = _with_harm(verdict, candidate)
    for key in (
        _verdict_key(candidate, spec, starts),
        _content_key(candidate),
    ):
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
    known = Verdict.from_text(recall(_verdict_key(candidate, spec, starts))) or verdict
    if known.isolate:
        return known
    harmful = replace(known, isolate=True, reasons=(*known.reasons, reason))
    revise(candidate, spec, starts, harmful)
    return harmful


def _examine(request: Request, must_survive: bool) -> Verdict:
    """Start workers until one finishes. Each skips the stages in which earlier ones crashed."""
    name, notes = request.candidate.path.name, _Notes()
    while True:
        outcome = run(request)
        if outcome.stage is None:
            logger.warning("%s could not be tried before: it %s%s", name, outcome.end, outcome.said)
            return Verdict()
        notes.add(outcome)
        notes.require_licence(name, outcome)
        if "finished" in outcome.answer:
            break
        if "complete" not in outcome.answer:
            if not (request.check_memory and outcome.shows_memory_error):
                return notes.died_alone(name, must_survive)
            request = replace(request, check_memory=False)
        elif outcome.stage in request.skip:  # it dies outside the requested stages
            break
        else:
            request = replace(request, skip=request.skip | {outcome.stage})
    verdict = notes.verdict
    if request.known is not None:
        verdict = _completed(request.known, verdict)
    elif request.spec is not None and request.spec.keep_states and verdict.complete:
        verdict = replace(verdict, states=_grade_of_states(request, notes.sample, verdict))
    verdict = _with_harm(verdict, request.candidate)
    logger.info(
        "%s was tried with %d instance(s) at once at most, and %d initialization(s) in all",
        *(name, verdict.instances, verdict.initializations),
    )
    if verdict.complete:
        remember(_content_key(request.candidate), verdict.to_text())
    return verdict


def _completed(known: Verdict, found: Verdict) -> Verdict:
    """Add to a verdict what several instances need."""
    return replace(
        known,
        neighbours=found.neighbours,
        instances=found.instances,
        initializations=known.initializations + found.initializations,
        reasons=tuple(dict.fromkeys((*known.reasons, *found.reasons))),
    )


def _grade_of_states(request: Request, sample: bytes | None, verdict: Verdict) -> Grade:
    """Let a second process begin with an initial state of the first one."""
    if verdict.resets.get(ResetMethod.RESTORE) is not Grade.BITWISE:
        return Grade.ABSENT
    if sample is None:
        return Grade.FAILS
    spec = replace(request.spec, blind_start=verdict.blind_start)
    outcome = run(replace(request, spec=spec, sample=pickle.loads(sample)))
    _Notes().require_licence(request.candidate.path.name, outcome)
    return Grade(outcome.answer.get("states", Grade.FAILS))


class _Notes:
    """The findings of the workers of one trial."""

    def __init__(self) -> None:
        self._answer: dict[str, Any] = {}
        self._deaths: list[Outcome] = []
        self._initializations = 0
        self.sample: bytes | None = None

    def add(self, outcome: Outcome) -> None:
        """Record the answer of a worker, and how it ended if it did not finish."""
        self._answer |= outcome.answer
        self._initializations += int(outcome.answer.get("initializations", 0))
        self.sample = outcome.sample or self.sample
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
            components=tuple(map(ResetMethod, answer.get("components", ()))),
            neighbours=None if neighbours is None else Neighbours(neighbours),
            instances=int(answer.get("instances", 1)),
            initializations=self._initializations,
            blind_start=bool(answer.get("blind_start")),
            unreadable=tuple(answer.get("unreadable", ())),
            isolate=any(death.stage in _ALONE for death in self._deaths),
            reasons=(FRUGAL,) * bool(answer.get("frugal"))
            + tuple(f"in {d.stage} it {d.end}{d.said}" for d in self._deaths),
        )

    def require_licence(self, name: str, outcome: Outcome) -> None:
        """Give up if an instance got no licence: this tells nothing about the FMU itself.

        Raises:
            LicenceError: With the FMU's words.
        """
        answer, said = outcome.answer, outcome.said
        words = answer.get("refused", "")
        if "finished" not in answer and "complete" in answer and speaks_of_licence(said):
            words = f"it {outcome.end}{said}"
        if words:
            raise LicenceError(
                f"{name} got no licence in its trial, which used {answer['instances']} "
                f"instance(s) at once: {words}"
            )

    def died_alone(self, name: str, must_survive: bool) -> Verdict:
        """Report that even a lone instance dies, or that it needs a separate process.

        Raises:
            FMULoadError: If ``must_survive``.
            LicenceError: If it also speaks of a licence.
        """
        last = self._deaths[-1]
        if must_survive:
            text = (
                f"{name} cannot be used: in {last.stage} it {last.end}{last.said}. That was a "
                "trial in a process of its own; probe_timeout=None turns it off"
            )
            raise LicenceError(text) if speaks_of_licence(last.said) else FMULoadError(text)
        return replace(self.verdict, isolate=True, neighbours=Neighbours.PROCESSES)


def run(request: Request) -> Outcome:
    """Let a worker try what is requested; returns how that ended."""
    with tempfile.TemporaryDirectory(prefix="fmugym-probe-", ignore_cleanup_errors=True) as name:
        folder = Path(name)
        (folder / "request").write_bytes(pickle.dumps(request))
        try:
            end, last_lines = _watch(folder, request)
        except OSError as error:
            end, last_lines = f"found no Python to start: {error}", []
        return Outcome(_stage(folder), _answer(folder), end, last_lines, _sample(folder))


def _stage(folder: Path) -> str | None:
    try:
        return (folder / "stage").read_text()
    except OSError:
        return None


def _sample(folder: Path) -> bytes | None:
    try:
        return (folder / "sample").read_bytes()
    except OSError:
        return None


def _answer(folder: Path) -> dict[str, Any]:
    """Read the worker's answer so far."""
    try:
        return dict(json.loads((folder / "answer").read_text()))
    except (OSError, ValueError, TypeError):
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
        with contextlib.suppress(OSError):
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
    except OSError:
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


# Keys of the cache


def _verdict_key(candidate: Candidate, spec: Any, starts: Any) -> str:
    """The scope of a verdict on resets and neighbours."""
    tried = replace(
        spec,
        initialization_interval=0.0,
        max_instances=None,
        locks="",
        licence_wait=0.0,
        keep_states=False,
    )
    asked = _digest(repr((tried, starts, candidate.preload)).encode())
    return f"{_content_key(candidate)}-{asked}"


def content_of(candidate: Candidate) -> str:
    """The SHA-256 of a file, or that of a system: of its plan and its files."""
    plan = candidate.plan
    if plan is None:
        return _content_of_file(candidate.path)
    names = tuple(replace(part, path=Path(part.path.name)) for part in plan.components)
    texts = [repr(replace(plan, components=names, file=None))]
    texts += [_content_of_file(part.path) for part in plan.components]
    return hashlib.sha256("\n".join(texts).encode()).hexdigest()


def _content_of_file(path: Path) -> str:
    """The SHA-256 of a file; it is read again only when it has changed."""
    status = path.stat()
    return _file_digest(path, status.st_mtime_ns, status.st_size, status.st_ino)


def _content_key(candidate: Candidate) -> str:
    """The scope of a verdict: content, interface, sizes, platform, and version of the package."""
    scope = f"{content_of(candidate)} {fmpy.platform_tuple} {_version()}"
    if candidate.interface != "co_simulation":
        scope += f" {candidate.interface}"
    if candidate.sizes:
        scope += f" {sorted(candidate.sizes)}"
    return _digest(scope.encode())


@functools.lru_cache(maxsize=256)
def _file_digest(path: Path, *_: int) -> str:
    """Hash a file; read it again only when its modification time, size or inode changes."""
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
