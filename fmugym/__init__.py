"""Co-simulation FMUs as Gymnasium environments.

Importing this package registers its environments, so that ``gymnasium.make("fmugym/...")`` works.
Everything else is imported when it is first used.
"""

from typing import TYPE_CHECKING

from fmugym.lazy import lazily
from fmugym.registration import register, register_bundled

if TYPE_CHECKING:
    from fmugym import envs
    from fmugym.archive.bundled import bundled_fmu
    from fmugym.archive.fmu import FMU
    from fmugym.declared import Task, TaskEnv, load
    from fmugym.distributions import Choice, LogUniform, Normal, Uniform
    from fmugym.env import FMI1CSEnv, FMI1MEEnv, FMI2CSEnv, FMI2MEEnv, FMI3CSEnv, FMI3MEEnv, FMUEnv
    from fmugym.errors import (
        ConfigError,
        ContractError,
        FMUGymError,
        FMULoadError,
        LicenceError,
        SimulationError,
        TaskError,
    )
    from fmugym.systems import Component, Connection, FMUSystem
    from fmugym.task.snapshot import Snapshot
    from fmugym.vector import FMUVectorEnv

__all__ = [
    "FMU",
    "Choice",
    "Component",
    "ConfigError",
    "Connection",
    "ContractError",
    "FMI1CSEnv",
    "FMI1MEEnv",
    "FMI2CSEnv",
    "FMI2MEEnv",
    "FMI3CSEnv",
    "FMI3MEEnv",
    "FMUEnv",
    "FMUGymError",
    "FMULoadError",
    "FMUSystem",
    "FMUVectorEnv",
    "LicenceError",
    "LogUniform",
    "Normal",
    "SimulationError",
    "Snapshot",
    "Task",
    "TaskEnv",
    "TaskError",
    "Uniform",
    "bundled_fmu",
    "envs",
    "load",
    "register",
]

_MODULES = {
    "archive.bundled": ["bundled_fmu"],
    "archive.fmu": ["FMU"],
    "declared": ["Task", "TaskEnv", "load"],
    "distributions": ["Choice", "LogUniform", "Normal", "Uniform"],
    "env": [
        *("FMI1CSEnv", "FMI2CSEnv", "FMI3CSEnv", "FMUEnv"),
        *("FMI1MEEnv", "FMI2MEEnv", "FMI3MEEnv"),
    ],
    "errors": [
        *("ConfigError", "ContractError", "FMUGymError"),
        *("FMULoadError", "LicenceError", "SimulationError", "TaskError"),
    ],
    "systems": ["Component", "Connection", "FMUSystem"],
    "task.snapshot": ["Snapshot"],
    "vector": ["FMUVectorEnv"],
}
_ROOMS = [
    *("archive", "baselines", "checks", "config", "declared", "distributions", "env", "envs"),
    *("errors", "fmi", "identification", "lab", "linearization", "pool", "recording"),
    *("registration", "rendering", "sb3", "systems", "task", "testing", "tools", "trial"),
    "vector",
]
"""Modules and packages that ``fmugym.name`` imports."""


def _places(rooms: dict[str, list[str]]) -> dict[str, str]:
    return {name: f"{__name__}.{room}" for room, names in rooms.items() for name in names}


__getattr__ = lazily(__name__, {room: f"{__name__}.{room}" for room in _ROOMS} | _places(_MODULES))


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})


register_bundled()
