"""Co-simulation FMUs as Gymnasium environments.

Importing this package registers its environments, so that ``gymnasium.make("fmugym/...")`` works.
Everything else is imported when it is first used.
"""

from typing import TYPE_CHECKING

from fmugym.extras import lazily
from fmugym.registration import register, register_bundled

if TYPE_CHECKING:
    from fmugym import envs
    from fmugym.environment.distributions import Choice, LogUniform, Normal, Uniform
    from fmugym.environment.env import (
        FMI1CSEnv,
        FMI1MEEnv,
        FMI2CSEnv,
        FMI2MEEnv,
        FMI3CSEnv,
        FMI3MEEnv,
        FMUEnv,
    )
    from fmugym.environment.snapshots import Snapshot
    from fmugym.environment.vector import FMUVectorEnv
    from fmugym.errors import (
        ConfigError,
        ContractError,
        FMUGymError,
        FMULoadError,
        LicenceError,
        SimulationError,
        TaskError,
    )
    from fmugym.fmi import FMU, bundled_fmu
    from fmugym.fmi.systems import Component, Connection, FMUSystem
    from fmugym.task import Task, TaskEnv, load

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
    "environment.distributions": ["Choice", "LogUniform", "Normal", "Uniform"],
    "environment.env": [
        *("FMI1CSEnv", "FMI1MEEnv", "FMI2CSEnv", "FMI2MEEnv"),
        *("FMI3CSEnv", "FMI3MEEnv", "FMUEnv"),
    ],
    "environment.snapshots": ["Snapshot"],
    "environment.vector": ["FMUVectorEnv"],
    "errors": [
        *("ConfigError", "ContractError", "FMUGymError", "FMULoadError"),
        *("LicenceError", "SimulationError", "TaskError"),
    ],
    "fmi.bundled": ["bundled_fmu"],
    "fmi.fmu": ["FMU"],
    "fmi.systems": ["Component", "Connection", "FMUSystem"],
    "task": ["Task", "TaskEnv", "load"],
}
_ROOMS = [
    *("checks", "cli", "control", "deployment", "environment", "envs", "errors", "fmi"),
    *("lab", "pool", "records", "registration", "rendering", "task", "training"),
]
"""Modules and packages that ``fmugym.name`` imports."""


def _places(rooms: dict[str, list[str]]) -> dict[str, str]:
    return {name: f"{__name__}.{room}" for room, names in rooms.items() for name in names}


__getattr__ = lazily(__name__, {room: f"{__name__}.{room}" for room in _ROOMS} | _places(_MODULES))


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})


register_bundled()
