"""States of FMUs on disk, which episodes of later programs begin with.

They are files in the cache folder: a digest, and the bytes that a caller makes of a state. A file
that is damaged, too large, or no regular file is no state.
"""

from __future__ import annotations

import hashlib
import logging
import os
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Final

from fmugym.caching import read_file, replace_file
from fmugym.pool.spec import PoolSpec

__all__ = ["MOST_BYTES", "StateFiles", "essence"]

logger = logging.getLogger(__name__)

MOST_BYTES: Final = 2**30
"""The size of all states together, in bytes; the ones that were not used for longest go first."""

_LARGEST: Final = 2**28
"""The largest size of one state, in bytes."""

_MAGIC: Final = b"fmugym initial state 2\n"
_DIGEST: Final = hashlib.sha256().digest_size


class StateFiles:
    """States on disk.

    Args:
        prefix: The folder, and the beginning of the files' names, which stands for the FMU.
    """

    def __init__(self, prefix: str) -> None:
        self._prefix = Path(prefix)

    def path(self, key: str) -> Path:
        """The file of a state."""
        return self._prefix.with_name(f"{self._prefix.name}-{key}")

    def find(self, key: str) -> bytes | None:
        """Read a state; None if there is none, or only a damaged one."""
        path = self.path(key)
        try:
            state = _parsed(read_file(path, _LARGEST))
            os.utime(path)
        except OSError:
            return None
        return state

    def keep(self, key: str, state: bytes) -> None:
        """Write a state; if that is not possible, nothing is kept, and no error is raised."""
        if len(state) > _LARGEST // 2:
            return
        try:
            self._prefix.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
            replace_file(self.path(key), _MAGIC + hashlib.sha256(state).digest() + state)
            _remove_old(self._prefix.parent)
        except OSError as error:
            logger.debug("no state is kept: %s", error)


def _parsed(content: bytes) -> bytes | None:
    start = len(_MAGIC) + _DIGEST
    digest, state = content[len(_MAGIC) : start], content[start:]
    is_sound = content[: len(_MAGIC)] == _MAGIC and hashlib.sha256(state).digest() == digest
    return state if is_sound else None


def _remove_old(folder: Path) -> None:
    """Remove the states that were not used for longest until the others are few enough."""
    files = []
    for path in folder.iterdir():
        with suppress(OSError):  # another process has removed it
            status = path.lstat()
            files.append((status.st_mtime_ns, status.st_size, path))
    total = 0
    for _, size, path in sorted(files, reverse=True):
        total += size
        if total > MOST_BYTES:
            with suppress(OSError):
                path.unlink()


def essence(spec: PoolSpec) -> PoolSpec:
    """The part of a spec on which states depend."""
    return replace(
        spec,
        inputs=tuple(replace(variable, bounds=None) for variable in spec.inputs),
        outputs=tuple(replace(variable, bounds=None) for variable in spec.outputs),
        num_observed=0,
        fault_retries=0,
        leak_limit=None,
        one_initialization=False,
        max_instances=None,
        licence_wait=0.0,
        records=False,
    )
