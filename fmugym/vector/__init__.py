"""Many environments over one pool of FMU instances."""

from fmugym.vector.env import FMUVectorEnv, vectorized

__all__ = ["FMUVectorEnv", "vectorized"]
