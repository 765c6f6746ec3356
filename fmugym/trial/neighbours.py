"""Whether instances of an FMU disturb each other.

The standard says that they do not. Even so, some FMUs keep part of their state in global variables
of their library, or call functions that are not thread-safe. Threads that step instances of such a
library spoil each other's results so rarely that a comparison need not show it. So the data
themselves are looked at while a lone instance steps, where Linux tells them. What only the loading
or an initialization writes does not count; what is on the heap is for a comparison in threads.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np

from fmugym.archive.fmu import FMU
from fmugym.pool.base import FloatArray, Pool
from fmugym.pool.process.library_data import library_data
from fmugym.pool.spec import PoolSpec, ResetMethod
from fmugym.trial.inputs import inputs_of_two, moving_inputs
from fmugym.trial.rehearsal import Rehearsal
from fmugym.trial.subject import Subject, TriedPool
from fmugym.trial.trial_episodes import Starts, start, steps
from fmugym.trial.verdict import FRUGAL, Neighbours, Verdict

__all__ = ["disturb_in_threads", "need_in_turn", "need_of_several"]

_THREADS: Final = "the comparison of instances in two threads"
_TURNS: Final = "the comparison of instances in two threads, initialized in turn"
_COPIES: Final = "the comparison of copies of the library in two threads"

_CALLS: Final = 4
_CALL_SECONDS: Final = 8e-3
_MOST_SUBSTEPS: Final = 2**15
"""How many calls an episode in threads makes, how long each takes if steps are quick, and the most
steps that one makes then. Threads meet although the machine has other work."""
_THREAD_SECONDS: Final = 0.3
"""The real time in seconds after which a comparison in threads ends."""
_FEW_ROUNDS: Final = 2
"""The episodes in threads at least; a pool divides its work among threads from the second call on.
"""


_MOST_STEPS: Final = 1000
_IDLE_CALLS: Final = 20
_STEP_SECONDS: Final = 0.1
_WATCHED_SECONDS: Final = 1e-3
"""The real time in seconds after which the search for data that steps share ends, and how long each
of its calls takes if steps are quick: what comes and goes between processes is little of that."""


def need_of_several(rehearsal: Rehearsal, alone: Verdict) -> Neighbours:
    """Find the cheapest way to keep instances from disturbing each other.

    Args:
        rehearsal: Has played the reference, if that is possible.
        alone: The verdict on a lone instance.

    Raises:
        LicenceError: If an instance gets no licence.
    """
    method, components = alone.reset_method, alone.components
    need = need_in_turn(rehearsal, method, components)
    if need is not Neighbours.INDEPENDENT:
        return need
    subject, starts = rehearsal.subject, rehearsal.starts
    spec = _without(rehearsal.spec, alone.noisy)
    unknown = _Steps(Neighbours.INDEPENDENT, math.inf)
    watched = _with_long_calls(spec, rehearsal.step_seconds, _WATCHED_SECONDS)
    watch = partial(_watch_steps, subject, watched, starts, watched.substeps // spec.substeps)
    seen = subject.attempt(watch, refused=unknown, died=unknown, alone=True)
    frugal = FRUGAL in alone.reasons
    in_threads = partial(
        disturb_in_threads, subject, spec, starts, step_seconds=seen.seconds, frugal=frugal
    )
    if seen.need is Neighbours.INDEPENDENT:
        if not in_threads():
            return Neighbours.INDEPENDENT
        by_steps = in_threads(one_initialization=True)
        return Neighbours.ONE_THREAD if by_steps else Neighbours.ONE_INITIALIZATION
    apart = seen.need is Neighbours.LIBRARIES and not (
        rehearsal.is_disturbed(method, components, private_libraries=True)
        or in_threads(private_libraries=True)
    )
    return Neighbours.LIBRARIES if apart else Neighbours.ONE_THREAD


def _without(spec: PoolSpec, noisy: tuple[str, ...]) -> PoolSpec:
    """Leave out the outputs that tell nothing about other instances, unless all are such."""
    kept = tuple(variable for variable in spec.outputs if variable.name not in noisy)
    return replace(spec, outputs=kept) if kept else spec


def need_in_turn(
    rehearsal: Rehearsal, method: ResetMethod, components: tuple[ResetMethod, ...] = ()
) -> Neighbours:
    """Find out what instances need that one thread steps in turn.

    Args:
        rehearsal: Has played the reference.
        method: How the episodes begin.
        components: How each component of a system begins them.

    Returns:
        ``INDEPENDENT``, ``LIBRARIES`` or ``PROCESSES``.
    """
    if method is ResetMethod.PROCESS:
        return Neighbours.PROCESSES
    if not rehearsal.possible:
        return Neighbours.INDEPENDENT
    disturbed = partial(rehearsal.is_disturbed, method, components)
    if method is not ResetMethod.LIBRARY and not disturbed():
        return Neighbours.INDEPENDENT
    copies = rehearsal.subject.can_copy_libraries and not disturbed(private_libraries=True)
    return Neighbours.LIBRARIES if copies else Neighbours.PROCESSES


# Data that steps share


class _Steps(NamedTuple):
    """What the steps of a lone instance have shown.

    Attributes:
        need: What several instances need for the sake of the data of their library:
            ``INDEPENDENT``, ``LIBRARIES``, or ``ONE_THREAD`` if copies would share the data, too.
        seconds: The real time of the fastest step.
    """

    need: Neighbours
    seconds: float


def _watch_steps(subject: Subject, spec: PoolSpec, starts: Starts, together: int) -> _Steps:
    """Step a lone instance for a while.

    Args:
        subject: The FMU.
        spec: What to do at a reset and in a step.
        starts: The start values of the instance; the first of each two.
        together: How many steps a call makes.

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
        seconds = _step(pool, spec) / together
        after = library_data(pool.fmu, process)
        written = {place.library for place, sum_ in after.items() if sum_ != before.get(place)}
        return _Steps(_need(written, pool.fmu), seconds)


def _step(pool: Pool, spec: PoolSpec) -> float:
    """Step until something fails or it takes too long; returns the time of the fastest call.

    That is the time in the FMU, without that of a call which steps nothing.
    """
    nobody, fastest, idle = np.ones(1, np.bool_), _STEP_SECONDS, _STEP_SECONDS
    for _ in range(_IDLE_CALLS):
        begin = time.perf_counter()
        pool.step(None, nobody)
        now = time.perf_counter()
        idle = min(idle, now - begin)
    deadline = now + _STEP_SECONDS
    for _ in steps(pool, moving_inputs(spec, _MOST_STEPS, 1.0)[:, :, None]):
        begin, now = now, time.perf_counter()
        fastest = min(fastest, now - begin)
        if now > deadline:
            break
    return max(0.0, fastest - idle)


def _need(written: set[Path], fmu: FMU) -> Neighbours:
    """A copy has data of its own, but the loader gives all copies the same dependencies."""
    if not written:
        return Neighbours.INDEPENDENT
    own = {library for _, library in fmu.libraries_in(fmu.extract().resolve())}
    return Neighbours.LIBRARIES if written <= own else Neighbours.ONE_THREAD


# Threads


def disturb_in_threads(
    subject: Subject,
    spec: PoolSpec,
    starts: Starts,
    *,
    step_seconds: float,
    frugal: bool = False,
    one_initialization: bool = False,
    private_libraries: bool = False,
) -> bool:
    """Compare two instances in two threads with the same instances in one.

    Args:
        subject: The FMU.
        spec: What to do in a step.
        starts: The start values of the two instances.
        step_seconds: How long a step takes; a call makes many quick ones, so that threads meet.
        one_initialization: Whether instances are made, initialized and freed in turn, so that only
            steps run at the same time as other calls.
        private_libraries: Whether each instance has a copy of the library.
        frugal: Whether to do with as few initializations as possible.

    Returns:
        Whether an instance gave different outputs, or failed, while another thread ran.

    Raises:
        LicenceError: If an instance gets no licence.
    """
    if subject.fmu.in_wine:
        return False  # one thread steps all instances
    stage = _TURNS if one_initialization else _COPIES if private_libraries else _THREADS
    spec = replace(
        _with_long_calls(spec, step_seconds, _CALL_SECONDS),
        reset_method=ResetMethod.INSTANCE,
        component_resets=(),
        warm_up_steps=1,  # so that some instances are initialized while others step
        one_initialization=one_initialization,
    )
    open_pool = partial(subject.pool, stage, spec, 2, private_libraries=private_libraries)
    inputs, starts = inputs_of_two(spec, _CALLS, 1.0), starts.apart()

    def play_in_one_thread() -> tuple[bytes, int]:
        with open_pool() as pool:
            return _play(pool, starts, inputs)

    def compare() -> bool:
        alone = play_in_one_thread()
        with open_pool(threads=2) as pool:
            same = all(_is_as(alone, _play(pool, starts, inputs)) for _ in _rounds(frugal))
        return not same and _is_as(alone, play_in_one_thread())  # or they never repeat it

    return subject.attempt(compare, refused=False, died=True)


def _rounds(frugal: bool) -> Iterator[None]:
    """A few rounds if initializations are precious, or as many as there is time for."""
    deadline, rounds = time.perf_counter() + _THREAD_SECONDS, 0
    while rounds < _FEW_ROUNDS or not (frugal or time.perf_counter() > deadline):
        rounds += 1
        yield


def _with_long_calls(spec: PoolSpec, step_seconds: float, call_seconds: float) -> PoolSpec:
    """Let each call take long enough for another thread, and its outputs tell of all its steps.

    Powers of two leave the step size that the FMU sees alone.
    """
    wanted = call_seconds / max(step_seconds, 1e-9)
    factor = 2 ** int(math.log2(min(max(wanted, 1.0), _MOST_SUBSTEPS)))
    return replace(
        spec,
        time_step=spec.time_step * factor,
        substeps=spec.substeps * factor,
        outputs=tuple(
            v if v.kind == "string" else replace(v, sampling="mean") for v in spec.outputs
        ),
        warm_up_steps=0,
    )


def _play(pool: TriedPool, starts: Starts, inputs: FloatArray) -> tuple[bytes, int]:
    """Play an episode of two instances; returns what they gave, and their initializations."""
    before = pool.initializations
    rows = [start(pool, starts, 0, 1), *steps(pool, inputs)]
    return np.array(rows).tobytes() + pool.statuses.tobytes(), pool.initializations - before


def _is_as(expected: tuple[bytes, int], played: tuple[bytes, int]) -> bool:
    """Whether an episode is as it was; a pool may have repeated an initialization that failed."""
    return played[0] == expected[0] and played[1] <= expected[1]
