"""Co-simulation FMUs as Gymnasium environments.

Importing this package registers its environments, so that ``gymnasium.make("fmugym/...")`` works.
"""

from fmugym import envs
from fmugym.adapters import Status
from fmugym.archive import FMU
from fmugym.bundled import bundled_fmu
from fmugym.config import EnvConfig
from fmugym.distributions import Choice, LogUniform, Normal, Uniform
from fmugym.env import FMI1CSEnv, FMI2CSEnv, FMI3CSEnv, FMUEnv
from fmugym.errors import ConfigError, ContractError, FMUGymError, FMULoadError, SimulationError
from fmugym.linearization import LinearModel, linearize
from fmugym.pool import Backend, Paced
from fmugym.registration import register
from fmugym.safe_zip import ArchiveLimits
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
    "LinearModel",
    "LogUniform",
    "Normal",
    "Paced",
    "SimulationError",
    "Status",
    "Uniform",
    "bundled_fmu",
    "envs",
    "linearize",
    "register",
]
