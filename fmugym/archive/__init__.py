"""Reader of an FMU file: archive, model description and shared library."""

from fmugym.archive.bundled import bundled_fmu
from fmugym.archive.fmu import FMU
from fmugym.archive.safe_zip import ArchiveLimits

__all__ = ["FMU", "ArchiveLimits", "bundled_fmu"]
