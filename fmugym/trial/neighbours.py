"""Whether instances of an FMU disturb each other.

The standard says that they do not. Even so, some FMUs keep part of their state in global variables
of their library, or call functions that are not thread-safe.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from typing import Any, Final

import numpy as np

from fmugym.archive.fmu import FMU
from fmugym.archive.variable import Variable
from fmugym.errors import FMULoadError, LicenceError, SimulationError
from fmugym.fmi.access import Access
from fmugym.fmi.instance import Instance
from fmugym.fmi.library import Library
from fmugym.fmi.status import WARNING_CODE, Status
from fmugym.fmi.system_library import open_library
from fmugym.pool.base import FloatArray, Pool
from fmugym.pool.pacing import Pacer
from fmugym.pool.patience import licence_errors, require_licence
from fmugym.pool.progress import INITIALIZATION, STEP, announce
from fmugym.pool.spec import PoolSpec
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
    *,
    one_initialization: bool = False,
    frugal: bool = False,
) -> bool:
    """Compare a lone instance with instances that are made and stepped at the same time.

    Args:
        candidate: The FMU.
        spec: What to do in a step.
        one_initialization: Whether instances are made, initialized and freed in turn, so that only
            steps run at the same time as other calls.
        frugal: Whether to do with as few initializations as possible.

    Returns:
        Whether an instance gave different outputs, or failed, while another thread ran.

    Raises:
        FMULoadError: If FMPy cannot load the FMU.
        SimulationError: If an instance alone fails.
    """
    library = open_library(candidate.open(), logger, spec.solving, spec.inputs, spec.outputs)
    try:
        lives = _two_lives(library, spec)
        if lives[0]() != lives[0].outputs:
            return False  # a lone instance does not repeat its outputs: nothing to compare
        company = _Turns() if one_initialization else _Crowd()
        rounds = 1 if frugal and not one_initialization else 2
        return not _Race(lives, company, rounds).is_undisturbed()
    finally:
        library.close()


def _two_lives(library: Library, spec: PoolSpec) -> list[_Life]:
    """Let two instances live one after the other, with inputs that differ if the FMU bears it."""
    pacer = Pacer(spec)
    try:
        return [_Life(library, spec, inputs, pacer) for inputs in _inputs_of_two(spec, 1.0)]
    except LicenceError:
        raise
    except SimulationError:
        return [_Life(library, spec, _inputs_of_two(spec, 0.0)[0], pacer)] * 2


class _Company:
    """What an instance waits for in the course of its life; a lone one waits for nothing."""

    turn: AbstractContextManager[Any] = nullcontext()
    """Held while an instance is made, initialized or freed."""

    def before_initialization(self) -> None:
        """Wait until the other instance is about to be initialized, too."""

    def before_steps(self) -> None:
        """Wait until the other instance is about to be stepped, too."""

    def leave(self) -> None:
        """Let nobody wait any more."""


class _Crowd(_Company):
    """Two instances are initialized at the same moment."""

    def __init__(self) -> None:
        self._barrier = threading.Barrier(2)

    def before_initialization(self) -> None:
        self._barrier.wait()

    def leave(self) -> None:
        self._barrier.abort()


class _Turns(_Crowd):
    """Two instances are initialized in turn.

    In every other round they step at the same moment. In the rounds between, the first one steps
    while the second one is initialized.
    """

    def __init__(self) -> None:
        super().__init__()
        self.turn = threading.Lock()
        self._rounds = threading.local()

    def before_steps(self) -> None:
        count = getattr(self._rounds, "count", 0)
        self._rounds.count = count + 1
        if count % 2:
            self._barrier.wait()


class _Race:
    """Two threads that each make, run and free an instance at the same time, several times."""

    def __init__(self, lives: Sequence[_Life], company: _Company, least_rounds: int) -> None:
        self._lives, self._company, self._least_rounds = lives, company, least_rounds
        self._refusal: LicenceError | None = None
        self._deadline = time.perf_counter() + _THREAD_SECONDS
        self._disturbed = False

    def is_undisturbed(self) -> bool:
        threads = [threading.Thread(target=self._run, args=[life]) for life in self._lives]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        if self._refusal is not None:
            raise self._refusal
        return not self._disturbed

    def _run(self, life: _Life) -> None:
        try:
            for number in range(1, _ROUNDS + 1):
                if life(self._company) != life.outputs:
                    self._disturbed = True
                is_late = number >= self._least_rounds and time.perf_counter() > self._deadline
                if self._disturbed or is_late:
                    break
        except LicenceError as error:
            self._refusal = error
        except (FMULoadError, SimulationError) as error:
            logger.info("an instance fails beside another thread: %s", error)
            self._disturbed = True
        except threading.BrokenBarrierError:  # the other thread has ended
            pass
        finally:
            self._company.leave()


class _Life:
    """The life of an instance with given inputs; calling it makes another instance.

    Args:
        library: The FMU's library.
        spec: What to do in a step.
        inputs: Shape (steps, inputs).
        pacer: Waits before an instance is made or initialized.

    Attributes:
        outputs: All outputs of a lone instance.
    """

    def __init__(self, library: Library, spec: PoolSpec, inputs: FloatArray, pacer: Pacer) -> None:
        self._library, self._spec, self._inputs, self._pacer = library, spec, inputs, pacer
        self.outputs = self()

    def __call__(self, company: _Company | None = None) -> bytes:
        """Make, initialize, step and free an instance; return all outputs."""
        company = company or _Company()
        spec = self._spec
        announce(INITIALIZATION)
        with company.turn, licence_errors():
            self._pacer.wait()
            instance = self._library.instantiate()
        try:
            company.before_initialization()
            with company.turn, licence_errors():
                self._pacer.wait()
                instance.initialize(
                    spec.start_time, spec.stop_time, spec.tolerance, _no_start_values
                )
            company.before_steps()
            announce(STEP)
            return _steps(instance, spec, self._inputs)
        finally:
            with company.turn:
                self._library.discard(instance)


def _steps(instance: Instance, spec: PoolSpec, inputs: FloatArray) -> bytes:
    writer, reader = Access(instance, spec.inputs), Access(instance, spec.outputs)
    if not spec.blind_start:
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
