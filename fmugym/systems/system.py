"""Systems as users make and read them."""

from __future__ import annotations

import os
from dataclasses import replace
from functools import partial
from typing import Any, Self

from fmugym.archive.fmu import DEFAULT_PROBE_TIMEOUT
from fmugym.archive.safe_zip import ArchiveLimits
from fmugym.errors import FMUGymError
from fmugym.systems.system_fmu import SystemFMU
from fmugym.systems.wired import WiredSystem

__all__ = ["FMUSystem"]


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
        from fmugym.systems.ssp.archives import system_arguments  # optional: only archives need it

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
