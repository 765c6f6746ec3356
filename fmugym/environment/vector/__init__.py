"""Many environments over one pool of FMUs: episodes in arrays, tasks around their steps."""

from typing import TYPE_CHECKING

from fmugym.environment.vector.entry_points import vectorized
from fmugym.extras import lazily

if TYPE_CHECKING:
    from fmugym.environment.vector.vector_env import FMUVectorEnv

__all__ = ["FMUVectorEnv", "vectorized"]

__getattr__ = lazily(__name__, {"FMUVectorEnv": "fmugym.environment.vector.vector_env"})
