"""Modbus TCP: a client that only reads, and a server that nobody writes to."""

from __future__ import annotations

import logging
import math
import struct
from collections.abc import Awaitable, Callable, Iterator, Mapping, Sequence
from typing import Any, Final

from fmugym.extras import imported
from fmugym.plant.reading import Answer, LostError, host_and_port
from fmugym.plant.tags import Plant, Tag

__all__ = ["ModbusClient", "serve_modbus"]

_FORMATS: Final = {
    **{
        f"{sign}int{bits}": letter
        for sign, letters in (("", "hiq"), ("u", "HIQ"))
        for bits, letter in zip((16, 32, 64), letters, strict=True)
    },
    "float32": "f",
    "float64": "d",
}
_BITS: Final = ("coil", "discrete")
_MOST: Final = 120
"""So many registers are asked for at once; the standard allows 125."""

_SAID: Final = {
    1: "it does not know this function",
    2: "there is no such register",
    3: "it refuses the number of registers",
    4: "the device has failed",
    10: "there is no way to this device",
    11: "the device does not answer",
}

_KINDS: Final = ("coil", "discrete", "holding", "input")

logging.getLogger("pymodbus.logging").addHandler(logging.NullHandler())


def _width(tag: Tag) -> int:
    """How many registers or bits a number takes."""
    if tag.address["kind"] in _BITS:
        return 1
    return struct.calcsize(">" + _FORMATS[tag.address["type"]]) // 2


def _answer(tag: Tag, cells: Sequence[Any]) -> Answer:
    """The numbers in registers or bits; devices write NaN for what they do not know."""
    width = _width(tag)
    parts = [cells[i : i + width] for i in range(0, tag.count * width, width)]
    numbers = tuple(tag.conversion(_number(tag, part)) for part in parts)
    if not all(map(math.isfinite, numbers)):
        return Answer((), f"{tag.address['kind']} {tag.address['register']} has no finite number")
    return Answer(numbers)


def _number(tag: Tag, cells: Sequence[Any]) -> float:
    if tag.address["kind"] in _BITS:
        return float(cells[0])
    words = cells if tag.address["word_order"] == "big" else cells[::-1]
    content = b"".join(word.to_bytes(2, "big") for word in words)
    return float(struct.unpack(">" + _FORMATS[tag.address["type"]], content)[0])


def _cells(tag: Tag, value: float) -> list[int]:
    """The registers, or the bit, of a value."""
    number = tag.conversion.inverse(value)
    if tag.address["kind"] in _BITS:
        return [int(number > 0.5)]
    form = _FORMATS[tag.address["type"]]
    content = struct.pack(">" + form, number if form in "fd" else round(number))
    words = [int.from_bytes(content[i : i + 2], "big") for i in range(0, len(content), 2)]
    return words if tag.address["word_order"] == "big" else words[::-1]


class _Block:
    """Neighbours, which are read at once."""

    def __init__(self, kind: str, unit_id: int, first: Tag) -> None:
        self.kind, self.unit_id, self.tags = kind, unit_id, [first]
        self.begin = first.address["register"]
        self.end = self.begin + first.count * _width(first)

    def takes(self, kind: str, unit_id: int, tag: Tag) -> bool:
        """Whether a tag follows without a gap, and what it then does."""
        end = self.end + tag.count * _width(tag)
        is_next = (kind, unit_id, tag.address["register"]) == (self.kind, self.unit_id, self.end)
        if not is_next or end - self.begin > _MOST:
            return False
        self.tags, self.end = [*self.tags, tag], end
        return True


def _blocks(plant: Plant) -> list[_Block]:
    placed = [(_place(plant, tag), tag) for tag in plant.tags.values()]
    found: list[_Block] = []
    for (kind, unit_id, _), tag in sorted(placed, key=lambda one: one[0]):
        if not found or not found[-1].takes(kind, unit_id, tag):
            found.append(_Block(kind, unit_id, tag))
    return found


def _place(plant: Plant, tag: Tag) -> tuple[str, int, int]:
    unit_id = tag.address.get("unit_id")
    return (
        tag.address["kind"],
        plant["unit_id"] if unit_id is None else unit_id,
        tag.address["register"],
    )


class ModbusClient:
    """Reads the tags of a plant; see ``reading.Client``."""

    def __init__(self, plant: Plant, address: str) -> None:
        self._client_of = imported("pymodbus.client", "plant").AsyncModbusTcpClient
        self._exceptions = imported("pymodbus.exceptions", "plant")
        self._host, self._port = host_and_port(address, 502)
        self._timeout, self._blocks = plant["timeout"], _blocks(plant)
        self._client: Any = None

    async def connect(self) -> None:
        """See ``reading.Client``."""
        options = {"timeout": self._timeout, "retries": 0, "reconnect_delay": 0}
        self._client = self._client_of(self._host, port=self._port, **options)
        if not await self._client.connect():
            raise LostError("it refuses the connection, or does not answer")

    async def read(self) -> dict[str, Answer]:
        """See ``reading.Client``."""
        found: dict[str, Answer] = {}
        for block in self._blocks:
            cells, fault = await self._ask(block, block.begin, block.end)
            for tag in block.tags:
                begin = tag.address["register"]
                end = begin + tag.count * _width(tag)
                own, why = cells[begin - block.begin : end - block.begin], fault
                if fault and len(block.tags) > 1:  # one of them may be the reason
                    own, why = await self._ask(block, begin, end)
                found[tag.name] = Answer((), why) if why else _answer(tag, own)
        return found

    async def _ask(self, block: _Block, begin: int, end: int) -> tuple[Sequence[Any], str]:
        """The registers or bits, and what the server says instead."""
        calls = {
            "holding": self._client.read_holding_registers,
            "input": self._client.read_input_registers,
            "coil": self._client.read_coils,
            "discrete": self._client.read_discrete_inputs,
        }
        if not self._client.connected:
            raise LostError("the connection is lost")
        try:
            told = await calls[block.kind](begin, count=end - begin, device_id=block.unit_id)
        except self._exceptions.ConnectionException:
            raise LostError("the connection is lost") from None
        except self._exceptions.ModbusException:
            raise LostError("it does not answer, or not by Modbus") from None
        if told.isError():
            code = told.exception_code
            where = f"{block.kind} {begin} of unit {block.unit_id}"
            return (), f"{where}: {_SAID.get(code, 'refused')} (exception {code})"
        return (told.bits if block.kind in _BITS else told.registers), ""

    async def close(self) -> None:
        """See ``reading.Client``."""
        if self._client is not None:
            self._client.close()


# The server.


async def serve_modbus(
    plant: Plant,
    port: int,
    values: Callable[[], Mapping[str, Sequence[float]]],
    bound: Callable[[str], None],
) -> Callable[[], Awaitable[None]]:
    """Serve tags on the loopback.

    Args:
        plant: Has the tags.
        port: The port; 0 for a free one.
        values: Returns the values of now, by the names of tags.
        bound: Is told the address.

    Returns:
        What ends it.
    """
    server_of = imported("pymodbus.server", "plant").ModbusTcpServer
    devices = [_device(unit, own, values) for unit, own in _by_unit(plant).items()]
    server = server_of(devices, address=("127.0.0.1", port))
    await server.serve_forever(background=True)
    bound(f"127.0.0.1:{server.transport.sockets[0].getsockname()[1]}")
    ended: Callable[[], Awaitable[None]] = server.shutdown
    return ended


def _by_unit(plant: Plant) -> dict[int, list[_Block]]:
    found: dict[int, list[_Block]] = {}
    for block in _blocks(plant):
        found.setdefault(block.unit_id, []).append(block)
    return found


def _device(
    unit_id: int, blocks: list[_Block], values: Callable[[], Mapping[str, Sequence[float]]]
) -> Any:
    """A device whose registers are written anew before each reading."""
    simulator = imported("pymodbus.simulator", "plant")
    refused = imported("pymodbus.constants", "plant").ExcCodes.ILLEGAL_FUNCTION

    async def look(
        code: int, start: int, address: int, count: int, registers: list[int], written: Any
    ) -> Any:
        if written is not None:
            return refused
        kind = {1: "coil", 2: "discrete", 3: "holding", 4: "input"}[code]
        now = values()
        for block in (one for one in blocks if one.kind == kind):
            cells = [cell for tag in block.tags for v in now[tag.name] for cell in _cells(tag, v)]
            _place_cells(kind, registers, block.begin, start, cells)
        return None

    areas = tuple([*_area(simulator, kind, blocks)] for kind in _KINDS)
    return simulator.SimDevice(unit_id, areas, action=look)


def _place_cells(
    kind: str, registers: list[int], begin: int, start: int, cells: Sequence[int]
) -> None:
    if kind not in _BITS:
        registers[begin - start : begin - start + len(cells)] = cells
        return
    for place, bit in enumerate(cells, begin - 16 * start):
        word, mask = place // 16, 1 << (place % 16)
        registers[word] = registers[word] | mask if bit else registers[word] & ~mask


def _area(simulator: Any, kind: str, blocks: Sequence[_Block]) -> Iterator[Any]:
    """What the library needs to know of the registers of a kind, or of the bits."""
    own = [block for block in blocks if block.kind == kind]
    if kind in _BITS:
        bits = max([block.end for block in own], default=1)
        form = simulator.DataType.BITS
        yield simulator.SimData(0, values=[False] * (-(-bits // 16) * 16), datatype=form)
        return
    for block in own:
        form, size = simulator.DataType.REGISTERS, block.end - block.begin
        yield simulator.SimData(block.begin, count=size, datatype=form)
    if not own:
        yield simulator.SimData(0)
