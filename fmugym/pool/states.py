"""Initial states that instances and processes share, in memory and on disk.

A model may need minutes to initialize. Where its FMU serializes its state, and a second process
gives the same outputs with it, one initialization serves all instances with the same start values.
The states are files in the cache folder: a digest, the outputs just after the initialization, and
the FMU's own bytes. A file that is damaged, too large, or no regular file is no state.
"""

from __future__ import annotations

import hashlib
import logging
import os
import stat
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np

from fmugym.archive.variable import Variable
from fmugym.fmi.status import WARNING_CODE
from fmugym.pool.attendant import AttendedPool, Attending, InitialState, Reset
from fmugym.pool.base import FloatArray, MaskArray
from fmugym.pool.spec import PoolSpec
from fmugym.signals import Ignoring, ordinary

__all__ = ["MOST_BYTES", "InitialStates", "StateFiles", "essence"]

logger = logging.getLogger(__name__)

MOST_BYTES: Final = 2**30
"""The size of all states together, in bytes; the ones that were not used for longest go first."""

_LARGEST: Final = 2**28
"""The largest size of one state, in bytes."""

_MAGIC: Final = b"fmugym initial state 1\n"
_DIGEST: Final = hashlib.sha256().digest_size

_READ: Final = os.O_RDONLY | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0)
"""Do not follow links, and do not wait for a pipe's writer; Windows has no such flags."""


class StateFiles:
    """States on disk.

    Args:
        prefix: The folder, and the beginning of the files' names, which stands for the FMU.
        width: How many outputs a state has.
    """

    def __init__(self, prefix: str, width: int) -> None:
        self._prefix, self._width = Path(prefix), width

    def path(self, key: str) -> Path:
        """The file of a state."""
        return self._prefix.with_name(f"{self._prefix.name}-{key}")

    def find(self, key: str) -> InitialState | None:
        """Read a state; None if there is none, or only a damaged one."""
        path = self.path(key)
        try:
            handle = os.open(path, _READ)
            with os.fdopen(handle, "rb") as file:
                status = os.fstat(handle)
                if not stat.S_ISREG(status.st_mode) or status.st_size > _LARGEST:
                    return None
                state = self._parse(file.read(_LARGEST))
            os.utime(path)
        except ordinary(OSError):
            return None
        return state

    def _parse(self, content: bytes) -> InitialState | None:
        start = len(_MAGIC) + _DIGEST
        digest, body = content[len(_MAGIC) : start], content[start:]
        size = 8 * self._width
        if content[: len(_MAGIC)] != _MAGIC or len(body) <= size:
            return None
        if hashlib.sha256(body).digest() != digest:
            return None
        return InitialState(body[:size], body[size:])

    def keep(self, key: str, state: InitialState) -> None:
        """Write a state; if that is not possible, nothing is kept, and no error is raised."""
        body = state.outputs + state.data
        if len(body) > _LARGEST // 2:
            return
        try:
            self._prefix.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
            _write(self.path(key), _MAGIC + hashlib.sha256(body).digest() + body)
            _remove_old(self._prefix.parent)
        except ordinary(OSError) as error:
            logger.debug("no initial state is kept: %s", error)


def _write(path: Path, content: bytes) -> None:
    """Replace a file atomically, because another process may be reading or writing it."""
    handle, name = tempfile.mkstemp(dir=path.parent)
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(content)
        os.replace(name, path)
    except BaseException:
        with Ignoring(OSError):
            os.unlink(name)
        raise


def _remove_old(folder: Path) -> None:
    """Remove the states that were not used for longest until the others are few enough."""
    files = []
    for path in folder.iterdir():
        with Ignoring(OSError):  # another process has removed it
            status = path.lstat()
            files.append((status.st_mtime_ns, status.st_size, path))
    total = 0
    for _, size, path in sorted(files, reverse=True):
        total += size
        if total > MOST_BYTES:
            with Ignoring(OSError):
                path.unlink()


class InitialStates(Attending):
    """Goes with the resets of a pool: instances restore states that others have made.

    Args:
        spec: What the pool does; ``spec.state_files`` says where the states are.
    """

    def __init__(self, spec: PoolSpec) -> None:
        self._files = StateFiles(spec.state_files, len(spec.outputs))
        self._scope = repr(essence(spec)).encode()
        self._work = True

    def reset(
        self,
        pool: AttendedPool,
        reset: Reset,
        variables: tuple[Variable, ...],
        values: FloatArray,
        mask: MaskArray | None,
    ) -> None:
        """See ``Attending.reset``; instances with the same start values are initialized once."""
        chosen = np.ones(pool.num_instances, np.bool_) if mask is None else np.array(mask, bool)
        columns: dict[bytes, list[int]] = {}
        for index in np.flatnonzero(chosen).tolist():
            columns.setdefault(values[:, index].tobytes(), []).append(index)
        for column, indices in columns.items():
            unknown = [i for i in indices if not pool.knows_start(i, variables, values[:, i])]
            if unknown and self._work:
                done = self._share(pool, reset, variables, values, column, unknown)
                chosen[done] = False
        if chosen.any():
            reset(variables, values, chosen)

    def _share(
        self,
        pool: AttendedPool,
        reset: Reset,
        variables: tuple[Variable, ...],
        values: FloatArray,
        column: bytes,
        indices: Sequence[int],
    ) -> list[int]:
        """Give a state to instances with the same start values; return which are reset already."""
        key = self._key(variables, column)
        state, done = self._files.find(key), list[int]()
        if state is None:
            first = indices[0]
            reset(variables, values, np.arange(pool.num_instances) == first)
            if pool.statuses[first] > WARNING_CODE:
                return [first]
            state = pool.pack(first)
            if state is None:
                self._work = False  # whatever the trial showed
                return []  # the refusal may have harmed the instance: it is reset again
            self._files.keep(key, state)
            done = [first]
        for index in indices:
            pool.adopt(index, variables, values[:, index], state)
        return done

    def _key(self, variables: tuple[Variable, ...], column: bytes) -> str:
        names = repr([(v.name, v.value_reference) for v in variables]).encode()
        parts = (self._scope, names, column)
        return hashlib.sha256(b"".join(hashlib.sha256(p).digest() for p in parts)).hexdigest()[:32]


def essence(spec: PoolSpec) -> PoolSpec:
    """The part of a spec on which initial states depend."""
    return replace(
        spec,
        num_observed=0,
        fault_retries=0,
        leak_limit=None,
        input_limits=(),
        one_initialization=False,
        max_instances=None,
        licence_wait=0.0,
        keep_states=False,
        state_files="",
        records=False,
    )
