"""What programs ask of the lab, checked."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from fmugym.errors import ConfigError, unknown_name
from fmugym.lab.data import CellType
from fmugym.lab.disturbance import Disturbance, resolve
from fmugym.lab.errors import LabError
from fmugym.lab.experiments import EXPERIMENTS, PLANTS

__all__ = ["Request", "check_range", "entries_of", "gains_of"]


@dataclass(frozen=True)
class Request:
    """What a program asks for when it starts an experiment or an episode.

    Attributes:
        experiment_type: One of ``EXPERIMENTS``.
        length: How long it may last, in s.
        preparation_time: How long the arm is held at its start position, in s.
        position: The angles to start from, in rad; None for hanging down.
        record: Whether to make a video.
        cell_id: Which cell; None for any.
        disturbances: The name of a preset, one, or several.
    """

    experiment_type: str
    length: float
    preparation_time: float = 0.0
    position: Any = None
    record: bool = False
    cell_id: int | None = None
    disturbances: str | Disturbance | Sequence[Disturbance] | None = None

    def __post_init__(self) -> None:
        if self.experiment_type not in EXPERIMENTS:
            error = unknown_name("experiment type", self.experiment_type, EXPERIMENTS)
            raise LabError(str(error))

    @property
    def cell_type(self) -> CellType:
        """The kind of cell that is needed."""
        return EXPERIMENTS[self.experiment_type].cell_type

    @property
    def joints(self) -> int:
        """The number of joints of such a cell."""
        return PLANTS[self.cell_type].joints

    def angles(self) -> list[float]:
        """Return the angle of each joint to start from, in rad.

        Raises:
            LabError: If there are more or fewer, or one is not a finite number.
        """
        if self.position is None:
            return [0.0] * self.joints
        entries = entries_of(self.position, self.joints, "initial_position")
        return [0.0 if entry is None else entry for entry in entries]

    def acting(self) -> tuple[Disturbance, ...]:
        """Return the disturbances.

        Raises:
            LabError: If a preset is unknown or has not one entry for each joint.
        """
        try:
            return resolve(self.disturbances, self.joints)
        except ConfigError as error:
            raise LabError(str(error)) from None


def check_range(name: str, value: float, highest: float, lowest: float | None = None) -> None:
    """Refuse what is not in a range.

    Args:
        name: What it is, for the error.
        value: The value.
        highest: The highest that is allowed.
        lowest: The lowest; None for anything above 0.

    Raises:
        LabError: If it is not.
    """
    if lowest is None and not 0.0 < value <= highest:
        raise LabError(f"{name} {value!r} is outside the limits: more than 0, at most {highest:g}")
    if lowest is not None and not lowest <= value <= highest:
        raise LabError(f"{name} {value!r} is outside the limits of {lowest:g} to {highest:g}")


def entries_of(value: Any, joints: int, name: str) -> list[float | None]:
    """Return one entry for each joint.

    Args:
        value: A number, a list or an array; None entries are kept.
        joints: How many there must be.
        name: What it is, for the error.

    Raises:
        LabError: If there are more or fewer, or one is not a finite number.
    """
    if joints == 1 and type(value) is float and math.isfinite(value):
        return [value]
    entries = np.ravel(np.array(value, dtype=object)).tolist()
    if len(entries) != joints:
        raise LabError(f"{name} has {len(entries)} entries, the cell has {joints} joints")
    try:
        numbers = [None if entry is None else float(entry) for entry in entries]
    except (TypeError, ValueError):
        raise LabError(f"{name} must be a number for each joint, not {value!r}") from None
    if not all(x is None or math.isfinite(x) for x in numbers):
        raise LabError(f"{name} must be finite, not {value!r}")
    return numbers


def gains_of(value: Any, joints: int, name: str) -> list[float | None]:
    """Return one stiffness or damping for each joint; see `entries_of`.

    Raises:
        LabError: As there, and if one is negative.
    """
    entries = entries_of(value, joints, name)
    for entry in entries:
        if entry is not None and entry < 0.0:
            raise LabError(f"{name} {entry:g} is outside the limits: it must not be negative")
    return entries
