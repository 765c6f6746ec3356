"""The parent's side of one worker: requests, time limits, and the causes of deaths."""

from __future__ import annotations

import contextlib
import logging
import math
import socket
import time
from collections import deque
from pathlib import Path
from typing import Any, Final

from fmugym.errors import printable
from fmugym.fmi.words import as_messages, quoted
from fmugym.pool.process.channel import Channel, Code
from fmugym.pool.process.last_words import describe_exit, lines_of_echo
from fmugym.pool.process.launcher import Process
from fmugym.pool.process.output import Output
from fmugym.pool.process.shared_memory import Memory, make_echo, make_progress
from fmugym.pool.process.transport import transport_for
from fmugym.pool.process.worker import Setup
from fmugym.pool.spec import INITIALIZATION_FACTOR
from fmugym.signals import Ignoring, ordinary

__all__ = ["INSTANTIATION", "ROLLOUT", "LostError", "Supervisor", "patience_with"]

INSTANTIATION: Final = "the instantiation"
ROLLOUT: Final = "a rollout"
_SLOW: Final = (INSTANTIATION, "a reset")
"""What may take ten times as long as other calls: models may need minutes to initialize."""

_MOST_DEATHS: Final = 5
"""Deaths in a row, without a successful reset, after which no worker is started any more."""

_FIRST_PAUSE: Final = 0.05
"""Seconds before a worker is started after its second death in a row; doubled for each more."""

_LAST_MOMENT: Final = 0.05
"""Seconds that a worker that has closed its channel may take to end."""

_LONGEST_KILL: Final = 2.0
"""Seconds that a killed process may take to end; a system call may hold it for longer."""

_TAIL: Final = 10
"""How many of the FMU's last messages the cause of a death quotes."""


def patience_with(doing: str) -> int:
    """How many call time-outs something may take."""
    return INITIALIZATION_FACTOR if doing in _SLOW else 1


class LostError(Exception):
    """The worker and all of its instances are lost; the text is the cause."""


class Supervisor:
    """Runs one worker, in one process after another.

    Args:
        setup: What the worker needs to know.
        memory: Shared with the worker.
        log: Gets the FMU's messages.

    Attributes:
        block: The indices of the worker's instances.
        generation: The number of processes that have ended.
        reason: Why the last process died.
        growth: By how many bytes the process has grown since its first resets.
        is_new: Whether no reset has succeeded in this process yet.
        known: The numbers of the lists of variables that this process knows.
        released: The snapshots without any reference left, by generation and number.
    """

    def __init__(
        self,
        setup: Setup,
        memory: Memory,
        log: logging.Logger,
    ) -> None:
        self.block = setup.block
        self.generation = 0
        self.reason = ""
        self.growth = 0
        self.is_new = True
        self.known: set[int] = set()
        self.released: deque[tuple[int, int]] = deque()
        self._setup, self._log = setup, log
        self._transport = transport_for(setup, memory)
        self._echo = make_echo(memory, setup.spec, setup.num_instances, setup.number)
        self._progress = make_progress(memory, setup.num_instances)[setup.block]
        self._done = b""
        self._output = Output()
        self._deaths = 0
        self._process: Process | None = None
        self._opening = self._busy = False
        self._asked = 0.0

    @property
    def pid(self) -> int:
        """The process number of the worker; 0 if there is no process."""
        return 0 if self._process is None else self._process.pid

    # The life of the process.

    def start(self) -> None:
        """Start a process, without waiting until it is ready.

        Raises:
            LostError: If the system refuses.
        """
        try:
            self._process, self._channel = self._launch()
        except ordinary(OSError, EOFError) as error:
            raise LostError(f"no worker process can be started: {error}") from None
        self._tail: deque[str] = deque(maxlen=_TAIL)
        self._echo[0] = 0
        self._fault: int | None = None
        self.growth, self.is_new = 0, True
        self.known.clear()
        self._play = -1
        self.tell("open", self._setup)
        self._opening = True

    def _launch(self) -> tuple[Process, Channel]:
        end, other_end = socket.socketpair()
        output = Output()
        try:
            with other_end:
                output.open()
                process = self._transport.launch(other_end, output.writing_ends)
        except BaseException:
            end.close()
            output.close()
            raise
        output.release_writing_ends()
        self._output = output
        coding, bell = self._transport.coding(), self._transport.bell()
        return process, Channel(end, process.sentinel, output, coding, bell)

    def revive(self) -> None:
        """Start a process if there is none, with longer and longer pauses between deaths.

        Raises:
            LostError: If too many have died in a row, or the system refuses.
        """
        if self._process is not None:
            return
        if self._deaths >= _MOST_DEATHS:
            raise LostError(self.reason)
        if self._deaths > 1:
            time.sleep(_FIRST_PAUSE * 2 ** (self._deaths - 2))
        try:
            self.start()
        except LostError as error:
            self.reason = str(error)
            raise

    def start_ahead(self) -> None:
        """Start a process before it is needed, but only after a first death."""
        if self._process is None and self._deaths == 1:
            with contextlib.suppress(LostError):  # there is time to try again
                self.start()

    def bury(self, reason: str) -> None:
        """End the process if there is one, and free its resources."""
        if self._process is None:
            return
        self._process.kill()
        self._process.exit_status(_LONGEST_KILL)
        self._output.drain()
        self._forget_process(reason)

    def _forget_process(self, reason: str) -> None:
        self.forget()
        self._opening = self._busy = False
        self.generation += 1
        self._deaths += 1
        gone = self._deaths >= _MOST_DEATHS
        prefix = f"given up after {self._deaths} deaths in a row: " if gone else ""
        self.reason = prefix + reason

    def retire(self, reason: str, deadline: float) -> None:
        """End a process that has not failed, in an orderly way."""
        deaths = self._deaths
        self.begin_closing()
        self.close(deadline)
        self._deaths, self.reason = deaths, printable(f"{self._setup.path.name}: {reason}")

    def note_success(self) -> None:
        """Remember that a reset has succeeded."""
        self.is_new = False
        self._deaths = 0

    def forget(self) -> None:
        """Let go of the process without ending it, as a fork of this process has to."""
        if self._process is not None:
            self._channel.close()
            self._process.forget()
            self._process = None
            self._output.close()

    def begin_closing(self) -> None:
        """Ask the worker to free its instances; end it at once if it has not made them yet."""
        if self._opening:
            self.bury("the pool was closed")
        if self._process is not None:
            self.tell("close")

    def close(self, deadline: float) -> None:
        """Wait until it has freed them, and end it if this takes too long."""
        if self._process is None:
            return
        try:
            self.reply(deadline, "its end")
        except LostError as error:
            self._log.warning("%s", error)
        self.bury("the pool was closed")

    # Requests and replies.

    @property
    def is_busy(self) -> bool:
        """Whether a reply is due."""
        return self._busy

    def step(self, code: bytes) -> None:
        """Ask the worker to step; failures show in the reply."""
        self._busy, self._asked = True, time.monotonic()
        try:
            if self.released:
                self._release()
            self._channel.send_code(code)
        except ordinary(OSError):  # "Ignoring" takes longer
            return

    def tell(self, name: str, *arguments: Any) -> None:
        """Ask for a call of one of the worker's methods; failures show in the reply."""
        self._busy, self._asked = True, time.monotonic()
        self._output.pump()
        with Ignoring(OSError):
            if self.released:
                self._release()
            self._channel.send_object(Code.REQUEST, (name, arguments))

    def roll_out(self, number: int, play: Any, steps: Any, departure: Any) -> None:
        """Ask for a rollout; failures show in the reply.

        Args:
            number: The number of the play.
            play: What surrounds the steps.
            steps: Those of the episodes until now, shape of the block.
            departure: See ``RollingWorker.roll_out``.
        """
        told = None if number == self._play else play
        self._play = number
        self._progress[:] = steps
        self._done = self._progress.tobytes()
        self.tell("roll_out", told, departure)

    def forget_output(self) -> None:
        """Forget what was printed, because it would not explain a later failure."""
        self._output.drain()
        self._output.clear()

    @property
    def printed(self) -> str:
        """The telling ones of the last lines since ``forget_output``, to end an error's text."""
        self._output.drain()
        return quoted(as_messages(self._output.lines()), "it printed")

    def _release(self) -> None:
        generation, numbers = self.generation, []
        while self.released:
            owner, number = self.released.popleft()
            numbers += [number] if owner == generation else []
        self._channel.send_object(Code.RELEASE, numbers)

    def reply(self, deadline: float, doing: str) -> Any:
        """Wait for the reply.

        Args:
            deadline: Until when, in the time of ``time.monotonic``.
            doing: What the worker does, for the cause of a death.

        Returns:
            ``Code.FINE`` or ``Code.TROUBLE`` for a step; what the method returned; or the
            exception that it raised.

        Raises:
            LostError: If the worker has died or is late.
        """
        if self._opening:
            self.finish_opening(deadline)
        result = self._receive(deadline, doing)
        self._busy = False
        return result

    def finish_opening(self, deadline: float) -> None:
        """Wait until a new worker has made its instances.

        Raises:
            LostError: If it could not make them.
        """
        result = self._receive(deadline, INSTANTIATION)
        self._opening = False
        if isinstance(result, Exception):
            self.bury(f"{result}{self.printed}")
            raise LostError(self.reason) from result

    def _receive(self, deadline: float, doing: str) -> Any:
        while True:
            left = deadline - time.monotonic() if deadline < math.inf else None
            if not self._channel.wait(left):
                if time.monotonic() >= deadline and not _is_debugged(self.pid):
                    deadline = self._extended(deadline, doing)
                continue
            try:
                code = self._channel.receive_code()
                if code == Code.FINE or code == Code.TROUBLE:
                    return code
                content = self._channel.receive_object(code)
            except ordinary(EOFError, OSError):
                self._explain_death(doing)
            if code == Code.LOG:
                self._pass_on(*content)
            elif code == Code.FAULT:
                self._fault = content
            else:
                return content

    def _pass_on(self, level: int, message: str) -> None:
        self._tail.append(message)
        self._log.log(level, "%s", message)

    def _explain_death(self, doing: str) -> None:
        assert self._process is not None
        pid, status = self._process.pid, self._process.exit_status(_LAST_MOMENT)
        if status is None:
            self._process.kill()
            self._process.exit_status(_LONGEST_KILL)
        status = status if self._fault is None else self._fault
        self._output.drain()
        how = "closed its connection" if status is None else f"ended with {describe_exit(status)}"
        self._forget_process(self._cause(f"worker process {pid} {how} in {doing}"))
        raise LostError(self.reason)

    def _extended(self, deadline: float, doing: str) -> float:
        """Give a rollout more time if it has done steps since it got time last; end what hangs."""
        done = self._progress.tobytes()
        if doing != ROLLOUT or done == self._done:
            self._end_hang(doing)
        patience = deadline - self._asked
        self._done, self._asked = done, time.monotonic()
        return self._asked + patience

    def _end_hang(self, doing: str) -> None:
        """End a worker that is late; messages that it has not sent yet are lost."""
        factor = "ten times " if patience_with(doing) > 1 else ""
        seconds = time.monotonic() - self._asked
        what = (
            f"worker process {self.pid} took longer than {factor}call_timeout for {doing} and was "
            f"ended after {seconds:.3g} s"
        )
        self._output.drain()
        self.bury(self._cause(what))
        raise LostError(self.reason)

    def _cause(self, text: str) -> str:
        lines = lines_of_echo(self._echo.tobytes()) or list(self._tail)
        said = quoted(as_messages(lines))
        return printable(f"{self._setup.path.name}: {text}{said}{self.printed}")


def _is_debugged(pid: int) -> bool:
    """Whether a debugger holds the process, which may then take its time; known on Linux only."""
    try:
        status = Path(f"/proc/{pid}/status").read_text()
    except ordinary(OSError):
        return False
    return any(
        line.startswith("TracerPid:") and line.split()[1] != "0" for line in status.splitlines()
    )
