"""A system in the place of an FMU: pools, trials and environments take it like one."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import cached_property
from pathlib import Path

from fmugym.archive.fmu import DEFAULT_PROBE_TIMEOUT, FMU, file_digest
from fmugym.archive.safe_zip import ArchiveLimits
from fmugym.errors import FMULoadError
from fmugym.systems.system_description import describe_system
from fmugym.systems.system_plan import ComponentPlan, SystemPlan

__all__ = ["SystemFMU"]


class SystemFMU(FMU):
    """A system with the interface of an ``FMU``.

    Args:
        plan: Execution plan.
        probe_timeout: See ``FMU``.

    Attributes:
        plan: As given.
        path: The file of the system, or just its name.
        description: A ``SystemDescription``.

    Raises:
        ConfigError: If a name of the plan is unknown.
        FMULoadError: If an FMU of a component cannot be read.
    """

    def __init__(
        self, plan: SystemPlan, *, probe_timeout: float | None = DEFAULT_PROBE_TIMEOUT
    ) -> None:
        self.plan = plan
        self._opened = tuple(_opened(plan.components))
        self.path = Path(plan.name) if plan.file is None else plan.file
        self.description = describe_system(plan, [fmu.description for fmu in self._opened])
        self.preload = ()
        self.limits, self.interface = ArchiveLimits(), None
        self.probe_timeout = probe_timeout
        self.findings = plan.findings
        self.isolated = any(component.isolate for component in plan.components)
        self.in_wine = all(fmu.in_wine for fmu in self._opened)
        self._folder: Path | None = None
        self._remove_folder = None

    @property
    def content(self) -> str:
        """See ``FMU.content``."""
        components = self.plan.components
        named = tuple(replace(part, path=Path(part.path.name)) for part in components)
        texts = [repr(replace(self.plan, components=named, file=None))]
        texts += [file_digest(part.path) for part in components]
        return hashlib.sha256("\n".join(texts).encode()).hexdigest()

    @property
    def bundled(self) -> bool:
        """Whether all FMUs come with the package."""
        return all(fmu.bundled for fmu in self._opened)

    def parts_in(self, folder: Path) -> list[tuple[FMU, Path]]:
        """FMUs of the components, with the place of each in a folder like ``extract``'s."""
        return [(fmu, folder / str(number)) for number, fmu in enumerate(self._opened)]

    @cached_property
    def platforms(self) -> tuple[str, ...]:
        """The platforms for which all FMUs were built, by the names of each."""
        return tuple(sorted(set.intersection(*(set(fmu.platforms) for fmu in self._opened))))

    @cached_property
    def obstacles(self) -> tuple[str, ...]:
        """Reasons why the components cannot be loaded; see ``FMU.obstacles``."""
        of_components = (
            f"component {component.name!r}: {text}"
            for component, fmu in self._pairs()
            if self.in_wine or not fmu.in_wine
            for text in fmu.obstacles
        )
        return (*of_components, *filter(None, [self._mixed]))

    @property
    def _mixed(self) -> str:
        """Name the components that run in Wine only beside others, and the cure; "" if none do.

        A system runs in one process.
        """
        if self.in_wine:
            return ""
        names, others = (
            ", ".join(repr(one.name) for one, fmu in self._pairs() if fmu.in_wine is in_wine)
            for in_wine in (True, False)
        )
        if not names:
            return ""
        ways = [fmu._how_to_compile for fmu in dict.fromkeys(self._opened) if fmu.in_wine]
        return (
            f"{self.plan.name} cannot run here: its components with libraries for Windows only are "
            f"{names}, the others are {others}. A system runs in one process: export {names} for "
            f"Linux, too{''.join(ways)}"
        )

    @cached_property
    def missing_libraries(self) -> tuple[str, ...]:
        """See ``FMU.missing_libraries``."""
        found = [name for fmu in self._opened for name in fmu.missing_libraries]
        return tuple(dict.fromkeys(found))

    def _pairs(self) -> Iterator[tuple[ComponentPlan, FMU]]:
        return zip(self.plan.components, self._opened, strict=True)

    def _check_library(self) -> None:
        if self._mixed:
            raise FMULoadError(self._mixed)
        for component, fmu in self._pairs():
            with _naming(component):
                fmu._check_library()

    def _extract_to(self, folder: Path, only: str = "") -> bool:
        """Extract each FMU into a folder of its own."""
        extracted = False
        for component, (fmu, own) in zip(self.plan.components, self.parts_in(folder), strict=True):
            with _naming(component):
                own.mkdir(exist_ok=True)
                extracted |= fmu._extract_to(own, only)
        return extracted


def _opened(components: Iterable[ComponentPlan]) -> Iterator[FMU]:
    """The FMUs of components; a file is read once for all that use it in the same way."""
    known: dict[ComponentPlan, FMU] = {}
    for component in components:
        use = replace(component, name="", steps=1, starts=())
        if use not in known:
            known[use] = _open(component)
        yield known[use]


def _open(component: ComponentPlan) -> FMU:
    with _naming(component):
        return FMU(
            component.path,
            limits=component.limits,
            preload=component.preload,
            interface=component.interface,
            sizes=dict(component.sizes),
        )


@contextmanager
def _naming(component: ComponentPlan) -> Iterator[None]:
    """Name the component in errors."""
    try:
        yield
    except FMULoadError as error:
        raise FMULoadError(f"component {component.name!r}: {error}") from None
