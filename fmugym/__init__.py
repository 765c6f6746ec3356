"""Co-simulation FMUs as Gymnasium environments.

Importing this package registers its environments, so that ``gymnasium.make("fmugym/...")`` works.
"""

from fmugym import envs
from fmugym.archive import FMU
from fmugym.bundled import bundled_fmu
from fmugym.config import EnvConfig
from fmugym.distributions import Choice, LogUniform, Normal, Uniform
from fmugym.env import FMI1CSEnv, FMI2CSEnv, FMI3CSEnv, FMUEnv
from fmugym.errors import ConfigError, ContractError, FMUGymError, FMULoadError, SimulationError
from fmugym.registration import register
from fmugym.vector import FMUVectorEnv

__all__ = [
    "FMU",
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
    "LogUniform",
    "Normal",
    "SimulationError",
    "Uniform",
    "bundled_fmu",
    "envs",
    "register",
]
