"""The pace at which instances are made and initialized, for licences that limit it.

All environments of an FMU on a machine share a file with the time at which the last of these calls
began. Before a call, an environment moves this time on by its own interval, and waits until it has
come. The native pool does so in ``native/pace.c``. All processes of a machine have the same
monotonic clock, but it begins anew with the machine: so the file also has the time of that.
"""

from __future__ import annotations

import mmap
import os
import threading
import time
from contextlib import nullcontext
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt

from fmugym.errors import ConfigError
from fmugym.pool.extension import has_native_pool
from fmugym.pool.locks import exclusively
from fmugym.pool.spec import PoolSpec
from fmugym.signals import ordinary

__all__ = ["Pacer", "last_initialization", "pace_file"]

TimeArray = npt.NDArray[np.int64]

_lock: Final = threading.Lock()

_SIZE: Final = 4096
_DRIFT: Final = 60.0
"""By how many seconds the time at which the machine was started seems to change at most."""


def last_initialization(spec: PoolSpec) -> TimeArray:
    """When the last instance was made or initialized, in ns of the monotonic clock; 0 for never.

    Returns:
        Memory of shape (1,) that all pools with the same ``spec.locks`` share.

    Raises:
        ConfigError: If the file cannot be made.
    """
    path = pace_file(spec)
    if path is None:
        return np.zeros(1, np.int64)
    try:
        with exclusively(_mutex(spec)):
            return _opened(path)[:1]
    except ordinary(OSError) as error:
        raise ConfigError(
            f"config key 'max_initializations_per_second' needs the file {path}: {error}"
        ) from None


def pace_file(spec: PoolSpec) -> Path | None:
    """The file of ``last_initialization``; None if the pace is not limited for all environments."""
    is_limited = bool(spec.locks) and spec.initialization_interval > 0.0
    return Path(f"{spec.locks}.pace") if is_limited else None


def _mutex(spec: PoolSpec) -> Path:
    return Path(f"{spec.locks}.lock")


def _opened(path: Path) -> TimeArray:
    """Map the file; forget what it has from before the machine was started."""
    handle = os.open(path, os.O_RDWR | os.O_CREAT, 0o600)
    try:
        if os.fstat(handle).st_size < _SIZE:
            os.write(handle, bytes(_SIZE))
        times: TimeArray = np.frombuffer(mmap.mmap(handle, _SIZE), np.int64)
    finally:
        os.close(handle)
    start = int(time.time() - time.monotonic())
    if abs(times[1] - start) > _DRIFT:
        times[:2] = 0, start
    return times


class Pacer:
    """Waits before an instance is made or initialized.

    Args:
        spec: Has the interval and the place of the file.
    """

    def __init__(self, spec: PoolSpec) -> None:
        self._spec, self._interval = spec, spec.initialization_interval
        self._last = last_initialization(spec)

    def wait(self) -> None:
        """Wait until a call may begin."""
        if self._interval > 0.0:
            time.sleep(self._claim())

    def _claim(self) -> float:
        """Take the next moment; returns the seconds until then."""
        if has_native_pool():
            from fmugym import _native

            return _native.claim_initialization(self._last, self._interval)
        with _lock, exclusively(_mutex(self._spec)) if self._spec.locks else nullcontext():
            now = time.monotonic_ns()
            following = int(self._last[0]) + int(1e9 * self._interval)
            self._last[0] = following if self._last[0] and following > now else now
            return max(0.0, 1e-9 * (int(self._last[0]) - now))
