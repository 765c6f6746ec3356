"""Disturbances that an experiment brings upon its own cell.

The names and the arguments of the two timed ones are the lab's. What the state-dependent ones take
is not public: their arguments are this package's own. So is what a position disturbance does, which
is to let the drive pull the joints to a position for a while, whatever was commanded.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Final, Protocol

from fmugym.errors import ConfigError, unknown_name

__all__ = [
    "PRESETS",
    "Disturbance",
    "StateDependentPositionDisturbance",
    "StateDependentTorqueDisturbance",
    "TimedPositionDisturbance",
    "TimedTorqueDisturbance",
    "resolve",
]


class Disturbance(Protocol):
    """What all disturbances have in common; each acts at most once in a session."""

    @property
    def duration(self) -> float:
        """How long it acts, in s."""
        ...

    @property
    def torque(self) -> Sequence[float] | None:
        """What it adds to the torque of each joint, in N m; None if it pulls to a position."""
        ...

    @property
    def position(self) -> Sequence[float] | None:
        """Where it pulls the joints, in rad; None if it adds a torque."""
        ...

    def is_due(self, time: float, position: Sequence[float]) -> bool:
        """Whether it begins now.

        Args:
            time: Time of the session, in s.
            position: Angles of the joints, in rad.
        """
        ...


@dataclass(frozen=True)
class TimedTorqueDisturbance:
    """A torque from outside, at a fixed time.

    Args:
        start_time: When it begins, in s after the session's start.
        duration: How long it lasts, in s.
        torque: On each joint, in N m.
    """

    start_time: float
    duration: float
    torque: Sequence[float]
    position = None

    def is_due(self, time: float, position: Sequence[float]) -> bool:
        """See ``Disturbance.is_due``."""
        return time >= self.start_time


@dataclass(frozen=True)
class TimedPositionDisturbance:
    """A pull to a position, at a fixed time.

    Args:
        trigger_time: When it begins, in s after the session's start.
        disturbance_position: Where it pulls each joint, in rad; None for hanging down.
        duration: How long it lasts, in s; ours.
    """

    trigger_time: float
    disturbance_position: Sequence[float] | None = None
    duration: float = 0.5
    torque = None

    @property
    def position(self) -> Sequence[float]:
        """Where it pulls the joints, in rad."""
        return self.disturbance_position or (0.0, 0.0)

    def is_due(self, time: float, position: Sequence[float]) -> bool:
        """See ``Disturbance.is_due``."""
        return time >= self.trigger_time


@dataclass(frozen=True)
class StateDependentTorqueDisturbance:
    """A torque from outside, when the joints first come near a position.

    Args:
        trigger_position: Of each joint, in rad; turns do not count.
        duration: How long it lasts, in s.
        torque: On each joint, in N m.
        tolerance: How near each joint must come, in rad.
        earliest: Before this time it does not begin, in s after the session's start.
    """

    trigger_position: Sequence[float]
    duration: float
    torque: Sequence[float]
    tolerance: float = 0.1
    earliest: float = 0.0
    position = None

    def is_due(self, time: float, position: Sequence[float]) -> bool:
        """See ``Disturbance.is_due``."""
        near = _is_near(position, self.trigger_position, self.tolerance)
        return time >= self.earliest and near


@dataclass(frozen=True)
class StateDependentPositionDisturbance:
    """A pull to a position, when the joints first come near another one.

    Args:
        trigger_position: Of each joint, in rad; turns do not count.
        disturbance_position: Where it pulls each joint, in rad; None for hanging down.
        duration: How long it lasts, in s.
        tolerance: How near each joint must come, in rad.
        earliest: Before this time it does not begin, in s after the session's start.
    """

    trigger_position: Sequence[float]
    disturbance_position: Sequence[float] | None = None
    duration: float = 0.5
    tolerance: float = 0.1
    earliest: float = 0.0
    torque = None

    @property
    def position(self) -> Sequence[float]:
        """Where it pulls the joints, in rad."""
        return self.disturbance_position or (0.0, 0.0)

    def is_due(self, time: float, position: Sequence[float]) -> bool:
        """See ``Disturbance.is_due``."""
        near = _is_near(position, self.trigger_position, self.tolerance)
        return time >= self.earliest and near


def _is_near(position: Sequence[float], goal: Sequence[float], tolerance: float) -> bool:
    pairs = zip(position, goal, strict=False)
    return all(abs(math.remainder(q - aim, math.tau)) <= tolerance for q, aim in pairs)


PRESETS: Final[dict[str, tuple[Disturbance, ...]]] = {
    "default_simple_pendulum": (TimedTorqueDisturbance(5.0, 0.1, (0.05,)),)
}
"""The lab knows the name; the push of 0.05 N m for 0.1 s after 5 s is this package's own."""


def resolve(
    disturbances: str | Disturbance | Iterable[Disturbance] | None, joints: int
) -> tuple[Disturbance, ...]:
    """Look presets up, and check the number of joints.

    Args:
        disturbances: The name of a preset, one disturbance, several, or None.
        joints: The number of joints of the cell.

    Raises:
        ConfigError: If a preset is unknown or a list has not one entry for each joint.
    """
    if disturbances is None:
        return ()
    if isinstance(disturbances, str):
        if disturbances not in PRESETS:
            raise unknown_name("disturbance preset", disturbances, PRESETS)
        disturbances = PRESETS[disturbances]
    several = disturbances if isinstance(disturbances, Iterable) else (disturbances,)
    found = tuple(several)
    for disturbance in found:
        _check(disturbance, joints)
    return found


def _check(disturbance: Disturbance, joints: int) -> None:
    for name in ("torque", "disturbance_position", "trigger_position"):
        entries = getattr(disturbance, name, None)
        if entries is not None and len(entries) != joints:
            raise ConfigError(
                f"{type(disturbance).__name__}: {name} has {len(entries)} entries for "
                f"{joints} joints"
            )
