"""The options of a lab, and the two sets of them that have names."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import Any, Final

from fmugym.errors import ConfigError, unknown_name

__all__ = ["HARDWARE", "IDEAL", "PRESETS", "Options", "make_options"]


@dataclass(frozen=True)
class Options:
    """What a lab simulates; the defaults are those of the preset ``ideal``.

    Pairs are for shoulder and elbow; a cell with one joint takes the first. ``docs/lab.md`` names
    the source of each value.

    Attributes:
        heartbeat: A session ends after this time without any request, in s.
        session_grace: How much longer than its time a session lasts, in s: a last request that the
            network or a busy machine delays shall not come too late.
        homing_time: How long a cell takes to get to its start position, in s.
        starts_per_window: How many experiments, gyms and episodes a user may start within
            ``start_window``; None for any number.
        start_window: See there, in s.
        torque_limit: Largest torque of a drive, in N m.
        velocity_limit: Angular velocity at which a session ends, in rad/s.
        position_limit: Angle from hanging at which a session ends, in rad.
        saturate_torque: Whether a drive that is to give more than ``torque_limit`` gives that much;
            otherwise it gives up to ``peak_torque`` and the session ends.
        peak_torque: Largest torque of the motor, in N m.
        clamp_setters: Whether the client clamps what is set to the limits; otherwise it refuses.
        hold_stiffness: Of the controller that holds the start position, in N m/rad; it knows
            nothing of gravity, so the arm sags. Infinity for none of it.
        drive_step: Time from one evaluation of the drive's control law to the next, in s; the FMU
            does one step in between.
        coulomb_friction: Lowest and highest Coulomb friction of a single pendulum's joint, in N m;
            each cell draws its own. The double pendulum has what its own fit says.
        sample_period: Time between new samples, in s; 0 for a new one with each ``drive_step``.
        early_sample_share: How many of the samples come after half of ``sample_period``.
        encoder_step: Resolution of the position, in rad.
        velocity_lag: Time constant of the velocity's filter, in s.
        velocity_noise: Standard deviation, in rad/s.
        torque_noise: Standard deviation, in N m.
        get_time: Median and 99th percentile of the time a getter takes, in s.
        set_time: The same of all other requests, in s.
        stall_share: How many requests take much longer, evenly up to ``longest_stall``.
        shortest_stall: What a stall adds at the least, in s.
        longest_stall: What it adds at the most, in s.
    """

    heartbeat: float = 2.0
    session_grace: float = 0.1
    homing_time: float = 0.0
    starts_per_window: int | None = None
    start_window: float = 10.0
    torque_limit: float = 0.15
    velocity_limit: float = 50.0
    position_limit: float = math.tau
    saturate_torque: bool = True
    peak_torque: float = 0.45
    clamp_setters: bool = True
    hold_stiffness: float = math.inf
    drive_step: float = 0.0005
    coulomb_friction: tuple[float, float] = (0.0, 0.0)
    sample_period: float = 0.0
    early_sample_share: float = 0.0
    encoder_step: tuple[float, float] = (0.0, 0.0)
    velocity_lag: float = 0.0
    velocity_noise: tuple[float, float] = (0.0, 0.0)
    torque_noise: float = 0.0
    get_time: tuple[float, float] = (0.0, 0.0)
    set_time: tuple[float, float] = (0.0, 0.0)
    stall_share: float = 0.0
    shortest_stall: float = 0.01
    longest_stall: float = 0.049

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            entries = value if isinstance(value, tuple) else (value,)
            if any(entry is not None and not entry >= 0 for entry in entries):
                raise ConfigError(f"{field.name} must not be negative, is {value!r}")
        if not 1e-5 <= self.drive_step <= 2e-3:
            raise ConfigError(f"drive_step must be 0.01 to 2 ms, is {self.drive_step!r} s")


IDEAL: Final = Options()
"""The lab's rules and limits, around cells without friction, noise and delay of their own."""

HARDWARE: Final = Options(
    homing_time=1.0,
    starts_per_window=30,
    hold_stiffness=0.43,
    coulomb_friction=(1.7e-3, 3.9e-3),
    sample_period=0.002,
    early_sample_share=0.2,
    encoder_step=(math.tau / 2**17, math.tau / 2**14),
    velocity_lag=0.00375,
    velocity_noise=(0.04, 0.3),
    torque_noise=0.0004,
    get_time=(0.00023, 0.0009),
    set_time=(0.00033, 0.00135),
    stall_share=0.002,
)
"""As near to the real cells as public measurements tell."""

PRESETS: Final = {"ideal": IDEAL, "hardware": HARDWARE}


def make_options(preset: str | Options, **changes: Any) -> Options:
    """Take a preset and change some of its options.

    Args:
        preset: One of ``PRESETS``, or options of one's own.
        changes: New values by name.

    Raises:
        ConfigError: If there is no such preset or option, or a value is out of its range.
    """
    if isinstance(preset, str):
        if preset not in PRESETS:
            raise unknown_name("preset", preset, PRESETS)
        preset = PRESETS[preset]
    known = [field.name for field in dataclasses.fields(Options)]
    for name in changes:
        if name not in known:
            raise unknown_name("option of the lab", name, known)
    return dataclasses.replace(preset, **changes)
