"""Whether instances of an FMU disturb each other.

The standard says that they do not. Even so, some FMUs keep part of their state in global variables
of their library, or call functions that are not thread-safe.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from typing import Final

import numpy as np

from fmugym.archive.fmu import FMU
from fmugym.errors import FMULoadError, SimulationError
from fmugym.fmi.access import Access
from fmugym.fmi.instance import Instance
from fmugym.fmi.library import Library
from fmugym.fmi.status import Status
from fmugym.pool.base import FloatArray, Pool
from fmugym.pool.local import local_pool
from fmugym.pool.spec import PoolSpec
from fmugym.trial.inputs import moving_inputs, neighbour_inputs
from fmugym.trial.trial import Candidate

__all__ = ["default_spec", "disturb_in_threads", "disturb_in_turn"]

logger = logging.getLogger(__name__)

_DEFAULT_STEP_SIZE: Final = 0.01
"""The step size in seconds if the FMU gives none."""

_MOST_OUTPUTS: Final = 1000
_STEPS: Final = 30
_ROUNDS: Final = 20
_THREAD_SECONDS: Final = 0.2
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
    *,
    private_libraries: bool = False,
) -> bool:
    """Compare an instance run alone with one run beside another that gets different inputs.

    Each run loads a fresh copy of the FMU's library. FMUs may still share things outside their
    library: files, other libraries, licences.

    Args:
        candidate: The FMU.
        spec: What to do in a step; by default all inputs are written and all outputs read.
        private_libraries: Whether each instance has a copy of the library.

    Returns:
        Whether the two instances depend on each other.

    Raises:
        FMULoadError: If even a single instance cannot be made.
        SimulationError: If an instance alone fails.
    """
    spec = default_spec(candidate.open()) if spec is None else spec
    alone, inputs = _run_alone(candidate, spec, private_libraries)
    try:
        beside = _run(candidate, spec, inputs, private_libraries)
    except (FMULoadError, SimulationError) as error:
        logger.info("%s: a second instance fails: %s", candidate.path.name, error)
        return True
    return alone.tobytes() != beside.tobytes()


def _run_alone(
    candidate: Candidate, spec: PoolSpec, private_libraries: bool
) -> tuple[FloatArray, FloatArray]:
    """Run one instance with moving inputs, or with constant ones if the FMU then fails."""
    inputs = _inputs_of_two(spec, 1.0)
    try:
        return _run(candidate, spec, inputs[:1], private_libraries), inputs
    except SimulationError:
        inputs = _inputs_of_two(spec, 0.0)
        return _run(candidate, spec, inputs[:1], private_libraries), inputs


def _inputs_of_two(spec: PoolSpec, amplitude: float) -> FloatArray:
    """The inputs of two instances, different in every step, shape (2, steps, inputs)."""
    first = moving_inputs(spec, _STEPS, amplitude)
    second = moving_inputs(spec, _STEPS, 1.0, phase=_STEPS)
    second[: _STEPS // 3] = neighbour_inputs(spec)
    return np.stack([first, second])


def _run(
    candidate: Candidate, spec: PoolSpec, inputs: FloatArray, private_libraries: bool
) -> FloatArray:
    """Step instances of a fresh copy in turn; return the outputs of the first one."""
    count = len(inputs)
    fmu = candidate.open()
    pool = local_pool(fmu, spec, count, logger, threads=1, private_libraries=private_libraries)
    try:
        return _trajectory(pool, inputs)
    finally:
        pool.close()


def _trajectory(pool: Pool, inputs: FloatArray) -> FloatArray:
    outputs, statuses = pool.reset((), np.zeros((0, pool.num_instances)))
    rows = []
    for step in range(_STEPS + 1):
        if statuses[0] > Status.WARNING:
            if step > 1 and statuses[0] == Status.TERMINATED:
                break
            raise SimulationError(pool.failure(0))
        rows.append(outputs[:, 0].copy())
        if step < _STEPS:
            outputs, statuses = pool.step(inputs[:, step].T)
    return np.array(rows)


def disturb_in_threads(candidate: Candidate, spec: PoolSpec) -> bool:
    """Compare a lone instance with instances that are made and stepped at the same time.

    Args:
        candidate: The FMU.
        spec: What to do in a step.

    Returns:
        Whether an instance gave different outputs, or failed, while another thread ran.

    Raises:
        FMULoadError: If FMPy cannot load the FMU.
        SimulationError: If an instance alone fails.
    """
    library = Library(candidate.open(), logger)
    try:
        inputs = _inputs_of_two(spec, 0.0)[0]
        expected = _life(library, spec, inputs, _nobody_waits)
        if _life(library, spec, inputs, _nobody_waits) != expected:
            return False  # a lone instance does not repeat its outputs: nothing to compare
        return not _Race(library, spec, inputs, expected).is_undisturbed()
    finally:
        library.close()


class _Race:
    """Two threads that each make, run and free an instance at the same time, several times."""

    def __init__(
        self, library: Library, spec: PoolSpec, inputs: FloatArray, expected: bytes
    ) -> None:
        self._arguments = library, spec, inputs
        self._expected = expected
        self._barrier = threading.Barrier(2)
        self._deadline = time.perf_counter() + _THREAD_SECONDS
        self._disturbed = False

    def is_undisturbed(self) -> bool:
        threads = [threading.Thread(target=self._run) for _ in range(2)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        return not self._disturbed

    def _run(self) -> None:
        try:
            for _ in range(_ROUNDS):
                if _life(*self._arguments, self._wait) != self._expected:
                    self._disturbed = True
                if self._disturbed or time.perf_counter() > self._deadline:
                    break
        except (FMULoadError, SimulationError) as error:
            logger.info("an instance fails beside another thread: %s", error)
            self._disturbed = True
        except threading.BrokenBarrierError:  # the other thread has ended
            pass
        finally:
            self._barrier.abort()

    def _wait(self) -> None:
        self._barrier.wait()


def _life(library: Library, spec: PoolSpec, inputs: FloatArray, wait: Callable[[], None]) -> bytes:
    """Make, initialize, step and free an instance; return all outputs."""
    instance = library.instantiate()
    try:
        wait()
        instance.initialize(spec.start_time, spec.stop_time, spec.tolerance, _no_start_values)
        return _steps(instance, spec, inputs)
    finally:
        library.discard(instance)


def _steps(instance: Instance, spec: PoolSpec, inputs: FloatArray) -> bytes:
    writer, reader = Access(instance, spec.inputs), Access(instance, spec.outputs)
    instance.check("reading the outputs", reader.get())
    values = reader.values.tobytes()
    for step, row in enumerate(inputs):
        writer.values[:] = row
        instance.check("setting the inputs", writer.set())
        time_ = spec.communication_point(step)
        if instance.step(time_, spec.communication_step_size) > Status.WARNING:
            break
        instance.check("reading the outputs", reader.get())
        values += reader.values.tobytes()
    return values


def _no_start_values() -> None:
    """Keep the FMU's start values."""


def _nobody_waits() -> None:
    """Do nothing: a lone instance does not wait for others."""
