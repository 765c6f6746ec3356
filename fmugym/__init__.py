"""Co-simulation FMUs as Gymnasium environments.

Importing this package registers its environments, so that ``gymnasium.make("fmugym/...")`` works.
"""

from fmugym.archive import FMU
from fmugym.config import EnvConfig
from fmugym.distributions import Choice, LogUniform, Normal, Uniform
from fmugym.env import FMI1CSEnv, FMI2CSEnv, FMI3CSEnv, FMUEnv
from fmugym.errors import ConfigError, FMUGymError, FMULoadError, SimulationError

__all__ = [
    "FMU",
    "Choice",
    "ConfigError",
    "EnvConfig",
    "FMI1CSEnv",
    "FMI2CSEnv",
    "FMI3CSEnv",
    "FMUEnv",
    "FMUGymError",
    "FMULoadError",
    "LogUniform",
    "Normal",
    "SimulationError",
    "Uniform",
]
