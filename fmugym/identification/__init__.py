"""Identification: the parameters of an FMU from logged trajectories, and how well they are known.

``fit_swing`` fits the equation of motion of a single pendulum to free swings, by linear least
squares. ``fit_parameters`` fits any parameters of any FMU, by simulation. What both find can be
passed on as parameter values or, with its uncertainty, as distributions.

Needs SciPy: ``pip install "fmugym-toolbox[identification]"``.
"""

from fmugym.identification.output_error import FitResult, fit_parameters
from fmugym.identification.results import Comparison, plot_comparison
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
