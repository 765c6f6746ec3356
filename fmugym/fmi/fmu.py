"""FMU file: opened once, checked, extracted to a folder of its own, and cleaned up.

Reading the description never executes the FMU. Loading it (``fmugym.pool``) does: an FMU is native
code that runs with all the rights of the process.
"""

from __future__ import annotations

import copy
import functools
import hashlib
import logging
import os
import shlex
import shutil
import threading
import weakref
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from functools import cached_property
from pathlib import Path
from types import MappingProxyType
from typing import Final, Protocol, runtime_checkable

import fmpy

from fmugym.checks import KnownArguments, check_mapping, check_number, check_option, check_path
from fmugym.errors import ConfigError, FMULoadError, plain, printable, shown, warn_once
from fmugym.files import is_own
from fmugym.fmi import system_loader
from fmugym.fmi.binaries import check_library
from fmugym.fmi.bundled import is_bundled
from fmugym.fmi.description import INTERFACES, Feedthrough, read_feedthrough
from fmugym.fmi.description_reader import read_model_description, read_root
from fmugym.fmi.library_dependencies import (
    ask_in_a_child,
    calls_python,
    describe_missing,
    load_globally,
    missing_libraries,
    stray_libraries,
)
from fmugym.fmi.safe_zip import ArchiveLimits, SafeZip
from fmugym.fmi.temporary import folder_name, make_folder, remove_folder
from fmugym.fmi.variable import Variable
from fmugym.fmi.wine import can_run_windows, obstacle_to_wine

__all__ = [
    "DEFAULT_PROBE_TIMEOUT",
    "FMU",
    "StandsForFMU",
    "copy_libraries",
    "extracted_again",
    "file_digest",
]

logger = logging.getLogger(__name__)

DEFAULT_PROBE_TIMEOUT: Final = 60.0
"""Seconds that a call may take in the trial of an unknown FMU; for an initialization, ten times."""

_extracting: Final = threading.RLock()
"""Held while files are extracted: no other thread finds a part of one, or writes it again."""

_NEVER_NEEDED: Final = {"documentation", "sources"}
_NAMES: Final = {
    "linux64": "x86_64-linux",
    "linux32": "x86-linux",
    "darwin64": "x86_64-darwin",
    "win64": "x86_64-windows",
    "win32": "x86-windows",
}
"""Of folders under ``binaries/`` until FMI 2.0, and in FMI 3.0."""

_OTHER_NAMES: Final = {**_NAMES, **{new: old for old, new in _NAMES.items()}}
_WINDOWS_32: Final = {"win32", "x86-windows"}
_MOST_FINDINGS: Final = 20
"""Findings that the log repeats; ``FMU.findings`` has all."""


@runtime_checkable
class StandsForFMU(Protocol):
    """Interface of an FMU and of its substitutes, such as a system."""

    def as_fmu(self) -> FMU:
        """Open it, with a temporary folder of its own."""


class FMU(KnownArguments):
    """An FMU archive and the temporary folder it is extracted to.

    Args:
        path: The ``.fmu`` file.
        limits: Limits of the size of an archive; by default ``ArchiveLimits()``.
        preload: Shared libraries to load before the FMU's, which may need them: paths, or names
            that the system's loader finds.
        probe_timeout: Seconds that a call of an unknown FMU may take in a trial in a process of its
            own; None to do without. See ``fmugym.pool.trial``.
        interface: ``"co_simulation"`` or ``"model_exchange"``; by default co-simulation where the
            FMU offers it.
        sizes: Values of structural parameters by name; arrays get the sizes that follow.

    Attributes:
        path: The file's absolute path.
        description: The model description.
        findings: What breaks rules of the standard in the archive and in the model description,
            as texts.
        limits, preload, probe_timeout: As given; ``preload`` a tuple with absolute paths.
        interface: As given; ``description.interface`` is the one in use.
        sizes: As given.
        in_wine: Whether the library is one for Windows that can only run in Wine here.
        isolated: Whether it is a system that shall run in worker processes.
        extractions: How often files were missing, which are then extracted or copied anew.

    Raises:
        ConfigError: If an argument does not fit.
        ArgumentError: If there is no argument of this name; that is a ``TypeError``, too.
        FMULoadError: If the file is missing, not a sound FMU archive, or lacks the interface.
    """

    sizes: Mapping[str, int] = MappingProxyType({})
    in_wine = False
    isolated = False
    extractions = 0

    def __init__(
        self,
        path: str | os.PathLike[str],
        *,
        limits: ArchiveLimits | None = None,
        preload: Sequence[str | os.PathLike[str]] = (),
        probe_timeout: float | None = DEFAULT_PROBE_TIMEOUT,
        interface: str | None = None,
        sizes: Mapping[str, int] | None = None,
    ) -> None:
        file = check_path("the path of an FMU", path).absolute()
        self.limits = ArchiveLimits() if limits is None else limits
        if not isinstance(self.limits, ArchiveLimits):
            raise ConfigError(f"limits must be ArchiveLimits, got {shown(limits)}")
        if probe_timeout is not None:
            check_number("probe_timeout", probe_timeout, positive=True)
        self.probe_timeout = probe_timeout
        if interface is not None:
            check_option("interface", interface, INTERFACES)
        self.interface = interface
        libraries = _absolute(preload)
        self._archive = SafeZip(file, self.limits)
        description = read_model_description(self._archive, interface)
        if sizes:
            self.sizes = check_mapping("sizes", sizes)
            description = description.resized(self.sizes)
        self.path, self.description, self.preload = file, description, libraries
        self._library_place = place = self._choose_library()
        findings = [*self._archive.notes]
        if place not in (None, self.library):
            findings.append(f"the library is {place!r}, expected {self.library!r}; it is used")
        self.findings = (*findings, *self.description.findings)
        self._folder: Path | None = None
        self._remove_folder: weakref.finalize[..., FMU] | None = None
        self._log_findings()

    def __repr__(self) -> str:
        about = self.description
        counts = Counter(variable.causality for variable in about.variables.values())
        told = ", ".join(f"{counts[kind]} {kind}s" for kind in ("input", "output", "parameter"))
        return (
            f"{type(self).__name__}({str(self.path)!r}: {about.model_name}, FMI "
            f"{about.fmi_version}, {told})"
        )

    def _choose_library(self) -> str | None:
        """Find the library for this platform, or else one for Windows that can run here in Wine."""
        wanted = self._wanted_library()
        if wanted is None and can_run_windows():
            self.in_wine = True
            wanted = self._wanted_library()
            self.in_wine = wanted is not None
        return None if wanted is None else _find_library(list(self._archive.files), wanted)

    def _wanted_library(self) -> str | None:
        """Path of the library for this machine, or of another FMI version's.

        None if neither has a library.
        """
        name, places = self.library.rpartition("/")[2], list(self._archive.files)
        folders = (self.platform, _OTHER_NAMES.get(self.platform, self.platform))
        there = (f"binaries/{folder}/{name}" for folder in folders)
        return next((wanted for wanted in there if _libraries_in(places, wanted)), None)

    def _log_findings(self) -> None:
        if self.findings:
            logger.info(
                "%s: %d findings in the FMU: %s",
                printable(self.path.name),
                len(self.findings),
                printable("; ".join(self.findings[:_MOST_FINDINGS])),
            )

    @classmethod
    def of(cls, source: FMU | StandsForFMU | str | os.PathLike[str]) -> FMU:
        """Open an FMU by its path, or open a second one with the arguments of the first."""
        if isinstance(source, StandsForFMU):
            return source.as_fmu()
        return source.again() if isinstance(source, FMU) else cls(source)

    def again(self) -> FMU:
        """The same FMU once more, which is not read again, with a temporary folder of its own."""
        other = copy.copy(self)
        other._folder, other._remove_folder = None, None
        return other

    def with_units(self, units: Mapping[str, str]) -> FMU:
        """The same FMU with other units of its variables.

        The log tells once in a process which units of the FMU they replace.

        Args:
            units: Units by the names of scalars and arrays.

        Raises:
            ConfigError: If there is no such variable.
        """
        other = self.again()
        other.description = self.description.with_units(units)
        for name, unit in units.items():
            own = self.variable(name).unit
            if own not in (None, unit):
                warn_once(
                    logger,
                    f"{self.path.name}: the unit of {plain(name)} is {plain(unit)}, as the task "
                    f"says, not {plain(own)}, as the FMU says",
                )
        return other

    @property
    def bundled(self) -> bool:
        """Whether it comes with the package."""
        return is_bundled(self.path)

    @property
    def content(self) -> str:
        """SHA-256 of the file; for a system, of its plan and files."""
        return file_digest(self.path)

    def variable(self, name: str) -> Variable:
        """Look a variable up by name; see ``ModelDescription.variable``."""
        return self.description.variable(name)

    @cached_property
    def feedthrough(self) -> Feedthrough:
        """Direct feed-through: the inputs that act at once on each output, by the XML.

        Raises:
            FMULoadError: If the archive has been changed or removed.
        """
        return read_feedthrough(read_root(self._archive), self.description)

    @cached_property
    def platforms(self) -> tuple[str, ...]:
        """The folders under ``binaries/``, which name the platforms the FMU was built for."""
        parts = [place.split("/") for place in self._archive.files]
        return tuple(sorted({p[1] for p in parts if len(p) > 2 and p[0] == "binaries"}))

    @property
    def runs_here(self) -> bool:
        """Whether nothing is known that would keep the FMU from being loaded on this machine."""
        return not self.obstacles

    @cached_property
    def obstacles(self) -> tuple[str, ...]:
        """Reasons why the FMU cannot be loaded on this machine, as texts with the cure.

        There is no library for this platform or processor, or it needs Wine or shared libraries
        that are missing here. Nothing of the FMU is loaded.
        """
        try:
            self._check_library()
            if self.in_wine and (obstacle := obstacle_to_wine()):
                return (
                    f"{self.path.name} has libraries for Windows only. To run them, {obstacle}",
                )
            missing = self.missing_libraries
        except FMULoadError as error:
            return (str(error),)
        return (printable(describe_missing(self.path.name, missing)),) if missing else ()

    @cached_property
    def missing_libraries(self) -> tuple[str, ...]:
        """The shared libraries that the FMU needs and this system does not have.

        Empty where there is no library for this platform, and on systems other than Linux. What
        libraries for Windows need is not known.

        Raises:
            FMULoadError: If a library of the FMU is damaged.
        """
        if self._library_place is None or self.in_wine:
            return ()
        if self._folder is not None:
            return self._missing_in(self._folder)
        folder = folder_name()
        try:
            make_folder(folder)
            self._extract_to(folder, only="binaries")
            return self._missing_in(folder)
        finally:
            remove_folder(folder, os.getpid())

    def _missing_in(self, folder: Path) -> tuple[str, ...]:
        return tuple(missing_libraries(folder / self.library, self.preload, ask_in_a_child))

    def parts_in(self, folder: Path) -> Sequence[tuple[FMU, Path]]:
        """FMUs of a system, or this one, with the place of each in a folder like ``extract``'s."""
        return [(self, folder)]

    def libraries_in(self, folder: Path) -> list[tuple[FMU, Path]]:
        """The same FMUs, and their libraries there."""
        return [(part, place / part.library) for part, place in self.parts_in(folder)]

    def calls_python(self) -> bool:
        """Whether a library calls the Python of its process; see ``dependencies.calls_python``."""
        return any(calls_python(path) for _, path in self.libraries_in(self.extract()))

    def libraries_before(self, folder: Path) -> list[tuple[str, str]]:
        """Libraries to load before the libraries of the FMUs.

        Args:
            folder: As for ``libraries_in``.

        Returns:
            Names and paths, in the order in which they are to be loaded: those of ``preload``
            without a name, and those that an FMU brings along where the loader does not look. Such
            a one is loaded only if the loader finds none of its name.
        """
        return [
            before
            for fmu, library in self.libraries_in(folder)
            for before in (
                *(("", path) for path in fmu.preload),
                *((path.name, str(path)) for path in stray_libraries(library)),
            )
        ]

    def require_libraries(
        self, folder: Path, ask: Callable[[Sequence[str]], list[str]] = ask_in_a_child
    ) -> None:
        """Require that the loader finds all libraries that the FMUs need.

        Args:
            folder: As for ``libraries_in``.
            ask: See ``missing_libraries``.

        Raises:
            FMULoadError: If others are missing, or one that the FMU brings along is cut short.
        """
        for fmu, library in self.libraries_in(folder):
            missing = missing_libraries(library, fmu.preload, ask)
            if missing:
                raise FMULoadError(describe_missing(fmu.path.name, missing))

    def prepare_libraries(self) -> list[Path]:
        """Make the libraries of all FMUs ready to be loaded into this process.

        Loads those that are to be loaded before, and finds out which others are missing.

        Returns:
            Their paths, in the folder of ``extract``; several for a system.

        Raises:
            FMULoadError: As ``extract``; or if one of these libraries cannot be loaded, or others
                are missing; or if it is a library for Windows, which needs a process in Wine.
        """
        if self.in_wine:
            raise FMULoadError(
                f"{self.path.name} has no library for this platform. Environments run its library "
                "for Windows in worker processes in Wine, but this process cannot load it"
            )
        folder = self.extract()
        for path in {path: None for fmu, _ in self.libraries_in(folder) for path in fmu.preload}:
            load_globally(path)
        self.require_libraries(folder, system_loader.ask)
        for name, path in self.libraries_before(folder):
            if name and system_loader.ask([name]):
                load_globally(path)
        return [library for _, library in self.libraries_in(folder)]

    @property
    def platform(self) -> str:
        """The folder under ``binaries/`` that this machine needs."""
        if self.in_wine:
            return "x86_64-windows" if self.description.fmi_major_version == 3 else "win64"
        return self.description.platform

    @property
    def library(self) -> str:
        """The place of the library for this machine, relative to the folder of ``extract``."""
        suffix = ".dll" if self.in_wine else fmpy.sharedLibraryExtension
        return f"binaries/{self.platform}/{self.description.model_identifier}{suffix}"

    def extract(self) -> Path:
        """Extract the files for this machine to a temporary folder.

        The folder is removed by ``close``, with this object, or at the end of the interpreter.
        Later calls extract anew what a cleaner of temporary files has removed meanwhile.

        Returns:
            The folder, always the same one.

        Raises:
            FMULoadError: If there is no library for this platform or the archive is damaged.
        """
        with _extracting:
            if self._folder is not None:
                self._extract_again(self._folder)
                return self._folder
            self._check_library()
            folder = folder_name()
            self._remove_folder = weakref.finalize(self, remove_folder, folder, os.getpid())
            try:
                make_folder(folder)
                self._extract_to(folder)
            except BaseException:
                self.close()
                raise
            self._folder = folder
            return folder

    @property
    def is_extracted(self) -> bool:
        """Whether it was extracted, and not closed since."""
        return self._folder is not None

    def _extract_again(self, folder: Path) -> None:
        """Extract files that are missing in the folder."""
        if not folder.exists():
            make_folder(folder)
        elif not is_own(folder):
            raise FMULoadError(f"{folder}, the folder of {self.path.name}, belongs to another user")
        if self._extract_to(folder):
            self.extractions += 1
            logger.warning(
                "%s: files were missing in its temporary folder %s and are extracted anew",
                printable(self.path.name),
                folder,
            )

    def _check_library(self) -> None:
        """Look at the library inside the archive: nothing is written if it cannot be loaded."""
        place = self._library_place
        if place is None:
            raise FMULoadError(self._no_library())
        with self._archive.open(place) as file:
            size = self._archive.files[place].file_size
            check_library(file, size, f"{self.path.name}: {place}")

    def _no_library(self) -> str:
        """Describe the missing library, and the ones that the FMU has."""
        wanted = self._wanted_library() or self.library
        folder, _, name = wanted.rpartition("/")
        there = [p.rpartition("/")[2] for p in _libraries_in(list(self._archive.files), wanted)]
        if there:
            return (
                f"{self.path.name} has {len(there)} libraries for this platform in {folder} "
                f"({', '.join(there)}), but none is named {name}; give the right one that name"
            )
        text = (
            f"{self.path.name} has no library for this platform ({self.library}); it was built "
            f"for: {', '.join(self.platforms) or 'no platform at all'}"
        )
        text += self._how_to_compile
        if can_run_windows() and {p.casefold() for p in self.platforms} & _WINDOWS_32:
            text += ". Those for 32-bit Windows cannot run in Wine here; export for 64-bit Windows"
        return text

    @property
    def _how_to_compile(self) -> str:
        """The end of an error's text; "" if the FMU does not have its source code."""
        if not any(place.startswith("sources/") for place in self._archive.files):
            return ""
        return f". It has its source code: fmugym info --repair {shlex.quote(self.path.name)}"

    def _extract_to(self, folder: Path, only: str = "") -> bool:
        """Extract the files that are needed and not there; returns whether there are any.

        Args:
            folder: Target folder.
            only: The one folder of the archive whose files are needed; by default several are.
        """
        files = {p: self._target(p) for p in self._archive.files if self._needed(p, only)}
        folders = [self._target(p) for p in self._archive.folders if self._needed(p, only)]
        folders.append("resources")  # tools pass its path always
        files = {p: target for p, target in files.items() if _is_missing(folder, target)}
        folders = [target for target in folders if _is_missing(folder, target)]
        if not files and not folders:
            return False
        try:
            self._archive.extract(folder, files, folders)
        except BaseException:  # a file that is cut short would pass for one that is there
            for target in files.values():
                with suppress(OSError):  # it is not there, or its name is too long
                    (folder / target).unlink()
            raise
        return True

    def _needed(self, place: str, only: str) -> bool:
        first, _, rest = place.partition("/")
        if only and first != only:
            return False
        if first == "binaries":
            used = (self._library_place or self.library).split("/")[1]
            return rest.partition("/")[0].casefold() == used.casefold() and "/" in rest
        return first not in _NEVER_NEEDED

    def _target(self, place: str) -> str:
        """Path to which a file is extracted; the library gets its standard name."""
        if place == self._library_place:
            return self.library
        first, _, rest = place.partition("/")
        if first == "binaries":
            return f"binaries/{self.platform}/{rest.partition('/')[2]}"
        return place

    def close(self) -> None:
        """Remove the temporary folder; more than one call is fine."""
        with _extracting:
            self._folder = None
            finalizer = self._remove_folder
            if finalizer is not None and (alive := finalizer.peek()) is not None:
                _, remove, arguments, _ = alive
                remove(*arguments)
                finalizer.detach()  # not before: a signal may have interrupted the removal


def _is_missing(folder: Path, target: str) -> bool:
    return not os.path.exists(os.path.join(folder, target))  # a Path would take three times as long


def copy_libraries(fmu: FMU, count: int) -> list[Path]:
    """Copy the libraries of all parts, so that each instance has global variables of its own.

    Copies that are there stay as they are.
    """
    copies = [
        _copy_library(fmu, place, Path(part.library), count)
        for part, place in fmu.parts_in(fmu.extract())
    ]
    return [path for paths in zip(*copies, strict=True) for path in paths]


def extracted_again(fmu: FMU, copies: int) -> bool:
    """Extract missing files of an FMU anew; returns whether there were any.

    Args:
        fmu: The FMU; nothing happens if it is closed.
        copies: How many copies of its libraries there are to be, too.

    Raises:
        FMULoadError: As ``FMU.extract``.
    """
    with _extracting:
        before = fmu.extractions
        if not fmu.is_extracted:
            return False
        fmu.extract()
        if copies:
            copy_libraries(fmu, copies)
        return fmu.extractions > before


def _copy_library(fmu: FMU, folder: Path, library: Path, count: int) -> list[Path]:
    """Copy the library's folder: the system treats files with other paths and inodes as new.

    The copies are in the FMU's temporary folder and are deleted with it.
    """
    paths = []
    try:
        for index in range(count):
            copy = folder / "private" / str(index)
            if not (copy / library.name).exists():
                fmu.extractions += 1
                shutil.copytree(folder / library.parent, copy, dirs_exist_ok=True)
            paths.append(copy / library.name)
    except (OSError, shutil.Error) as error:
        raise FMULoadError(
            f"{library.name} needs a copy for each instance, but copy {len(paths) + 1} of {count} "
            f"failed: {error}; use fewer instances, or one process for each"
        ) from None
    return paths


def file_digest(path: Path) -> str:
    """The SHA-256 of a file; it is read again only when it has changed."""
    status = path.stat()
    return _digest(path, status.st_mtime_ns, status.st_size, status.st_ino)


@functools.lru_cache(maxsize=256)
def _digest(path: Path, *_: int) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _find_library(places: Sequence[str], wanted: str) -> str | None:
    """Find the library for this platform, which some tools give another name; None if none fits."""
    if wanted in places:
        return wanted
    there = _libraries_in(places, wanted)
    same = [place for place in there if place.casefold() == wanted.casefold()]
    candidates = same or there
    return candidates[0] if len(candidates) == 1 else None


def _libraries_in(places: Sequence[str], wanted: str) -> list[str]:
    """The libraries right in the folder of the wanted one, whose name may differ in case."""
    folder, suffix = wanted.rpartition("/")[0], os.path.splitext(wanted)[1].casefold()
    return [
        place
        for place in places
        if place.rpartition("/")[0].casefold() == folder.casefold()
        and place.casefold().endswith(suffix)
    ]


def _absolute(libraries: Sequence[str | os.PathLike[str]]) -> tuple[str, ...]:
    """A bare name is left to the system's loader."""
    try:
        paths = [] if isinstance(libraries, str) else [_file_name(one) for one in libraries]
    except Exception:  # a TypeError; or an object whose own methods fail
        paths = []
    if not paths and not (isinstance(libraries, list | tuple) and len(libraries) == 0):
        raise ConfigError(f"preload must be a list of paths, got {shown(libraries)}")
    return tuple(os.path.abspath(path) if os.path.dirname(path) else path for path in paths)


def _file_name(path: str | os.PathLike[str]) -> str:
    """The text of a path that a file can have."""
    encoded = os.fsencode(path)
    if b"\0" in encoded:
        raise ValueError
    return os.fsdecode(encoded)
