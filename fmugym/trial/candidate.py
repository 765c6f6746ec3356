"""An FMU that may have to be tried, and what it is known by in the cache."""

from __future__ import annotations

import functools
import hashlib
import os
from dataclasses import dataclass, replace
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, Final

import fmpy

from fmugym.archive.bundled import is_bundled
from fmugym.archive.fmu import FMU
from fmugym.archive.safe_zip import ArchiveLimits
from fmugym.errors import unknown_name
from fmugym.systems.fmu import SystemFMU
from fmugym.systems.plan import SystemPlan

__all__ = ["Candidate", "content_key", "content_of", "verdict_key"]

_ON: Final = ("on", "1", "yes", "true")
_OFF: Final = ("off", "0", "no", "false")
"""The values of ``FMUGYM_PROBE``; an empty one is none."""


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


def verdict_key(candidate: Candidate, spec: Any, starts: Any) -> str:
    """The scope of a verdict on resets and neighbours."""
    tried = replace(
        spec,
        max_instances=None,
        licence_wait=0.0,
    )
    asked = _digest(repr((tried, starts, candidate.preload)).encode())
    return f"{content_key(candidate)}-{asked}"


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


def content_key(candidate: Candidate) -> str:
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
