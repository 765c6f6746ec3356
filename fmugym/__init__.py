"""Co-simulation FMUs as Gymnasium environments.

Importing this package registers its environments, so that ``gymnasium.make("fmugym/...")`` works.
"""

from fmugym import envs
from fmugym.archive.bundled import bundled_fmu
from fmugym.archive.fmu import FMU
from fmugym.archive.safe_zip import ArchiveLimits
from fmugym.config import EnvConfig
from fmugym.declared import Task, TaskEnv, load
from fmugym.distributions import Choice, LogUniform, Normal, Uniform
from fmugym.env import FMI1CSEnv, FMI2CSEnv, FMI3CSEnv, FMUEnv
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
from fmugym.pool import Backend, Paced
from fmugym.registration import register
from fmugym.tools.linearization import LinearModel, linearize
from fmugym.vector import FMUVectorEnv

__all__ = [
    "FMU",
    "ArchiveLimits",
    "Backend",
    "Choice",
    "ConfigError",
    "ContractError",
    "EnvConfig",
    "FMI1CSEnv",
    "FMI2CSEnv",
    "FMI3CSEnv",
    "FMUEnv",
    "FMUGymError",
    "FMULoadError",
    "FMUVectorEnv",
    "LicenceError",
    "LinearModel",
    "LogUniform",
    "Normal",
    "Paced",
    "SimulationError",
    "Status",
    "Task",
    "TaskEnv",
    "TaskError",
    "Uniform",
    "bundled_fmu",
    "envs",
    "linearize",
    "load",
    "register",
]
