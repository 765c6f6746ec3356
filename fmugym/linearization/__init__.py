"""Linear models of FMUs: at a point, along a trajectory, and of whole environments."""

from fmugym.linearization.models import LinearModel, linearize

__all__ = ["LinearModel", "linearize"]
