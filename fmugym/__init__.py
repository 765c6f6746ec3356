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
    from fmugym.archive.safe_zip import ArchiveLimits
    from fmugym.config import EnvConfig
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
    from fmugym.fmi.status import Status
    from fmugym.linearization import LinearModel, linearize
    from fmugym.linearization.sensitivities import derivatives
    from fmugym.linearization.trajectories import linearize_along
    from fmugym.pool import Backend, Paced
    from fmugym.recording import Recorder, Recording, replay
    from fmugym.systems import Component, Connection, FMUSystem
    from fmugym.task.snapshot import Snapshot
    from fmugym.training.agents import load_agent
    from fmugym.vector import FMUVectorEnv

__all__ = [
    "FMU",
    "ArchiveLimits",
    "Backend",
    "Choice",
    "Component",
    "ConfigError",
    "Connection",
    "ContractError",
    "EnvConfig",
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
    "LinearModel",
    "LogUniform",
    "Normal",
    "Paced",
    "Recorder",
    "Recording",
    "SimulationError",
    "Snapshot",
    "Status",
    "Task",
    "TaskEnv",
    "TaskError",
    "Uniform",
    "bundled_fmu",
    "derivatives",
    "envs",
    "linearize",
    "linearize_along",
    "load",
    "load_agent",
    "register",
    "replay",
]

_MODULES = {
    "archive.bundled": ["bundled_fmu"],
    "archive.fmu": ["FMU"],
    "archive.safe_zip": ["ArchiveLimits"],
    "config": ["EnvConfig"],
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
    "fmi.status": ["Status"],
    "pool": ["Backend", "Paced"],
    "recording": ["Recorder", "Recording", "replay"],
    "systems": ["Component", "Connection", "FMUSystem"],
    "task.snapshot": ["Snapshot"],
    "training.agents": ["load_agent"],
    "linearization": ["LinearModel", "linearize"],
    "linearization.sensitivities": ["derivatives"],
    "linearization.trajectories": ["linearize_along"],
    "vector": ["FMUVectorEnv"],
}
_ROOMS = [
    *("archive", "baselines", "checks", "config", "declared", "distributions", "env", "envs"),
    *("errors", "fmi", "identification", "lab", "pool", "registration", "rendering", "sb3"),
    *("single", "systems", "task", "testing", "tools", "trial", "vector"),
]
"""Modules and packages that ``fmugym.name`` imports."""

__getattr__ = lazily(
    __name__,
    {room: f"{__name__}.{room}" for room in _ROOMS}
    | {name: f"{__name__}.{module}" for module, names in _MODULES.items() for name in names},
)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})


register_bundled()
