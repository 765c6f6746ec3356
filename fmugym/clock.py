"""The former place of the clocks, which are in ``fmugym.pool.backend.clocks`` now."""

import warnings

from fmugym.pool.backend.clocks import Clock, ManualClock, RealClock

__all__ = ["Clock", "ManualClock", "RealClock"]

warnings.warn(
    "fmugym.clock has moved: import Clock, ManualClock and RealClock from fmugym.lab",
    DeprecationWarning,
    stacklevel=2,
)
