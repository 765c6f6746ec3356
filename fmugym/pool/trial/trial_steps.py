"""Steps of a trial: each plays with the instances of a pool, and returns their outputs.

``fmugym.pool.trial.trial`` has their list, and opens the pools.
"""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np

from fmugym.errors import SimulationError
from fmugym.fmi.status import WARNING_CODE, Status
from fmugym.pool.pool import FloatArray, Pool
from fmugym.pool.pool_spec import PoolSpec, ResetMethod
from fmugym.pool.states import Bundle
from fmugym.pool.trial.library_data import library_data
from fmugym.pool.trial.reference import BUDGET, SMALL_BUDGET, Budget, Reference
from fmugym.pool.trial.trial_episodes import Inputs, Run, Starts, Stretch, play
from fmugym.pool.trial.trial_workers import TriedPool
from fmugym.pool.trial.verdict import Finding, Grade

__all__ = [
    "Halfway",
    "PairResult",
    "Watched",
    "is_repeated",
    "play_again_and_again",
    "play_alone",
    "play_beside",
    "play_rounds",
    "spec_for_threads",
    "spec_to_watch",
    "watch_data",
]

_SHORT, _LONG = 3, 200
"""The steps of a short episode, and the most of a long one; the longest is as long as the
reference."""

_RESTORED: Final = 2
"""The number of the first episode that begins with a restored state."""


# Resets


def play_again_and_again(pool: TriedPool, reference: Reference) -> tuple[list[Run], bool]:
    """Play episodes with one instance, each of which should begin anew.

    Returns:
        What it gave, and whether the pool restored the state of the first episode for which it
        should have done so.
    """
    runs, restored = list[Run](), True
    for number, (episode, steps) in enumerate(_episodes(reference)):
        before = pool.initializations
        runs.append(reference.play(pool, episode, steps))
        restored &= number != _RESTORED or pool.initializations == before
    return runs, restored


def _episodes(reference: Reference) -> tuple[tuple[int, int], ...]:
    """Episodes to play, with their numbers of steps.

    After the longest ones come one that begins with a restored state, and one that begins with
    other start values; one has no step.
    """
    longest = reference.steps
    short, long = min(_SHORT, longest), min(_LONG, longest)
    return (
        *((0, short), (0, long), (0, long), (1, 0)),
        *((1, longest), (0, short), (0, longest), (0, long)),
    )


# Saved states


@dataclass(frozen=True)
class Halfway:
    """A state in the middle of an episode, and the outputs that followed it.

    Attributes:
        state: The state.
        inputs: The inputs of the steps after it, shape (steps, k_in).
        rows: The outputs after each of them.
    """

    state: Bundle
    inputs: FloatArray
    rows: list[bytes]

    @classmethod
    def of(
        cls, pool: TriedPool, starts: Starts, inputs: Inputs, length: int | None
    ) -> Halfway | None:
        """Play until the middle of an episode, save the state, and play on.

        Args:
            pool: One instance.
            starts: The start values.
            inputs: The inputs.
            length: The most steps of an episode; None if nothing limits them.

        Returns:
            The state; None if no episode lasts long enough.
        """
        wanted = sys.maxsize if length is None else max(1, length // 2)
        while wanted:
            limit = Budget(SMALL_BUDGET if length is None else BUDGET / 2)
            (run,) = play(pool, starts, inputs, [Stretch((0,), wanted)], limit)[0]
            taken = len(run.rows) - 1
            if run.status == Status.OK:
                after = inputs.until(2 * taken + _AFTER)[taken : 2 * taken + _AFTER, :, 0]
                return cls(pool.save_instances(_ONE), after, _rows(pool, after))
            wanted = taken // 2  # so that it is well in the middle
        return None

    def goes_on(self, pool: Pool) -> Finding:
        """Restore the state; the same steps should lead to the same outputs."""
        pool.restore_instances(self.state, _ONE, _ONE)
        if _rows(pool, self.inputs) == self.rows:
            return Finding(Grade.BITWISE, "")
        return Finding(Grade.WRONG, "an episode that goes on from a saved state has other outputs")


_ONE: Final = np.zeros(1, np.int64)

_AFTER: Final = 25
"""How many steps follow a saved state at least."""


def _rows(pool: Pool, inputs: FloatArray) -> list[bytes]:
    rows = []
    for row in inputs:
        if pool.statuses[0] > WARNING_CODE:
            break
        outputs, _ = pool.step(row[:, None])
        rows.append(outputs.tobytes())
    return rows


# Other instances


def play_beside(pool: TriedPool, reference: Reference) -> list[list[Run]]:
    """Play episodes with N instances that are stepped in turn; return the episodes of each."""
    stretches = _beside(pool.num_instances, reference)
    return _read_again(pool, play(pool, reference.starts, reference.inputs, stretches))


def play_alone(pool: TriedPool, reference: Reference, index: int, num_instances: int) -> list[Run]:
    """Play with one instance the episodes of an instance at an index of N."""
    stretches = [
        Stretch((begins[index],), steps) for begins, steps in _beside(num_instances, reference)
    ]
    return _read_again(pool, play(pool, reference.starts, reference.inputs, stretches))[0]


def _read_again(pool: TriedPool, played: list[list[Run]]) -> list[list[Run]]:
    """Put what the outputs are in the end in the place of the last rows, where both are the same.

    Another instance may have been stepped since an instance gave its last row.
    """
    outputs = pool.spec.outputs
    rows = [i for i, v in enumerate(outputs) if v.sampling == "last"]
    try:
        values = pool.read(tuple(outputs[row] for row in rows))
    except SimulationError:
        return played
    for runs, own in zip(played, values.T, strict=True):
        runs[-1].rows[-1, rows] = own
    return played


def _beside(num_instances: int, reference: Reference) -> list[Stretch]:
    """The episodes of instances that are beside each other.

    First all begin at once. Then each one is restored, and each is initialized with other start
    values, while the others go on; so all are at different times of their episodes in the end.
    """
    each, longest = range(num_instances), reference.steps
    pause = min(_SHORT, longest // (2 * num_instances))
    first = tuple((0, 1, 1, 0)[index % 4] for index in each)
    restored = [Stretch(_only(index, first[index], each), pause) for index in each]
    initialized = [Stretch(_only(index, 1 - first[index], each), pause) for index in each]
    rest = Stretch((None,) * num_instances, longest - num_instances * pause)
    return [Stretch(first, longest), Stretch(first, pause), *restored, *initialized, rest]


def _only(index: int, episode: int, each: range) -> tuple[int | None, ...]:
    """One instance begins an episode, and the others go on."""
    return tuple(episode if one == index else None for one in each)


# Data that instances share

_MOST_STEPS: Final = 1000
_IDLE_CALLS: Final = 20
_STEP_SECONDS: Final = 0.1
_WATCHED_SECONDS: Final = 1e-3
"""The real time in seconds after which the search for data that steps share ends, and how long each
of its calls takes if steps are quick."""


class Watched(NamedTuple):
    """Findings of the steps of an instance.

    Attributes:
        written: The libraries to whose data they write, on Linux.
        seconds: The real time of the fastest call.
    """

    written: frozenset[Path]
    seconds: float


def watch_data(pool: TriedPool, starts: Starts) -> list[Watched]:
    """Step one instance after another for a while, and look at the writable data of libraries.

    Threads spoil each other's results so rarely that a comparison need not show it. What only the
    loading or an initialization writes does not count; what is on the heap is for a comparison.

    Args:
        pool: One instance, or two that have copies of the library.
        starts: The start values.

    Raises:
        DeathError: If the process does not survive that.
    """
    each = range(pool.num_instances)
    play(pool, starts, Inputs(pool.spec, 1.0), [Stretch(tuple(each), 0)])
    return [_watch(pool, index) for index in each]


def _watch(pool: TriedPool, index: int) -> Watched:
    process = pool.processes()[0]
    before = library_data(pool.fmu, process)
    seconds = _fastest_call(pool, index)
    after = library_data(pool.fmu, process)
    written = (place.library for place, sum_ in after.items() if sum_ != before.get(place))
    return Watched(frozenset(written), seconds)


def _fastest_call(pool: TriedPool, index: int) -> float:
    """Step an instance until it fails or it takes too long; returns the fastest call's time.

    That is the time in the FMU, without that of a call which steps nothing.
    """
    nobody, fastest, idle = np.ones(pool.num_instances, np.bool_), _STEP_SECONDS, _STEP_SECONDS
    others = np.arange(pool.num_instances) != index
    for _ in range(_IDLE_CALLS):
        begin = time.perf_counter()
        pool.step(None, nobody)
        now = time.perf_counter()
        idle = min(idle, now - begin)
    deadline = now + _STEP_SECONDS
    for row in Inputs(pool.spec, 1.0).until(_MOST_STEPS)[:_MOST_STEPS, :, :1]:
        if pool.statuses[index] > WARNING_CODE or now > deadline:
            break
        pool.step(np.repeat(row, pool.num_instances, axis=1), others)
        begin, now = now, time.perf_counter()
        fastest = min(fastest, now - begin)
    return max(0.0, fastest - idle)


# Threads

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


@dataclass(frozen=True)
class PairResult:
    """Outputs of two instances in an episode, and the number of initializations."""

    runs: tuple[Run, ...]
    initializations: int

    @classmethod
    def by(cls, pool: TriedPool, reference: Reference) -> PairResult:
        """Play an episode of two instances with long calls; see ``spec_with_long_calls``."""
        before, inputs = pool.initializations, Inputs(pool.spec, reference.inputs.amplitude)
        runs = play(pool, reference.starts, inputs, [Stretch((0, 1), _CALLS)])
        return cls(tuple(own[0] for own in runs), pool.initializations - before)

    def allows(self, other: PairResult) -> bool:
        """Whether another episode is as this one; a pool may repeat a failed initialization."""
        same = all(one.equals(two) for one, two in zip(self.runs, other.runs, strict=True))
        return same and other.initializations <= self.initializations


def play_rounds(pool: TriedPool, reference: Reference) -> list[PairResult]:
    """Play the reference of rounds in threads: a first and a later episode.

    Args:
        pool: Two instances, stepped by one thread.
        reference: Has the start values, and how far inputs move.
    """
    return [PairResult.by(pool, reference) for _ in range(2)]


def is_repeated(pool: TriedPool, reference: Reference, expected: Sequence[PairResult]) -> bool:
    """Whether two instances give the same again and again.

    Args:
        pool: Two instances, stepped by two threads.
        reference: As for ``play_rounds``.
        expected: What they give in one thread, first and later.
    """
    return all(
        expected[min(number, len(expected) - 1)].allows(PairResult.by(pool, reference))
        for number in _rounds()
    )


def _rounds() -> Iterator[int]:
    """As many rounds as there is time for, and a few at least."""
    deadline, rounds = time.perf_counter() + _THREAD_SECONDS, 0
    while rounds < _FEW_ROUNDS or time.perf_counter() <= deadline:
        yield rounds
        rounds += 1


def spec_for_threads(spec: PoolSpec, step_seconds: float, method: ResetMethod) -> PoolSpec:
    """Work of instances in threads: some are initialized while others step.

    Args:
        spec: What they do otherwise.
        step_seconds: How long a step takes.
        method: How episodes begin.
    """
    spec = spec_with_long_calls(spec, step_seconds, _CALL_SECONDS).beginning_by(method)
    return replace(spec, warm_up_steps=1)


def spec_to_watch(spec: PoolSpec, step_seconds: float) -> PoolSpec:
    """Work of a lone instance in ``watch_data``: little comes and goes between processes."""
    spec = spec_with_long_calls(spec, step_seconds, _WATCHED_SECONDS)
    return spec.beginning_by(ResetMethod.RESET)


def spec_with_long_calls(spec: PoolSpec, step_seconds: float, call_seconds: float) -> PoolSpec:
    """Let each call take so long, and its outputs tell of all its steps.

    Powers of two leave the step size that the FMU sees alone.
    """
    wanted = call_seconds / max(step_seconds, 1e-9)
    factor = 2 ** int(math.log2(min(max(wanted, 1.0), _MOST_SUBSTEPS)))
    return replace(
        spec,
        time_step=spec.time_step * factor,
        substeps=spec.substeps * factor,
        outputs=tuple(replace(v, sampling="mean") for v in spec.outputs),
        warm_up_steps=0,
    )
