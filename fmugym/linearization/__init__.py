"""Linear models of FMUs: at a point, along a trajectory, and of whole environments."""

from fmugym.linearization.models import LinearModel, linearize
from fmugym.linearization.sensitivities import derivatives
from fmugym.linearization.trajectories import linearize_along

__all__ = ["LinearModel", "derivatives", "linearize", "linearize_along"]
