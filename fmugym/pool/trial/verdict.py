"""Verdict: the result of the first trial of an FMU, as a value, and as text for the cache.

Results of earlier trials are kept in the cache folder under the identity of the FMU. If the folder
cannot be read or written, nothing is kept, and no error is raised.
"""

from __future__ import annotations

import functools
import hashlib
import json
import logging
import os
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from enum import StrEnum
from importlib.metadata import PackageNotFoundError, version
from typing import Any, Final, NamedTuple

import fmpy

from fmugym.checks import check_option
from fmugym.files import cache_folder, read_file, replace_file
from fmugym.fmi.fmu import FMU
from fmugym.fmi.systems.system_plan import SystemPlan
from fmugym.pool.pool_spec import PoolSpec, ResetMethod
from fmugym.pool.states import SaveMethod

__all__ = [
    "MOST_INSTANCES",
    "Finding",
    "Grade",
    "Neighbours",
    "Verdict",
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

_FORMAT: Final = 8

MOST_INSTANCES: Final = 4
"""The most instances that a trial has at once."""


class Grade(StrEnum):
    """Grade of the match of an episode after a reset with the same of a fresh instance."""

    BITWISE = "bitwise"
    """All outputs are bit-identical."""
    TOLERANCE = "tolerance"
    """The outputs differ by no more than a solver's tolerance."""
    WRONG = "wrong"
    """The outputs differ, or an episode ends too early."""
    FAILS = "fails"
    """The FMU returned an error or crashed its process."""


class Finding(NamedTuple):
    """The answer of a step of the trial.

    Attributes:
        grade: How well the FMU keeps its promise.
        text: Where it does not; empty if it does.
    """

    grade: Grade
    text: str

    @property
    def is_kept(self) -> bool:
        """Whether it keeps it to the last bit."""
        return self.grade is Grade.BITWISE


class Neighbours(StrEnum):
    """Isolation that several instances need in order not to disturb each other."""

    INDEPENDENT = "independent"
    ONE_INITIALIZATION = "one initialization at a time"
    """Instances may step at the same time, but not be initialized."""
    ONE_THREAD = "one thread"
    """Instances give correct results in turn, but not at the same time."""
    LIBRARIES = "libraries"
    """Each instance needs a copy of the shared library."""
    PROCESSES = "processes"
    """Each instance needs a process."""


@dataclass(frozen=True)
class Verdict:
    """The result of a trial.

    Attributes:
        complete: Whether an instance could be made, initialized and stepped.
        noisy: The names of the outputs that two fresh instances give differently.
        resets: The grade of each reset method that was tried.
        components: How each component of a system begins an episode; empty if all do alike.
        neighbours: What several instances need; None if only one was tried.
        harm: How a lone instance has harmed its process; empty if it has not.
        blind_start: Whether the FMU cannot be read before its first step.
        unreadable: The names of outputs that could not be read at all.
        instances: How many instances the trial used at once, each of which may take a licence.
        initializations: How many initializations the trial took, which may be slow.
        length: The most steps of an episode for which it holds; None if for any.
        unlimited: Whether it holds for tasks whose episodes nothing limits.
        findings: A sentence for each finding, for the log and ``fmugym info``.
    """

    complete: bool = False
    noisy: tuple[str, ...] = ()
    resets: Mapping[ResetMethod, Grade] = field(default_factory=dict)
    components: tuple[ResetMethod, ...] = ()
    neighbours: Neighbours | None = None
    harm: str = ""
    blind_start: bool = False
    unreadable: tuple[str, ...] = ()
    instances: int = 1
    initializations: int = 0
    length: int | None = None
    unlimited: bool = True
    findings: tuple[str, ...] = ()

    @property
    def isolate(self) -> bool:
        """Whether a lone instance has harmed its process."""
        return bool(self.harm)

    def covers(self, length: int | None, num_instances: int) -> bool:
        """Whether it tells all of a task.

        Args:
            length: The most steps of an episode; None if nothing limits them.
            num_instances: How many instances there are.
        """
        is_longer = not self.unlimited if length is None else length > (self.length or length)
        if is_longer:
            return False
        if num_instances == 1:
            return True
        tried = self.instances >= min(num_instances, MOST_INSTANCES)
        return self.neighbours is not None and (tried or self.neighbours is Neighbours.PROCESSES)

    def finding(self, *sentences: str) -> Verdict:
        """The verdict with more findings, each of them once; empty ones are left out."""
        told = dict.fromkeys((*self.findings, *filter(None, sentences)))
        return replace(self, findings=tuple(told))

    @property
    def deterministic(self) -> bool:
        """Whether two fresh instances give the same outputs."""
        return not self.noisy

    @property
    def reset_method(self) -> ResetMethod:
        """The first method with the best grade; the FMU's reset function if nothing was tried."""
        for wanted in (Grade.BITWISE, Grade.TOLERANCE):
            for method in ResetMethod:
                if self.resets.get(method) is wanted:
                    return method
        return ResetMethod.PROCESS if self.resets else ResetMethod.RESET

    def steady(self, spec: PoolSpec) -> PoolSpec:
        """Leave out the outputs that tell nothing about other instances, unless all are such."""
        kept = tuple(variable for variable in spec.outputs if variable.name not in self.noisy)
        return replace(spec, outputs=kept) if kept else spec

    def components_of(self, plan: SystemPlan | None) -> dict[str, str]:
        """The methods of a system's components by their names; empty if all begin alike."""
        if plan is None or not self.components:
            return {}
        pairs = zip(plan.components, self.components, strict=True)
        return {component.name: str(method) for component, method in pairs}

    def to_text(self) -> str:
        """Write the verdict as JSON."""
        return json.dumps({"format": _FORMAT} | asdict(self))

    @classmethod
    def from_text(cls, text: str | None) -> Verdict | None:
        """Read a verdict; return None for any text that ``to_text`` would not write."""
        try:
            data = json.loads(text or "")
            neighbours = data["neighbours"]
            verdict = cls(
                complete=bool(data["complete"]),
                noisy=tuple(map(str, data["noisy"])),
                resets={ResetMethod(m): Grade(g) for m, g in data["resets"].items()},
                components=tuple(map(ResetMethod, data["components"])),
                neighbours=None if neighbours is None else Neighbours(neighbours),
                harm=str(data["harm"]),
                blind_start=bool(data["blind_start"]),
                unreadable=tuple(map(str, data["unreadable"])),
                instances=int(data["instances"]),
                initializations=int(data["initializations"]),
                length=None if data["length"] is None else int(data["length"]),
                unlimited=bool(data["unlimited"]),
                findings=tuple(map(str, data["findings"])),
            )
        except (ValueError, TypeError, KeyError, AttributeError, RecursionError):
            return None
        return verdict if verdict.to_text() == text else None


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
    """Folder of the states of an FMU; see ``fmugym.pool.states``."""
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
