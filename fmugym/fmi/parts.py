"""The components of a system: their instances, the slots of their values, and what routes carry."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from fmugym.archive.variable import Variable
from fmugym.errors import SimulationError
from fmugym.fmi.access import Access
from fmugym.fmi.instance import Instance, SavedState
from fmugym.fmi.status import Phase, Status, sane
from fmugym.systems.layout import Layout, PartLayout, Route

__all__ = ["FailedError", "Memory", "Part", "Parts", "carried", "scaled", "shared_out"]

_GOOD: Final = (Status.OK, Status.WARNING)


class FailedError(Exception):
    """A call of a component returned a status worse than a warning."""

    def __init__(self, status: int, who: str) -> None:
        super().__init__(status)
        self.status, self.who = status, who


def scaled(gain: float, offset: float, value: float) -> float:
    """Apply a gain and an offset; a gain of 1 and an offset of 0 keep the very bits."""
    return value if gain == 1.0 and offset == 0.0 else gain * value + offset


def carried(source: Part, route: Route, values: Iterable[float]) -> list[float]:
    """What a route carries. Values that are not finite must not reach other FMUs.

    Raises:
        FailedError: If one of them is not finite.
    """
    carried = []
    for value in values:
        if not math.isfinite(value):
            raise FailedError(Status.NOT_FINITE, f"{source.label}, whose outputs are not finite")
        carried.append(scaled(route.gain, route.offset, value))
    return carried


def shared_out(routes: Iterable[Route], values: Sequence[float]) -> Iterator[Any]:
    """Each route with its part of the values of all."""
    first = 0
    for route in routes:
        yield route, values[first : first + route.count]
        first += route.count


class Part:
    """The instance of one component.

    Args:
        layout: Its slots.
        instance: Of its FMU.
    """

    def __init__(self, layout: PartLayout, instance: Instance) -> None:
        self.layout, self.instance = layout, instance
        self.label = layout.label
        self.inputs = Access(instance, layout.inputs)
        self.outputs = Access(instance, layout.outputs)
        self.started = False
        self.forget()

    def renew(self, instance: Instance) -> None:
        """Go on with another instance."""
        self.instance, self.started = instance, False
        self.inputs = Access(instance, self.layout.inputs, self.inputs.values)
        self.outputs = Access(instance, self.layout.outputs, self.outputs.values)

    def forget(self) -> None:
        """Return the slots to the start values."""
        self.inputs.values[:] = self.layout.starts_of(self.layout.inputs)
        self.outputs.values[:] = 0.0

    def judge(self, status: int) -> None:
        """Raise for a bad status of a call.

        Raises:
            FailedError: With the name of the component.
        """
        status = self.instance.judge(sane(status))
        if status not in _GOOD:
            raise FailedError(status, self.label)

    def get(self, variables: Sequence[Variable]) -> list[float]:
        """Get a scalar, or some elements of an array."""
        access = Access(self.instance, variables)
        self.judge(access.get())
        return list(map(float, access.values))

    def set(self, variables: Sequence[Variable], values: Iterable[float]) -> None:
        """Set a scalar, or all elements of an array, or several of both."""
        access = Access(self.instance, variables, np.array(list(values), float))
        self.judge(access.set())

    def read(self) -> None:
        """Fill the slots of the outputs."""
        self.judge(self.outputs.get())

    def advance(self, time: float, step: float) -> bool:
        """Do the communication steps; returns whether the FMU has asked to stop."""
        count = self.layout.component.steps
        size = step / count
        for index in range(count):
            status = self.instance.step(time + index * size, size)
            if status == Status.TERMINATED:
                return True
            self.judge(status)
        return False


@dataclass(frozen=True, eq=False)
class Memory:
    """What a system adds to a saved state: the slots of all parts, and the states of the parts."""

    inputs: bytes
    outputs: bytes
    fresh: bool
    states: tuple[SavedState, ...]


class Parts:
    """The components of a system, and what moves between them.

    Args:
        layout: The slots and routes.
        instances: Those of the components, in their order.
        statistics: The numbers that a control of the step size gives; None without one.

    Attributes:
        all: The components, in their order.
        fresh: Whether the slots of the outputs are up to date.
    """

    def __init__(
        self,
        layout: Layout,
        instances: Iterable[Instance],
        statistics: npt.NDArray[np.float64] | None,
    ) -> None:
        self.layout, self.statistics = layout, statistics
        pairs = zip(layout.parts, instances, strict=True)
        self.all = [Part(part, instance) for part, instance in pairs]
        self.fresh = False

    def forget(self) -> None:
        """Return all slots to the start values."""
        if self.statistics is not None:
            self.statistics[:] = 0.0
        for part in self.all:
            part.forget()
        self.fresh = False

    def refresh(self) -> None:
        """Fill the slots of all outputs."""
        for part in self.all:
            part.read()
        self.fresh = True

    def carried(self, route: Route) -> list[float]:
        """What a route carries: that of the slots of its source."""
        part = self.all[route.source_part]
        first = route.source - part.layout.first_output
        return carried(part, route, part.outputs.values[first : first + route.count].tolist())

    def take(self, route: Route, values: Sequence[float]) -> None:
        """Put values into the slots of the target of a route."""
        part = self.all[route.target_part]
        first = route.target - part.layout.first_input
        part.inputs.values[first : first + route.count] = values

    def carry(self, route: Route) -> None:
        """Carry what is in the slots from the source of a route to its target."""
        self.take(route, self.carried(route))

    def carry_to(self, index: int) -> None:
        """Do so for all routes to a component."""
        for route in self.layout.routes:
            if route.target_part == index:
                self.carry(route)

    @contextmanager
    def blaming(self, index: int) -> Iterator[None]:
        """Raise ``FailedError`` with the name of a component if one of its calls fails."""
        try:
            yield
        except SimulationError:
            part = self.all[index]
            raise FailedError(self._status_of(part), part.label) from None

    def save(self, index: int) -> SavedState:
        """Save the state of a component.

        Raises:
            FailedError: If it cannot.
        """
        with self.blaming(index):
            return self.all[index].instance.save_state()

    def restore(self, index: int, state: SavedState) -> None:
        """Restore the state of a component.

        Raises:
            FailedError: If it cannot.
        """
        with self.blaming(index):
            self.all[index].instance.restore_state(state)

    def _status_of(self, part: Part) -> int:
        """The status of a component of which a call has failed."""
        return Status.FATAL if part.instance.phase is Phase.DEAD else Status.ERROR

    def slots(self) -> tuple[bytes, bytes]:
        """The slots of the inputs, and those of the outputs with the statistics."""
        statistics = b"" if self.statistics is None else self.statistics.tobytes()
        return (
            b"".join(part.inputs.values.tobytes() for part in self.all),
            b"".join(part.outputs.values.tobytes() for part in self.all) + statistics,
        )

    def put_slots(self, memory: Memory) -> None:
        """Fill all slots as they were."""
        self.put_inputs(memory.inputs)
        outputs = np.frombuffer(memory.outputs)
        for part in self.all:
            first = part.layout.first_output
            part.outputs.values[:] = outputs[first : first + len(part.layout.outputs)]
        if self.statistics is not None:
            self.statistics[:] = outputs[self.layout.first_statistic :]
        self.fresh = memory.fresh

    def put_inputs(self, data: bytes) -> None:
        """Fill the slots of the inputs."""
        inputs = np.frombuffer(data)
        for part in self.all:
            first = part.layout.first_input
            part.inputs.values[:] = inputs[first : first + len(part.layout.inputs)]
