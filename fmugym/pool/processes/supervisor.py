"""The parent's side of one worker: requests, time limits, and the causes of deaths."""

from __future__ import annotations

import contextlib
import logging
import math
import os
import signal
import socket
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, Final, NamedTuple, NoReturn

from fmugym.errors import FMULoadError, printable
from fmugym.pool.engine import Answer, Answers, DamagedError, Reader, Request
from fmugym.pool.failure_texts import MORE_PROCESSES, Receiver, as_messages, loading_failed, quoted
from fmugym.pool.health import Arrays
from fmugym.pool.pool_spec import INITIALIZATION_FACTOR
from fmugym.pool.processes.channel import Channel, LateError, Output, describe_exit, lines_of_echo
from fmugym.pool.processes.guard import LONGEST_START
from fmugym.pool.processes.launcher import Process, launch
from fmugym.pool.processes.shared_memory import BlockCopies, Memory
from fmugym.pool.processes.worker_setup import Setup

__all__ = [
    "A_STEP",
    "INSTANTIATION",
    "INTERRUPTED",
    "RESET",
    "Loss",
    "LostError",
    "RefusedError",
    "Supervisor",
    "WorkerError",
    "timeout_factor",
]

INSTANTIATION: Final = "the instantiation"
RESET: Final = "a reset"
A_STEP: Final = "a step"
INTERRUPTED: Final = "the call was interrupted"
_SLOW: Final = (INSTANTIATION, RESET)
"""What may take ten times as long as other calls: models may need minutes to initialize."""

_MOST_DEATHS: Final = 5
"""Deaths in a row, without a successful reset, after which no worker is started any more."""

_FIRST_PAUSE: Final = 0.05
"""Seconds before a worker is started after its second death in a row; doubled for each more."""

_LAST_MOMENT: Final = 0.5
"""Seconds that a worker that has closed its channel may take to end."""

_LONGEST_KILL: Final = 2.0
"""Seconds that a killed process may take to end; a system call may hold it for longer."""

_GIVEN_UP: Final = "ended with exit status 1"
"""What Wine does if it gets no server."""

_STEPPED: Final = (Answer.RESULT, Answer.TROUBLE)


def timeout_factor(doing: str) -> int:
    """Number of call time-outs that something may take."""
    return INITIALIZATION_FACTOR if doing in _SLOW else 1


class LostError(Exception):
    """The worker and all of its instances are lost; the text is the cause."""


class RefusedError(LostError):
    """The FMU could not be loaded or instantiated; its process is in order."""


class Loss(NamedTuple):
    """Death or hang of a process.

    Attributes:
        how: What it did: ``"ended with signal SIGSEGV"``, for example.
        is_late: Whether it was ended because it did not answer in time.
        lines: The last messages of its FMU, and what it printed last.
    """

    how: str
    is_late: bool
    lines: list[str]


class WorkerError(FMULoadError):
    """A worker could not be started, or did not survive the instantiation.

    Attributes:
        loss: How it died or hung; None if it could not be started.
    """

    loss: Loss | None = None


class Supervisor:
    """Runs one worker, in one process after another.

    Args:
        setup: What the worker needs to know.
        memory: Shared with the worker.
        arrays: Those of all instances of the pool.
        log: Gets the FMU's messages.

    Attributes:
        block: The indices of the worker's instances.
        answers: Reads the worker's answers.
        reason: Why the last process died.
        growth: By how many bytes the process has grown since its first resets.
        is_new: Whether no reset has succeeded in this process yet.
        is_busy: Whether a reply is due.
        receiver: Gets the messages of the worker's FMUs.
        deadline: Until when the worker has to read a request, in the time of ``time.monotonic``.
        initializations: How many initializations its processes have begun.
        losses: How processes died or hung, in their order.
        counts: What its instances do; see ``Arrays``.
        take_counts: Copies them to the arrays of the pool.
        kills: How many of them were killed from outside, as by the system if memory is short.
    """

    def __init__(
        self,
        setup: Setup,
        memory: Memory,
        arrays: Arrays,
        log: logging.Logger,
    ) -> None:
        self.block = setup.block
        self.answers = Answers(setup.description, setup.spec, setup.block)
        self.reason = ""
        self.losses: list[Loss] = []
        self.initializations = self.kills = 0
        self.growth = 0
        self.is_new = True
        self.deadline = math.inf
        self.receiver = Receiver(log, setup.description, setup.block.start)
        self._setup, self._log, self._memory = setup, log, memory
        self._echo = memory.echo
        self.counts = memory.arrays.counts
        copies = self._copies = BlockCopies(arrays, setup.block, memory)
        self.take_counts = copies.take_counts
        self._read: Callable[[Reader], Any] | None = None
        self._content = b""
        self._output = Output(setup.on_trial)
        self._deaths = 0
        self._process: Process | None = None
        self._opening = self.is_busy = False
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
        with self._ending_if_interrupted():
            self.begin()
            self.confirm()

    def begin(self) -> None:
        """Begin to start a process; see ``confirm``.

        Raises:
            LostError: If the system refuses.
        """
        self._opening = True
        try:
            with _refusals():
                setup = self._setup.prepared()
                setup.lend(setup.texts)
                self._content = setup.opening(self._memory)
                self._process, self._channel = self._launch(setup)
        except LostError:
            self._opening = False
            raise

    def confirm(self) -> None:
        """Wait for the process, and send it the request to open.

        Raises:
            LostError: If the system refuses.
        """
        assert self._process is not None
        try:
            with _refusals():
                self._process.confirm()
        except LostError:
            self.forget()
            self._opening = False
            raise
        self._echo[0] = 0
        self._fault: int | None = None
        self.growth, self.is_new = 0, True
        self._initializations = 0
        self.tell(Request.OPEN, self._content)
        self._content = b""

    def _launch(self, setup: Setup) -> tuple[Process, Channel]:
        end, other_end = socket.socketpair()
        output = Output(setup.on_trial)
        try:
            with other_end:
                output.open()
                process = launch(other_end, self._memory, setup.order(), output.writing_ends)
        except BaseException:
            end.close()
            output.close()
            raise
        output.release_writing_ends()
        self._output = output
        return process, Channel(end, process.sentinel, output, self._memory.bell)

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
        if not self._ends_by_itself(self._process):
            self._process.kill()
            self._process.exit_status(_LONGEST_KILL)
        self._output.drain()
        self._forget_process(reason)

    def interrupt(self) -> None:
        """End the process, of which a call was interrupted; that is no death of its own."""
        deaths = self._deaths
        self.bury(INTERRUPTED)
        self._opening = self.is_busy = False
        self._deaths, self.reason = deaths, printable(f"{self._name}: {INTERRUPTED}")

    @contextlib.contextmanager
    def _ending_if_interrupted(self) -> Iterator[None]:
        """End the process if a signal handler raises in the middle of its start or of its end."""
        try:
            yield
        except LostError:
            raise
        except BaseException:
            self.interrupt()
            raise

    def _ends_by_itself(self, process: Process) -> bool:
        """Let a worker end that Wine may still be starting; see ``LONGEST_START``."""
        time_left = self._asked + LONGEST_START - time.monotonic()
        if self._setup.wine is None or not self._opening or time_left <= 0.0:
            return False
        self._channel.close()
        return process.exit_status(time_left) is not None

    def _forget_process(self, reason: str) -> None:
        self.forget()
        self._opening = self.is_busy = False
        self._deaths += 1
        gone = self._deaths >= _MOST_DEATHS
        prefix = f"given up after {self._deaths} deaths in a row: " if gone else ""
        self.reason = prefix + reason

    def retire(self, reason: str, deadline: float) -> None:
        """End a process that has not failed, in an orderly way."""
        deaths = self._deaths
        with self._ending_if_interrupted():
            self.begin_closing()
            self.close(deadline)
        self.is_new = True  # the next one will be
        self._deaths, self.reason = deaths, printable(f"{self._name}: {reason}")

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
            self.tell(Request.CLOSE)

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

    def step(self) -> None:
        """Ask the worker to step; failures show in the reply."""
        self.is_busy, self._asked, self._read = True, time.monotonic(), None
        self._copies.give_for_step()
        try:
            self._channel.send(Request.STEP, deadline=self.deadline)
        except OSError:  # "Ignoring" takes longer
            return

    def tell(
        self,
        request: Request,
        content: bytes = b"",
        read: Callable[[Reader], Any] = Reader.end,
    ) -> None:
        """Ask the worker for something; failures show in the reply.

        Args:
            request: What it is asked for.
            content: The content of the request.
            read: Reads the answer; raises a ``DamagedError`` if it is none.
        """
        self.is_busy, self._asked, self._read = True, time.monotonic(), read
        self._copies.give()
        self._output.pump()
        with suppress(OSError):
            self._channel.send(request, content, self.deadline)

    def lend(self, texts: Sequence[str]) -> None:
        """See ``Setup.lend``."""
        self._setup.lend(texts)

    def forget_output(self) -> None:
        """Forget printed text, because it would not explain a later failure."""
        self._output.drain()
        self._output.clear()

    @property
    def printed(self) -> str:
        """The telling ones of the last lines since ``forget_output``, to end an error's text."""
        self._output.drain()
        return quoted(as_messages(self._output.lines()), "it printed")

    def reply(self, deadline: float, doing: str) -> Any:
        """Wait for the reply.

        Args:
            deadline: Until when, in the time of ``time.monotonic``.
            doing: What the worker does, for the cause of a death.

        Returns:
            ``Answer.RESULT`` or ``TROUBLE`` for a step; the result; or a ``SimulationError``.

        Raises:
            LostError: If the worker has died or is late.
        """
        if self._opening:
            self.finish_opening(deadline)
        result = self._receive(deadline, doing, self._read)
        self._copies.take()
        self.is_busy = False
        return result

    def finish_opening(self, deadline: float) -> None:
        """Wait until a new worker has made its instances.

        Raises:
            LostError: If it could not make them.
        """
        result = self._receive(deadline, INSTANTIATION, Reader.end)
        self._opening = False
        if isinstance(result, Exception):
            self.bury(f"{self._why_not_loaded(result.args[0])}{self.printed}")
            raise RefusedError(self.reason)

    def opens_again(self) -> bool:
        """Start a process in the place of one that Wine has ended before it could run.

        Wine does so if its server takes more than six seconds to end. The next process gets a
        server of its own.

        Raises:
            LostError: If the system refuses.
        """
        is_first = self._deaths == 1 and self._setup.wine is not None
        if not is_first or not self.losses or self.losses[0].how != _GIVEN_UP:
            return False
        self.losses.clear()
        self.start()
        return True

    def _why_not_loaded(self, text: str) -> str:
        """Name missing libraries, or else quote the worker."""
        try:
            if self._setup.wine is None:
                self._setup.fmu.require_libraries(self._setup.folder)
        except FMULoadError as error:
            return str(error)
        return loading_failed(self._name, text, self._setup.folder, MORE_PROCESSES)

    def _receive(self, deadline: float, doing: str, read: Callable[[Reader], Any] | None) -> Any:
        while True:
            left = deadline - time.monotonic() if deadline < math.inf else None
            result = None
            if self._channel.wait(left):
                try:
                    code, size = self._channel.receive_head(deadline)
                    if read is None and not size and code in _STEPPED:
                        return code
                    result = self._take(code, self._channel.receive_content(size, deadline), read)
                except LateError:
                    self._end_hang(doing)
                except (EOFError, OSError):
                    self._explain_death(doing)
                except DamagedError as error:
                    self._end(f"has sent what is no answer in {doing}", error)
            if result is not None:
                return result[0]
            if time.monotonic() >= deadline and not _is_debugged(self.pid):
                self._end_hang(doing)

    def _take(
        self, code: int, content: bytes, read: Callable[[Reader], Any] | None
    ) -> tuple[Any] | None:
        """Take a message; returns the answer to the request if it is one."""
        reader = Reader(content)
        if code == Answer.LOG:
            self._pass_on(reader)
        elif code == Answer.FAULT:
            self._fault = reader.integer()
        elif read is None:
            raise DamagedError(f"the code {code}")
        else:
            return (self.answers.result(code, reader, read),)
        return None

    def read_growth(self, reader: Reader) -> None:
        """Read the answer to a reset."""
        self.growth, count = reader.integer(), reader.integer()
        reader.end()
        self.initializations += max(0, count - self._initializations)
        self._initializations = count

    def _pass_on(self, reader: Reader) -> None:
        index = reader.index(self.receiver.sources * self._setup.count)
        self.receiver(index, reader.integer(), reader.text(), reader.text())

    @property
    def _name(self) -> str:
        return self._setup.fmu.path.name

    def _explain_death(self, doing: str) -> NoReturn:
        assert self._process is not None
        pid, status = self._process.pid, self._process.exit_status(_LAST_MOMENT)
        if status is None:
            self._process.kill()
            self._process.exit_status(_LONGEST_KILL)
        status = status if self._fault is None else self._fault
        self.kills += status == -signal.SIGKILL
        how = "closed its connection" if status is None else f"ended with {describe_exit(status)}"
        self._note_loss(how)
        self._forget_process(self._cause(f"worker process {pid} {how} in {doing}"))
        raise LostError(self.reason)

    def _end_hang(self, doing: str) -> NoReturn:
        """End a worker that is late; messages that it has not sent yet are lost."""
        factor = "ten times " if timeout_factor(doing) > 1 else ""
        seconds = time.monotonic() - self._asked
        how = f"took longer than {factor}call_timeout for {doing} and was ended after"
        self._end(f"{how} {seconds:.3g} s", is_late=True)

    def _end(self, how: str, error: Exception | None = None, *, is_late: bool = False) -> NoReturn:
        """End a worker that lives, but is of no use."""
        self._note_loss(how, is_late)
        self.bury(self._cause(f"worker process {self.pid} {how}"))
        raise LostError(self.reason) from error

    def _note_loss(self, how: str, is_late: bool = False) -> None:
        self._output.drain()
        self.losses.append(Loss(how, is_late, self._last_messages() + self._output.lines()))

    def _last_messages(self) -> list[str]:
        return lines_of_echo(self._echo.tobytes())

    def _cause(self, text: str) -> str:
        said = quoted(as_messages(self._last_messages()))
        return printable(f"{self._name}: {text}{said}{self.printed}")


@contextlib.contextmanager
def _refusals() -> Iterator[None]:
    """Turn refusals of the system into the loss of a worker."""
    try:
        yield
    except FMULoadError as error:
        raise LostError(str(error)) from None
    except (OSError, EOFError) as error:
        raise LostError(f"no worker process can be started: {error}") from None


def _is_debugged(pid: int) -> bool:
    """Whether a debugger holds the process, which may then take its time; known on Linux only.

    An FMU may have itself traced, by its parent or by a fork of its process; they are no debuggers.
    """
    try:
        lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    except OSError:
        return False
    told = {name: value.strip() for name, _, value in (line.partition(":") for line in lines)}
    tracer = told["TracerPid"]
    return tracer not in ("0", told["PPid"]) and _program(tracer) != _program(str(pid))


def _program(process: str) -> str:
    """The file of the program that a process runs; "" if it is another user's."""
    try:
        return os.readlink(f"/proc/{process}/exe")
    except OSError:
        return ""
