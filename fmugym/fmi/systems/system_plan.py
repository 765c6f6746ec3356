"""Execution plan of a system's master, as data, and the order in which a system is evaluated.

A plan holds names and numbers only: it can be pickled, compared and hashed. Whoever makes one
(Python, a task file, an SSP archive) has resolved units into gains and offsets, and has put the
components and links in order. ``fmugym.fmi.systems.system`` makes a system of it, which
``native/system/system_steps.c`` runs.

One step of the master with the communication step size h:

* ``"jacobi"``: all components get the values that their links carry at the beginning of the step,
  then all of them step.
* ``"gauss_seidel"``: the groups step in their order, and each gets the newest values: those at the
  end of the step from components that have stepped already, and those at its beginning from others.

A component with ``steps`` = m does m communication steps of h / m, with constant inputs. A group of
several components is an algebraic loop: in a Gauss-Seidel step, it is repeated from saved states
until the values of its links agree with what it computes. In a Jacobi step no loop can occur.

A node of the graphs of the order depends on its successors. Strongly connected nodes are found by
Tarjan's algorithm (SIAM Journal on Computing 1 (1972), 146-160), which gives them in an order in
which each comes after all it depends on.
"""

from __future__ import annotations

from collections.abc import Container, Hashable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final, TypeVar

from fmugym.fmi.description import Feedthrough, Unit
from fmugym.fmi.safe_zip import ArchiveLimits

__all__ = [
    "MASTERS",
    "ComponentPlan",
    "Connector",
    "End",
    "Evaluation",
    "Group",
    "Link",
    "Loop",
    "SystemOrder",
    "SystemPlan",
    "order_of",
    "strong_components",
]

MASTERS: Final = ("gauss_seidel", "jacobi")
"""The orders in which values are exchanged and components step, the preferred one first."""


@dataclass(frozen=True)
class ComponentPlan:
    """One FMU of a system.

    Attributes:
        name: Unique in the system; variables are called ``name.variable``.
        path: The ``.fmu`` file, absolute.
        interface: One of ``fmugym.fmi.description.INTERFACES``; None for the FMU's first one.
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


Node = TypeVar("Node", bound=Hashable)


@dataclass(frozen=True)
class SystemOrder:
    """The order of a system.

    Attributes:
        groups: The components in the order of their steps.
        initialization: The links in the order of the initialization.
        loops: The links of each algebraic loop between steps.
        late: Links whose value is one step late although no loop asks for it.
        unsolved: The components because of which loops between steps are not solved.
        unsolved_at_start: The components because of which loops at the start are not solved.
    """

    groups: tuple[Group, ...]
    initialization: tuple[Evaluation, ...]
    loops: tuple[tuple[Link, ...], ...]
    late: tuple[Link, ...]
    unsolved: tuple[str, ...]
    unsolved_at_start: tuple[str, ...]


def order_of(
    names: Sequence[str],
    links: Sequence[Link],
    told: Mapping[str, Feedthrough],
    loop: Loop,
    unable: Container[str] = (),
    unable_at_start: Container[str] = (),
) -> SystemOrder:
    """Order the components and links of a system.

    A component steps after those whose new values act on its outputs at once. Where nothing asks
    for an order, it is that of the names.

    Args:
        names: The components.
        links: The connections.
        told: The direct feed-through of each component.
        loop: Treatment of algebraic loops.
        unable: The components that cannot repeat a step. Their inputs in a loop count as given, so
            that only the rest of the loop is solved.
        unable_at_start: Components for which the same holds at the start.
    """
    in_step = _chains(links, {name: one.in_step for name, one in told.items()})
    solvable, unsolved = _cut(in_step, links, unable)
    loops, solved = (_linked_loops(graph, links) for graph in (in_step, solvable))
    teams = _teams(names, solved)
    order, late = _order_of_teams(names, teams, links, told)
    looping = {link.source for one in solved for link in one}
    groups = tuple(Group(team, None if looping.isdisjoint(team) else loop) for team in order)
    at_start = _chains(links, {name: one.at_start for name, one in told.items()})
    evaluable, unsolved_at_start = _cut(at_start, links, unable_at_start)
    evaluations = tuple(_evaluations(evaluable, loop))
    return SystemOrder(groups, evaluations, loops, late, unsolved, unsolved_at_start)


def _cut(
    graph: dict[int, list[int]], links: Sequence[Link], unable: Container[str]
) -> tuple[dict[int, list[int]], tuple[str, ...]]:
    """Let nothing depend on the links of loops that end at components that are unable.

    Returns:
        The graph, and the names of these components.
    """
    cut = {i: links[i].target for loop in _loops(graph) for i in loop if links[i].target in unable}
    if not cut:
        return graph, ()
    rest = {place: [one for one in others if one not in cut] for place, others in graph.items()}
    return rest, tuple(dict.fromkeys(cut.values()))


def _linked_loops(
    graph: Mapping[int, Sequence[int]], links: Sequence[Link]
) -> tuple[tuple[Link, ...], ...]:
    return tuple(tuple(links[place] for place in sorted(cycle)) for cycle in _loops(graph))


def _chains(
    links: Sequence[Link], told: Mapping[str, Mapping[str, frozenset[str]]]
) -> dict[int, list[int]]:
    """For each link, the links whose values its own depends on at once."""
    into: dict[tuple[str, str], list[int]] = {}
    for place, link in enumerate(links):
        for name in _told_names(link.input):
            into.setdefault((link.target, name), []).append(place)
    return {
        place: sorted(
            other
            for output in _told_names(link.output)
            for name in told[link.source].get(output, ())
            for other in into.get((link.source, name), ())
        )
        for place, link in enumerate(links)
    }


def _told_names(name: str) -> tuple[str, ...]:
    """The names by which an FMU may tell the feed-through of a variable.

    FMI 3.0 tells it of arrays, not of their elements. The scalars of other versions, which may be
    called ``y[1]``, have no other name.
    """
    return (name, name.rpartition("[")[0]) if name.endswith("]") else (name,)


def _loops(graph: Mapping[int, Sequence[int]]) -> list[list[int]]:
    return [found for found in strong_components(graph) if _is_loop(graph, found)]


def _is_loop(graph: Mapping[int, Sequence[int]], found: list[int]) -> bool:
    return len(found) > 1 or found[0] in graph[found[0]]


def _evaluations(graph: Mapping[int, Sequence[int]], loop: Loop) -> Iterator[Evaluation]:
    for found in strong_components(graph):
        yield Evaluation(tuple(sorted(found)), loop if _is_loop(graph, found) else None)


def _teams(names: Sequence[str], loops: Iterable[Sequence[Link]]) -> dict[str, tuple[str, ...]]:
    """For each component, the components in algebraic loops with it, and itself."""
    team = {name: {name} for name in names}
    for loop in loops:
        union = set().union(*(team[end] for link in loop for end in (link.source, link.target)))
        team.update(dict.fromkeys(union, union))
    places = {name: place for place, name in enumerate(names)}
    return {name: tuple(sorted(team[name], key=places.__getitem__)) for name in names}


def _order_of_teams(
    names: Sequence[str],
    teams: Mapping[str, tuple[str, ...]],
    links: Sequence[Link],
    told: Mapping[str, Feedthrough],
) -> tuple[list[tuple[str, ...]], tuple[Link, ...]]:
    """Order the teams; teams in one cycle stay in the order of names."""
    acting = [
        link for link in links if _acts(link, told) and teams[link.source] != teams[link.target]
    ]
    graph: dict[tuple[str, ...], list[tuple[str, ...]]] = {teams[name]: [] for name in names}
    for link in acting:
        graph[teams[link.target]].append(teams[link.source])
    places = {team: place for place, team in enumerate(graph)}
    order = [
        team
        for together in strong_components(graph)
        for team in sorted(together, key=places.__getitem__)
    ]
    rank = {team: place for place, team in enumerate(order)}
    late = (link for link in acting if rank[teams[link.source]] > rank[teams[link.target]])
    return order, tuple(late)


def _acts(link: Link, told: Mapping[str, Feedthrough]) -> bool:
    """Whether the value of a link acts on an output of its target at once."""
    names = _told_names(link.input)
    return any(not inputs.isdisjoint(names) for inputs in told[link.target].in_step.values())


def strong_components(graph: Mapping[Node, Sequence[Node]]) -> list[list[Node]]:
    """Find the strongly connected components of a graph.

    The search uses no recursion, since systems may be long chains.

    Args:
        graph: For each node, those it depends on.

    Returns:
        The components, each after all it depends on.
    """
    places: dict[Node, int] = {}  # in the stack
    low: dict[Node, int] = {}  # the lowest place that a node leads to; beyond all if it is found
    rest: dict[Node, Iterator[Node]] = {}
    stack: list[Node] = []
    found: list[list[Node]] = []
    for root in graph:
        path = [] if root in low else [root]
        while path:
            node = path[-1]
            if node not in low:
                places[node] = low[node] = len(stack)
                rest[node] = iter(graph[node])
                stack.append(node)
            for after in rest[node]:
                if after not in low:
                    path.append(after)
                    break
                low[node] = min(low[node], low[after])
            else:
                path.pop()
                if low[node] == places[node]:
                    found.append(stack[places[node] :])
                    del stack[places[node] :]
                    low |= dict.fromkeys(found[-1], len(graph))
                if path:
                    low[path[-1]] = min(low[path[-1]], low[node])
    return found
