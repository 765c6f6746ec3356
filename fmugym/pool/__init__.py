"""Pools: N instances of one FMU behind arrays, knowing nothing of actions and rewards."""

from fmugym.pool.pool import FloatArray, MaskArray, Pool, StatusArray
from fmugym.pool.pool_spec import DEFAULT_CALL_TIMEOUT, ISOLATIONS, PoolSpec
from fmugym.pool.rig.clocks import Paced
from fmugym.pool.rig.rig import Backend
from fmugym.pool.rig.rig_pool import BackendPool

__all__ = [
    "DEFAULT_CALL_TIMEOUT",
    "ISOLATIONS",
    "Backend",
    "BackendPool",
    "FloatArray",
    "MaskArray",
    "Paced",
    "Pool",
    "PoolSpec",
    "StatusArray",
]
