"""Poller of tags: the interface of clients, and the thread that asks them periodically.

The thread runs a coroutine.
"""

from __future__ import annotations

import asyncio
import math
import threading
from collections import deque
from collections.abc import Callable, Coroutine, Mapping, Sequence
from contextlib import AbstractAsyncContextManager, AsyncExitStack, suppress
from typing import Any, Final, NamedTuple, Protocol

from fmugym.deployment.plant.tags import Plant, Tag
from fmugym.errors import FMUGymError
from fmugym.extras import imported
from fmugym.pool.rig.clocks import Clock, speed_of

__all__ = [
    "BackgroundLoop",
    "CertificateError",
    "ConnectionLostError",
    "PlantProtocol",
    "Poller",
    "Round",
    "TagClient",
    "TagReading",
    "Values",
    "protocol_of",
]

_JOIN_SECONDS: Final = 0.1
"""Time to wait for the effect of a cancellation, in seconds."""


class BackgroundLoop:
    """Runs a coroutine in a thread until it ends, or is stopped.

    Args:
        make: Makes the coroutine.
        name: Name of the thread.

    Attributes:
        error: Exception of the coroutine, or None.
    """

    def __init__(self, make: Callable[[], Coroutine[Any, Any, None]], name: str) -> None:
        self.error: BaseException | None = None
        self._loop = asyncio.new_event_loop()
        self._task = self._loop.create_task(make())
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        with asyncio.Runner(loop_factory=lambda: self._loop) as runner:
            runner.run(asyncio.wait([self._task]))
            self.error = None if self._task.cancelled() else self._task.exception()

    def join(self, seconds: float) -> bool:
        """Wait for its end, for some time; tells whether it has come."""
        self._thread.join(seconds)
        return not self._thread.is_alive()

    def stop(self) -> None:
        """Cancel the coroutine, and wait for its end.

        Libraries lose cancellations: ``asyncio.wait_for`` does so until Python 3.12.
        """
        while not self.join(0.0):
            with suppress(RuntimeError):  # the loop is closed
                self._loop.call_soon_threadsafe(self._task.cancel)
            self.join(_JOIN_SECONDS)


Values = Callable[[], Mapping[str, Sequence[float]]]

_MOST: Final = 10_000
"""So many rounds are kept until they are used."""


_REFUSALS: Final = ("Certificate", "Security", "Identity", "UserAccess")
"""Words in the names of errors of a server that refuses a client, or is refused."""


class ConnectionLostError(FMUGymError):
    """The server is not there, or does not answer."""


class CertificateError(ConnectionLostError):
    """This client does not want the server."""


class TagReading(NamedTuple):
    """Answer of a server about a tag.

    Attributes:
        numbers: In the unit of the task.
        fault: Fault of the numbers; "" for good ones.
    """

    numbers: tuple[float, ...]
    fault: str = ""

    @classmethod
    def of(cls, tag: Tag, where: str, numbers: Sequence[float]) -> TagReading:
        """The numbers of a plant in the unit of the task, if they are finite."""
        if not all(map(math.isfinite, numbers)):
            return cls((), f"{where} has no finite number")
        return cls(tuple(tag.conversion(float(number)) for number in numbers))


class Round(NamedTuple):
    """The answers for all tags, and when they were asked for: they are no older."""

    asked: float
    answers: dict[str, TagReading]


class TagClient(Protocol):
    """Interface of a client, which reads from a server and has no method that writes."""

    def connected(self) -> AbstractAsyncContextManager[None]:
        """Connect, and disconnect in the end, whatever has happened before.

        Raises:
            Exception: If it cannot connect.
        """

    async def read(self) -> dict[str, TagReading]:
        """Read all tags.

        Raises:
            Exception: If the server does not answer.
        """


class PlantProtocol(NamedTuple):
    """The client of a protocol, and the server of the tags of a simulated plant."""

    client: Callable[[Plant], TagClient]
    serve: Callable[[Plant, int, Values], AbstractAsyncContextManager[str]]


def protocol_of(plant: Plant) -> PlantProtocol:
    """Import the protocol of a plant.

    Raises:
        ConfigError: If the extra ``plant`` is missing.
    """
    module: Any = imported(f"fmugym.deployment.plant.{plant['protocol']}", "plant")
    if plant["protocol"] == "modbus":
        return PlantProtocol(module.ModbusClient, module.serve_modbus)
    return PlantProtocol(module.OPCUAClient, module.serve_opcua)


class Poller:
    """Asks a client again and again, in a thread of its own, and connects anew when it must.

    Args:
        client: The client.
        clock: The monotonic clock by which values are asked for.
        interval: Time from one question to the next, in s of the clock.
        timeout: How long an answer may take, in s of real time.

    Attributes:
        answers: The latest ones; none before the first.
        is_refused: Whether this client was refused when it last connected.
    """

    def __init__(self, client: TagClient, clock: Clock, interval: float, timeout: float) -> None:
        self._client, self._clock, self._timeout = client, clock, timeout
        self._interval, self._speed = interval, speed_of(clock)
        self._rounds: deque[Round] = deque(maxlen=_MOST)
        self._trouble = "it has not answered yet"
        self.answers: dict[str, TagReading] = {}
        self.is_refused = False
        self._background = BackgroundLoop(self._poll, "plant")

    async def _poll(self) -> None:
        while True:
            async with AsyncExitStack() as connection:
                try:
                    await self._converse(connection)
                except TimeoutError:
                    self._trouble = f"it does not answer within {self._timeout:g} s"
                except Exception as error:  # whatever a library makes of a broken line
                    self._note(error)
            await asyncio.sleep(self._interval / self._speed)

    def _note(self, error: Exception) -> None:
        name = type(error).__name__
        self.is_refused = any(word in name for word in _REFUSALS)
        what = "it refuses this client" if self.is_refused else "it does not answer"
        is_own = isinstance(error, ConnectionLostError)
        self._trouble = str(error) if is_own else f"{what}: {name} {error}".strip()

    async def _converse(self, connection: AsyncExitStack) -> None:
        async with asyncio.timeout(self._timeout):
            await connection.enter_async_context(self._client.connected())
        while True:
            begin = self._clock.time()
            async with asyncio.timeout(self._timeout):
                self.answers = await self._client.read()
            self._trouble = ""
            self._rounds.append(Round(begin, self.answers))
            rest = begin + self._interval - self._clock.time()
            await asyncio.sleep(max(0.0, rest / self._speed))

    def take(self, end: float) -> list[Round]:
        """Take the rounds until some time that nobody has taken."""
        found = []
        while self._rounds and self._rounds[0].asked <= end:
            found.append(self._rounds.popleft())
        return found

    def trouble(self, name: str) -> str:
        """Present fault of a tag; "" for none."""
        return self._trouble or (self.answers[name].fault if self.answers else "")

    def stop(self) -> None:
        """End the thread."""
        self._background.stop()
