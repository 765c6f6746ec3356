"""The environments that come with the package."""

from fmugym.envs.cart_pole import CartPoleEnv
from fmugym.envs.modelica_cart_pole import (
    DymolaCSCartPoleEnv,
    JModelicaCSCartPoleEnv,
    ModelicaCartPoleEnv,
)
from fmugym.envs.pendulum import PendulumEnv
from fmugym.registration import register

__all__ = [
    "CartPoleEnv",
    "DymolaCSCartPoleEnv",
    "JModelicaCSCartPoleEnv",
    "ModelicaCartPoleEnv",
    "PendulumEnv",
]

register("fmugym/CartPole-v0", "fmugym.envs:CartPoleEnv", 500, reward_threshold=475.0)
register("fmugym/Pendulum-v0", "fmugym.envs:PendulumEnv", 200)
register("fmugym/ModelicaCartPole-v0", "fmugym.envs:ModelicaCartPoleEnv", 200)
