"""Systems as users make and read them, in the place of an FMU.

Pools, trials and environments take a system like an FMU.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any, Self

from fmugym.errors import FMUGymError, FMULoadError
from fmugym.fmi.fmu import DEFAULT_PROBE_TIMEOUT, FMU, file_digest
from fmugym.fmi.safe_zip import ArchiveLimits
from fmugym.fmi.systems.system_description import describe_system
from fmugym.fmi.systems.system_plan import ComponentPlan, SystemPlan
from fmugym.fmi.systems.wiring import WiredSystem

__all__ = ["FMUSystem", "SystemFMU"]


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


class FMUSystem(WiredSystem):
    """Several FMUs that run as one. It can stand wherever an FMU can.

    The variables of the system are those of its components, named ``component.variable``. Inputs
    that nothing drives are inputs of the system. A connection that begins or ends at a name without
    a component gives the system an input, parameter or output of this name.

    Args:
        components: By name: the path of an FMU, an ``FMU`` or a ``Component``.
        connections: ``"plant.y -> controller.u"``, pairs of names, or ``Connection`` objects.
        name: The name of the system.
        units: Units of the system's own inputs, outputs and parameters by name; without one, they
            have the unit of the variable behind them.
        master: ``"gauss_seidel"``, where each component gets the newest values, or ``"jacobi"``.
        loops: Treatment of algebraic loops: ``"newton"``, or ``"refuse"``.
        loop_tolerance: Relative, and absolute below 1, for the values in a loop.
        loop_iterations: After so many, a step fails.
        step_size: The default communication step size in seconds; without one, the smallest
            default step size of the components.
        start_time, stop_time: Times of the default experiment, in seconds.
        tolerance: For the solvers of the components; None for their own defaults.
        description: For people.
        own_names: Names of the system itself that contain a dot.
        unit_definitions: Units that ``units`` use and that neither an FMU nor pint knows.
        findings: What a file that described the system had of doubtful things.
        file: The file that described the system.

    Attributes:
        name, description, units, unit_definitions, own_names, master, loops: As given.
        components: The components by name, their FMUs read.
        connections: As given, as ``Connection`` objects.
        loop: Treatment of algebraic loops.
        times: ``step_size``, ``start_time``, ``stop_time`` and ``tolerance`` as given.
        links: The connections between components, with gains and offsets between the FMUs' units.
        connectors: The system's own inputs, outputs and parameters.

    Raises:
        ConfigError: If an argument does not fit, a name is unknown, two connections have one
            target, or units or types do not fit.
        ArgumentError: If there is no argument of this name; that is a ``TypeError``, too.
        FMULoadError: If an FMU cannot be read.
    """

    @classmethod
    def read(
        cls,
        path: str | os.PathLike[str],
        limits: ArchiveLimits | None = None,
        *,
        master: str | None = None,
    ) -> Self:
        """Read an SSP archive. Nothing of its FMUs is executed.

        Nested systems become one level: a component ``plant`` of the system ``car`` is named
        ``car.plant``. Geometry, annotations and values for parameters that do not
        exist are ignored and listed in ``findings``.

        Args:
            path: The ``.ssp`` file.
            limits: Limits of the size of an archive.
            master: One of those of ``FMUSystem``; by default what the archive says.

        Raises:
            ConfigError: If the system has a mistake.
            FMULoadError: If the archive or an FMU cannot be read, or it has something that changes
                results and is not supported, such as signal dictionaries.
        """
        from fmugym.fmi.systems.ssp_archive import (
            system_arguments,  # optional: only archives need it
        )

        arguments = system_arguments(path, limits)
        if master is not None:
            arguments["master"] = master
        try:
            return cls(**arguments)
        except FMUGymError as error:
            raise type(error)(f"{arguments['file'].name}: {error}") from None

    def as_fmu(self, probe_timeout: float | None = DEFAULT_PROBE_TIMEOUT) -> SystemFMU:
        """Open the system as an ``FMU``, for functions that take one.

        Args:
            probe_timeout: See ``FMU``.

        Raises:
            FMULoadError: If an FMU of a component cannot be read any more.
        """
        return SystemFMU(self.plan, probe_timeout=probe_timeout)

    def __reduce__(self) -> tuple[Any, tuple[()]]:
        """A system pickles as the file that it came from, or as its arguments."""
        if self.file is not None:
            return partial(type(self).read, self.file, master=self.master), ()
        return partial(type(self), **self.arguments()), ()

    def arguments(self) -> dict[str, Any]:
        """The arguments that make this system once more, FMUs as their paths."""
        components = {
            name: replace(one.given, fmu=one.fmu.path, interface=one.fmu.interface)
            for name, one in self.components.items()
        }
        return {
            **self._given,
            "components": components,
            "own_names": self.own_names,
            "unit_definitions": self.unit_definitions,
        }
