"""The order in which a system is evaluated, and its algebraic loops.

A node of these graphs depends on its successors. Strongly connected nodes are found by Tarjan's
algorithm (SIAM Journal on Computing 1 (1972), 146-160), which gives them in an order in which each
comes after all it depends on.
"""

from __future__ import annotations

from collections.abc import Container, Hashable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeVar

from fmugym.archive.structure import Feedthrough
from fmugym.systems.system_plan import Evaluation, Group, Link, Loop

__all__ = ["SystemOrder", "order_of", "strong_components"]

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
