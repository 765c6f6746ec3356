"""Many environments over one pool of FMU instances."""

from typing import TYPE_CHECKING

from fmugym.lazy import lazily
from fmugym.vector.entry_points import vectorized

if TYPE_CHECKING:
    from fmugym.vector.vector_env import FMUVectorEnv

__all__ = ["FMUVectorEnv", "vectorized"]

__getattr__ = lazily(__name__, {"FMUVectorEnv": "fmugym.vector.vector_env"})
