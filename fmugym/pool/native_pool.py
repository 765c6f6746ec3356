"""Pool in C: it steps thousands of instances in one call, on several threads.

Its results do not depend on the number of threads. Beyond the contract of ``Pool``, it offers the
vector environment its internal arrays and calls without any conversion:

write ``pool.inputs``, call ``pool.step_own()``, read ``pool.outputs``, ``pool.statuses`` and
``pool.observations``.

``play_around`` runs programs around the steps of pools that have none of their own. They run in
this process, on the arrays of such a pool, which may be memory that it shares with others, and in a
native pool that has no FMU.
"""

from __future__ import annotations

import logging
import time
import weakref
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, Final, ParamSpec, TypeVar, cast

import numpy as np
import numpy.typing as npt

from fmugym import _native
from fmugym.errors import FMULoadError, SimulationError
from fmugym.fmi.fmu import FMU, copy_libraries, extracted_again
from fmugym.fmi.variable import Variable
from fmugym.pool.c_extension import require_refusal
from fmugym.pool.engine import (
    Answers,
    EnginePool,
    Reader,
    Request,
    read_states,
    request_restore,
    request_restore_snapshot,
    request_save,
)
from fmugym.pool.failure_texts import FRESH_PROCESSES, REFUSED_ANEW, Receiver, loading_failed
from fmugym.pool.health import new_arrays, no_counts
from fmugym.pool.held_signals import undisturbed
from fmugym.pool.licences import speaks_of_licence
from fmugym.pool.play_form import Rows, form_of_play
from fmugym.pool.pool import (
    FloatArray,
    MaskArray,
    Play,
    Pool,
    PoolSpec,
    StatusArray,
    available_processors,
)
from fmugym.pool.pool_form import (
    Files,
    Writer,
    form_of_listing,
    form_of_pool,
    form_of_programs,
    manner_of,
)
from fmugym.pool.saving_pool import keeps_records
from fmugym.pool.states import IndexArray

__all__ = ["NativePool", "play_around", "prepare", "programs_for"]

_MOST_CACHED: Final = 64

_BETWEEN_LOOKS: Final = 1e-3
"""Seconds between two looks for the FMU's files in steps; a look takes some microseconds."""

P = ParamSpec("P")
R = TypeVar("R")


class NativePool(EnginePool):
    """N instances stepped by the C extension; see ``Pool`` for the contract.

    Args:
        fmu: The FMU; closed with the pool.
        spec: What to do at each reset and step.
        num_instances: N.
        log: The logger that gets the FMU's messages.
        threads: The most threads to use, including the calling one; by default one for each
            processor that this process may use. The results do not depend on it.
        private_libraries: Whether each instance gets a private copy of the FMU's library, and so
            of its global variables.

    Attributes:
        inputs: The inputs, shape (k_in, N), float64.
        outputs: The outputs, shape (k, N), float64.
        statuses: The statuses, shape (N,), int8.
        observations: The observations after a step, shape (N, num_observed), float32.
        threads: The most threads that a call uses.

    Raises:
        FMULoadError: If the FMU cannot be loaded or instantiated.
    """

    def __init__(
        self,
        fmu: FMU,
        spec: PoolSpec,
        num_instances: int,
        log: logging.Logger,
        *,
        threads: int | None = None,
        private_libraries: bool = False,
    ) -> None:
        spec = spec.fitting(fmu.description)
        self._use(new_arrays(spec, num_instances))
        self.threads = available_processors() if threads is None else max(1, threads)
        self._result = self.outputs, self.statuses
        self._fmu, self._spec = fmu, spec
        self._accesses: dict[tuple[Variable, ...], _native.Access] = {}
        self._looked = 0.0
        try:
            self._pool = self._open(log, private_libraries)
        except BaseException:
            fmu.close()
            raise
        self._close = weakref.finalize(self, _close, self._pool, fmu)
        self._prepare(fmu, spec, log)
        self._answers = Answers(fmu.description, spec, slice(0, num_instances))
        self.step_own = partial(self._pool.step, None)
        self._reset = self._pool.reset
        self._starting_play = (
            self._with_files(self._pool.play),
            self._with_files(self._pool.start),
        )

    def _open(self, log: logging.Logger, private_libraries: bool) -> _native.Pool:
        fmu, spec, description = self._fmu, self._spec, self._fmu.description
        paths = fmu.prepare_libraries()
        if private_libraries:
            paths = copy_libraries(fmu, self.num_instances)
        self._private = private_libraries
        form = form_of_pool(
            description,
            spec,
            Files.here(fmu, fmu.extract(), paths),
            self.num_instances,
            self.threads,
            private_libraries=private_libraries,
            logging=log.isEnabledFor(logging.INFO),
            records=keeps_records(description, spec),
        )
        arrays = self.inputs, self.outputs, self.statuses, self.observations, self._counts
        make = undisturbed(_native.Pool) if fmu.calls_python() else _native.Pool
        try:
            pool = make(form, arrays, Receiver(log, description))
        except OSError as error:
            text = loading_failed(fmu.path.name, str(error), fmu.extract(), FRESH_PROCESSES)
            raise FMULoadError(text) from None
        return cast(_native.Pool, _Undisturbed(pool)) if fmu.calls_python() else pool

    def _access(self, variables: tuple[Variable, ...]) -> _native.Access:
        """Find or make the access to variables; there is one for each list of variables."""
        access = self._accesses.get(variables)
        if access is None:
            if len(self._accesses) >= _MOST_CACHED:
                self._accesses.clear()
            manner = manner_of(self._fmu.description)
            access = _native.access(form_of_listing(variables, self._version, manner))
            self._accesses[variables] = access
        return access

    @property
    def plays_alone(self) -> bool:
        """See ``Pool.plays_alone``."""
        return True

    # The contract of Pool.

    def step(
        self,
        inputs: FloatArray | None = None,
        skip: MaskArray | None = None,
    ) -> tuple[FloatArray, StatusArray]:
        """See ``Pool.step``."""
        if inputs is not None:
            np.copyto(self.inputs, inputs)
        try:
            self._pool.step(skip)
        except (TypeError, BufferError, ValueError) as error:
            require_refusal(error)
            self._open_pool().step(_as_mask(skip))
        return self._result

    def failure(self, index: int) -> str:
        """See ``Pool.failure``."""
        if not 0 <= index < self.num_instances:
            raise IndexError(f"there is no instance {index}")
        content, tell = Writer().integers(index).form(), self._answers.failure
        text = self._ask_pool(Request.FAILURE, content, lambda reader: tell(reader, index))
        is_full = REFUSED_ANEW in text and not speaks_of_licence(text)
        return text + FRESH_PROCESSES if is_full else text

    def _ask(
        self,
        doing: str,
        request: Request,
        content: Callable[[slice], bytes],
        read: Callable[[Reader, int], R],
    ) -> list[R]:
        """See ``EnginePool._ask``; the instances are one block."""
        count = self.num_instances
        return [
            self._ask_pool(request, content(slice(0, count)), lambda reader: read(reader, count))
        ]

    def _ask_pool(self, request: Request, content: bytes, read: Callable[[Reader], R]) -> R:
        code, answer = self._open_pool().ask(request, content)
        found: R | SimulationError = self._answers.result(code, Reader(answer), read)
        if isinstance(found, SimulationError):
            raise found
        return found

    def save_states(self, indices: IndexArray, records: bool) -> Sequence[bytes]:
        """See ``SavingPool.save_states``."""
        outputs, content = len(self.outputs), request_save(indices, records)
        return self._ask_pool(
            Request.SAVE, content, lambda reader: read_states(reader, len(indices), outputs)
        )

    def restore_states(
        self, states: Sequence[bytes], sources: IndexArray, indices: IndexArray
    ) -> None:
        """See ``SavingPool.restore_states``."""
        self._ask_pool(Request.RESTORE, request_restore(states, sources, indices), Reader.end)

    def _restore_snapshot(self, number: int, mask: MaskArray) -> None:
        """See ``SavingPool._restore_snapshot``."""
        content = request_restore_snapshot(number, np.flatnonzero(mask))
        self._ask_pool(Request.RESTORE, content, Reader.end)

    def _count_steps(self) -> None:
        if self._close.alive:
            self._pool.count_steps()

    def close(self) -> None:
        """See ``Pool.close``."""
        try:
            self._close()
        finally:
            self._release_claim()

    def _open_pool(self) -> _native.Pool:
        if not self._close.alive:
            raise SimulationError("the pool is closed")
        return self._pool

    def _reset_once(
        self, variables: tuple[Variable, ...], values: FloatArray, mask: MaskArray | None
    ) -> int:
        """See ``RetryingPool._reset_once``."""
        access = self._accesses.get(variables) or self._access(variables)
        try:
            return self._reset(access, values, mask)
        except (TypeError, BufferError, ValueError) as error:
            require_refusal(error)
            self._open_pool()
            return self._reset(access, np.asarray(values, np.float64), _as_mask(mask))

    def extract(self) -> bool:
        """See ``Pool.extract``."""
        self._looked = time.monotonic()
        return extracted_again(self._fmu, self.num_instances if self._private else 0)

    def _with_files(self, function: Callable[P, R]) -> Callable[P, R]:
        """See to the FMU's files before a function that may make instances anew."""
        if not self._spec.makes_anew:
            return function

        def call(*args: P.args, **kwargs: P.kwargs) -> R:
            if time.monotonic() > self._looked + _BETWEEN_LOOKS:
                self.extract()
            return function(*args, **kwargs)

        return call

    # Steps with programs around them.

    def prepare_play(self, variables: tuple[Variable, ...], *parts: Any) -> Play:
        """See ``Pool.prepare_play``."""
        pool = self._pool
        prepare(pool, self._access(variables), *parts)
        step, start = self._starting_play
        return Play(pool.check_actions, pool.play_before, pool.play_after, pool.play, step, start)


class _Undisturbed:
    """A pool of the extension whose FMU is Python code: signals are held while it works.

    Args:
        pool: The pool.
    """

    def __init__(self, pool: _native.Pool) -> None:
        self._pool = pool

    def __getattr__(self, name: str) -> Any:
        return undisturbed(getattr(self._pool, name))


def prepare(
    pool: _native.Pool,
    start: _native.Access,
    programs: Sequence[tuple[Any, ...]],
    actions: Mapping[str, Any],
    start_values: FloatArray,
    draws: tuple[_native.Draws, npt.NDArray[np.uint64]],
    ended: MaskArray,
    surroundings: Mapping[str, Any],
) -> None:
    """Prepare a pool for steps of a vector environment, hooks included.

    This replaces what was prepared before. Every step uses the given arrays in place.

    Args:
        pool: The pool.
        start: To the start variables, as for ``Pool.reset``.
        programs: From the actions to the inputs; from the outputs to all that follows; and from
            those at the start of an episode to observations and infos. See ``Program.with_rows``.
        actions: How actions are checked and kept: the bytes of an element; the check (0 none, 1 the
            range from lowest to highest, 2 and 3 no NaN of float64 and float32); the memory for the
            actions of this step and of the one before, environments first, whose type and shape
            actions must have; what counts as the action of a new episode, flat.
        start_values: As the values of ``reset``; the pool writes the draws there.
        draws: The draws of an episode, and the random streams, shape (N, 6); see
            ``EpisodeStreams``.
        ended: Which environments start an episode in the next step, shape (N,).
        surroundings: ``kept``, for the outputs before the step; ``reads_kept``, whether the second
            program reads them; ``before_inputs`` and ``before_conclusion``, pairs of rows: values,
            and where they are kept before a program replaces them; ``starts``, pairs of rows and
            what they hold at the start of an episode, in this order, see ``RowStart``;
            ``unstepped``, the same for what the second program stores where an episode starts
            instead of a step; ``results``, whether to return numbers in the place of arrays of
            one; and for each array one of its shape and type: ``seen`` of observations and infos,
            which the pool fills with float32 if no program does, then rewards, terminated and
            truncated of a step, mask and drawn values (draws, N) of a reset.
    """
    rows = Rows()
    pool.prepare_play(
        form_of_play(rows, programs, actions, surroundings),
        tuple(rows.arrays),
        start,
        start_values,
        actions["current"],
        actions["previous"],
        *draws,
        ended,
        surroundings["kept"],
        surroundings["results"],
    )


def _as_mask(mask: MaskArray | None) -> MaskArray | None:
    return None if mask is None else np.asarray(mask, np.bool_)


def _close(pool: _native.Pool, fmu: FMU) -> None:
    try:
        pool.close()
    finally:
        fmu.close()


def play_around(pool: Pool, spec: PoolSpec, variables: tuple[Variable, ...], *parts: Any) -> Play:
    """Prepare programs that run before and after the steps of a pool; see ``Pool.prepare_play``."""
    programs = programs_for(pool, spec)
    prepare(programs, _native.access(form_of_listing(variables)), *parts)
    return Play(programs.check_actions, programs.play_before, programs.play_after)


def programs_for(pool: Pool, spec: PoolSpec) -> _native.Pool:
    """Make a native pool of no FMU that runs programs on the arrays of another pool.

    Args:
        pool: Its arrays are those that programs read and write.
        spec: What the pool does at each step.
    """
    count = pool.num_instances
    form = form_of_programs(spec, count, available_processors())
    own = pool.inputs, pool.outputs, pool.statuses, pool.observations, no_counts(count)
    return _native.Pool(form, own, _ignore)


def _ignore(index: int, status: int, category: str, message: str) -> None:
    """Receive the messages of FMUs, of which there are none."""
    logging.getLogger(__name__).debug("%d %d %s %s", index, status, category, message)
