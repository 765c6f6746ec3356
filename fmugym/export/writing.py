"""Writing agents to files."""

from __future__ import annotations

import os
from pathlib import Path

from fmugym.checks import check_path
from fmugym.errors import ConfigError, shown
from fmugym.export.agent import Agent
from fmugym.export.c99 import header, source

__all__ = ["write_c"]


def write_c(agent: Agent, folder: str | os.PathLike[str]) -> list[Path]:
    """Write an agent as C99: a header and a source file, which need nothing but the C library.

    Args:
        agent: The agent. Its name is that of the files.
        folder: Where to write them; neither file may exist.

    Returns:
        The paths of the header and the source.

    Raises:
        ConfigError: If the task computes what cannot be written in C; the text names it.
        FileExistsError: If a file exists.
    """
    place = check_path("folder", folder)
    if not place.is_dir():
        raise ConfigError(f"{shown(str(place))} is no folder")
    texts = {f"{agent.name}.h": header(agent), f"{agent.name}.c": source(agent)}
    for name in texts:
        if (place / name).exists():
            raise FileExistsError(f"{place / name} exists")
    for name, text in texts.items():
        (place / name).write_text(text, encoding="ascii", newline="\n")
    return [place / name for name in texts]
