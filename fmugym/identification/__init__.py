"""Identification: fit the parameters of an FMU to logged trajectories, with their uncertainty.

``fit_swing`` fits the equation of motion of a single pendulum to free swings, by linear least
squares. ``fit_parameters`` fits any parameters of any FMU, by simulation. An environment takes the
results as parameter values or, with their uncertainty, as distributions.

The package needs SciPy, which the extra ``identification`` installs.
"""

from fmugym.identification.comparison import Comparison, plot_comparison
from fmugym.identification.output_error import FitResult, fit_parameters
from fmugym.identification.swing import SwingFit, fit_swing
from fmugym.identification.trajectory import Trajectory

__all__ = [
    "Comparison",
    "FitResult",
    "SwingFit",
    "Trajectory",
    "fit_parameters",
    "fit_swing",
    "plot_comparison",
]
