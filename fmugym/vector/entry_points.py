"""Vector entry points by name, which Gymnasium's specs need in order to be written as text.

``"fmugym.vector.entry_points:me.boilers.Boiler"`` is the vector entry point of the class ``Boiler``
in the module ``me.boilers``.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from fmugym.vector.env import vectorized

__all__ = ["vector_entry_point"]


def vector_entry_point(entry_point: str) -> str:
    """Return the vector entry point for the entry point ``"module:Class"`` of one environment."""
    return f"{__name__}:{entry_point.replace(':', '.')}"


def __getattr__(name: str) -> Callable[..., Any]:
    module, _, attribute = name.rpartition(".")
    if not module:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return vectorized(f"{module}:{attribute}")
