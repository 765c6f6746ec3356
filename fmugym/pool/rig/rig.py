"""Rig in the place of one FMU instance: its methods, and the calls of them."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

from fmugym.errors import SimulationError
from fmugym.fmi.status import Status
from fmugym.pool.pool_spec import PoolSpec

__all__ = ["Backend", "FaultError", "Outcome", "Outputs", "Rig", "describe_error"]

logger = logging.getLogger(__name__)

Outputs = Mapping[str, float] | Sequence[float] | npt.NDArray[Any]
"""The outputs and monitored variables, by name or in the order of the config."""


class Backend(Protocol):
    """Rig in the place of one FMU instance.

    A method that fails raises an exception. The step then fails like that of an FMU, with the
    exception's text as the reason, and no step follows before the next reset.

    A backend may offer more:

    * ``hold()`` takes the safe action and keeps the session alive. It is called after a fault, and
      by `Paced` while nobody steps. After its construction, a backend with this method is only
      called by a thread of its own.
    * ``sample_time`` is the time at which the newest outputs were measured, in s of the clock of
      `Paced`. Without it, the time of the call counts.
    * ``samples_outputs`` is True if its outputs are already what the ``samplings`` of the config
      ask for, such as means over a step. A backend without it refuses a config that has some.
    """

    def reset(self, start_values: Mapping[str, Any]) -> Outputs:
        """Start an episode.

        Args:
            start_values: The parameters of the config and of the options of ``reset``, by name.
                A backend that cannot set one should raise an exception.

        Returns:
            The outputs.
        """
        ...

    def step(self, inputs: Mapping[str, float]) -> tuple[Outputs, int]:
        """Apply inputs and read outputs.

        Args:
            inputs: The inputs by name, in the order of the config.

        Returns:
            The outputs, and a ``fmugym.fmi.Status``: ``Status.OK`` (0), or for example
            ``Status.TERMINATED`` if the episode should end.
        """
        ...

    def stop(self) -> None:
        """Come to a safe rest and end the session; ``reset`` may start another one.

        It is called after every reset, also after a failed one, an exception or Ctrl-C; at the
        latest when the interpreter exits.
        """
        ...


class FaultError(SimulationError):
    """Fault of a backend, with its status.

    Args:
        text: The reason.
        status: A ``fmugym.fmi.Status`` worse than a warning.
    """

    def __init__(self, text: str, status: int = Status.ERROR) -> None:
        super().__init__(text)
        self.status = status


class Outcome(NamedTuple):
    """The result of a call.

    Attributes:
        status: A ``fmugym.fmi.Status``.
        values: The outputs if they are valid.
        reason: Why the call failed, or "".
        sample_time: When the outputs were measured, in s of the clock; NaN if this is unknown.
    """

    status: int
    values: list[float] | None = None
    reason: str = ""
    sample_time: float = math.nan


class Rig:
    """Calls a backend, and stops it when its session has to end.

    No method lets an ``Exception`` through, apart from the constructor.

    Args:
        backend: The backend.
        spec: Has the names of inputs and outputs.
        now: Returns the time, in s of the clock.
    """

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

    def reset(self, start_values: Mapping[str, Any]) -> Outcome:
        """Start an episode; if this fails, stop the backend."""
        self._is_running = True
        outcome = self._try("reset", lambda: (self._backend.reset(start_values), Status.OK))
        if outcome.values is None:
            self.stop()
        return outcome

    def step(self, inputs: Sequence[float]) -> Outcome:
        """Do one step; if it fails, take the safe action, or stop if there is none."""
        named = dict(zip(self._input_names, inputs, strict=True))
        outcome = self._try("step", lambda: self._backend.step(named))
        if outcome.values is None:
            (self.hold if self.can_hold else self.stop)()
        return outcome

    def hold(self) -> None:
        """Take the safe action if an episode runs; a failure shows in the next step."""
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

    def _try(self, method: str, call: Callable[[], Any]) -> Outcome:
        called_at = self._now()
        try:
            outputs, status = _pair(call())
            outcome = self._judged(outputs, status)
            measured = float(getattr(self._backend, "sample_time", called_at))
        except Exception as error:
            status = error.status if isinstance(error, FaultError) else Status.ERROR
            outcome, measured = Outcome(status, None, describe_error(error)), called_at
        if outcome.reason:
            name = f"{type(self._backend).__name__}.{method}"
            outcome = outcome._replace(reason=f"{name}: {outcome.reason}")
        return outcome._replace(sample_time=measured)

    def _judged(self, outputs: Any, status: int) -> Outcome:
        if status not in (Status.OK, Status.WARNING, Status.TERMINATED):
            return Outcome(status, None, f"it returned the status {Status(status).name}")
        values = self._values(outputs)
        bad = [
            f"{name} = {value}"
            for name, value in zip(self._output_names, values, strict=True)
            if not math.isfinite(value)
        ]
        if bad:
            reason = f"the outputs are not finite: {', '.join(bad)}"
            return Outcome(Status.NOT_FINITE, None, reason)
        return Outcome(status, values)

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


def describe_error(error: Exception) -> str:
    """The text of an exception; its type comes first unless it is a ``SimulationError``."""
    return f"{error}" if isinstance(error, SimulationError) else f"{type(error).__name__}: {error}"
