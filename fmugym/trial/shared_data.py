"""Whether the steps of an FMU write to data of its library, which all instances share.

Threads that step instances of such a library spoil each other's results so rarely that a comparison
need not show it. So this looks at the data themselves while a lone instance steps. Data that only
the loading, an initialization or a runtime library writes do not count, nor does what is on the
heap: that is for ``disturb_in_threads`` to find. It needs the maps of memory of Linux.
"""

from __future__ import annotations

import ctypes
import logging
import time
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Final, NamedTuple

from fmugym.archive.elf import opened
from fmugym.archive.loadable import LoadableFMU
from fmugym.fmi.status import WARNING_CODE
from fmugym.pool.base import Pool
from fmugym.pool.patience import require_licence
from fmugym.pool.spec import PoolSpec
from fmugym.trial.candidate import Candidate
from fmugym.trial.inputs import moving_inputs
from fmugym.trial.pools import trial_pool
from fmugym.trial.rehearsal import Starts
from fmugym.trial.verdict import Neighbours

__all__ = ["Steps", "watch_steps"]

_MAPS: Final = Path("/proc/self/maps")
_MOST_STEPS: Final = 1000
_SECONDS: Final = 0.1
"""The real time in seconds after which the steps end."""

_RUNTIMES: Final = (
    *("libc.", "libc++", "libgcc", "libgfortran", "libgomp", "libm.", "libpython", "libquadmath"),
    *("libstdc++",),
)
"""How the names of libraries begin that FMUs bring along and that threads may share."""


class Steps(NamedTuple):
    """What the steps of a lone instance have shown.

    Attributes:
        need: What several instances need for the sake of the data of their library:
            ``INDEPENDENT``, ``LIBRARIES``, or ``ONE_THREAD`` if copies would share the data, too.
        seconds: The real time of the fastest step.
    """

    need: Neighbours
    seconds: float


def watch_steps(candidate: Candidate, spec: PoolSpec, starts: Starts) -> Steps:
    """Step a lone instance for a while.

    Args:
        candidate: The FMU.
        spec: What to do at a reset and in a step.
        starts: The start values of the instance; the first of each two.

    Raises:
        FMULoadError: If the FMU cannot be loaded or instantiated.
        LicenceError: If it gets no licence.
    """
    fmu = candidate.open()
    pool = trial_pool(fmu, spec, 1, logging.getLogger(__name__))
    try:
        pool.reset(starts.variables, starts.column(0))
        require_licence(pool)
        places = list(_shared_places(fmu))
        before = list(map(_checksum, places))
        seconds = _step(pool, spec)
        pairs = zip(places, before, strict=True)
        written = {place.library for place, sum_ in pairs if _checksum(place) != sum_}
        return Steps(_need(written, fmu), seconds)
    finally:
        pool.close()


def _step(pool: Pool, spec: PoolSpec) -> float:
    """Step until something fails or it takes too long; returns the time of the fastest step."""
    now = time.perf_counter()
    deadline, fastest = now + _SECONDS, _SECONDS
    for row in moving_inputs(spec, _MOST_STEPS, 1.0):
        before = now
        _, statuses = pool.step(row[:, None])
        now = time.perf_counter()
        fastest = min(fastest, now - before)
        if statuses[0] > WARNING_CODE or now > deadline:
            break
    return fastest


def _need(written: set[Path], fmu: LoadableFMU) -> Neighbours:
    """A copy has data of its own, but the loader gives all copies the same dependencies."""
    if not written:
        return Neighbours.INDEPENDENT
    own = {part.extract().resolve() / part.library for part in fmu.parts or (fmu,)}
    return Neighbours.LIBRARIES if written <= own else Neighbours.ONE_THREAD


class _Place(NamedTuple):
    """Writable data of a library in the memory of this process."""

    library: Path
    address: int
    size: int


def _shared_places(fmu: LoadableFMU) -> Iterator[_Place]:
    """The writable data of the libraries that the FMU has brought along and loaded."""
    folders = [part.extract().resolve() for part in fmu.parts or (fmu,)]
    for library, base in _loaded_libraries().items():
        ours = any(library.is_relative_to(folder) for folder in folders)
        if ours and not library.name.startswith(_RUNTIMES):
            with opened(library) as elf:
                for address, size in elf.writable:
                    yield _Place(library, base + address, size)


def _loaded_libraries() -> dict[Path, int]:
    """The address at which each file is mapped into this process; none where that is not told."""
    bases: dict[Path, int] = {}
    lines = _MAPS.read_text(errors="surrogateescape").splitlines() if _MAPS.exists() else []
    for addresses, _, offset, _, _, *path in (line.split(maxsplit=5) for line in lines):
        if path and path[0].startswith("/") and int(offset, 16) == 0:
            bases.setdefault(Path(path[0]), int(addresses.partition("-")[0], 16))
    return bases


def _checksum(place: _Place) -> int:
    return zlib.crc32((ctypes.c_char * place.size).from_address(place.address))
