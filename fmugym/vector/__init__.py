"""Many environments over one pool of FMU instances."""

from fmugym.vector.entry_points import vectorized
from fmugym.vector.env import FMUVectorEnv

__all__ = ["FMUVectorEnv", "vectorized"]
