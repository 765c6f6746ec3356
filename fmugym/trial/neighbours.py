"""Whether instances of an FMU disturb each other.

The standard says that they do not. Even so, some FMUs keep part of their state in global variables
of their library, or call functions that are not thread-safe.
"""

from __future__ import annotations

import logging
import math
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import replace
from typing import Final, cast

import numpy as np

from fmugym.archive.fmu import FMU
from fmugym.archive.loadable import ExtractedFMU
from fmugym.archive.variable import Variable
from fmugym.errors import FMULoadError, LicenceError, SimulationError
from fmugym.fmi.status import WARNING_CODE, Status
from fmugym.pool.base import FloatArray, Pool, StatusArray
from fmugym.pool.local import local_pool
from fmugym.pool.patience import require_licence
from fmugym.pool.spec import PoolSpec, ResetMethod
from fmugym.systems.description import SystemDescription
from fmugym.systems.fmu import ExtractedSystem, SystemFMU
from fmugym.trial.candidate import Candidate
from fmugym.trial.inputs import moving_inputs, neighbour_inputs
from fmugym.trial.pools import trial_pool
from fmugym.trial.rehearsal import Starts

__all__ = ["default_spec", "disturb_in_threads", "disturb_in_turn"]

logger = logging.getLogger(__name__)

_DEFAULT_STEP_SIZE: Final = 0.01
"""The step size in seconds if the FMU gives none."""

_MOST_OUTPUTS: Final = 1000
_STEPS: Final = 30
_EPISODES: Final = (_STEPS, 3, 3)
"""The steps of each episode. From the third one on, a saved state may be restored."""
_CALLS: Final = 10
_CALL_SECONDS: Final = 2e-3
_MOST_SUBSTEPS: Final = 1024
"""How many calls an episode in threads makes, how long each takes if steps are quick, and the most
steps that one makes then."""
_THREAD_SECONDS: Final = 0.3
"""The real time in seconds after which a comparison in threads ends."""


def default_spec(fmu: FMU) -> PoolSpec:
    """The spec for an unknown FMU: write all inputs, read all outputs, use the FMU's step size."""
    description = fmu.description
    numeric = [v for v in description.variables.values() if v.numeric]
    outputs = [v for v in numeric if v.causality == "output"] or [
        v for v in numeric if v.causality == "local"
    ]
    return PoolSpec(
        inputs=tuple(v for v in numeric if v.causality == "input"),
        outputs=tuple(outputs[:_MOST_OUTPUTS]),
        time_step=description.step_size or _DEFAULT_STEP_SIZE,
        start_time=description.start_time,
    )


def disturb_in_turn(
    candidate: Candidate,
    spec: PoolSpec | None = None,
    starts: Starts | None = None,
    *,
    private_libraries: bool = False,
) -> bool:
    """Compare an instance run alone with one beside another that gets other values.

    Inputs and start values differ. There are several episodes, since an instance may spoil the
    saved states of another. Each run loads a fresh copy of the FMU's library. FMUs may still share
    things outside their library: files, other libraries, licences.

    Args:
        candidate: The FMU.
        spec: What to do at a reset and in a step; by default all inputs are written and all
            outputs read.
        starts: The start values of the two instances; by default those of the FMU.
        private_libraries: Whether each instance has a copy of the library.

    Returns:
        Whether the two instances depend on each other.

    Raises:
        FMULoadError: If even a single instance cannot be made.
        SimulationError: If an instance alone fails.
    """
    spec = default_spec(candidate.open()) if spec is None else spec

    def run(inputs: FloatArray) -> FloatArray:
        return _run(candidate, spec, starts or Starts(), inputs, private_libraries)

    alone, inputs = _run_alone(spec, run)
    try:
        beside = run(inputs)
    except LicenceError:
        raise
    except (FMULoadError, SimulationError) as error:
        logger.info("%s: a second instance fails: %s", candidate.path.name, error)
        return True
    return alone.tobytes() != beside.tobytes()


def _run_alone(
    spec: PoolSpec, run: Callable[[FloatArray], FloatArray]
) -> tuple[FloatArray, FloatArray]:
    """Run one instance with moving inputs, or with constant ones if the FMU then fails."""
    inputs = _inputs_of_two(spec, 1.0)
    try:
        return run(inputs[:1]), inputs
    except SimulationError:
        inputs = _inputs_of_two(spec, 0.0)
        return run(inputs[:1]), inputs


def _inputs_of_two(spec: PoolSpec, amplitude: float) -> FloatArray:
    """The inputs of two instances, different in every step, shape (2, steps, inputs)."""
    first = moving_inputs(spec, _STEPS, amplitude)
    second = moving_inputs(spec, _STEPS, 1.0, phase=_STEPS)
    second[: _STEPS // 3] = neighbour_inputs(spec)
    return np.stack([first, second])


def _run(
    candidate: Candidate,
    spec: PoolSpec,
    starts: Starts,
    inputs: FloatArray,
    private_libraries: bool,
) -> FloatArray:
    """Step instances of a fresh copy in turn; return the outputs of the first one."""
    count = len(inputs)
    fmu = candidate.open()
    pool = trial_pool(fmu, spec, count, logger, private_libraries=private_libraries)
    both = starts.apart()  # a caller may give each environment its own value of a fixed parameter
    values = np.hstack([both.column(0), both.column(1)])[:, :count]
    try:
        episodes = [
            _trajectory(pool, starts.variables, values, inputs[:, :steps]) for steps in _EPISODES
        ]
        return np.concatenate(episodes)
    finally:
        pool.close()


def _trajectory(
    pool: Pool, variables: tuple[Variable, ...], values: FloatArray, inputs: FloatArray
) -> FloatArray:
    outputs, statuses = pool.reset(variables, values)
    require_licence(pool)
    rows = [outputs[:, 0].copy()]
    for step in range(inputs.shape[1]):
        if statuses[0] > WARNING_CODE:
            break
        outputs, statuses = pool.step(inputs[:, step].T)
        rows.append(outputs[:, 0].copy())
    if statuses[0] not in (Status.OK, Status.WARNING, Status.TERMINATED):
        raise SimulationError(pool.failure(0))
    return np.array(rows)


def disturb_in_threads(
    candidate: Candidate,
    spec: PoolSpec,
    starts: Starts | None = None,
    *,
    step_seconds: float,
    one_initialization: bool = False,
    private_libraries: bool = False,
    frugal: bool = False,
) -> bool:
    """Compare two instances in two threads with the same instances in one.

    Args:
        candidate: The FMU.
        spec: What to do in a step.
        starts: The start values of the two instances; by default those of the FMU.
        step_seconds: How long a step takes; a call makes many quick ones, so that threads meet.
        one_initialization: Whether instances are made, initialized and freed in turn, so that only
            steps run at the same time as other calls.
        private_libraries: Whether each instance has a copy of the library.
        frugal: Whether to do with as few initializations as possible.

    Returns:
        Whether an instance gave different outputs, or failed, while another thread ran.

    Raises:
        FMULoadError: If the FMU cannot be loaded.
        LicenceError: If an instance gets no licence.
    """
    if candidate.open().in_wine:
        return False  # one thread steps all instances
    spec = replace(
        _with_long_calls(spec, step_seconds),
        reset_method=ResetMethod.INSTANCE,
        component_resets=(),
        one_initialization=one_initialization,
    )
    fmus = [candidate.open() for _ in range(2 if private_libraries else 1)]
    with ExitStack() as stack:
        for fmu in fmus:
            stack.callback(fmu.close)
        pair = [_Life(fmus[-i], spec, starts or Starts(), i) for i in range(2)]
        for life in pair:
            stack.callback(life.end)
        return _differ_in_threads(pair, frugal)


def _with_long_calls(spec: PoolSpec, step_seconds: float) -> PoolSpec:
    """Let each call take long enough for another thread, and its outputs tell of all its steps.

    Powers of two leave the step size that the FMU sees alone.
    """
    wanted = _CALL_SECONDS / max(step_seconds, 1e-9)
    factor = 2 ** int(math.log2(min(max(wanted, 1.0), _MOST_SUBSTEPS)))
    return replace(
        spec,
        time_step=spec.time_step * factor,
        substeps=spec.substeps * factor,
        samplings=tuple("last" if v.kind == "string" else "mean" for v in spec.outputs),
        warm_up_steps=0,
    )


def _differ_in_threads(pair: Sequence[_Life], frugal: bool) -> bool:
    """Let both play at the same time, one episode or as many as there is time for."""
    alone = [life.play() for life in pair]
    deadline = time.perf_counter() + _THREAD_SECONDS
    barrier = threading.Barrier(len(pair))
    with ThreadPoolExecutor(len(pair)) as threads:
        while True:
            together = list(threads.map(_Life.play, pair, [barrier] * len(pair)))
            if together != alone:
                return [life.play() for life in pair] == alone  # or they never repeat it
            if frugal or time.perf_counter() > deadline:
                return False


class _Life:
    """An instance that begins the same episode again and again, each time made anew.

    Args:
        fmu: The FMU, whose library it shares with other instances.
        spec: What to do in a step.
        starts: The start values of two instances.
        index: Which of the two it is.
    """

    def __init__(self, fmu: FMU, spec: PoolSpec, starts: Starts, index: int) -> None:
        self._variables, self._values = starts.variables, starts.apart().column(index)
        self._inputs = _inputs_of_two(spec, 1.0)[index, :_CALLS]
        self._pool = local_pool(_lent(fmu), spec, 1, logger, threads=1)
        self.end = self._pool.close

    def play(self, barrier: threading.Barrier | None = None) -> bytes:
        """Play an episode; returns all outputs and statuses."""
        if barrier is not None:
            barrier.wait()
        seen = [_copy_of(*self._pool.reset(self._variables, self._values))]
        require_licence(self._pool)
        seen += [_copy_of(*self._pool.step(row[:, None])) for row in self._inputs]
        return b"".join(seen)


def _lent(fmu: FMU) -> ExtractedFMU:
    """The FMU for a pool that must not remove its files."""
    if isinstance(fmu, SystemFMU):
        return ExtractedSystem(fmu.path, cast("SystemDescription", fmu.description), fmu.extract())
    return ExtractedFMU(fmu.path, fmu.description, fmu.preload, fmu.extract())


def _copy_of(outputs: FloatArray, statuses: StatusArray) -> bytes:
    return outputs.tobytes() + statuses.tobytes()
