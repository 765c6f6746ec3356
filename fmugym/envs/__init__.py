"""The environments that come with the package."""

from fmugym.envs.cart_pole import CartPoleEnv
from fmugym.envs.cloud_pendulum import CloudPendulumEnv
from fmugym.envs.modelica_cart_pole import (
    DymolaCSCartPoleEnv,
    JModelicaCSCartPoleEnv,
    ModelicaCartPoleEnv,
)
from fmugym.envs.pendulum import PendulumEnv
from fmugym.registration import register

__all__ = [
    "CartPoleEnv",
    "CloudPendulumEnv",
    "DymolaCSCartPoleEnv",
    "JModelicaCSCartPoleEnv",
    "ModelicaCartPoleEnv",
    "PendulumEnv",
]

for name, steps, threshold in (
    ("CartPole", 500, 475.0),
    ("Pendulum", 200, None),
    ("ModelicaCartPole", 200, None),
    ("CloudPendulum", 500, None),
):
    register(
        f"fmugym/{name}-v0",
        f"fmugym.envs:{name}Env",
        steps,
        reward_threshold=threshold,
    )

register("fmugym/FMU-v0", "fmugym.declared:load")
