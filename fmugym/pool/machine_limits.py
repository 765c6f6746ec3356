"""Processors and memory that this process may use, in a container too."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Iterator
from pathlib import Path, PurePosixPath
from typing import Final

__all__ = ["available_memory", "available_processors", "processor_quota", "used_memory"]

_ROOT: Final = Path("/")
"""The folder with ``proc`` and ``sys``."""

_MEMORY_V1: Final = ("memory.limit_in_bytes", "memory.usage_in_bytes")
_MEMORY_V2: Final = ("memory.max", "memory.current")

_PLACE_OF_SIZE: Final = 21
"""That of the resident pages among the fields behind the name in ``/proc/N/stat``."""


def available_processors() -> int:
    """The number of processors that this process may use.

    Counts the processors it may run on, and no more than the CPU quota of its container is worth,
    rounded up.
    """
    if hasattr(os, "sched_getaffinity"):
        processors = len(os.sched_getaffinity(0))
    else:
        processors = os.cpu_count() or 1
    return max(1, math.ceil(min(processors, processor_quota())))


def processor_quota() -> float:
    """The processors that the control groups of this process allow; inf if there is no limit.

    The limits of all groups count that contain the process, for cgroup v1 and v2. Groups that
    cannot be read count as groups without a limit.
    """
    quotas = [math.inf]
    for controllers, group in _groups("cpu"):
        quota = _quota_v1 if controllers else _quota_v2
        quotas.extend(map(quota, _folders(controllers, group)))
    return min(quotas)


def available_memory() -> float:
    """The bytes that this process may still take; inf where nothing tells that."""
    free = re.search(r"^MemAvailable: *(\d+) kB$", _read(_ROOT / "proc/meminfo"), re.MULTILINE)
    left = [1024.0 * int(free[1]) if free else math.inf]
    for controllers, group in _groups("memory"):
        names = _MEMORY_V1 if controllers else _MEMORY_V2
        for folder in _folders(controllers, group):
            limit, used = (_read(folder / name) for name in names)
            if limit.isdigit() and used.isdigit():
                left.append(max(0.0, float(limit) - float(used)))
    return min(left)


def used_memory() -> float:
    """The bytes that this process and those that it has started have in memory; 0 if unknown."""
    parents, sizes = dict[int, int](), dict[int, int]()
    for file in (_ROOT / "proc").glob("[0-9]*/stat"):
        fields = _read(file).rpartition(")")[2].split()
        if len(fields) > _PLACE_OF_SIZE:  # it has not ended
            own = int(file.parent.name)
            parents[own], sizes[own] = int(fields[1]), int(fields[_PLACE_OF_SIZE])
    family = {os.getpid()}
    while more := {own for own, parent in parents.items() if parent in family} - family:
        family |= more
    pages = sum(sizes.get(one, 0) for one in family)
    return float(pages * os.sysconf("SC_PAGE_SIZE")) if pages else 0.0


def _groups(controller: str) -> Iterator[tuple[str, PurePosixPath]]:
    """The controllers (empty in cgroup v2) and the path of each group that may limit something."""
    for line in _read(_ROOT / "proc/self/cgroup").splitlines():
        _, _, rest = line.partition(":")
        controllers, _, path = rest.partition(":")
        if not controllers or controller in controllers.split(","):
            yield controllers, PurePosixPath(path)


def _folders(controllers: str, group: PurePosixPath) -> Iterator[Path]:
    """The folders of a group and of those around it.

    In a container only the last one, the folder of all groups, may be there.
    """
    top = _ROOT / "sys/fs/cgroup" / controllers
    parts = [part for part in group.parts if part not in ("/", "..")]
    for count in range(len(parts), -1, -1):
        yield top.joinpath(*parts[:count])


def _quota_v2(folder: Path) -> float:
    quota, _, period = _read(folder / "cpu.max").partition(" ")
    return _ratio(quota, period)


def _quota_v1(folder: Path) -> float:
    return _ratio(_read(folder / "cpu.cfs_quota_us"), _read(folder / "cpu.cfs_period_us"))


def _ratio(quota: str, period: str) -> float:
    """Ratio of both; no limit if they are not positive numbers, as ``max`` and ``-1``."""
    try:
        values = int(quota), int(period)
    except ValueError:
        return math.inf
    return values[0] / values[1] if min(values) > 0 else math.inf


def _read(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8", errors="replace").strip()
    except OSError:
        return ""
