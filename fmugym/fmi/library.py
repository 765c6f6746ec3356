"""The shared library of an FMU, loaded once through FMPy."""

from __future__ import annotations

import logging
import os
import threading
import weakref
from typing import Any, Final

import fmpy

from fmugym.archive.description import ModelDescription
from fmugym.archive.loadable import LoadableFMU
from fmugym.errors import FMULoadError, SimulationError
from fmugym.fmi.events import FMI3EventsInstance
from fmugym.fmi.exchange import (
    FMI1ExchangeInstance,
    FMI2ExchangeInstance,
    FMI3ExchangeInstance,
)
from fmugym.fmi.fmi1 import FMI1Instance
from fmugym.fmi.fmi2 import FMI2Instance
from fmugym.fmi.fmi3 import FMI3Instance
from fmugym.fmi.instance import Instance
from fmugym.fmi.log import Hearing
from fmugym.fmi.solver import Solving
from fmugym.signals import ordinary

__all__ = ["Library"]

_INSTANCE_CLASSES: Final[dict[tuple[int, str], type[Instance]]] = {
    (1, "co_simulation"): FMI1Instance,
    (2, "co_simulation"): FMI2Instance,
    (3, "co_simulation"): FMI3Instance,
    (1, "model_exchange"): FMI1ExchangeInstance,
    (2, "model_exchange"): FMI2ExchangeInstance,
    (3, "model_exchange"): FMI3ExchangeInstance,
}
_load_lock = threading.Lock()


def _instance_class(description: ModelDescription) -> type[Instance]:
    if description.uses_event_mode:
        return FMI3EventsInstance
    return _INSTANCE_CLASSES[description.fmi_major_version, description.interface]


class Library:
    """The shared library of an FMU, loaded from the FMU's temporary folder.

    Args:
        fmu: The FMU. It is extracted if necessary, and closed with the library.
        target: The logger for the messages of all instances.
        solving: How the equations of FMUs of model exchange are solved; None for the defaults.

    Raises:
        FMULoadError: If the library cannot be loaded or lacks a function of the standard.
    """

    def __init__(
        self, fmu: LoadableFMU, target: logging.Logger, solving: Solving | None = None
    ) -> None:
        description = fmu.description
        self._instance_class = _instance_class(description)
        self._solving = solving
        self._fmu = fmu
        self._target = target
        self._hearing = Hearing()
        self._native = _Native(fmu)
        try:
            self._native.load(self._instance_class)
        except BaseException:
            self._native.close()
            raise
        self.can_save_state = fmu.description.capabilities.can_get_and_set_fmu_state
        self.close = weakref.finalize(self, self._native.close)

    def instantiate(self, *, hear_all: bool = False) -> Instance:
        """Make a new instance.

        Args:
            hear_all: Whether it logs everything, even if the logger drops most of it.

        Raises:
            FMULoadError: If the FMU refuses.
            SimulationError: If the library is closed.
        """
        if not self.close.alive:
            raise SimulationError(f"{self._fmu.path.name} is closed")
        instance = self._instance_class(
            self._fmu.description,
            self._native.slave,
            self._target,
            self._hearing,
            hear_all,
            self._solving,
        )
        self._native.instances.append(instance)
        return instance

    def discard(self, instance: Instance) -> None:
        """Free an instance before its library is closed."""
        if instance in self._native.instances:
            self._native.instances.remove(instance)
        instance.free()


class _Native:
    """The part of a library that its finalizer needs, which must not refer to the library."""

    def __init__(self, fmu: LoadableFMU) -> None:
        self.fmu = fmu
        self.slave: Any = None
        self.instances: list[Instance] = []

    def load(self, instance_class: type[Instance]) -> None:
        self.fmu.prepare_library()
        folder, description = self.fmu.extract(), self.fmu.description
        self.slave = instance_class.slave_class.__new__(instance_class.slave_class)
        arguments = {
            "guid": description.instantiation_token,
            "modelIdentifier": description.model_identifier,
            "unzipDirectory": str(folder),
        }
        with _load_lock:
            working_directory = _working_directory(self.fmu)
            try:
                self.slave.__init__(**arguments)
            except ordinary(Exception) as error:
                raise FMULoadError(f"{self.fmu.path.name} cannot be loaded: {error}") from None
            finally:
                os.chdir(working_directory)  # FMPy leaves it changed after a failed load
        instance_class.mend(self.slave)

    def close(self) -> None:
        while self.instances:
            self.instances.pop().free()
        if hasattr(self.slave, "dll"):
            fmpy.freeLibrary(self.slave.dll._handle)
            self.slave = None
        self.fmu.close()


def _working_directory(fmu: LoadableFMU) -> str:
    try:
        return os.getcwd()
    except ordinary(OSError) as error:
        name = fmu.path.name
        raise FMULoadError(
            f"{name} cannot be loaded from this working directory: {error}"
        ) from None
