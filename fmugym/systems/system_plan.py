"""Execution plan of a system's master, as data.

A plan holds names and numbers only: it can be pickled, compared and hashed. Whoever makes one
(Python, a task file, an SSP archive) has resolved units into gains and offsets, and has put the
components and links in order. ``fmugym.systems.system_fmu`` makes a system of it, which
``native/system_steps.c`` runs.

One step of the master with the communication step size h:

* ``"jacobi"``: all components get the values that their links carry at the beginning of the step,
  then all of them step.
* ``"gauss_seidel"``: the groups step in their order, and each gets the newest values: those at the
  end of the step from components that have stepped already, and those at its beginning from others.

A component with ``steps`` = m does m communication steps of h / m, with constant inputs. A group of
several components is an algebraic loop: in a Gauss-Seidel step, it is repeated from saved states
until the values of its links agree with what it computes. In a Jacobi step no loop can occur.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Final

from fmugym.archive.description import Unit
from fmugym.archive.safe_zip import ArchiveLimits

__all__ = [
    "MASTERS",
    "ComponentPlan",
    "Connector",
    "End",
    "Evaluation",
    "Group",
    "Link",
    "Loop",
    "SystemPlan",
]

MASTERS: Final = ("gauss_seidel", "jacobi")
"""The orders in which values are exchanged and components step, the preferred one first."""


@dataclass(frozen=True)
class ComponentPlan:
    """One FMU of a system.

    Attributes:
        name: Unique in the system; variables are called ``name.variable``.
        path: The ``.fmu`` file, absolute.
        interface: One of ``fmugym.archive.description.INTERFACES``; None for the FMU's first one.
        steps: Communication steps in one step of the master.
        starts: Values set before initialization, by the names of the component's variables and
            elements of arrays. Those that an environment sets win.
        limits, preload: See ``fmugym.FMU``.
        sizes: The values of structural parameters.
        isolate: Whether the system shall run in worker processes because of it.
    """

    name: str
    path: Path
    interface: str | None = None
    steps: int = 1
    starts: tuple[tuple[str, float | str], ...] = ()
    limits: ArchiveLimits | None = None
    preload: tuple[str, ...] = ()
    sizes: tuple[tuple[str, int], ...] = ()
    isolate: bool = False


@dataclass(frozen=True)
class Link:
    """A connection: the input becomes ``gain * output + offset``.

    Attributes:
        source: The name of a component.
        output: The name of its variable: a scalar, an element of an array, or a whole array.
        target: The name of a component.
        input: The name of its variable, of the same shape; no other link has it.
        gain, offset: 1 and 0 leave the value as it is.
    """

    source: str
    output: str
    target: str
    input: str
    gain: float = 1.0
    offset: float = 0.0


@dataclass(frozen=True)
class Loop:
    """Limits of Newton's method, which solves an algebraic loop.

    Attributes:
        tolerance: The loop is solved when no value that a link of it carries differs by more than
            ``tolerance * max(1, abs(value))`` from what it was in the iteration before.
        max_iterations: After so many, the step or the initialization fails with Discard.
    """

    tolerance: float = 1e-9
    max_iterations: int = 50


@dataclass(frozen=True)
class Group:
    """Components that step one after the other, or together if they are an algebraic loop.

    Attributes:
        components: Their names.
        loop: Solution of the loop; None if there is none. A group of several has one.
    """

    components: tuple[str, ...]
    loop: Loop | None = None


@dataclass(frozen=True)
class Evaluation:
    """Links whose values are transferred one after the other, or solved for together.

    Attributes:
        links: Indices of the plan's links.
        loop: Solution of the loop of these links; None if there is none.
    """

    links: tuple[int, ...]
    loop: Loop | None = None


@dataclass(frozen=True)
class End:
    """A variable of a component behind a connector.

    Attributes:
        component: The name of the component.
        variable: The name of its variable: a scalar, an element of an array, or a whole array.
        gain, offset: ``gain * x + offset`` is the value of the target if x is that of the source.
            An input or parameter of the system is the source, an output of it the target.
    """

    component: str
    variable: str
    gain: float = 1.0
    offset: float = 0.0


@dataclass(frozen=True)
class Connector:
    """An input, output or parameter of the system, under a name of its own.

    Attributes:
        name: Unique among the names of all connectors and variables.
        ends: What it stands for; an output has one end.
        causality: ``"input"``, ``"output"`` or ``"parameter"``.
        unit: None for that of the first end.
    """

    name: str
    ends: tuple[End, ...]
    causality: str
    unit: str | None = None


@dataclass(frozen=True)
class SystemPlan:
    """A system, ready to be executed.

    Attributes:
        name: Name of the system, for messages.
        components: The FMUs.
        links: The connections between them.
        groups: Every component in the order of the steps; each is in one group.
        initialization: Every link in the order of the initialization; each is in one evaluation.
            All components stay in Initialization Mode meanwhile.
        master: One of ``MASTERS``.
        connectors: The system's own names.
        step_size: The default communication step size in seconds; None for none.
        start_time, stop_time: Times of the default experiment, in seconds.
        tolerance: Tolerance of the default experiment.
        description: For people.
        findings: Doubtful facts about the system, as texts.
        file: File of the system; None if it was made in Python.
        units: Definitions by name of units that the FMUs do not define.
    """

    name: str
    components: tuple[ComponentPlan, ...]
    links: tuple[Link, ...] = ()
    groups: tuple[Group, ...] = ()
    initialization: tuple[Evaluation, ...] = ()
    master: str = MASTERS[0]
    connectors: tuple[Connector, ...] = ()
    step_size: float | None = None
    start_time: float = 0.0
    stop_time: float | None = None
    tolerance: float | None = None
    description: str = ""
    findings: tuple[str, ...] = ()
    file: Path | None = None
    units: tuple[tuple[str, Unit], ...] = ()
