"""Whether the steps of an FMU write to data of its library, which all instances share.

Threads that step instances of such a library spoil each other's results so rarely that a comparison
need not show it. So this looks at the data themselves while a lone instance steps. Data that only
the loading, an initialization or a runtime library writes do not count, nor does what is on the
heap: that is for ``disturb_in_threads`` to find. It needs the maps of memory of Linux.
"""

from __future__ import annotations

import logging
import time
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np

from fmugym.archive.loadable import LoadableFMU
from fmugym.pool.base import Pool
from fmugym.pool.process.library_data import library_data
from fmugym.pool.spec import PoolSpec, ResetMethod
from fmugym.trial.episodes import Starts, start, steps
from fmugym.trial.inputs import moving_inputs
from fmugym.trial.subject import Subject
from fmugym.trial.verdict import Neighbours

__all__ = ["Steps", "watch_steps"]

logger = logging.getLogger(__name__)

_MOST_STEPS: Final = 1000
_IDLE_CALLS: Final = 20
_SECONDS: Final = 0.1
"""The real time in seconds after which the steps end."""


class Steps(NamedTuple):
    """What the steps of a lone instance have shown.

    Attributes:
        need: What several instances need for the sake of the data of their library:
            ``INDEPENDENT``, ``LIBRARIES``, or ``ONE_THREAD`` if copies would share the data, too.
        seconds: The real time of the fastest step.
    """

    need: Neighbours
    seconds: float


def watch_steps(subject: Subject, spec: PoolSpec, starts: Starts) -> Steps:
    """Step a lone instance for a while.

    Args:
        subject: The FMU.
        spec: What to do at a reset and in a step.
        starts: The start values of the instance; the first of each two.

    Raises:
        DeathError: If the process does not survive that.
        FMULoadError: If the FMU cannot be loaded or instantiated.
        LicenceError: If it gets no licence.
    """
    spec = spec.beginning_by(ResetMethod.RESET)
    with subject.pool("the search for data that steps share", spec) as pool:
        start(pool, starts, 0)
        process = pool.processes()[0]
        before = library_data(pool.fmu, process)
        seconds = _step(pool, spec)
        after = library_data(pool.fmu, process)
        written = {place.library for place, sum_ in after.items() if sum_ != before.get(place)}
        return Steps(_need(written, pool.fmu), seconds)


def _step(pool: Pool, spec: PoolSpec) -> float:
    """Step until something fails or it takes too long; returns the time of the fastest step.

    That is the time in the FMU, without that of a call which steps nothing.
    """
    nobody, fastest, idle = np.ones(1, np.bool_), _SECONDS, _SECONDS
    for _ in range(_IDLE_CALLS):
        begin = time.perf_counter()
        pool.step(None, nobody)
        now = time.perf_counter()
        idle = min(idle, now - begin)
    deadline = now + _SECONDS
    for _ in steps(pool, moving_inputs(spec, _MOST_STEPS, 1.0)[:, :, None]):
        begin, now = now, time.perf_counter()
        fastest = min(fastest, now - begin)
        if now > deadline:
            break
    return max(0.0, fastest - idle)


def _need(written: set[Path], fmu: LoadableFMU) -> Neighbours:
    """A copy has data of its own, but the loader gives all copies the same dependencies."""
    if not written:
        return Neighbours.INDEPENDENT
    own = {part.extract().resolve() / part.library for part in fmu.parts or (fmu,)}
    return Neighbours.LIBRARIES if written <= own else Neighbours.ONE_THREAD
