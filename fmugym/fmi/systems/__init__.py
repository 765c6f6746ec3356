"""Systems: several FMUs that run as one.

``system`` holds what users make, and lets it look like an FMU; ``system_plan`` says what a master
executes. ``ssp_archive`` reads the arguments of an ``FMUSystem`` from an archive of SSP 1.0, and
``ssp_elements`` holds what its files say.
"""

from fmugym.fmi.systems.components import Component, Connection
from fmugym.fmi.systems.system import FMUSystem

__all__ = ["Component", "Connection", "FMUSystem"]
