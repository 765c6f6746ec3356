"""Setup of a worker, which it receives when it starts."""

from __future__ import annotations

import itertools
import logging
import os
import shutil
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

from fmugym.errors import FMULoadError
from fmugym.fmi.description import ModelDescription
from fmugym.fmi.fmu import FMU, copy_libraries
from fmugym.fmi.wine import Wine, windows_path
from fmugym.pool.pool import PoolSpec
from fmugym.pool.pool_form import Files, Writer, form_of_pool
from fmugym.pool.pool_spec import ResetMethod
from fmugym.pool.processes.launcher import Order
from fmugym.pool.processes.shared_memory import ECHO_SIZE, Memory
from fmugym.pool.saving_pool import keeps_records

__all__ = ["Setup"]

_seeds: Final = itertools.count(1)
"""Of the random numbers of the C library, each for a worker on trial."""

_WORKERS: Final = "of-workers"
"""The folder within the FMU's one that has a folder for each worker."""


@dataclass(frozen=True)
class Setup:
    """Set-up of a worker.

    Attributes:
        fmu: The FMU.
        folder: Where it was extracted to.
        files: Where the worker has its files: the folder, or its own copy of it.
        scratch: The worker's working directory.
        copies: Of its libraries, for each of the N instances; empty if they share them.
        before: The libraries to load before its own; see ``FMU.libraries_before``.
        spec: What to do at each reset and step.
        num_instances: N, the instances of all workers together.
        logs_all: Whether FMUs are asked to log everything.
        directory: The working directory of this process; empty if it has been removed.
        environment: The environment variables.
        texts: The start values of the FMU's Strings, which may be paths.
        block: The indices of the worker's instances.
        number: Which of the pool's workers it is.
        threads: See ``NativePool``.
        own_files: Whether the worker has a copy of the folder, because instances would share files
            otherwise.
        checks_heap: Whether the C library ends workers that free memory beyond which an FMU has
            written; only with glibc.
        on_trial: Whether the FMU is only tried. Nothing of what it prints appears on the streams of
            this process, and the random numbers of the C library differ from worker to worker.
        wine: What the worker needs to run in Wine; None for one of this system.
    """

    fmu: FMU
    folder: Path
    files: Path
    scratch: Path
    copies: tuple[Path, ...]
    before: tuple[tuple[str, str], ...]
    spec: PoolSpec
    num_instances: int
    logs_all: bool
    directory: str
    environment: Mapping[str, str]
    texts: tuple[str, ...]
    block: slice
    number: int = 0
    threads: int = 1
    own_files: bool = False
    checks_heap: bool = False
    on_trial: bool = False
    wine: Wine | None = None

    @classmethod
    def of(
        cls,
        fmu: FMU,
        spec: PoolSpec,
        num_instances: int,
        log: logging.Logger,
        *,
        private_libraries: bool = False,
        **options: Any,
    ) -> Setup:
        """Extract an FMU, and make the set-up of a worker for all of its instances.

        Args:
            fmu: The FMU.
            spec: What to do at each reset and step.
            num_instances: N.
            log: The logger that gets the FMU's messages.
            private_libraries: See ``NativePool``.
            options: Those attributes that have a default.
        """
        folder = fmu.extract()
        return cls(
            fmu=fmu,
            folder=folder,
            files=folder,
            scratch=folder,
            copies=tuple(copy_libraries(fmu, num_instances)) if private_libraries else (),
            before=_libraries_before(fmu, folder),
            spec=spec.fitting(fmu.description),
            num_instances=num_instances,
            logs_all=log.isEnabledFor(logging.INFO),
            directory=_working_directory(),
            environment=dict(os.environ),
            texts=tuple(_start_texts(fmu)),
            block=slice(num_instances),
            wine=Wine.ready() if fmu.in_wine else None,
            **options,
        )

    @property
    def description(self) -> ModelDescription:
        """The description of the FMU."""
        return self.fmu.description

    @property
    def count(self) -> int:
        """The number of the worker's instances."""
        return int(self.block.stop - self.block.start)

    @property
    def needs_copy(self) -> bool:
        """Whether the worker needs its own copy of the folder: an FMU may keep state in files."""
        return self.own_files or self.spec.reset_method is ResetMethod.PROCESS

    def prepared(self) -> Setup:
        """Make files for a new process, in the place of the files of an earlier one.

        They are an empty working directory, the files of the FMU that are missing, and its own copy
        of them if it needs one.

        Raises:
            FMULoadError: If the system refuses.
        """
        own = self.fmu.extract() / _WORKERS / str(self.number)
        try:
            scratch = _emptied(own / "scratch")
            if not self.needs_copy:
                if self.copies:
                    copy_libraries(self.fmu, self.num_instances)
                return replace(self, scratch=scratch)
            files, left_out = own / "files", shutil.ignore_patterns(_WORKERS)
            shutil.rmtree(files, ignore_errors=True)
            shutil.copytree(self.folder, files, ignore=left_out)
        except (OSError, shutil.Error) as error:
            raise FMULoadError(
                f"{self.fmu.path.name} needs a folder for each process: {error}"
            ) from None
        before = _libraries_before(self.fmu, files)
        # Of libraries there are no copies, because the process has one instance.
        return replace(self, files=files, scratch=scratch, copies=(), before=before)

    def lend(self, texts: Iterable[str]) -> None:
        """Let the worker find the user's files that its FMU is told of by relative paths.

        A link to each appears in the worker's own working directory.

        Args:
            texts: The texts that the FMU may get; those that name no file change nothing.
        """
        scratch = self.folder / _WORKERS / str(self.number) / "scratch"
        for text in texts if self.directory else ():
            with suppress(OSError, ValueError):  # it is no path
                own = Path(self.directory, text)
                first = Path(text).parts[:1]
                if own.exists() and not os.path.isabs(text) and first != ("..",):
                    Path(scratch, *first).symlink_to(Path(self.directory, *first))

    def order(self) -> Order:
        """Command of the worker."""
        if self.wine is None:
            environment, command = self.environment, []
        else:
            environment, command = self.wine.environment(self.environment), self.wine.command
        return Order(
            self.folder, str(self.scratch), environment, command, checks_heap=self.checks_heap
        )

    def opening(self, memory: Memory) -> bytes:
        """First request: the files to load, the settings of steps, and the shared memory."""
        writer = Writer()
        writer.block(
            form_of_pool(
                self.description,
                self.spec,
                self._files(),
                self.count,
                self.threads,
                private_libraries=bool(self.copies),
                logging=self.logs_all,
                records=keeps_records(self.description, self.spec),
            )
        )
        self._write_memory(writer, memory)
        writer.integers(next(_seeds) if self.on_trial else 0)
        writer.texts([name.encode() for name, _ in self.before])
        writer.texts([os.fsencode(path) for _, path in self.before])
        return writer.form()

    def _files(self) -> Files:
        """Places of the FMU for the worker, or of copies of libraries for its own instances."""
        fmu, folder = self.fmu, self.files
        if fmu.in_wine:
            return Files.in_wine(fmu, folder)
        if not self.copies:
            return Files.here(fmu, folder, [library for _, library in fmu.libraries_in(folder)])
        parts = len(self.copies) // self.num_instances
        block = slice(parts * self.block.start, parts * self.block.stop)
        return Files.here(fmu, folder, self.copies[block])

    def _write_memory(self, writer: Writer, memory: Memory) -> None:
        """Name the memory on Windows, and in Wine by this process's descriptor of it."""
        path = windows_path(Path("/proc", str(os.getpid()), "fd", str(memory.descriptor)))
        writer.text(os.fsencode(path if self.wine is not None else memory.tag))
        *arrays, echo, bell = memory.offsets
        writer.integers(memory.size, *arrays, ECHO_SIZE, echo, bell)


def _emptied(folder: Path) -> Path:
    """Make an empty folder."""
    try:
        os.makedirs(folder)
    except FileExistsError:
        if os.listdir(folder):
            shutil.rmtree(folder)
            folder.mkdir()
    return folder


def _libraries_before(fmu: FMU, folder: Path) -> tuple[tuple[str, str], ...]:
    return () if fmu.in_wine else tuple(fmu.libraries_before(folder))


def _start_texts(fmu: FMU) -> Iterator[str]:
    """The texts that Strings of an FMU, or of a system's components, have at first."""
    for variable in fmu.description.variables.values():
        if variable.kind == "string" and variable.start:
            yield variable.start
    plan = getattr(fmu, "plan", None)
    for component in () if plan is None else plan.components:
        yield from (value for _, value in component.starts if isinstance(value, str))


def _working_directory() -> str:
    try:
        return os.getcwd()
    except OSError:
        return ""
