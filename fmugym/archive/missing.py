"""The libraries and tools that an FMU needs and this machine lacks."""

from __future__ import annotations

import re
import shutil
from collections.abc import Sequence
from typing import Final

__all__ = ["describe_missing", "missing_tool", "note_on"]

_TOOLS: Final = (
    (r"energyplus", "EnergyPlus", "energyplus"),
    (r"overture|into-cps|vdmj", "Java", "java"),
    (r"fmi4j|fmu4j|javafmi", "Java", "java"),
    (r"matlab|simulink", "MATLAB", "matlab"),
    (r"scilab|xcos", "Scilab", "scilab"),
)
"""Pattern of the generation tool, the tool that such an FMU starts, and its program."""

_START_ALWAYS: Final = {"EnergyPlus", "Java"}
"""Tools whose FMUs start them without saying so by ``needsExecutionTool``."""


def missing_tool(generation_tool: str, needs_execution_tool: bool) -> str | None:
    """Name the tool that an FMU starts, unless its program is found.

    Args:
        generation_tool: The tool that made the FMU, the only hint at what it starts.
        needs_execution_tool: The FMU's flag.

    Returns:
        The tool, or None if the FMU starts none or its program is in the search path.
    """
    for pattern, tool, program in _TOOLS:
        if re.search(pattern, generation_tool, re.IGNORECASE):
            needed = needs_execution_tool or tool in _START_ALWAYS
            return tool if needed and shutil.which(program) is None else None
    return (generation_tool or "the tool that exported it") if needs_execution_tool else None


def note_on(library: str) -> str:
    """What to do about a library that is missing, beyond installing it; empty for most."""
    if re.fullmatch(r"libgfortran\.so\.[34]", library):
        return "no current distribution has it; 'fmugym info --repair FMU' makes a replacement"
    return ""


def describe_missing(fmu: str, libraries: Sequence[str]) -> str:
    """Say which libraries an FMU of this name misses, and what to do about it."""
    notes = ((name, note_on(name)) for name in libraries)
    listing = "; ".join(f"{name} ({note})" if note else name for name, note in notes)
    return (
        f"{fmu} needs shared libraries that are not found here: {listing}. Install them, or name "
        "their files in preload=[...]"
    )
