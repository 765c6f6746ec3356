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
from fmugym.vector import vectorized

__all__ = [
    "CartPoleEnv",
    "CloudPendulumEnv",
    "DymolaCSCartPoleEnv",
    "JModelicaCSCartPoleEnv",
    "ModelicaCartPoleEnv",
    "PendulumEnv",
]

# By name, so that the specs can be written as JSON.
CartPoleVectorEnv = vectorized(CartPoleEnv)
PendulumVectorEnv = vectorized(PendulumEnv)
CloudPendulumVectorEnv = vectorized(CloudPendulumEnv)
ModelicaCartPoleVectorEnv = vectorized(ModelicaCartPoleEnv)

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
        vector_entry_point=f"fmugym.envs:{name}VectorEnv",
        reward_threshold=threshold,
    )
