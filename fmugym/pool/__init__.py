"""Pools: N instances of one FMU behind arrays, knowing nothing of actions and rewards."""

from fmugym.pool.base import Pool, PoolSpec
from fmugym.pool.python import PythonPool

__all__ = ["Pool", "PoolSpec", "PythonPool"]
