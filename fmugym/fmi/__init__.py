"""FMU: its archive, model description and binaries, and what it lacks on this machine.

``systems`` makes one FMU of several.
"""

from fmugym.fmi.bundled import bundled_fmu
from fmugym.fmi.fmu import FMU
from fmugym.fmi.safe_zip import ArchiveLimits
from fmugym.fmi.status import Status

__all__ = ["FMU", "ArchiveLimits", "Status", "bundled_fmu"]
