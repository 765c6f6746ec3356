"""Modbus TCP: a client that only reads, and a server that cannot be written to."""

from __future__ import annotations

import logging
from collections.abc import AsyncIterator, Sequence
from contextlib import asynccontextmanager, suppress
from itertools import pairwise
from typing import Any, Final, NamedTuple
from urllib.parse import urlsplit

import numpy as np
from pymodbus.client import AsyncModbusTcpClient
from pymodbus.constants import ExcCodes
from pymodbus.server import ModbusTcpServer

from fmugym.deployment.plant.polling import ConnectionLostError, TagReading, Values
from fmugym.deployment.plant.tags import Plant, Tag
from fmugym.errors import ConfigError, shown

__all__ = ["ModbusClient", "serve_modbus"]

_PORT: Final = 502
"""Port of Modbus TCP for addresses without one."""

_MOST: Final = 120
"""So many registers are asked for at once; the standard allows 125."""

_KINDS: Final = {
    "coil": (1, "read_coils"),
    "discrete": (2, "read_discrete_inputs"),
    "holding": (3, "read_holding_registers"),
    "input": (4, "read_input_registers"),
}
"""Functions that read coils and registers: their codes, and the library's names."""

logging.getLogger("pymodbus.logging").addHandler(logging.NullHandler())


class _Place(NamedTuple):
    """Place of a tag: registers or bits of a device, from the first to before the end."""

    unit_id: int
    kind: str
    begin: int
    end: int
    tag: Tag

    @property
    def is_bits(self) -> bool:
        return self.kind in ("coil", "discrete")

    @classmethod
    def of(cls, plant: Plant, tag: Tag) -> _Place:
        where = tag.address
        unit_id = plant["unit_id"] if where.get("unit_id") is None else where["unit_id"]
        one = cls(unit_id, where["kind"], where["register"], 0, tag)
        width = 1 if one.is_bits else _type(tag).value[1]
        return one._replace(end=one.begin + tag.count * width)


def _type(tag: Tag) -> Any:
    return AsyncModbusTcpClient.DATATYPE[tag.address["type"].upper()]


def _answer(place: _Place, cells: Sequence[Any]) -> TagReading:
    """Numbers in registers or bits; devices write NaN for unknown values."""
    found: Any = cells
    tag = place.tag
    if not place.is_bits:
        order = tag.address["word_order"]
        found = AsyncModbusTcpClient.convert_from_registers(cells, _type(tag), order)
    return TagReading.of(tag, f"{place.kind} {place.begin}", [*np.ravel(found)])


def _cells(place: _Place, values: Sequence[float]) -> Sequence[int]:
    """The registers, or the bits, of values."""
    tag = place.tag
    numbers = [tag.conversion.inverse(value) for value in values]
    if place.is_bits:
        return [int(number > 0.5) for number in numbers]
    if "int" in tag.address["type"]:  # as converters: the nearest one, and the lowest one for NaN
        limits = np.iinfo(tag.address["type"])
        numbers = [round(min(max(limits.min, number), limits.max)) for number in numbers]
    made: Sequence[int] = AsyncModbusTcpClient.convert_to_registers(
        numbers, _type(tag), tag.address["word_order"]
    )
    return made


def _places(plant: Plant) -> list[_Place]:
    """Places of all tags, in their order."""
    found = [_Place.of(plant, tag) for tag in plant.tags.values()]
    return sorted(found, key=lambda one: one[:4])


def _neighbours(places: Sequence[_Place]) -> list[list[_Place]]:
    """The places that are read at once, since they follow each other without a gap."""
    found: list[list[_Place]] = []
    for one in places:
        last = found[-1][-1] if found else None
        if last is not None and (*last[:2], last.end) == one[:3]:
            found[-1].append(one)
        else:
            found.append([one])
    return found


class ModbusClient:
    """Reads the tags of a plant; see ``TagClient``."""

    def __init__(self, plant: Plant) -> None:
        self._host, self._port = _host_and_port(plant.address)
        self._timeout = plant["timeout"]
        self._blocks = _neighbours(_places(plant))

    @asynccontextmanager
    async def connected(self) -> AsyncIterator[None]:
        """See ``TagClient``."""
        options = {"timeout": self._timeout, "retries": 0, "reconnect_delay": 0}
        self._client = AsyncModbusTcpClient(self._host, port=self._port, **options)
        try:
            if not await self._client.connect():
                raise ConnectionLostError("it refuses the connection, or does not answer")
            yield
        finally:
            self._client.close()

    async def read(self) -> dict[str, TagReading]:
        """See ``TagClient``."""
        found: dict[str, TagReading] = {}
        for block in self._blocks:
            begin = block[0].begin
            whole, fault = await self._ask(block[0]._replace(end=block[-1].end))
            for one in block:
                cells, why = whole[one.begin - begin : one.end - begin], fault
                if fault and len(block) > 1:  # another one may be the reason
                    cells, why = await self._ask(one)
                found[one.tag.name] = TagReading((), why) if why else _answer(one, cells)
        return found

    async def _ask(self, place: _Place) -> tuple[Sequence[Any], str]:
        """Ask for registers or bits; returns them, and the fault that the server tells."""
        ask = getattr(self._client, _KINDS[place.kind][1])
        if not self._client.connected:
            raise ConnectionLostError("the connection is lost")
        cells: list[Any] = []
        for begin in range(place.begin, place.end, _MOST):
            count = min(_MOST, place.end - begin)
            told = await ask(begin, count=count, device_id=place.unit_id)
            if told.isError():
                known, code = {one.value: one.name for one in ExcCodes}, told.exception_code
                where = f"{place.kind} {begin} of unit {place.unit_id}"
                return (), f"{where}: exception {code}, {known.get(code, 'unknown')}"
            cells += told.bits[:count] if place.is_bits else told.registers
        return cells, ""


def _host_and_port(address: str) -> tuple[str, int]:
    """The two parts of an address.

    Raises:
        ConfigError: If it is none.
    """
    with suppress(ValueError):  # the port is no number
        parts = urlsplit(f"//{address}")
        if parts.hostname:
            return parts.hostname, parts.port or _PORT
    raise ConfigError(f"expected an address such as '10.0.0.5:{_PORT}', got {shown(address)}")


@asynccontextmanager
async def serve_modbus(plant: Plant, port: int, values: Values) -> AsyncIterator[str]:
    """Serve tags on the loopback.

    Args:
        plant: Has the tags.
        port: The port; 0 for a free one.
        values: Returns the values of now, by the names of tags.

    Yields:
        The address.
    """
    places = _places(plant)
    for one, after in pairwise(places):
        if one[:2] == after[:2] and after.begin < one.end:
            text = f"it shares {one.kind} {after.begin} with {one.tag.name!r}"
            raise after.tag.entry.error(text)
    server = ModbusTcpServer([], address=("127.0.0.1", port))
    server.context = _Registers(places, values)
    await server.serve_forever(background=True)
    try:
        yield f"127.0.0.1:{server.transport.sockets[0].getsockname()[1]}"
    finally:
        await server.shutdown()


class _Registers(NamedTuple):
    """Registers and bits of a server, made of the present values."""

    places: Sequence[_Place]
    values: Values

    # The library gives these methods their names.

    async def async_getValues(self, unit_id: int, code: int, begin: int, count: int) -> Any:  # noqa: N802
        """Cells from an address on; cells between tags are 0."""
        found: dict[int, int] = {}
        now = self.values()
        for one in self.places:
            if (one.unit_id, _KINDS[one.kind][0]) == (unit_id, code):
                cells = _cells(one, now[one.tag.name])
                found |= zip(range(one.begin, one.end), cells, strict=True)
        if not (found and min(found) <= begin and begin + count <= max(found) + 1):
            return ExcCodes.ILLEGAL_ADDRESS
        return [found.get(place, 0) for place in range(begin, begin + count)]

    async def async_setValues(self, *_: Any) -> Any:  # noqa: N802
        """Refuse to be written."""
        return ExcCodes.ILLEGAL_FUNCTION
