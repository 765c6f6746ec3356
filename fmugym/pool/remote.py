"""Components of systems in processes of their own: how the C code starts these."""

from __future__ import annotations

import multiprocessing.spawn
import os
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from fmugym.archive.loadable import LoadableFMU
from fmugym.errors import FMULoadError
from fmugym.pool.settings import PlaceOfFMU
from fmugym.wine.prefix import Wine

__all__ = ["Hosts", "place_of", "remote_settings"]

_SERVE: Final = """
import sys, types
sys.path[:] = {path!r}
package = sys.modules["fmugym"] = types.ModuleType("fmugym")
package.__path__ = {folders!r}
from fmugym import _native
del sys.modules["fmugym"]
_native.serve_component()
"""
"""What a worker executes. It does without the package itself, whose import takes a while."""


@dataclass(frozen=True)
class Hosts:
    """The processes of each component that has some of its own.

    Attributes:
        workers: How many there are for as many instances.
        instances: These.
        call_timeout: How long a call may take, in seconds.
    """

    workers: int = 1
    instances: int = 1
    call_timeout: float = float("inf")


def place_of(part: LoadableFMU, folder: Path) -> PlaceOfFMU:
    """Where the files of a component are, as the process that loads it names them."""
    version, library = part.description.fmi_major_version, folder / part.library
    if part.in_wine:
        return PlaceOfFMU.in_wine(folder, library, version)
    return PlaceOfFMU.here(folder, (library,), version)


def remote_settings(part: LoadableFMU, folder: Path, hosts: Hosts) -> tuple[Any, ...] | None:
    """What ``take_remote`` of ``native/python/systems.c`` takes; None for one of this process.

    Args:
        part: The FMU of a component.
        folder: Where it was extracted to.
        hosts: How many processes there are.

    Raises:
        FMULoadError: If there are no such processes here, or Wine is missing.
    """
    if not part.is_apart:
        return None
    if sys.platform == "win32":
        raise FMULoadError(
            f"{part.path.name} is a component that shall run in a process of its own, which works "
            "on Linux and macOS only"
        )
    wine = Wine.ready() if part.in_wine else None
    environment = dict(os.environ) if wine is None else wine.environment(os.environ)
    return (
        tuple(os.fsencode(text) for text in _command(wine)),
        _texts(environment),
        tuple(os.fsencode(path) for path in part.loaded_before),
        place_of(part, folder).paths[0],
        hosts.workers,
        hosts.instances,
        hosts.call_timeout,
    )


def _command(wine: Wine | None) -> list[str]:
    if wine is not None:
        return [*wine.command, "component"]
    executable = os.fsdecode(multiprocessing.spawn.get_executable())
    folders = list(sys.modules["fmugym"].__path__)
    return [executable, "-c", _SERVE.format(path=[*map(str, sys.path)], folders=folders)]


def _texts(environment: Mapping[str, str]) -> tuple[bytes, ...]:
    return tuple(os.fsencode(f"{name}={value}") for name, value in environment.items())
