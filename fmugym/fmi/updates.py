"""The intermediate update mode of FMI 3.0: what an FMU asks for and tells within a step.

This does what ``native/updates.c`` does, operation by operation.
"""

from __future__ import annotations

import sys
import threading
from collections.abc import Callable, Sequence
from typing import Any, Final, Protocol, Self

import numpy as np
import numpy.typing as npt
from fmpy.fmi3 import fmi3IntermediateUpdateCallback

from fmugym.archive.variable import Variable
from fmugym.fmi.clocks import CallError
from fmugym.fmi.log import catching
from fmugym.fmi.status import Status

__all__ = ["Course", "Outputs", "Updates", "decline"]

_EPSILON: Final = sys.float_info.epsilon


def decline(time: float, requested: Any, early_return_time: Any) -> None:
    """Ask for no early return in an update.

    Args:
        time: That of the update.
        requested: Points to whether an early return is asked for; FMUs may leave it out.
        early_return_time: Points to its time; FMUs may leave it out.
    """
    if requested:
        requested[0] = False
    if early_return_time:
        early_return_time[0] = time


class Outputs(Protocol):
    """What ``fmugym.fmi.access.Access`` is, which needs instances."""

    values: npt.NDArray[np.float64]

    def get(self) -> int:
        """Read the values; return the status."""


class Course:
    """What is collected of one output from the beginning of a substep.

    Attributes:
        last, low, high: The latest, the least and the greatest value.
        area: Below straight lines through the points; before the first one its value holds.
    """

    def __init__(self, duration: float, value: float) -> None:
        self.last = self.low = self.high = value
        self.area = duration * value

    def extend(self, duration: float, value: float) -> None:
        """Add a point this many seconds after the last one."""
        self.area += duration * (0.5 * (self.last + value))
        self.low = self.low if self.low <= value else value
        self.high = self.high if self.high >= value else value
        self.last = value

    def result(self, sampling: str, duration: float) -> float:
        """What the substep of this length gives; an integral counts as a mean."""
        match sampling:
            case "min":
                return self.low
            case "max":
                return self.high
        return self.area / duration if duration > 0.0 else self.last


class Updates:
    """The intermediate updates of one instance.

    Args:
        variables: The outputs that it tells.
        inputs: The value references of the inputs that it gets.
        environment: That of the instance, with which the FMU calls back.
        complain: Logs why an update fails.

    Attributes:
        callback: The function that the FMU calls.
        references: What the FMU is told at its instantiation.
        access: The outputs, once the instance is there.
        set_inputs: Sets the inputs at a time, and returns the status.
        moves: Whether any input changes in this step.
    """

    access: Outputs
    set_inputs: Callable[[float], int]
    moves: Callable[[], bool]

    def __init__(
        self,
        variables: Sequence[Variable],
        inputs: Sequence[int],
        environment: int,
        complain: Callable[[str], None],
    ) -> None:
        watched = (variable.value_reference for variable in variables)
        self.references = tuple(dict.fromkeys((*inputs, *watched)))
        self.callback = fmi3IntermediateUpdateCallback(catching(self._answer))
        self._environment = environment
        self.variables, self._has_inputs, self._complain = variables, bool(inputs), complain
        self._begin = self._end = self._least = self._first = self._last = 0.0
        self._thread = 0
        self._asked = self._busy = self._strayed = self._collects = False
        self._status: int = Status.OK
        self._courses: list[Course] = []

    # Outputs.

    def clear(self) -> None:
        """Begin anew to collect outputs."""
        self._collects, self._courses = False, []

    def summarize(
        self, places: Sequence[int], samplings: Sequence[str], row: npt.NDArray[np.float64]
    ) -> None:
        """Replace the values at the end of a substep by what the substep gives.

        Args:
            places: Those of the outputs that the FMU tells.
            samplings: One for each value of the row.
            row: All outputs.
        """
        if self._courses:
            self._add(self._end, [float(row[place]) for place in places])
            duration = self._end - self._first
            for place, course in zip(places, self._courses, strict=True):
                row[place] = course.result(samplings[place], duration)
        self.clear()

    def _add(self, time: float, values: Sequence[float]) -> None:
        if self._courses:
            for course, value in zip(self._courses, values, strict=True):
                course.extend(time - self._last, value)
        else:
            self._courses = [Course(time - self._first, value) for value in values]
        self._last = time

    # Updates.

    def _answer(self, *arguments: Any) -> None:
        environment, time, set_requested, get_allowed, finished, _, requested, early_return_time = (
            arguments
        )
        decline(time, requested, early_return_time)
        if environment != self._environment or self._thread != threading.get_ident():
            self._strayed = True
            return
        if self._busy or self._status > Status.WARNING:
            return
        self._busy = True
        try:
            self._status = self._exchange(time, set_requested, get_allowed, finished)
        except CallError as failure:
            self._complain(failure.reason)
            fatal = failure.status == Status.FATAL
            self._status = Status.FATAL if fatal else Status.ERROR
        finally:
            self._busy = False

    def _exchange(self, time: float, set_requested: bool, get_allowed: bool, finished: bool) -> int:
        time, status = self._checked(time), int(Status.OK)
        if set_requested and self._has_inputs:
            self._asked = True
            status = _judged("setting inputs", time, self.set_inputs(time))
        if get_allowed and finished and self.variables:
            status = _judged("reading outputs", time, self.access.get())
            self._add(time, self.access.values.tolist())
        if finished:
            self._least = time
        return status

    def _checked(self, time: float) -> float:
        """The time of an update between the beginning and the end of the step."""
        rounding = 16.0 * _EPSILON * max(abs(self._begin), abs(self._end))
        if not self._begin - rounding <= time <= self._end + rounding:
            raise CallError(
                Status.ERROR,
                f"the FMU made an intermediate update at t = {time:.17g} s in a step from "
                f"t = {self._begin:.17g} s to {self._end:.17g} s",
            )
        if time < self._least - rounding:
            raise CallError(
                Status.ERROR,
                f"the FMU made an intermediate update at t = {time:.17g} s after it had finished "
                f"a step to t = {self._least:.17g} s",
            )
        return min(max(time, self._least), self._end)

    # Steps.

    def __enter__(self) -> Self:
        """Begin a step of the FMU; ``begin`` has told of it."""
        self._thread = threading.get_ident()
        return self

    def __exit__(self, *_: object) -> None:
        """End it."""
        self._thread = 0

    def begin(self, time: float, size: float) -> Self:
        """Tell of a step of the FMU, which is to be done in a ``with`` statement of the result."""
        self._begin = self._least = time
        self._end = time + size
        self._asked = self._strayed = False
        self._status = Status.OK
        if not self._collects:
            self._collects, self._first = True, time
        return self

    def judge(self, status: int) -> int:
        """Judge the step that has ended: return the worse of its status and those of updates."""
        step = f"in its step from t = {self._begin:.17g} s"
        if self._strayed and self._status <= Status.WARNING:
            self._fail(
                "the FMU made an intermediate update in another thread, or for another instance, "
                f"{step}"
            )
        is_good = status <= Status.WARNING and self._status <= Status.WARNING
        if is_good and self._has_inputs and not self._asked and self.moves():
            self._fail(
                f"the FMU asked for no inputs {step} to {self._end:.17g} s, so that none can be "
                "linear"
            )
        return status if status == Status.FATAL or self._status <= Status.WARNING else self._status

    def _fail(self, text: str) -> None:
        self._complain(text)
        self._status = Status.ERROR


def _judged(doing: str, time: float, status: int) -> int:
    """Refuse a bad status. FMI allows no Discard here; nothing could be tried again."""
    if not 0 <= status <= Status.WARNING:
        text = f"the FMU failed at {doing} in its intermediate update at t = {time:.17g} s"
        raise CallError(status, text)
    return status
