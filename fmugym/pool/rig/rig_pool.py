"""A pool of rigs, lab cells or other simulators in the place of FMU instances."""

from __future__ import annotations

import logging
import math
import weakref
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from itertools import compress
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from fmugym.checks import has_method
from fmugym.errors import ConfigError, SimulationError, shown
from fmugym.fmi.fmu import FMU
from fmugym.fmi.status import WARNING_CODE, Status
from fmugym.fmi.variable import Variable, values_by_name
from fmugym.pool.c_extension import needs_engine
from fmugym.pool.health import Column, CountedPool, new_arrays, note
from fmugym.pool.pool import FloatArray, MaskArray, Play, PoolSpec, StatusArray
from fmugym.pool.pool_spec import is_start_time
from fmugym.pool.rig.clocks import Clock, Paced, TickSchedule
from fmugym.pool.rig.rig import Backend, Outcome, Rig, describe_error
from fmugym.pool.rig.threads import Here, Idle, Worker, ask_all
from fmugym.pool.states import Bundle, IndexArray

__all__ = ["Backend", "BackendPool"]

logger = logging.getLogger(__name__)

_LONGEST_STOP: Final = 10.0
"""How long to wait for a stop, in s; its thread goes on with it after that."""


class BackendPool(CountedPool):
    """N backends in the place of N FMU instances, stepped at the same time.

    ``Pool`` describes the contract. Backends have no states that could be saved. The FMU only
    describes the variables; its code is not loaded. Each backend has a thread of its own, except a
    single backend without ``hold``.

    Args:
        fmu: The FMU; closed with the pool.
        spec: What to do at each reset and step, apart from substeps.
        num_instances: N.
        backend: A ``Backend``, a sequence of N, or a function of N that returns such a sequence;
            or a `Paced` one. The function may have the methods ``open`` and ``close`` for something
            that the backends share. ``open`` is called before each reset, ``close`` after all
            backends have stopped.
        is_real: Whether a step may move real hardware. What does not is called in the caller's
            thread, and episodes begin at the time of the config.

    Raises:
        ConfigError: If a backend lacks a method, or if there are not N of them.
    """

    def __init__(
        self, fmu: FMU, spec: PoolSpec, num_instances: int, backend: Any, *, is_real: bool = True
    ) -> None:
        if spec.fault_retries:
            raise ConfigError("config key 'fault_retries': a backend's steps cannot be repeated")
        if spec.samplings and not getattr(backend, "samples_outputs", False):
            raise ConfigError("a backend has no substeps: leave 'samplings' out of the config")
        self._use(new_arrays(spec, num_instances))
        self._spec, self._is_real = spec, is_real
        self._failures = [""] * num_instances
        self._is_ready = np.zeros(num_instances, np.bool_)
        self._ages: FloatArray = np.zeros(num_instances)
        self._paced = backend if isinstance(backend, Paced) else None
        self._clock = None if self._paced is None else self._paced.clock
        self._now = _no_time if self._clock is None else self._clock.time
        try:
            self._set_up(backend if self._paced is None else self._paced.backend)
        except BaseException:
            fmu.close()
            raise
        self._close = weakref.finalize(self, _close, fmu, *self._all)

    def _set_up(self, backend: Any) -> None:
        spec, paced, count = self._spec, self._paced, self.num_instances
        self._schedule = None if paced is None else TickSchedule(spec.time_step, paced.clock, count)
        self._rigs = [Rig(one, spec, self._now) for one in _backends(backend, count)]
        self._threads = [self._thread(index, rig) for index, rig in enumerate(self._rigs)]
        shared = backend if _makes_backends(backend) else None
        self._open = getattr(shared, "open", _nothing)
        self._all = self._rigs, self._threads, self._clock, getattr(shared, "close", _nothing)

    def _thread(self, index: int, rig: Rig) -> Here | Worker:
        if not self._is_real or (self.num_instances == 1 and not rig.can_hold):
            return Here()
        paced, name = self._paced, f"backend-{index}"
        if paced is None:
            return Worker(name)
        hold_after = paced.time_until_hold(self._spec.time_step)
        return Worker(name, paced.clock, Idle(rig.hold, hold_after))

    def prepare_play(self, variables: tuple[Variable, ...], *parts: Any) -> Play:
        """See ``Pool.prepare_play``."""
        from fmugym.pool.native_pool import play_around

        return play_around(self, self._spec, variables, *parts)

    @property
    def is_real(self) -> bool:
        """See ``Pool.is_real``; a rig may move at every step."""
        return self._is_real

    # The contract of Pool.

    def reset(
        self, variables: tuple[Variable, ...], values: FloatArray, mask: MaskArray | None = None
    ) -> tuple[FloatArray, StatusArray]:
        """See ``Pool.reset``."""
        self._require_open()
        chosen = self._as_mask(mask)
        given = [not (self._is_real and is_start_time(v)) for v in variables]  # it begins now
        own, values = list(compress(variables, given)), values[given]
        starts = {
            index: values_by_name(own, values[:, index].tolist())
            for index in np.flatnonzero(chosen).tolist()
        }
        with self._halted_by_errors():
            self._start(starts)
            self._stop_at_exit()
            if self._schedule is not None:
                self._schedule.start(chosen)
            self._warm_up(chosen, starts)
        return self.outputs, self.statuses

    def _start(self, starts: Mapping[int, Mapping[str, Any]]) -> None:
        try:
            self._open()
        except Exception as error:
            for index in starts:
                self._take(index, Outcome(Status.ERROR, None, describe_error(error)))
        else:
            self._ask("reset", starts)

    def _stop_at_exit(self) -> None:
        """Register the stop anew.

        At the interpreter's exit it then comes before the finalizers of all that the backends have
        made in their resets.
        """
        alive = self._close.detach()
        if alive is not None:
            _, function, args, _ = alive
            self._close = weakref.finalize(self, function, *args)

    def _warm_up(self, chosen: MaskArray, starts: Mapping[int, Mapping[str, Any]]) -> None:
        for _ in range(self._spec.warm_up_steps):
            for index, start in starts.items():
                self.inputs[:, index] = [
                    start.get(variable.name, variable.start_number)
                    for variable in self._spec.inputs
                ]
            running = chosen & self._is_ready
            self._advance(running)
            for index in np.flatnonzero(running & ~self._is_ready).tolist():
                self._failures[index] = f"the warm-up failed: {self._failures[index]}"

    def step(
        self,
        inputs: FloatArray | None = None,
        skip: MaskArray | None = None,
    ) -> tuple[FloatArray, StatusArray]:
        """See ``Pool.step``."""
        self._require_open()
        if inputs is not None:
            np.copyto(self.inputs, inputs)
        wanted = np.ones(self.num_instances, np.bool_) if skip is None else ~np.asarray(skip)
        for index in np.flatnonzero(wanted & ~self._is_ready).tolist():
            self.statuses[index] = Status.ERROR
            self._failures[index] = self._failures[index] or "it was not started by a reset"
        with self._halted_by_errors():
            self._advance(wanted & self._is_ready)
        observed = self.outputs[: self._spec.num_observed].T
        np.copyto(self.observations, observed, casting="same_kind")
        return self.outputs, self.statuses

    def _advance(self, chosen: MaskArray) -> None:
        if not chosen.any():
            return
        if self._schedule is not None:
            self._schedule.wait(chosen)
        inputs = self.inputs.T.tolist()
        self._ask("step", {index: inputs[index] for index in np.flatnonzero(chosen).tolist()})

    def _ask(self, method: str, arguments: Mapping[int, Any]) -> None:
        """Call a method of some rigs at the same time, and store the results."""
        self._counts[list(arguments), Column.RESETS if method == "reset" else Column.STEPS] += 1
        calls = [
            (self._threads[index], getattr(self._rigs[index], method), argument)
            for index, argument in arguments.items()
        ]
        for index, outcome in zip(arguments, ask_all(calls, self._clock), strict=True):
            self._take(index, outcome)

    @contextmanager
    def _halted_by_errors(self) -> Iterator[None]:
        """Stop all rigs after an exception, above all after Ctrl-C."""
        try:
            yield
        except BaseException:
            self._stop_all()
            raise

    def _take(self, index: int, outcome: Outcome) -> None:
        self.statuses[index] = note(self._counts[index], outcome.status)
        self._failures[index] = outcome.reason
        self._is_ready[index] = outcome.values is not None
        self._ages[index] = self._now() - outcome.sample_time
        if outcome.values is not None:
            self.outputs[:, index] = outcome.values

    def step_own(self) -> int:
        """See ``Pool.step_own``."""
        self.step()
        return int(np.count_nonzero(self.statuses > WARNING_CODE))

    def save_instances(self, indices: IndexArray) -> Bundle:
        """Refuse: a real system cannot return to a state."""
        if self._is_real:
            raise SimulationError("a backend has no states that could be saved")
        raise SimulationError(needs_engine("a saved state"))

    def failure(self, index: int) -> str:
        """See ``Pool.failure``."""
        return self._failures[index]

    def read(self, variables: tuple[Variable, ...]) -> FloatArray:
        """See ``Pool.read``; only the outputs of the last step can be read."""
        names = [variable.name for variable in self._spec.outputs]
        for variable in variables:
            if variable.name not in names:
                raise SimulationError(
                    f"{variable.name!r} cannot be read from a backend: it is neither an output nor "
                    "monitored"
                )
        return self.outputs[[names.index(variable.name) for variable in variables]]

    def close(self) -> None:
        """See ``Pool.close``; backends are stopped."""
        self._is_ready[:] = False
        self._close()

    def _require_open(self) -> None:
        if not self._close.alive:
            raise SimulationError("the pool is closed")

    # Abilities of a pool of real systems.

    def info(self) -> dict[str, npt.NDArray[Any]]:
        """Return the timing of paced steps, each array of shape (N,); nothing for other steps."""
        if self._schedule is None:
            return {}
        return {
            "sample_age": self._ages.copy(),
            "deadline_misses": self._schedule.misses.copy(),
            "worst_lateness": self._schedule.worst.copy(),
        }

    def halt(self) -> None:
        """Stop all rigs, whatever they do; the next reset starts them again."""
        if self._is_real:
            self._stop_all()

    def _stop_all(self) -> None:
        self._is_ready[:] = False
        _stop(*self._all)


def _no_time() -> float:
    return math.nan


def _nothing() -> None:
    """Stands in for ``open`` and ``close`` where the backends share nothing."""


def _makes_backends(backend: Any) -> bool:
    return callable(backend) and not has_method(backend, "step")


def _backends(backend: Any, count: int) -> list[Backend]:
    if _makes_backends(backend):
        backend = backend(count)
    several = isinstance(backend, Iterable) and not has_method(backend, "step")
    try:
        backends = list(backend) if several else [backend]
    except Exception:  # an iterable whose own methods fail
        backends = [backend]
    for one in backends:
        for method in ("reset", "step", "stop"):
            if not has_method(one, method):
                raise ConfigError(
                    "a backend needs the methods reset, step and stop; "
                    f"{shown(one)} has no {method}"
                )
    if len(backends) != count:
        raise ConfigError(
            f"{count} backends are needed, got {len(backends)}: give a sequence, or a function of "
            "their number that returns one"
        )
    return backends


def _stop(
    rigs: Sequence[Rig],
    threads: Sequence[Here | Worker],
    clock: Clock | None,
    close: Callable[[], None],
) -> None:
    """Stop rigs, each after its current call, and close their shared parts."""
    calls = [(thread, Rig.stop, rig) for rig, thread in zip(rigs, threads, strict=True)]
    try:
        ask_all(calls, clock, _LONGEST_STOP)
        close()
    except TimeoutError:
        logger.warning("a backend has not come to its stop within %g s", _LONGEST_STOP)
    except Exception as error:
        logger.warning("closing what the backends share failed: %s", error)


def _close(
    fmu: FMU,
    rigs: Sequence[Rig],
    threads: Sequence[Here | Worker],
    clock: Clock | None,
    close: Callable[[], None],
) -> None:
    try:
        _stop(rigs, threads, clock, close)
    finally:
        for thread in threads:
            thread.end(_LONGEST_STOP)
        fmu.close()
