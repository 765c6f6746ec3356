"""The initialization of a system: its components are initialized one inside of the other.

``native/system_start.c`` and ``native/system_reset.c`` do the same.
"""

from __future__ import annotations

import functools
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, Final

import numpy as np

from fmugym.errors import SimulationError
from fmugym.fmi.kept import KeptStart
from fmugym.fmi.loops import NotSolvedError, solve_loop
from fmugym.fmi.parts import FailedError, Part, Parts, carried, shared_out
from fmugym.fmi.span import Span
from fmugym.fmi.status import Status
from fmugym.systems.description import PartVariable
from fmugym.systems.layout import Route, array_key
from fmugym.systems.plan import Evaluation

__all__ = ["Initialization"]


_FRAMES: Final = 20
"""Calls of Python by which a component is initialized inside of another, and some more."""


@contextmanager
def _nesting(parts: int) -> Iterator[None]:
    """Let Python call itself as deep as so many components need."""
    limit = sys.getrecursionlimit()
    sys.setrecursionlimit(limit + _FRAMES * parts)
    try:
        yield
    finally:
        sys.setrecursionlimit(limit)


class Initialization:
    """Initializes the components of a system.

    Args:
        parts: The components.
        resets: How each begins an episode, see ``SystemInstance``.
        reset_part: Resets a component, given its number.

    Attributes:
        kept: The start to which some of them return.
        pending: What is set before the initialization; None at other times.
    """

    def __init__(
        self, parts: Parts, resets: Sequence[str], reset_part: Callable[[int], None]
    ) -> None:
        self._parts, self._layout = parts, parts.layout
        self._resets, self._reset_part = resets, reset_part
        self.kept = KeptStart()
        self.pending: list[tuple[PartVariable, float | str]] | None = None

    def run(self, span: Span, set_start_values: Callable[[], None]) -> None:
        """Initialize all components.

        Args:
            span: The times and the tolerance.
            set_start_values: Puts what is set into ``pending``.

        Raises:
            FailedError: If one fails.
        """
        values = self._collected(set_start_values)
        key = KeptStart.key_of(span.start_time, values)
        if self.kept.known and key == self.kept.key:
            if self._begin_again(span, values):
                return
            self._give_up()
            values = self._collected(set_start_values)
        self._begin_all(span, values)
        if self.kept.next(key) and not self._keep_states():
            self._give_up()
            self._begin_all(span, self._collected(set_start_values))

    def _collected(self, set_start_values: Callable[[], None]) -> list[Any]:
        self._parts.forget()
        self.pending = []
        try:
            set_start_values()
            return self.pending
        finally:
            self.pending = None

    def _begin_all(self, span: Span, values: list[Any]) -> None:
        self.kept.forget()
        for index in self._restoring:
            with self._restoring_part(index):
                self._reset_part(index)
        with _nesting(len(self._parts.all)):
            self._begin_from(0, span, values)
        self._parts.refresh()

    # Some components return to the kept start. The others begin with the inputs that are kept.

    @property
    def _restoring(self) -> list[int]:
        pairs = enumerate(self._resets)
        return [i for i, method in pairs if method == "restore" and i not in self.kept.useless]

    @property
    def others(self) -> list[int]:
        """The components that do not return to the kept start, by their numbers."""
        restoring = set(self._restoring)
        return [index for index in range(len(self._parts.all)) if index not in restoring]

    def _begin_again(self, span: Span, values: list[Any]) -> bool:
        """Return to the kept start; False if that failed or led elsewhere."""
        others = self.others
        try:
            self._restore_start()
            self._begin_others(others, span, values)
        except (FailedError, SimulationError):
            return False
        return not self._blame_different()

    def _blame_different(self) -> bool:
        """Restore those no more whose outputs differ from the kept ones; False if none differ."""
        now, then = (np.frombuffer(slots) for slots in (self._parts.slots()[1], self.kept.slots[1]))
        if now.tobytes() == then.tobytes():
            return False
        found = []
        for index in self._restoring:
            part = self._parts.all[index].layout
            place = slice(part.first_output, part.first_output + len(part.outputs))
            if now[place].tobytes() != then[place].tobytes():
                found.append(index)
        self.kept.useless.update(found or range(len(self._parts.all)))
        return True

    def _restore_start(self) -> None:
        for index in self._restoring:
            with self._restoring_part(index):
                self._parts.restore(index, self.kept.states[index])
        self.kept.stepped = False
        self._parts.put_inputs(self.kept.slots[0])

    @contextmanager
    def _restoring_part(self, index: int) -> Iterator[None]:
        """Restore a component no more that fails in this."""
        try:
            yield
        except BaseException:
            self.kept.useless.add(index)
            raise

    def _begin_others(self, indices: Iterable[int], span: Span, values: list[Any]) -> None:
        for index in indices:
            self._begin(index, span, values, functools.partial(self._set_links, index))
        self._parts.refresh()

    def _set_links(self, index: int) -> None:
        part = self._parts.all[index]
        for route in (self._layout.routes[i] for i in self._layout.routes_into(index)):
            first = route.target - part.layout.first_input
            self._write_target(route, part.inputs.values[first : first + route.count].tolist())

    def _keep_states(self) -> bool:
        """Save the states of those that restore; False if one cannot."""
        try:
            for index in self._restoring:
                with self._restoring_part(index):
                    self.kept.states[index] = self._parts.save(index)
        except FailedError:
            return False
        self.kept.slots, self.kept.known = self._parts.slots(), True
        return True

    def _give_up(self) -> None:
        """Forget the kept start, and reset the components that do not restore."""
        self.kept.forget()
        for index in self.others:
            self._reset_part(index)

    def _begin_from(self, index: int, span: Span, values: list[Any]) -> None:
        """Begin with this part and all that follow, then exchange values."""
        while index < len(self._parts.all) and not self._parts.all[index].layout.has_mode:
            index += 1
        if index == len(self._parts.all):
            self._exchange_all(span, values)
        else:
            self._begin(index, span, values, lambda: self._begin_from(index + 1, span, values))

    def _begin(
        self, index: int, span: Span, values: list[Any], exchange: Callable[[], None] | None
    ) -> None:
        part = self._parts.all[index]
        part.started = True
        part.instance.exchange = exchange
        try:
            with self._parts.blaming(index):
                part.instance.initialize(*span, lambda: self._set_starts(index, values))
        finally:
            part.instance.exchange = None

    def _set_starts(self, index: int, values: list[Any]) -> None:
        """What is set for this simulation wins over what the system says."""
        part = self._parts.all[index]
        starts = part.layout.starts
        numbers = [(v, value) for v, value in starts if not isinstance(value, str)]
        part.set([v for v, _ in numbers], [value for _, value in numbers])
        for variable, value in starts:
            if isinstance(value, str):
                part.instance.set_string(variable, value)
        self._set_pending(part, [(end, value) for end, value in values if end.part == index])
        if not part.layout.has_mode:
            part.judge(part.inputs.set())

    def _set_pending(self, part: Part, values: list[tuple[PartVariable, Any]]) -> None:
        arrays: dict[Any, list[tuple[int, float]]] = {}
        for end, value in values:
            if end.variable.array is not None:
                arrays.setdefault(array_key(end), []).append((end.variable.place, value))
        for end, value in values:
            if isinstance(value, str):
                part.instance.set_string(end.variable, value)
            elif end.variable.array is None:
                part.set((end.variable,), (value,))
            elif array_key(end) in arrays:
                self._set_array(part, end, arrays.pop(array_key(end)))

    def _set_array(
        self, part: Part, end: PartVariable, elements: Iterable[tuple[int, float]]
    ) -> None:
        """Set some elements of an array; the others start with what the system says."""
        whole = self._layout.arrays[array_key(end)][1].elements
        given = self._layout.input_slot(end)
        if given >= 0:
            values = list(part.inputs.values[part.layout.span_of(given - part.layout.first_input)])
        else:
            values = part.layout.starts_of(whole)
        for place, value in elements:
            values[place] = value
        part.set(whole, values)

    def _exchange_all(self, span: Span, values: list[Any]) -> None:
        def begin_if_old(index: int) -> None:
            part = self._parts.all[index]
            if not part.layout.has_mode and not part.started:
                self._begin(index, span, values, None)

        for evaluation in self._layout.plan.initialization:
            self._evaluate(evaluation, begin_if_old)
        for index in range(len(self._parts.all)):
            begin_if_old(index)

    def _evaluate(self, evaluation: Evaluation, begin_if_old: Callable[[int], None]) -> None:
        routes = [self._layout.routes[i] for i in self._layout.routes_of(evaluation)]
        if evaluation.loop is None:
            for route in routes:
                self._write_target(route, self._read_source(route, begin_if_old))
            return

        def read_all() -> list[float]:
            return [x for route in routes for x in self._read_source(route, begin_if_old)]

        def evaluate(x: list[float]) -> list[float]:
            for route, values in shared_out(routes, x):
                self._write_target(route, values)
            return read_all()

        x = read_all()
        try:
            solve_loop(evaluation.loop, x, evaluate)
        except NotSolvedError:
            label = self._layout.loop_label(route.source_part for route in routes)
            raise FailedError(Status.DISCARD, label) from None

    def _read_source(self, route: Route, begin_if_old: Callable[[int], None]) -> list[float]:
        begin_if_old(route.source_part)
        part = self._parts.all[route.source_part]
        first = route.source - part.layout.first_output
        values = part.get(part.layout.outputs[first : first + route.count])
        return carried(part, route, values)

    def _write_target(self, route: Route, values: Sequence[float]) -> None:
        """Set inputs. An element of an array is set with the others, which stay as they are.

        FMI forbids to set inputs with clocks in Initialization Mode: they get their values in
        steps.
        """
        part = self._parts.all[route.target_part]
        self._parts.take(route, values)
        place = route.target - part.layout.first_input
        if part.started and not part.layout.waits_for_clock(part.layout.inputs[place]):
            span = part.layout.span_of(place)
            part.set(part.layout.inputs[span], part.inputs.values[span])
