"""The worker of a pool of processes: it has a pool of its own for a block of the instances.

It answers the requests of its channel until the other end is closed. The arrays of its block are
copied from and to shared memory here, so that all workers copy at the same time.
"""

from __future__ import annotations

import itertools
import logging
import os
import shutil
import signal
import socket
import traceback
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import numpy.typing as npt

from fmugym.archive.description import ModelDescription
from fmugym.archive.fmu import FMU
from fmugym.archive.loadable import ExtractedFMU
from fmugym.archive.safe_zip import ArchiveLimits
from fmugym.archive.texts import text_of
from fmugym.archive.variable import Variable
from fmugym.errors import FMUGymError, FMULoadError
from fmugym.fmi.status import WARNING_CODE
from fmugym.pool.base import FloatArray, MaskArray, PoolSpec
from fmugym.pool.bundle import IndexArray
from fmugym.pool.health import HealthArray
from fmugym.pool.leaks import ProcessGrowth
from fmugym.pool.local import local_pool
from fmugym.pool.process.channel import Channel, Code
from fmugym.pool.process.shared_memory import Memory, make_arrays, make_echo, make_progress
from fmugym.pool.saving import SavingPool
from fmugym.pool.spec import ResetMethod
from fmugym.signals import Ignoring, ordinary
from fmugym.systems.description import SystemDescription
from fmugym.systems.fmu import ExtractedSystem
from fmugym.wine.prefix import Wine

if TYPE_CHECKING:
    from fmugym.pool.process.rollouts import Departure, Play

__all__ = ["BlockWorker", "Setup", "run_worker"]

_IGNORED_SIGNALS: Final = ("SIGINT", "SIGTERM", "SIGHUP", "SIGBREAK", "SIGTTIN", "SIGTTOU")
"""The first are meant for the parent, and often sent to all of its processes; the workers end with
it. The last two would stop a process in the background that uses the terminal."""


_COPIES: Final = "copies-for-workers"
"""The folder within the FMU's one that has the copies."""


@dataclass(frozen=True)
class Setup:
    """What a worker needs to know.

    Attributes:
        path: The FMU's file, for messages.
        description: Its model description.
        folder: Where it was extracted to.
        limits: See ``FMU``.
        preload: See ``FMU``.
        spec: What to do at each reset and step.
        num_instances: N, the instances of all workers together.
        log_level: The level of the messages that are passed on.
        directory: The working directory; empty if it has been removed.
        environment: The environment variables.
        block: The indices of the worker's instances.
        number: Which of the pool's workers it is.
        threads: See ``NativePool``.
        own_files: Whether the worker has a copy of the folder, which is also its working
            directory, because instances would share files otherwise.
        library: The place of the FMU's library in the folder.
        wine: What the worker needs to run in Wine; None for a worker of Python.
    """

    path: Path
    description: ModelDescription
    folder: Path
    limits: ArchiveLimits
    preload: tuple[str, ...]
    spec: PoolSpec
    num_instances: int
    log_level: int
    directory: str
    environment: Mapping[str, str]
    block: slice
    number: int = 0
    threads: int = 1
    own_files: bool = False
    library: str = ""
    wine: Wine | None = None

    @classmethod
    def of(cls, fmu: FMU, spec: PoolSpec, num_instances: int, log: logging.Logger) -> Setup:
        """Extract an FMU, and say what a worker for all of its instances needs to know."""
        return cls(
            path=fmu.path,
            description=fmu.description,
            folder=fmu.extract(),
            limits=fmu.limits,
            preload=fmu.preload,
            spec=spec,
            num_instances=num_instances,
            log_level=logging.INFO if log.isEnabledFor(logging.INFO) else logging.WARNING,
            directory=_working_directory(),
            environment=dict(os.environ),
            block=slice(num_instances),
            library=fmu.library,
            wine=Wine.ready() if fmu.in_wine else None,
        )

    @property
    def needs_copy(self) -> bool:
        """Whether the worker needs its own copy of the folder: an FMU may keep state in files."""
        return self.own_files or self.spec.reset_method is ResetMethod.PROCESS

    def with_copy(self) -> Setup:
        """Copy the folder afresh, in the place of the copy of an earlier worker.

        Raises:
            FMULoadError: If the system refuses.
        """
        folder = self.folder / _COPIES / str(self.number)
        try:
            shutil.rmtree(folder, ignore_errors=True)
            shutil.copytree(self.folder, folder, ignore=shutil.ignore_patterns(_COPIES))
        except ordinary(OSError, shutil.Error) as error:
            raise FMULoadError(
                f"{self.path.name} needs a copy of its files for each process: {error}"
            ) from None
        directory = str(folder) if self.own_files else self.directory
        return replace(self, folder=folder, directory=directory)


def _working_directory() -> str:
    try:
        return os.getcwd()
    except ordinary(OSError):
        return ""


def _enter(directory: str, folder: Path) -> None:
    """Make a directory the working directory, or a folder if the directory has been removed."""
    try:
        os.chdir(directory)
    except ordinary(OSError):
        os.chdir(folder)


class _Forwarder(logging.Handler):
    """Sends messages to the parent at once, since the next call may be the last."""

    def __init__(self, channel: Channel) -> None:
        super().__init__()
        self._channel = channel

    def emit(self, record: logging.LogRecord) -> None:
        """Send one message."""
        with Ignoring(OSError):  # the parent has ended, or an FMU closed it
            self._channel.send_object(Code.LOG, (record.levelno, record.getMessage()))


class BlockWorker:
    """Serves one block.

    Args:
        channel: To the parent.
        memory: Shared with the parent.
    """

    def __init__(self, channel: Channel, memory: Memory) -> None:
        self._channel = channel
        self._memory = memory
        self._variables: dict[int, tuple[Variable, ...]] = {}
        self._snapshots: dict[int, Any] = {}
        self._numbers = itertools.count()
        self._serving = True
        self._process = os.getpid()

    def serve(self) -> None:
        """Answer requests until one is ``close`` or the channel is closed."""
        actions: dict[bytes, Callable[[], None]] = {
            Code.STEP: self._step,
            Code.STEP_SOME: self._step_some,
            Code.REQUEST: self._answer,
            Code.RELEASE: self._release,
        }
        channel = self._channel
        while self._serving and channel.wait() and (code := channel.receive_code()):
            actions[code]()

    def _answer(self) -> None:
        name, arguments = self._channel.receive_object(Code.REQUEST)
        try:
            result = getattr(self, name)(*arguments)
            code = Code.RESULT
        except FMUGymError as error:
            code, result = Code.ERROR, error
        self._end_twin()
        self._channel.send_object(code, result)

    def _step(self) -> None:
        np.copyto(self._pool.inputs, self._block.inputs)
        self._note(self._pool.step_own())

    def _step_some(self) -> None:
        pool, block = self._pool, self._block
        pool.step(block.inputs, block.mask, pool.observations)
        self._note(int(np.count_nonzero(pool.statuses > WARNING_CODE)))

    def _end_twin(self) -> None:
        """End this process if an FMU has forked it and returned in it as well."""
        if os.getpid() != self._process:
            os._exit(0)

    def _note(self, troubled: int) -> None:
        self._channel.require_open()  # or else outputs of a lost step would be published
        self._publish()
        self._channel.send_code(Code.TROUBLE if troubled else Code.FINE)

    def _publish(self) -> None:
        self._end_twin()
        pool, block = self._pool, self._block
        np.copyto(block.outputs, pool.outputs)
        np.copyto(block.observations, pool.observations)
        np.copyto(block.statuses, pool.statuses)

    def _release(self) -> None:
        for number in self._channel.receive_object(Code.RELEASE):
            del self._snapshots[number]

    # The methods that the parent calls by name.

    def open(self, setup: Setup) -> None:
        """Make the pool; the first call."""
        setup = setup.with_copy() if setup.needs_copy else setup
        _enter(setup.directory, setup.folder)
        os.environ.update(setup.environment)
        log = logging.getLogger(__name__)
        log.setLevel(setup.log_level)
        arrays = make_arrays(self._memory, setup.spec, setup.num_instances)
        self._block = arrays.block(setup.block)
        self._progress = make_progress(self._memory, setup.num_instances)[setup.block]
        _echo_to(make_echo(self._memory, setup.spec, setup.num_instances, setup.number))
        self._pool = _make_pool(setup, log, self._block.counts)
        self._growth = ProcessGrowth(self._pool.num_instances)
        np.copyto(self._pool.outputs, self._block.outputs)  # those of the worker before

    def reset(
        self,
        number: int,
        variables: tuple[Variable, ...] | None,
        values: FloatArray,
        mask: MaskArray,
    ) -> int:
        """See ``Pool.reset``.

        Args:
            number: The number of the list of variables.
            variables: The list; None if this process knows it already.
            values: As for ``Pool.reset``.
            mask: As for ``Pool.reset``.

        Returns:
            By how many bytes this process has grown since its first resets.
        """
        if variables is not None:
            self._variables[number] = variables
        self._pool.reset(self._variables[number], values, mask)
        self._publish()
        return self._growth.after(int(np.count_nonzero(mask)))

    def save(self) -> int:
        """See ``SavingPool.save``; the snapshot stays here, and its number is returned."""
        number = next(self._numbers)
        self._snapshots[number] = self._pool.save()
        return number

    def restore(self, number: int, mask: MaskArray | None) -> None:
        """See ``SavingPool.restore``."""
        self._pool.restore(self._snapshots[number], mask)
        self._publish()

    def write(self, variables: tuple[Variable, ...], values: FloatArray) -> None:
        """See ``Pool.write``."""
        self._pool.write(variables, values)

    def save_states(self, indices: IndexArray, records: bool) -> list[bytes]:
        """See ``SavingPool.save_states``."""
        return self._pool.save_states(indices, records)

    def restore_states(self, states: Sequence[bytes], indices: IndexArray) -> None:
        """See ``SavingPool.restore_states``."""
        self._pool.restore_states(states, indices)
        self._publish()

    def roll_out(
        self, play: Play | None, departure: Departure
    ) -> tuple[int, tuple[npt.NDArray[Any], ...]] | IndexError:
        """Do many steps with compiled hooks; see ``RollingWorker.roll_out``.

        Args:
            play: What surrounds the steps; None if it is that of the rollout before.
            departure: Where the episodes are, and what they do.
        """
        from fmugym.pool.process.rollouts import RollingWorker

        pool: Any = self._pool
        if play is not None:
            self._rolling = RollingWorker(pool, play, self._progress)
        np.copyto(pool.inputs, self._block.inputs)
        try:
            return self._rolling.roll_out(departure)
        except IndexError as error:  # a hook's; the parent raises it
            return error

    def count_steps(self) -> None:
        """Add the steps until now to the shared counts."""
        self._pool.health()

    def failure(self, index: int) -> str:
        """See ``Pool.failure``; the index counts from the begin of the block."""
        return self._pool.failure(index)

    def read(self, variables: tuple[Variable, ...]) -> FloatArray:
        """See ``Pool.read``."""
        return self._pool.read(variables)

    def differentiate(
        self, unknowns: tuple[Variable, ...], knowns: tuple[Variable, ...]
    ) -> FloatArray:
        """See ``Pool.differentiate``."""
        np.copyto(self._pool.inputs, self._block.inputs)
        return self._pool.differentiate(unknowns, knowns)

    def text_of(self, number: float) -> str:
        """See ``fmugym.archive.texts.text_of``."""
        return text_of(number)

    def close(self) -> None:
        """Free the instances and leave ``serve``."""
        self._serving = False
        self._snapshots.clear()
        self._pool.close()


def _echo_to(memory: npt.NDArray[np.uint8]) -> None:
    """Keep a copy of messages: the pool logs after a call, which may end the process."""
    from fmugym import _native

    _native.echo_to(memory)


def _extracted(setup: Setup) -> ExtractedFMU:
    path, description, folder = setup.path, setup.description, setup.folder
    if isinstance(description, SystemDescription):
        return ExtractedSystem(path, description, folder)
    return ExtractedFMU(path, description, setup.preload, folder)


def _make_pool(setup: Setup, log: logging.Logger, counts: HealthArray) -> SavingPool:
    return local_pool(
        _extracted(setup),
        replace(setup.spec, leak_limit=None),  # the parent replaces this process
        setup.block.stop - setup.block.start,
        log,
        threads=setup.threads,
        first_index=setup.block.start,
        counts=counts,
        attended=False,  # the parent does that for all of its workers
    )


def run_worker(end: socket.socket, memory: Memory) -> int:
    """Be a worker until the parent closes the channel.

    Returns:
        The exit status of the process.
    """
    for name in _IGNORED_SIGNALS:
        if hasattr(signal, name):
            signal.signal(getattr(signal, name), signal.SIG_IGN)
    channel = Channel(end)
    root = logging.getLogger("fmugym")
    root.handlers, root.propagate = [_Forwarder(channel)], False
    try:
        BlockWorker(channel, memory).serve()
    except ordinary(EOFError, OSError):  # the parent has ended
        return 0
    except BaseException:
        root.critical("the worker failed:\n%s", traceback.format_exc())
        return 1
    return 0
