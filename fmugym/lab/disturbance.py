"""Disturbances that an experiment requests for its own cell.

The real lab has the same class names, and the timed disturbances have the lab's arguments. The
arguments of the state-dependent disturbances are not public, so this package defines its own. The
effect of a position disturbance is not public either: here the drive pulls the joints to a position
for a while and ignores the program's commands.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields
from typing import Any, Final, Protocol

from fmugym.checks import check_number, check_option
from fmugym.errors import ConfigError, shown
from fmugym.lab.drive import HOLD_DAMPING
from fmugym.signals import ordinary

__all__ = [
    "PRESETS",
    "Acting",
    "Disturbance",
    "StateDependentPositionDisturbance",
    "StateDependentTorqueDisturbance",
    "TimedPositionDisturbance",
    "TimedTorqueDisturbance",
    "resolve",
]

_VECTORS: Final = ("torque", "disturbance_position", "trigger_position")
_LARGEST: Final = 1e6
_MOST: Final = 1000  # disturbances of a session


class Disturbance(Protocol):
    """The interface of all disturbances. Each acts at most once in a session."""

    @property
    def duration(self) -> float:
        """How long it acts, in s."""
        ...

    @property
    def torque(self) -> Sequence[float] | None:
        """The torque that it adds to each joint, in N m; None if it pulls to a position."""
        ...

    @property
    def position(self) -> Sequence[float] | None:
        """The position to which it pulls the joints, in rad; None for hanging down or a torque."""
        ...

    def is_due(self, time: float, position: Sequence[float]) -> bool:
        """Whether the disturbance begins now.

        Args:
            time: Time of the session, in s.
            position: Angles of the joints, in rad.
        """
        ...


class _Checked:
    """What the disturbances of this module share: they check their arguments."""

    def __post_init__(self) -> None:
        """Check the arguments, and keep lists as tuples."""
        for field in fields(self):  # type: ignore[arg-type]  # the classes below are dataclasses
            value = getattr(self, field.name)
            if value is not None or field.default is not None:
                value = _checked(f"{type(self).__name__}: {field.name}", field.name, value)
            object.__setattr__(self, field.name, value)


class _Pull(_Checked):
    """What the disturbances share that pull the joints to a position."""

    disturbance_position: Sequence[float] | None
    torque = None

    @property
    def position(self) -> Sequence[float] | None:
        """The position to which it pulls the joints, in rad; None for hanging down."""
        return self.disturbance_position


class _Near:
    """What the disturbances share that begin when the joints first come near a position."""

    trigger_position: Sequence[float]
    tolerance: float
    earliest: float

    def is_due(self, time: float, position: Sequence[float]) -> bool:
        """See ``Disturbance.is_due``."""
        pairs = zip(position, self.trigger_position, strict=False)
        is_near = all(abs(math.remainder(q - aim, math.tau)) <= self.tolerance for q, aim in pairs)
        return time >= self.earliest and is_near


@dataclass(frozen=True)
class TimedTorqueDisturbance(_Checked):
    """An external torque at a fixed time.

    Args:
        start_time: When it begins, in s after the start of the session.
        duration: How long it lasts, in s.
        torque: The torque on each joint, in N m.

    Raises:
        ConfigError: If an argument is not a number, or not finite.
    """

    start_time: float
    duration: float
    torque: Sequence[float]
    position = None

    def is_due(self, time: float, position: Sequence[float]) -> bool:
        """See ``Disturbance.is_due``."""
        return time >= self.start_time


@dataclass(frozen=True)
class TimedPositionDisturbance(_Pull):
    """A pull to a position at a fixed time.

    Args:
        trigger_time: When it begins, in s after the start of the session.
        disturbance_position: The target of each joint, in rad; None for hanging down.
        duration: How long it lasts, in s. The real lab has no such argument.

    Raises:
        ConfigError: If an argument is not a number, or not finite.
    """

    trigger_time: float
    disturbance_position: Sequence[float] | None = None
    duration: float = 0.5

    def is_due(self, time: float, position: Sequence[float]) -> bool:
        """See ``Disturbance.is_due``."""
        return time >= self.trigger_time


@dataclass(frozen=True)
class StateDependentTorqueDisturbance(_Near, _Checked):
    """An external torque that begins when the joints first come near a position.

    Args:
        trigger_position: Angle of each joint, in rad; full turns do not matter.
        duration: How long it lasts, in s.
        torque: The torque on each joint, in N m.
        tolerance: Largest distance of each joint from its angle, in rad.
        earliest: It does not begin before this time, in s after the start of the session.

    Raises:
        ConfigError: If an argument is not a number, or not finite.
    """

    trigger_position: Sequence[float]
    duration: float
    torque: Sequence[float]
    tolerance: float = 0.1
    earliest: float = 0.0
    position = None


@dataclass(frozen=True)
class StateDependentPositionDisturbance(_Near, _Pull):
    """A pull to a position that begins when the joints first come near another position.

    Args:
        trigger_position: Angle of each joint, in rad; full turns do not matter.
        disturbance_position: The target of each joint, in rad; None for hanging down.
        duration: How long it lasts, in s.
        tolerance: Largest distance of each joint from its angle, in rad.
        earliest: It does not begin before this time, in s after the start of the session.

    Raises:
        ConfigError: If an argument is not a number, or not finite.
    """

    trigger_position: Sequence[float]
    disturbance_position: Sequence[float] | None = None
    duration: float = 0.5
    tolerance: float = 0.1
    earliest: float = 0.0


def _checked(what: str, name: str, value: Any) -> float | tuple[float, ...]:
    if name in _VECTORS:
        return _vector(what, value)
    low = 0.0 if name in ("duration", "tolerance") else -_LARGEST
    return check_number(what, value, low, _LARGEST)


def _vector(what: str, entries: Any) -> tuple[float, ...]:
    try:
        if isinstance(entries, str | bytes) or len(entries) > _MOST:
            raise TypeError
        values = tuple(entries)
    except ordinary(Exception):
        raise ConfigError(f"{what} must be a list of numbers, not {shown(entries)}") from None
    return tuple(check_number(what, entry, -_LARGEST, _LARGEST) for entry in values)


PRESETS: Final[dict[str, tuple[Disturbance, ...]]] = {
    "default_simple_pendulum": (TimedTorqueDisturbance(5.0, 0.1, (0.05,)),)
}
"""The name is the lab's. The push of 0.05 N m for 0.1 s after 5 s is this package's choice."""


def resolve(
    disturbances: str | Disturbance | Iterable[Disturbance] | None, joints: int
) -> tuple[Disturbance, ...]:
    """Look up presets, and check the disturbances.

    Args:
        disturbances: The name of a preset, one disturbance, several, or None.
        joints: The number of joints of the cell.

    Raises:
        ConfigError: If a preset does not exist, if something is not a disturbance, or if a list
            does not have one finite number for each joint.
    """
    if disturbances is None:
        return ()
    if isinstance(disturbances, str):
        disturbances = PRESETS[check_option("disturbance preset", disturbances, PRESETS)]
    try:
        found = _several(disturbances)
        for disturbance in found:
            _check(disturbance, joints)
    except ConfigError:
        raise
    except ordinary(Exception) as error:  # objects may do anything when they are looked at
        raise ConfigError(
            f"disturbances must be a preset, a disturbance or a list: {shown(disturbances)} "
            f"({type(error).__name__})"
        ) from None
    return found


def _several(disturbances: Any) -> tuple[Any, ...]:
    if callable(getattr(disturbances, "is_due", None)):
        return (disturbances,)
    if len(disturbances) > _MOST:
        raise ValueError("too many")
    return tuple(disturbances)


def _check(disturbance: Any, joints: int) -> None:
    name = type(disturbance).__name__
    if not callable(getattr(disturbance, "is_due", None)):
        raise ConfigError(f"{shown(disturbance)} is not a disturbance: it has no method is_due")
    missing = [a for a in ("duration", "torque", "position") if not hasattr(disturbance, a)]
    if missing:
        raise ConfigError(f"{name} is not a disturbance: it has no {missing[0]}")
    check_number(f"{name}: duration", disturbance.duration, 0.0, _LARGEST)
    for attribute in _VECTORS:
        entries = getattr(disturbance, attribute, None)
        if entries is not None and len(_vector(f"{name}: {attribute}", entries)) != joints:
            raise ConfigError(f"{name}: {attribute} has {len(entries)} entries for {joints} joints")
    if disturbance.torque is None and disturbance.position is not None:
        _vector(f"{name}: position", disturbance.position)


_PULL_STIFFNESS: Final = 0.43  # N m/rad, as of the controller that holds the start position


class Acting:
    """Applies one disturbance.

    Args:
        disturbance: The disturbance.
    """

    def __init__(self, disturbance: Disturbance) -> None:
        self._disturbance = disturbance
        self._began: float | None = None

    def apply(
        self,
        time: float,
        position: Sequence[float],
        velocity: Sequence[float],
        torque: Sequence[float],
    ) -> list[float]:
        """Add the disturbance to the torques, or replace them while it pulls to a position.

        Args:
            time: Time of the session, in s.
            position: Angles of the joints, in rad.
            velocity: Angular velocities of the joints, in rad/s.
            torque: Torques on the joints, in N m.

        Returns:
            Torques on the joints, in N m.
        """
        disturbance = self._disturbance
        if self._began is None and disturbance.is_due(time, position):
            self._began = time
        if self._began is None or time - self._began >= disturbance.duration:
            return list(torque)
        if disturbance.torque is not None:
            return [own + other for own, other in zip(torque, disturbance.torque, strict=True)]
        targets = disturbance.position or [0.0] * len(position)
        return [
            _PULL_STIFFNESS * (target - q) - HOLD_DAMPING * v
            for target, q, v in zip(targets, position, velocity, strict=False)
        ]
