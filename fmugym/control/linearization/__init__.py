"""Linear models of FMUs: at a point, along a trajectory, and of whole environments."""

from fmugym.control.linearization.linear_model import LinearModel, linearize
from fmugym.control.linearization.linear_trajectory import linearize_along
from fmugym.control.linearization.trajectory_derivatives import derivatives

__all__ = ["LinearModel", "derivatives", "linearize", "linearize_along"]
