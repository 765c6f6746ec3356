"""Where the parts of a picture of a system lie: boxes in columns, wires between them.

Components that depend on each other stand in columns from left to right (Sugiyama, Tagawa and Toda,
IEEE Transactions on Systems, Man, and Cybernetics 11 (1981), 109-125): columns by the longest path,
places in a column by the mean place of the neighbours. Wires that lead back run below the boxes.
Lengths are in inches; y grows upwards.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final

from fmugym.systems.system_plan import Connector, Link
from fmugym.systems.wired import WiredSystem

__all__ = ["Box", "Picture", "Wire", "picture_of"]

ROW: Final = 0.24
_HEAD: Final = 0.52
_LETTER: Final = 0.068
_LETTER_OF_TITLE: Final = 0.092
_COLUMN_GAP: Final = 1.3
_ROW_GAP: Final = 0.4
_LANE: Final = 0.2
_SWEEPS: Final = 8

Point = tuple[float, float]


@dataclass
class Box:
    """A component, or an input, parameter or output of the system.

    Attributes:
        title: Its name.
        subtitle: The file of its FMU; "" for a name of the system.
        inputs, outputs: The variables on its left and right side.
        x, y: The upper left corner.
        width, height: The size.
        column: From the left.
    """

    title: str
    subtitle: str = ""
    inputs: list[str] = field(default_factory=list)
    outputs: list[str] = field(default_factory=list)
    x: float = 0.0
    y: float = 0.0
    column: int = 0

    @property
    def is_component(self) -> bool:
        """Whether it is one, not a name of the system."""
        return bool(self.subtitle)

    @property
    def width(self) -> float:
        """The width that its texts need."""
        if not self.is_component:
            return max(0.36, 0.2 + _LETTER * len(self.title))
        sides = sum(
            _LETTER * max(map(len, side), default=0) for side in (self.inputs, self.outputs)
        )
        texts = (_LETTER_OF_TITLE * len(self.title), 0.062 * len(self.subtitle), sides + 0.35)
        return max(1.1, 0.3 + max(texts))

    @property
    def height(self) -> float:
        """The height that its ports need."""
        rows = max(len(self.inputs), len(self.outputs), 1)
        return _HEAD + ROW * rows + 0.08 if self.is_component else 0.3

    def port(self, name: str, *, left: bool) -> Point:
        """The place of a variable on the left or right side."""
        x = self.x if left else self.x + self.width
        if not self.is_component:
            return x, self.y - self.height / 2
        place = (self.inputs if left else self.outputs).index(name)
        return x, self.y - _HEAD - ROW * (place + 0.5)


@dataclass
class Wire:
    """A connection in the picture.

    Attributes:
        source, target: Keys of boxes and the names of their ports.
        text: What happens to the value on its way.
        in_loop: Whether it is part of an algebraic loop.
        points: Where it runs. Between two points it is a smooth curve, or with ``leads_back`` a
            straight line.
        leads_back: Whether its target stands left of its source or in the same column.
    """

    source: tuple[str, str]
    target: tuple[str, str]
    text: str
    in_loop: bool
    points: list[Point] = field(default_factory=list)
    leads_back: bool = False


@dataclass(frozen=True)
class Picture:
    """A picture of a system.

    Attributes:
        boxes: By key.
        wires: Between them.
        open_ports: The key of a box and the name of an input that nothing drives.
        size: Width and height of everything, in inches.
    """

    boxes: Mapping[str, Box]
    wires: Sequence[Wire]
    open_ports: Sequence[tuple[str, str]]
    size: Point


def picture_of(system: WiredSystem) -> Picture:
    """Place the components, names and wires of a system."""
    boxes = {name: Box(name, one.fmu.path.name) for name, one in system.components.items()}
    wires = [_wire(link, system) for link in system.links]
    for connector in system.connectors:
        boxes[f"={connector.name}"] = Box(connector.name)
        wires += _own_wires(connector)
    ports = [(port.component.name, port.variable.name) for port in system.open_inputs]
    _add_ports(boxes, wires, ports)
    _set_columns(boxes, wires, [n for group in system.order.groups for n in group.components])
    columns = _Columns(boxes, wires)
    size = columns.place()
    return Picture(boxes, wires, ports, size)


def _wire(link: Link, system: WiredSystem) -> Wire:
    in_loop = any(link in loop for loop in system.order.loops)
    text = _change(link.gain, link.offset)
    return Wire((link.source, link.output), (link.target, link.input), text, in_loop)


def _own_wires(connector: Connector) -> Iterable[Wire]:
    own = f"={connector.name}", connector.name
    for end in connector.ends:
        other, text = (end.component, end.variable), _change(end.gain, end.offset)
        ends = (other, own) if connector.causality == "output" else (own, other)
        yield Wire(*ends, text, in_loop=False)


def _change(gain: float, offset: float) -> str:
    text = "" if gain == 1 else f"\u00d7 {gain:.6g}"
    if not offset:
        return text
    sign = "+" if offset > 0 else "\u2212"
    return f"{text} {sign} {abs(offset):.6g}"


def _add_ports(
    boxes: Mapping[str, Box], wires: Sequence[Wire], open_ports: Sequence[tuple[str, str]]
) -> None:
    for wire in wires:
        for (key, name), side in ((wire.source, "outputs"), (wire.target, "inputs")):
            names = getattr(boxes[key], side)
            if name not in names:
                names.append(name)
    for key, name in open_ports:
        boxes[key].inputs.append(name)


def _set_columns(boxes: Mapping[str, Box], wires: Sequence[Wire], order: Sequence[str]) -> None:
    """Put a component right of all that it gets values from, as far as they step before it."""
    rank = {name: place for place, name in enumerate(order)}
    for name in order:
        before = [
            boxes[wire.source[0]].column
            for wire in wires
            if wire.target[0] == name and rank.get(wire.source[0], -1) < rank[name]
        ]
        boxes[name].column = max(before, default=0) + 1
    last = max(box.column for box in boxes.values()) + 1
    for key, box in boxes.items():
        if key not in rank:
            box.column = last if any(wire.target[0] == key for wire in wires) else 0


@dataclass
class _Columns:
    """The columns: keys of boxes, and indices of the wires that cross a column.

    ``paths`` has for each wire that does not lead back what stands for it in each of its columns.
    """

    boxes: Mapping[str, Box]
    wires: Sequence[Wire]
    columns: list[list[str | int]] = field(default_factory=list)
    paths: dict[int, dict[int, str | int]] = field(default_factory=dict)

    def place(self) -> Point:
        """Give all boxes and wires their places, and return the size."""
        count = max(box.column for box in self.boxes.values()) + 1
        self.columns = [[] for _ in range(count)]
        for key, box in self.boxes.items():
            self.columns[box.column].append(key)
        for number, wire in enumerate(self.wires):
            ends = wire.source[0], wire.target[0]
            first, last = (self.boxes[key].column for key in ends)
            wire.leads_back = first >= last
            if not wire.leads_back:
                crossed = dict.fromkeys(range(first + 1, last), number)
                self.paths[number] = {first: ends[0], **crossed, last: ends[1]}
                for column in crossed:
                    self.columns[column].append(number)
        self._sort()
        heights = self._stack()
        return self._route(heights)

    def _sort(self) -> None:
        for sweep in range(_SWEEPS):
            step = 1 if sweep % 2 else -1
            for column in range(len(self.columns))[::-step]:
                rank = {item: self._mean(item, column, step) for item in self.columns[column]}
                self.columns[column].sort(key=rank.__getitem__)

    def _mean(self, item: str | int, column: int, step: int) -> float:
        """The mean place of the neighbours in the next column, from 0 to 1."""
        places = [
            self._place_of(number, column + step)
            for number, path in self.paths.items()
            if path.get(column) == item and column + step in path
        ]
        own = self.columns[column].index(item) / len(self.columns[column])
        return sum(places) / len(places) if places else own

    def _place_of(self, number: int, column: int) -> float:
        """Where a wire ends in a column or crosses it, from 0 to 1."""
        items, wire, item = self.columns[column], self.wires[number], self.paths[number][column]
        within = 0.0
        if isinstance(item, str):
            box = self.boxes[item]
            is_source = item == wire.source[0]
            (_, name), names = (
                (wire.source, box.outputs) if is_source else (wire.target, box.inputs)
            )
            within = names.index(name) / len(names)
        return (items.index(item) + within) / len(items)

    def _stack(self) -> list[float]:
        """Set the places of boxes, each column in the middle of the height."""
        heights = [sum(map(self._height, column)) for column in self.columns]
        x, crossing = 0.2, {}
        for column, items in enumerate(self.columns):
            width = max((self.boxes[k].width for k in items if isinstance(k, str)), default=0.0)
            y = (heights[column] - _ROW_GAP) / 2
            for item in items:
                if isinstance(item, str):
                    box = self.boxes[item]
                    box.x, box.y = x + (width - box.width) * (0.5 if box.is_component else 0), y
                else:
                    crossing[item, column] = y - 0.05
                y -= self._height(item)
            for item in items:
                if isinstance(item, int):
                    middle = crossing[item, column]
                    self.wires[item].points += [(x, middle), (x + width, middle)]
            x += width + _COLUMN_GAP
        return [*heights, x - _COLUMN_GAP]

    def _height(self, item: str | int) -> float:
        return self.boxes[item].height + _ROW_GAP if isinstance(item, str) else 0.25

    def _route(self, heights: list[float]) -> Point:
        """Let wires run from port to port; those that lead back get a lane each below the boxes."""
        *columns, width = heights
        crossings = [y for wire in self.wires for _, y in wire.points]
        bottom = min([-(max(columns) - _ROW_GAP) / 2, *crossings])
        lanes = 0
        for wire in self.wires:
            (source, name), (target, other) = wire.source, wire.target
            start = self.boxes[source].port(name, left=False)
            end = self.boxes[target].port(other, left=True)
            if not wire.leads_back:
                wire.points = [start, *wire.points, end]
                continue
            lanes += 1
            right = self._edge(source, left=False) + 0.12 + 0.07 * lanes
            left = self._edge(target, left=True) - 0.12 - 0.07 * lanes
            y = bottom - _LANE * lanes
            wire.points = [start, (right, start[1]), (right, y), (left, y), (left, end[1]), end]
        return width + 0.2, (max(columns) - _ROW_GAP) / 2 - bottom + _LANE * lanes

    def _edge(self, key: str, *, left: bool) -> float:
        """The left or right edge of the column of a box."""
        boxes = [box for box in self.boxes.values() if box.column == self.boxes[key].column]
        if left:
            return min(box.x for box in boxes)
        return max(box.x + box.width for box in boxes)
