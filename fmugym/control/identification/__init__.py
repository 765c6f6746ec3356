"""Identification: fit the parameters of an FMU to logged trajectories, with their uncertainty.

``fit_parameters`` fits any parameters of any FMU, by simulation. An environment takes the results
as parameter values or, with their uncertainty, as rows of values of which it draws one.

The package needs SciPy, which the extra ``identification`` installs.
"""

from fmugym.control.identification.output_error import FitResult, fit_parameters
from fmugym.control.identification.trajectory import Comparison, Trajectory, plot_comparison

__all__ = [
    "Comparison",
    "FitResult",
    "Trajectory",
    "fit_parameters",
    "plot_comparison",
]
