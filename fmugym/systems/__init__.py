"""Systems: several FMUs that run as one.

``system`` holds what users make, ``system_plan`` says what a master executes, ``system_fmu`` makes
a system look like an FMU.
"""

from fmugym.systems.components import Component
from fmugym.systems.connections import Connection
from fmugym.systems.system import FMUSystem

__all__ = ["Component", "Connection", "FMUSystem"]
