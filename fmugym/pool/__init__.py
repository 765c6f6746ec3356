"""Pools: N instances of one FMU behind arrays, knowing nothing of actions and rewards."""

from fmugym.pool.backend.backend_pool import Backend, BackendPool
from fmugym.pool.backend.pacing import Paced
from fmugym.pool.base import FloatArray, MaskArray, Pool, StatusArray
from fmugym.pool.spec import DEFAULT_CALL_TIMEOUT, ISOLATIONS, PoolSpec

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
