"""How a worker is started and spoken to: one of Python, or the program for Windows in Wine."""

from __future__ import annotations

import socket
from abc import ABC, abstractmethod
from collections.abc import Sequence

from fmugym.pool.process.channel import Coding, Pickled
from fmugym.pool.process.fork_server import Program
from fmugym.pool.process.launcher import Process, launch, launch_program
from fmugym.pool.process.shared_memory import Memory, make_bell
from fmugym.pool.process.windows import ProgramCoding
from fmugym.pool.process.worker import Setup
from fmugym.wine.prefix import Wine

__all__ = ["Transport", "transport_for"]


class Transport(ABC):
    """What differs between kinds of workers.

    Args:
        setup: What the worker needs to know.
        memory: Shared with the worker.
    """

    def __init__(self, setup: Setup, memory: Memory) -> None:
        self._setup, self._memory = setup, memory

    @abstractmethod
    def launch(self, end: socket.socket, pipes: Sequence[int]) -> Process:
        """Start a process.

        Args:
            end: Its end of the channel. The caller may close it afterwards.
            pipes: For what it prints.

        Raises:
            OSError: If the system refuses.
        """

    @abstractmethod
    def coding(self) -> Coding:
        """How to speak to a new process."""

    def bell(self) -> memoryview | None:
        """What to ring before each message, if the process watches it; see ``Channel``."""
        return None


class _PythonTransport(Transport):
    """A process of Python."""

    def launch(self, end: socket.socket, pipes: Sequence[int]) -> Process:
        return launch(end, self._memory, self._setup.folder, pipes)

    def coding(self) -> Coding:
        return Pickled()


class _WineTransport(Transport):
    """The worker program in Wine."""

    def __init__(self, setup: Setup, memory: Memory, wine: Wine) -> None:
        super().__init__(setup, memory)
        self._wine = wine

    def launch(self, end: socket.socket, pipes: Sequence[int]) -> Process:
        setup = self._setup
        environment = self._wine.environment(setup.environment)
        program = Program(self._wine.command, environment, setup.directory or str(setup.folder))
        return launch_program(end, program, setup.folder, pipes)

    def coding(self) -> Coding:
        return ProgramCoding(self._memory)

    def bell(self) -> memoryview:
        setup = self._setup
        return make_bell(self._memory, setup.spec, setup.num_instances, setup.number)


def transport_for(setup: Setup, memory: Memory) -> Transport:
    """Make the transport for a worker."""
    if setup.wine is not None:
        return _WineTransport(setup, memory, setup.wine)
    return _PythonTransport(setup, memory)
