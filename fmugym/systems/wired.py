"""Wired systems: components and connections, with the order and the plan that follow from them."""

from __future__ import annotations

import inspect
from collections.abc import Iterator, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any, Final, Never

from fmugym.archive.description import Unit
from fmugym.errors import ConfigError, unknown_argument
from fmugym.keys import (
    COUNT,
    NUMBER,
    POSITIVE,
    REQUIRED,
    TEXT,
    Entries,
    Key,
    Listed,
    Table,
    checked_entry,
    option,
    table_of_fields,
)
from fmugym.systems.components import Component, OpenComponent
from fmugym.systems.connections import CONNECTION
from fmugym.systems.order import SystemOrder, order_of
from fmugym.systems.system_plan import MASTERS, Link, Loop, SystemPlan
from fmugym.systems.wiring import Port, Wiring

__all__ = ["SYSTEM", "WiredSystem"]

_LOOPS: Final = ("newton", "refuse")
"""Treatments of algebraic loops."""


SYSTEM: Final = Table(
    {
        "components": Key(
            Entries(table_of_fields(Component, make=Component, short="fmu")),
            "By name: the path of an FMU, or a [component](systems.md#connect-fmus).",
            REQUIRED,
        ),
        "connections": Key(
            Listed(CONNECTION),
            'Texts `"source -> target"`, or [tables](systems.md#connect-fmus).',
            (),
        ),
        "units": Key(
            Entries(TEXT), "Units of the system's own inputs, outputs and parameters by name.", {}
        ),
        "name": Key(TEXT, "Of the system.", "system"),
        "description": Key(TEXT, "A description for readers.", ""),
        "step_size": Key(
            POSITIVE,
            "Default communication step size.",
            None,
            "the smallest of a component",
        ),
        "start_time": Key(NUMBER, "Of the default experiment, in seconds.", 0.0),
        "stop_time": Key(NUMBER, "Of the default experiment, in seconds."),
        "master": Key(
            option(*MASTERS),
            "How values are exchanged; see [How systems run](systems.md#how-a-step-runs).",
            MASTERS[0],
        ),
        "loops": Key(
            option(*_LOOPS),
            "How [algebraic loops](systems.md#algebraic-loops) are solved, or that they are "
            "refused.",
            _LOOPS[0],
        ),
        "loop_tolerance": Key(
            POSITIVE,
            "A loop is solved when no value changes by more; relative, and absolute below 1.",
            Loop.tolerance,
        ),
        "loop_iterations": Key(COUNT, "After so many, the step fails.", Loop.max_iterations),
        "tolerance": Key(POSITIVE, "For the solvers of the components.", None, "the FMUs'"),
    }
)
"""The keys of a system."""

_TIMES: Final = ("step_size", "start_time", "stop_time", "tolerance")


class WiredSystem:
    """A system with all its names resolved.

    See ``fmugym.FMUSystem`` for the arguments, the attributes and the errors.
    """

    def __init__(
        self,
        components: Mapping[str, Any],
        connections: Sequence[Any] = (),
        *,
        name: str = "system",
        units: Mapping[str, str] | None = None,
        master: str = MASTERS[0],
        loops: str = _LOOPS[0],
        loop_tolerance: float = Loop.tolerance,
        loop_iterations: int = Loop.max_iterations,
        step_size: float | None = None,
        start_time: float = 0.0,
        stop_time: float | None = None,
        tolerance: float | None = None,
        description: str = "",
        own_names: Sequence[str] = (),
        unit_definitions: Mapping[str, Unit] | None = None,
        findings: Sequence[str] = (),
        file: Path | None = None,
        **unknown: Never,
    ) -> None:
        for argument in unknown:
            raise unknown_argument(type(self).__name__, argument, _ARGUMENTS)
        told = {
            "components": components,
            "connections": connections,
            "name": name,
            "units": units or {},
            "description": description,
            "master": master,
            "loops": loops,
            "loop_tolerance": loop_tolerance,
            "loop_iterations": loop_iterations,
            "step_size": step_size,
            "start_time": start_time,
            "stop_time": stop_time,
            "tolerance": tolerance,
        }
        self._given = given = checked_entry(SYSTEM, told)
        if not given["components"]:
            raise ConfigError("a system needs at least one component")
        self.name, self.description = given["name"], given["description"]
        self.units, self.master, self.loops = given["units"], given["master"], given["loops"]
        self.loop = Loop(given["loop_tolerance"], given["loop_iterations"])
        self.times = {name: given[name] for name in _TIMES}
        self._given_findings, self.file = tuple(findings), file
        self.connections = tuple(given["connections"])
        made = given["components"].items()
        self.components = {one: OpenComponent(one, component) for one, component in made}
        self.own_names = tuple(own_names)
        self.unit_definitions = dict(unit_definitions or {})
        self._wiring = Wiring(
            self.components,
            self.connections,
            self.units,
            frozenset(self.own_names) | self.units.keys(),
            self.unit_definitions,
        )
        self.links, self.connectors = tuple(self._wiring.links), tuple(self._wiring.connectors)
        self.units = {one.name: one.unit for one in self.connectors if one.unit is not None}
        if self.loops == "refuse" and self.order.loops:
            raise ConfigError(
                f"the system has an algebraic loop: {_told_loop(self.order.loops[0])}"
            )

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.name!r}: {', '.join(self.components)})"

    @cached_property
    def order(self) -> SystemOrder:
        """The order of steps and of the initialization, and the algebraic loops."""
        told = {name: one.feedthrough for name, one in self.components.items()}
        parts = {name: one.fmu.description for name, one in self.components.items()}
        old = {name for name, part in parts.items() if part.fmi_major_version == 1}
        unable = {n for n, part in parts.items() if not part.capabilities.can_get_and_set_fmu_state}
        if self.master == "jacobi":  # which repeats no steps
            unable = set()
        return order_of(list(told), self.links, told, self.loop, unable, old)

    def port(self, name: str) -> Port | None:
        """Find the variable that a name stands for; None for a name of the system itself.

        Raises:
            ConfigError: If there is no such component or variable.
        """
        return self._wiring.port(name)

    @property
    def open_inputs(self) -> tuple[Port, ...]:
        """The inputs of components that nothing drives."""
        return tuple(self._wiring.open_inputs())

    @cached_property
    def findings(self) -> tuple[str, ...]:
        """Doubtful facts about the system and its FMUs, as texts."""
        untold = [
            f"{name} does not tell its direct feed-through; each output is taken to depend on all "
            "inputs"
            for name, one in self.components.items()
            if not one.feedthrough.known
        ]
        of_fmus = [
            f"{name}: {finding}"
            for name, one in self.components.items()
            for finding in one.fmu.findings
        ]
        return (*self._given_findings, *_findings_of(self.order), *untold, *of_fmus)

    @cached_property
    def plan(self) -> SystemPlan:
        """Execution plan of the master."""
        times = dict(self.times)
        if times["step_size"] is None:
            times["step_size"] = self._smallest_step()
        return SystemPlan(
            self.name,
            tuple(one.planned() for one in self.components.values()),
            self.links,
            self.order.groups,
            self.order.initialization,
            self.master,
            self.connectors,
            description=self.description,
            findings=self.findings,
            file=self.file,
            units=tuple(self.unit_definitions.items()),
            **times,
        )

    def _smallest_step(self) -> float | None:
        """The smallest default step size of the components, as a step of the system."""
        steps = [
            size * one.given.steps
            for one in self.components.values()
            if (size := one.fmu.description.step_size) is not None
        ]
        return min(steps, default=None)


_ARGUMENTS: Final = tuple(
    name
    for name in inspect.signature(WiredSystem.__init__).parameters
    if name not in ("self", "unknown")
)


def _findings_of(order: SystemOrder) -> Iterator[str]:
    for loop in order.loops:
        yield f"algebraic loop: {_told_loop(loop)}"
    for name in order.unsolved:
        yield f"{name} cannot save its FMU state, so that its algebraic loop is not solved in steps"
    for name in order.unsolved_at_start:
        yield (
            f"{name} is an FMU of FMI 1.0, which has no Initialization Mode: in its algebraic loop "
            "it begins with the start values of its inputs"
        )
    for link in order.late:
        yield (
            f"{link.target} steps before {link.source}, so that {link.target}.{link.input} gets "
            "the value of the step before"
        )


def _told_loop(loop: Sequence[Link]) -> str:
    """Links of a loop one after the other, as far as each begins at the end of another."""
    rest = list(loop)
    chain = [rest.pop(0)]
    while rest:
        following = next((k for k in rest if k.source == chain[-1].target), rest[0])
        rest.remove(following)
        chain.append(following)
    return ", ".join(f"{k.source}.{k.output} -> {k.target}.{k.input}" for k in chain)
