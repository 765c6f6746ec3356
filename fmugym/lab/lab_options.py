"""Options of a simulated lab."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import Any, Final

from fmugym.checks import check_number
from fmugym.errors import ConfigError, shown

__all__ = ["Options"]

_SHARES: Final = ("early_sample_share", "stall_share")
_MAY_BE_INFINITE: Final = (
    *("heartbeat", "torque_limit", "velocity_limit", "position_limit", "hold_stiffness"),
)
_HIGHEST: Final = 1e6
_LARGEST_SPREAD: Final = 1000.0  # of a 99th percentile, in medians


@dataclass(frozen=True)
class Options:
    """Properties of the cells and of the way to them, as close to the real lab as is public.

    The values of a pair are for shoulder and elbow; a cell with one joint uses the first one.

    Each text ends with the source of the default. *Measured*: seen in public logs and recordings of
    the lab, all of the double pendulum. *Borrowed*: measured on the double pendulum, used for the
    single pendulum. *Documented*: stated by the lab. *Nominal*: plausible, without a source.

    Attributes:
        heartbeat: A session ends after this time without a request, in s; documented.
        session_grace: How much longer than its time a session lasts, in s. The grace lets a last
            request in that the network or a busy machine delays; nominal.
        homing_time: Time that a cell takes to reach its start position, in s; nominal.
        torque_limit: Largest torque of a drive, in N m, to which it limits its torque; measured.
        velocity_limit: Angular velocity at which a session ends, in rad/s; documented.
        position_limit: Angle from hanging at which a session ends, in rad; documented, 360 degrees.
        hold_stiffness: Stiffness of the controller that holds the start position, in N m/rad. It
            does not compensate gravity, so the arm sags. Infinity holds the exact position.
            Measured.
        drive_step: Time between two evaluations of the drive's control law, in s. The FMU does one
            step in this time. The real drive has 1/40000 s.
        coulomb_friction: Lowest and highest Coulomb friction of a single pendulum's joint, in N m.
            Each cell draws its own value. The double pendulum has the value of its fit. Borrowed
            from published fits.
        sample_period: Time between new samples, in s; 0 for a new sample every ``drive_step``.
            Measured.
        early_sample_share: Share of the samples that come after half of ``sample_period``;
            measured, 0.19 to 0.21.
        encoder_step: Resolution of the position, in rad; measured, 17 bit, elbow 14 bit.
        velocity_lag: Time constant of the velocity's filter, in s; measured, 3.5 to 4 ms.
        velocity_noise: Standard deviation, in rad/s; measured at rest.
        torque_noise: Standard deviation, in N m; measured at rest, 0.3 to 0.5 mN m.
        get_time: Median and 99th percentile of the time that a getter takes, in s; measured, 0.21
            to 0.25 and 0.5 to 1.3 ms.
        set_time: Median and 99th percentile of the time that other requests take, in s; measured,
            0.31 to 0.35 and 0.8 to 1.9 ms.
        stall_share: Share of requests that stall; measured, 0.6 % of loops of about three requests.
        shortest_stall: Shortest additional time of a stall, in s; measured.
        longest_stall: Longest additional time of a stall, in s; measured.

    Raises:
        ConfigError: If a value has a wrong type or is out of its range.
    """

    heartbeat: float = 2.0
    session_grace: float = 0.1
    homing_time: float = 1.0
    torque_limit: float = 0.15
    velocity_limit: float = 50.0
    position_limit: float = math.tau
    hold_stiffness: float = 0.43
    drive_step: float = 0.0005
    coulomb_friction: tuple[float, float] = (1.7e-3, 3.9e-3)
    sample_period: float = 0.002
    early_sample_share: float = 0.2
    encoder_step: tuple[float, float] = (math.tau / 2**17, math.tau / 2**14)
    velocity_lag: float = 0.00375
    velocity_noise: tuple[float, float] = (0.04, 0.3)
    torque_noise: float = 0.0004
    get_time: tuple[float, float] = (0.00023, 0.0009)
    set_time: tuple[float, float] = (0.00033, 0.00135)
    stall_share: float = 0.002
    shortest_stall: float = 0.01
    longest_stall: float = 0.049

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            value = _checked(field.name, getattr(self, field.name), field.default)
            object.__setattr__(self, field.name, value)
        stalls = (self.shortest_stall, self.longest_stall)
        _require_order("shortest_stall and longest_stall", stalls)
        for name in ("coulomb_friction", "get_time", "set_time"):
            _require_order(name, getattr(self, name))
        for name in ("get_time", "set_time"):
            median, p99 = getattr(self, name)
            if p99 > _LARGEST_SPREAD * median > 0.0:
                raise ConfigError(f"{name}: {p99:g} s is more than {_LARGEST_SPREAD:g} medians")


def _checked(name: str, value: Any, default: Any) -> Any:
    if isinstance(default, tuple):
        return _pair(name, value)
    if name == "drive_step":
        return check_number(name, value, 1e-5, 2e-3)
    if name in _MAY_BE_INFINITE:
        return check_number(name, value, 0.0, may_be_infinite=True)
    return check_number(name, value, 0.0, 1.0 if name in _SHARES else _HIGHEST)


def _pair(name: str, value: Any) -> tuple[float, float]:
    if not isinstance(value, tuple | list) or len(value) != 2:
        raise ConfigError(f"{name} must be a pair of numbers, not {shown(value)}")
    first, second = (check_number(name, entry, 0.0, _HIGHEST) for entry in value)
    return first, second


def _require_order(name: str, pair: tuple[float, float]) -> None:
    if pair[0] > pair[1]:
        raise ConfigError(f"{name}: {pair[0]:g} must not be greater than {pair[1]:g}")
