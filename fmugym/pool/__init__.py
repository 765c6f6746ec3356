"""Pools: N instances of one FMU behind arrays, knowing nothing of actions and rewards."""

from fmugym.pool.base import FloatArray, MaskArray, Pool, PoolSpec, StatusArray
from fmugym.pool.python import PythonPool

__all__ = ["FloatArray", "MaskArray", "Pool", "PoolSpec", "PythonPool", "StatusArray"]
