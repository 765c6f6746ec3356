"""Pools of what stands in for FMU instances: rigs, cells of a lab, other simulators."""

from __future__ import annotations

import logging
import math
import weakref
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, Final, NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

from fmugym.archive.description import Variable
from fmugym.archive.fmu import FMU
from fmugym.checks import has_method
from fmugym.errors import ConfigError, SimulationError, shown
from fmugym.fmi.status import Status
from fmugym.pool.backend.clock import Clock
from fmugym.pool.backend.pacing import Paced, Schedule
from fmugym.pool.backend.threads import Here, Idle, Worker, ask_all
from fmugym.pool.base import FloatArray, MaskArray, PoolSpec, StatusArray
from fmugym.pool.health import Column, CountedPool, no_counts, note

__all__ = ["Backend", "BackendPool", "Outputs"]

logger = logging.getLogger(__name__)

Outputs = Mapping[str, float] | Sequence[float] | npt.NDArray[Any]
"""The outputs (and monitored variables) by name, or in the order of the config."""

_LONGEST_STOP: Final = 10.0
"""How long a stop is waited for, in s; it goes on in its thread after that."""


class Backend(Protocol):
    """What stands in for one FMU instance.

    What fails is raised: the step then fails as that of an FMU does, with the exception's text for
    a reason, and no step follows before the next reset.

    A backend may have two things more. ``hold()`` takes the safe action and lets the session live
    on; it is called after a fault, and by `Paced` while nobody steps. A backend with it is only
    called by a thread of its own, after construction. ``sample_time`` is the time at which the
    newest outputs were measured, in s of the clock of `Paced`; without it they are taken to be of
    the time of the call.
    """

    def reset(self, start_values: Mapping[str, Any]) -> Outputs:
        """Start an episode.

        Args:
            start_values: The parameters of the config and of the options of ``reset``, by name;
                a backend that cannot set one should raise.

        Returns:
            The outputs.
        """
        ...

    def step(self, inputs: Mapping[str, float]) -> tuple[Outputs, int]:
        """Apply inputs and read outputs.

        Args:
            inputs: The inputs by name, in the order of the config.

        Returns:
            The outputs, and a ``fmugym.Status``: ``Status.OK`` (0), or for example
            ``Status.TERMINATED`` where the backend wants the episode to end.
        """
        ...

    def stop(self) -> None:
        """Come to a safe rest and end the session; ``reset`` may start another one.

        It follows every reset, at the latest when the interpreter exits: also one that failed, and
        also after exceptions and Ctrl-C.
        """
        ...


class _Outcome(NamedTuple):
    """What a call gave.

    Attributes:
        status: How it went.
        values: The outputs where they are valid.
        reason: Why it failed, or "".
        sample_time: When the outputs were measured, in s of the clock; NaN if that is not known.
    """

    status: int
    values: list[float] | None = None
    reason: str = ""
    sample_time: float = math.nan


class _Rig:
    """A backend, and what must be known to stop it. Its methods raise no Exception."""

    def __init__(self, backend: Backend, spec: PoolSpec, now: Callable[[], float]) -> None:
        self._backend, self._now = backend, now
        self._hold: Callable[[], None] | None = getattr(backend, "hold", None)
        self._input_names = [variable.name for variable in spec.inputs]
        self._output_names = [variable.name for variable in spec.outputs]
        self._is_running = False

    @property
    def can_hold(self) -> bool:
        """Whether the backend has a safe action."""
        return self._hold is not None

    def reset(self, start_values: Mapping[str, Any]) -> _Outcome:
        """Start an episode; a start that fails is stopped."""
        self._is_running = True
        outcome = self._try("reset", lambda: (self._backend.reset(start_values), Status.OK))
        if outcome.values is None:
            self.stop()
        return outcome

    def step(self, inputs: Sequence[float]) -> _Outcome:
        """Do one step; a step that fails is followed by the safe action, or else by a stop."""
        named = dict(zip(self._input_names, inputs, strict=True))
        outcome = self._try("step", lambda: self._backend.step(named))
        if outcome.values is None:
            (self.hold if self.can_hold else self.stop)()
        return outcome

    def hold(self) -> None:
        """Take the safe action, if an episode runs; the next step tells if that failed."""
        if self._is_running and self._hold is not None:
            try:
                self._hold()
            except Exception as error:
                logger.debug("%s.hold failed: %s", type(self._backend).__name__, error)

    def stop(self) -> None:
        """End the session, if there is one."""
        if self._is_running:
            self._is_running = False
            try:
                self._backend.stop()
            except Exception as error:
                logger.warning("%s.stop failed: %s", type(self._backend).__name__, error)

    def _try(self, method: str, call: Callable[[], Any]) -> _Outcome:
        called_at = self._now()
        try:
            outputs, status = _pair(call())
            outcome = self._judged(outputs, status)
            measured = float(getattr(self._backend, "sample_time", called_at))
        except Exception as error:
            outcome, measured = _Outcome(Status.ERROR, None, _text(error)), called_at
        if outcome.reason:
            name = f"{type(self._backend).__name__}.{method}"
            outcome = outcome._replace(reason=f"{name}: {outcome.reason}")
        return outcome._replace(sample_time=measured)

    def _judged(self, outputs: Any, status: int) -> _Outcome:
        if status not in (Status.OK, Status.WARNING, Status.TERMINATED):
            return _Outcome(status, None, f"it returned the status {Status(status).name}")
        values = self._values(outputs)
        bad = [
            f"{name} = {value}"
            for name, value in zip(self._output_names, values, strict=True)
            if not math.isfinite(value)
        ]
        if bad:
            reason = f"the outputs are not finite: {', '.join(bad)}"
            return _Outcome(Status.NOT_FINITE, None, reason)
        return _Outcome(status, values)

    def _values(self, outputs: Any) -> list[float]:
        names = self._output_names
        if isinstance(outputs, Mapping):
            missing = [name for name in names if name not in outputs]
            if missing:
                raise SimulationError(f"the outputs lack {', '.join(map(repr, missing))}")
            outputs = [outputs[name] for name in names]
        values: list[float] = np.ravel(np.asarray(outputs, np.float64)).tolist()
        if len(values) != len(names):
            raise SimulationError(
                f"there are {len(values)} outputs, expected {len(names)} ({', '.join(names)})"
            )
        return values


def _pair(result: Any) -> tuple[Any, int]:
    if not isinstance(result, tuple) or len(result) != 2:
        raise SimulationError(f"it returned {result!r}, expected outputs and a status")
    return result[0], Status(result[1])


def _text(error: Exception) -> str:
    return f"{error}" if isinstance(error, SimulationError) else f"{type(error).__name__}: {error}"


class BackendPool(CountedPool):
    """N backends in the place of N FMU instances, stepped at the same time.

    See ``Pool`` for the contract, apart from states: a backend has none to be saved. The FMU says
    what the variables are; its code is not loaded. Several backends, and those with a ``hold``,
    have a thread each.

    Args:
        fmu: The FMU; closed with the pool.
        spec: What to do at each reset and step; substeps are the backend's own affair.
        num_instances: N.
        backend: A ``Backend``, a sequence of N, or a function of N that returns such a sequence;
            or a `Paced` one. The function may have the methods ``open`` and ``close``, for what the
            backends share: they are called before each reset and after all have stopped.

    Raises:
        ConfigError: If that is none, or the number is not N.
    """

    def __init__(self, fmu: FMU, spec: PoolSpec, num_instances: int, backend: Any) -> None:
        self.num_instances = num_instances
        self._spec = spec
        self.inputs: FloatArray = np.zeros((len(spec.inputs), num_instances))
        self.outputs: FloatArray = np.zeros((len(spec.outputs), num_instances))
        self.statuses: StatusArray = np.zeros(num_instances, np.int8)
        self.observations = np.zeros((num_instances, spec.num_observed), np.float32)
        self._failures = [""] * num_instances
        self._counts = no_counts(num_instances)
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
        self._schedule = None
        if paced is not None:
            self._schedule = Schedule(spec.time_step, paced.clock, count)
        self._rigs = [_Rig(one, spec, self._now) for one in _backends(backend, count)]
        self._threads = [self._thread(index, rig) for index, rig in enumerate(self._rigs)]
        shared = backend if _makes_backends(backend) else None
        self._open = getattr(shared, "open", _nothing)
        self._all = self._rigs, self._threads, self._clock, getattr(shared, "close", _nothing)

    def _thread(self, index: int, rig: _Rig) -> Here | Worker:
        if self.num_instances == 1 and not rig.can_hold:
            return Here()
        paced, name = self._paced, f"backend-{index}"
        if paced is None:
            return Worker(name)
        patience = paced.patience(self._spec.time_step)
        return Worker(name, paced.clock, Idle(rig.hold, patience))

    @property
    def is_real(self) -> bool:
        """See ``Pool.is_real``; a rig may move at every step."""
        return True

    # The contract of Pool.

    def reset(
        self, variables: tuple[Variable, ...], values: FloatArray, mask: MaskArray | None = None
    ) -> tuple[FloatArray, StatusArray]:
        """See ``Pool.reset``."""
        self._require_open()
        chosen = np.ones(self.num_instances, np.bool_) if mask is None else np.asarray(mask)
        names = [variable.name for variable in variables]
        strings = {variable.name: text for variable, text in self._spec.strings}
        starts = {
            index: dict(zip(names, values[:, index].tolist(), strict=True)) | strings
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
                self._take(index, _Outcome(Status.ERROR, None, _text(error)))
        else:
            self._ask("reset", starts)

    def _stop_at_exit(self) -> None:
        """At the interpreter's exit, come before the finalizers of what the backends have made."""
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
            self._advance(chosen & self._is_ready)

    def step(
        self,
        inputs: FloatArray | None = None,
        skip: MaskArray | None = None,
        observations: npt.NDArray[np.float32] | None = None,
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
        if observations is not None:
            np.copyto(observations, self.outputs[: self._spec.num_observed].T, casting="same_kind")
        return self.outputs, self.statuses

    def _advance(self, chosen: MaskArray) -> None:
        if not chosen.any():
            return
        if self._schedule is not None:
            self._schedule.wait(chosen)
        inputs = self.inputs.T.tolist()
        self._ask("step", {index: inputs[index] for index in np.flatnonzero(chosen).tolist()})

    def _ask(self, method: str, arguments: Mapping[int, Any]) -> None:
        """Call a method of some rigs at the same time, and take over what it gives."""
        self._counts[list(arguments), Column.RESETS if method == "reset" else Column.STEPS] += 1
        calls = [
            (self._threads[index], getattr(self._rigs[index], method), argument)
            for index, argument in arguments.items()
        ]
        for index, outcome in zip(arguments, ask_all(calls, self._clock), strict=True):
            self._take(index, outcome)

    @contextmanager
    def _halted_by_errors(self) -> Iterator[None]:
        """Let nothing go on after an exception, Ctrl-C above all."""
        try:
            yield
        except BaseException:
            self.halt()
            raise

    def _take(self, index: int, outcome: _Outcome) -> None:
        self.statuses[index] = note(self._counts[index], outcome.status)
        self._failures[index] = outcome.reason
        self._is_ready[index] = outcome.values is not None
        self._ages[index] = self._now() - outcome.sample_time
        if outcome.values is not None:
            self.outputs[:, index] = outcome.values

    def step_own(self) -> int:
        """See ``Pool.step_own``."""
        self.step(None, None, self.observations)
        return int(np.count_nonzero(self.statuses > Status.WARNING))

    def save(self) -> Any:
        """Refuse: what is real cannot be put back."""
        raise SimulationError("a backend has no state that could be saved")

    def restore(
        self, snapshot: Any, mask: MaskArray | None = None
    ) -> tuple[FloatArray, StatusArray]:
        """Refuse: what is real cannot be put back."""
        raise SimulationError("a backend has no state that could be restored")

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

    # What is different where something is real.

    def info(self) -> dict[str, npt.NDArray[Any]]:
        """What paced steps tell of their time, each of shape (N,); nothing of others."""
        if self._schedule is None:
            return {}
        return {
            "sample_age": self._ages.copy(),
            "deadline_misses": self._schedule.misses.copy(),
            "worst_lateness": self._schedule.worst.copy(),
        }

    def halt(self) -> None:
        """Stop all backends, whatever they are doing; the next reset starts them again."""
        self._is_ready[:] = False
        _stop(*self._all)


def _no_time() -> float:
    return math.nan


def _nothing() -> None:
    """What backends that share nothing open and close."""


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
    rigs: Sequence[_Rig],
    threads: Sequence[Here | Worker],
    clock: Clock | None,
    close: Callable[[], None],
) -> None:
    """Stop rigs, each after what it is doing now, and close what they share."""
    calls = [(thread, _Rig.stop, rig) for rig, thread in zip(rigs, threads, strict=True)]
    try:
        ask_all(calls, clock, _LONGEST_STOP)
        close()
    except TimeoutError:
        logger.warning("a backend has not come to its stop within %g s", _LONGEST_STOP)
    except Exception as error:
        logger.warning("closing what the backends share failed: %s", error)


def _close(
    fmu: FMU,
    rigs: Sequence[_Rig],
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
