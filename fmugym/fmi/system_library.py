"""The libraries of the components of a system, as one.

``open_library`` opens those of FMUs and of systems.
"""

from __future__ import annotations

import functools
import logging
import weakref
from collections.abc import Sequence
from typing import Any

from fmugym.archive.loadable import LoadableFMU
from fmugym.archive.variable import Variable
from fmugym.errors import FMULoadError, SimulationError
from fmugym.fmi.instance import Instance
from fmugym.fmi.library import Library
from fmugym.fmi.solver import Solving
from fmugym.fmi.system import SystemInstance
from fmugym.systems.description import SystemDescription
from fmugym.systems.layout import Layout, PartLayout

__all__ = ["SystemLibrary", "open_library"]


class SystemLibrary(Library):
    """The libraries of the components of a system.

    Args:
        fmu: The system; extracted if necessary, and closed with the libraries.
        layout: The slots and routes.
        target: The logger for the messages of all instances.
        solving: See ``Library``.
        resets: See ``SystemInstance``; empty if all components are reset.

    Raises:
        FMULoadError: If a library cannot be loaded.
    """

    def __init__(
        self,
        fmu: LoadableFMU,
        layout: Layout,
        target: logging.Logger,
        solving: Solving | None,
        resets: Sequence[str] = (),
    ) -> None:
        self._resets = resets or ("reset",) * len(layout.parts)
        self.close: Any
        self._system, self._layout, self._target = fmu, layout, target
        self._libraries: list[Library] = []
        self.can_save_state = fmu.description.capabilities.can_get_and_set_fmu_state
        self._instances: list[SystemInstance] = []
        self.close = weakref.finalize(self, _close, self._instances, self._libraries, fmu)
        try:
            for part, known in zip(fmu.parts, layout.parts, strict=True):
                self._libraries.append(_load(part, known, target, solving))
        except BaseException:
            self.close()
            raise

    def instantiate(self, *, hear_all: bool = False) -> Instance:
        """See ``Library.instantiate``."""
        if not self.close.alive:
            raise SimulationError(f"{self._system.path.name} is closed")
        made: list[Instance] = []
        try:
            for part, library in zip(self._layout.parts, self._libraries, strict=True):
                made.append(_instantiate(library, part.label, hear_all))
        except BaseException:
            for instance in made:
                instance.free()
            raise
        renew = functools.partial(self._renewed, hear_all=hear_all)
        instance = SystemInstance(self._layout, made, self._target, self._resets, renew)
        self._instances.append(instance)
        return instance

    def _renewed(self, index: int, old: Instance, *, hear_all: bool) -> Instance:
        library, label = self._libraries[index], self._layout.parts[index].label
        library.discard(old)
        return _instantiate(library, label, hear_all)

    def discard(self, instance: Instance) -> None:
        """See ``Library.discard``."""
        assert isinstance(instance, SystemInstance)
        if instance in self._instances:
            self._instances.remove(instance)
        instance.free()


def _load(
    part: LoadableFMU, layout: PartLayout, target: logging.Logger, solving: Solving | None
) -> Library:
    if part.is_apart:
        raise FMULoadError(
            f"{layout.label}: it runs in a process of its own, which only the C extension can give "
            "it"
        )
    try:
        return Library(part, target, solving)
    except FMULoadError as error:
        raise FMULoadError(f"{layout.label}: {error}") from None


def _instantiate(library: Library, label: str, hear_all: bool) -> Instance:
    try:
        return library.instantiate(hear_all=hear_all)
    except FMULoadError as error:
        raise FMULoadError(f"{label}: {error}") from None


def _close(instances: list[SystemInstance], libraries: list[Library], fmu: LoadableFMU) -> None:
    while instances:
        instances.pop().free()
    for library in libraries:
        library.close()
    fmu.close()


def open_library(
    fmu: LoadableFMU,
    target: logging.Logger,
    solving: Solving | None,
    inputs: Sequence[Variable],
    outputs: Sequence[Variable],
    resets: Sequence[str] = (),
) -> Library:
    """Load an FMU or a system.

    Args:
        fmu: The FMU or system.
        target: See ``Library``.
        solving: See ``Library``.
        inputs: The variables that each step sets.
        outputs: The variables that are read after each step.
        resets: See ``SystemLibrary``.

    Raises:
        FMULoadError: As ``Library``.
    """
    description = fmu.description
    if not isinstance(description, SystemDescription):
        return Library(fmu, target, solving)
    layout = Layout(description, inputs, outputs)
    return SystemLibrary(fmu, layout, target, solving, resets)
