"""The environments that come with the package."""

from fmugym.envs.cart_pole import CartPoleEnv
from fmugym.envs.cloud_pendulum import CloudPendulumEnv
from fmugym.envs.house import HouseEnv
from fmugym.envs.modelica_cart_pole import (
    DymolaCSCartPoleEnv,
    JModelicaCSCartPoleEnv,
    ModelicaCartPoleEnv,
)
from fmugym.envs.pendulum import PendulumEnv

__all__ = [
    "CartPoleEnv",
    "CloudPendulumEnv",
    "DymolaCSCartPoleEnv",
    "HouseEnv",
    "JModelicaCSCartPoleEnv",
    "ModelicaCartPoleEnv",
    "PendulumEnv",
]
