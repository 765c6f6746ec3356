"""What a client of a protocol offers, and the thread that asks it again and again."""

from __future__ import annotations

import asyncio
import threading
from collections import deque
from typing import Final, NamedTuple, Protocol

from fmugym.errors import ConfigError, FMUGymError, shown
from fmugym.plant.background import Background
from fmugym.pool.backend.clocks import Clock
from fmugym.signals import ordinary

__all__ = ["Answer", "Client", "LostError", "Poller", "Reading", "RefusedError", "host_and_port"]

_MOST: Final = 100_000
"""So many readings of a tag are kept until they are used."""


class LostError(FMUGymError):
    """The server is not there, or does not answer."""


class RefusedError(LostError):
    """The server does not want this client, or this client does not want the server."""


class Answer(NamedTuple):
    """What a server says of a tag.

    Attributes:
        numbers: In the unit of the task.
        fault: What is wrong with them; "" if they are good.
    """

    numbers: tuple[float, ...]
    fault: str = ""


class Reading(NamedTuple):
    """A good answer, and when it was asked for on the monotonic clock: it is no older."""

    asked: float
    numbers: tuple[float, ...]


class Client(Protocol):
    """Reads from a server. It has no method that writes."""

    async def connect(self) -> None:
        """Connect.

        Raises:
            LostError: If that fails.
        """

    async def read(self) -> dict[str, Answer]:
        """Read all tags.

        Raises:
            LostError: If the server does not answer.
        """

    async def close(self) -> None:
        """Disconnect, whatever has happened before."""


class Poller:
    """Asks a client again and again, in a thread of its own, and connects anew when it must.

    Args:
        client: The client.
        clock: The monotonic clock by which values are asked for.
        interval: Time from one question to the next, in s of the clock.
        timeout: How long an answer may take, in s of real time.

    Attributes:
        has_answered: Whether there was an answer.
        is_refused: Whether this client was refused when it last connected.
    """

    def __init__(self, client: Client, clock: Clock, interval: float, timeout: float) -> None:
        self._client, self._clock, self._timeout = client, clock, timeout
        self._interval, self._speed = interval, getattr(clock, "speed", 1.0)
        self._lock = threading.Lock()
        self._readings: dict[str, deque[Reading]] = {}
        self._faults: dict[str, str] = {}
        self._trouble = "it has not answered yet"
        self.has_answered = self.is_refused = False
        self._background = Background(self._poll, "plant")

    async def _poll(self) -> None:
        while True:
            try:
                await self._converse()
            except ordinary(TimeoutError):
                self._note(f"it does not answer within {self._timeout:g} s")
            except ordinary(Exception) as error:  # whatever a library makes of a broken line
                is_own = isinstance(error, LostError)
                self._note(str(error) if is_own else f"{type(error).__name__}: {error}")
                self.is_refused = isinstance(error, RefusedError)
            finally:
                await self._client.close()
            await asyncio.sleep(self._interval / self._speed)

    async def _converse(self) -> None:
        async with asyncio.timeout(self._timeout):
            await self._client.connect()
        while True:
            begin = self._clock.time()
            async with asyncio.timeout(self._timeout):
                answers = await self._client.read()
            self._take(answers, begin)
            rest = begin + self._interval - self._clock.time()
            await asyncio.sleep(max(0.0, rest / self._speed))

    def _note(self, trouble: str) -> None:
        with self._lock:
            self._trouble = trouble

    def _take(self, answers: dict[str, Answer], asked: float) -> None:
        with self._lock:
            self._trouble, self.has_answered = "", True
            self._faults = {name: one.fault for name, one in answers.items() if one.fault}
            for name, one in answers.items():
                if not one.fault:
                    kept = self._readings.setdefault(name, deque(maxlen=_MOST))
                    kept.append(Reading(asked, one.numbers))

    def between(self, name: str, begin: float, end: float) -> list[Reading]:
        """The readings of a tag, asked for between two times, and the last one before.

        Earlier ones are forgotten.
        """
        with self._lock:
            kept = self._readings.get(name, deque())
            while len(kept) > 1 and kept[1].asked <= begin:
                kept.popleft()
            return [one for one in kept if one.asked <= end]

    def trouble(self, name: str) -> str:
        """What is wrong with a tag now; "" if nothing is."""
        with self._lock:
            return self._trouble or self._faults.get(name, "")

    def stop(self) -> None:
        """End the thread."""
        self._background.stop()


def host_and_port(address: str, usual: int) -> tuple[str, int]:
    """The two parts of an address.

    Raises:
        ConfigError: If it is none.
    """
    host, separator, port = address.rpartition(":")
    if not separator:
        return address, usual
    if not host or not port.isdecimal():
        raise ConfigError(f"expected an address such as '10.0.0.5:{usual}', got {shown(address)}")
    return host, int(port)
