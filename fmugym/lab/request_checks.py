"""The arguments of the client's methods, checked."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from numbers import Real
from typing import Any

import numpy as np

from fmugym.checks import (
    check_flag,
    check_number,
    check_option,
    check_text,
    float_or_nan,
)
from fmugym.errors import shown
from fmugym.lab.data import CellType, LabError, as_lab_error
from fmugym.lab.disturbance import Disturbance, resolve
from fmugym.lab.experiments import EXPERIMENTS, PLANTS
from fmugym.signals import ordinary

__all__ = ["Request", "cell_types_of", "check_range", "entries_of", "gains_of", "text_of"]


@dataclass(frozen=True)
class Request:
    """The request to start an experiment or an episode.

    Attributes:
        experiment_type: One of ``EXPERIMENTS``.
        length: How long it may last, in s.
        preparation_time: How long the arm is held at its start position, in s.
        position: The angles to start from, in rad; None for hanging down.
        record: Whether to make a video.
        cell_id: Which cell; None for any.
        disturbances: The name of a preset, one disturbance, or several.

    Raises:
        LabError: If an argument has a wrong type. The lab itself checks the ranges.
    """

    experiment_type: str
    length: float
    preparation_time: float
    position: Any
    record: bool
    cell_id: int | None
    disturbances: str | Disturbance | Sequence[Disturbance] | None

    def __post_init__(self) -> None:
        with as_lab_error():
            kind = check_option("experiment type", self.experiment_type, EXPERIMENTS)
            object.__setattr__(self, "experiment_type", kind)
            object.__setattr__(self, "record", check_flag("record", self.record))
            if self.cell_id is not None:
                object.__setattr__(self, "cell_id", check_number("cell_id", self.cell_id))

    @property
    def cell_type(self) -> CellType:
        """The type of cell that the experiment needs."""
        return EXPERIMENTS[self.experiment_type].cell_type

    @property
    def joints(self) -> int:
        """The number of joints of such a cell."""
        return PLANTS[self.cell_type].joints

    @cached_property
    def angles(self) -> list[float]:
        """The angle of each joint to start from, in rad.

        Raises:
            LabError: If there is not exactly one finite number for each joint.
        """
        if self.position is None:
            return [0.0] * self.joints
        entries = entries_of(self.position, self.joints, "initial_position")
        return [0.0 if entry is None else entry for entry in entries]

    @cached_property
    def acting(self) -> tuple[Disturbance, ...]:
        """The disturbances.

        Raises:
            LabError: If a preset does not exist, or a disturbance does not fit the cell.
        """
        with as_lab_error():
            return resolve(self.disturbances, self.joints)


def text_of(kind: str, token: object) -> str:
    """Return a token as a text.

    Args:
        kind: What the token stands for, for the error.
        token: The token.

    Raises:
        LabError: If the token is not a text.
    """
    with as_lab_error():
        return check_text(f"{kind} token", token)


def cell_types_of(value: Any) -> list[CellType]:
    """Return a list of cell types.

    Raises:
        LabError: If the value is not a list of at least one cell type.
    """
    try:
        kinds = list(value) if 0 < len(value) <= 1000 else []
    except ordinary(Exception):
        kinds = []
    if not kinds or not all(isinstance(kind, CellType) for kind in kinds):
        raise LabError(f"a gym needs a list of cell types, not {shown(value)}")
    return kinds


def check_range(name: str, value: Any, highest: float, lowest: float | None = None) -> float:
    """Return a number that lies in a range.

    Args:
        name: What the number is, for the error.
        value: The number.
        highest: The highest value allowed.
        lowest: The lowest value allowed; None for every value above 0.

    Raises:
        LabError: If the value is not a number, or is out of the range.
    """
    if not isinstance(value, Real):
        raise LabError(f"{name} must be a number, not {shown(value)}")
    checked = float_or_nan(value)
    is_inside = checked > 0.0 if lowest is None else checked >= lowest
    if not (is_inside and checked <= highest and math.isfinite(checked)):
        wanted = (
            f"above 0 and up to {highest:g}" if lowest is None else f"{lowest:g} to {highest:g}"
        )
        raise LabError(f"{name} {shown(value)} is outside the limits: {wanted}")
    return checked


def entries_of(value: Any, joints: int, name: str) -> list[float | None]:
    """Return one entry for each joint.

    Args:
        value: A number, a list or an array; None entries stay.
        joints: The number of joints.
        name: What the value is, for the error.

    Raises:
        LabError: If there is not exactly one finite number or None for each joint.
    """
    if joints == 1 and type(value) is float and math.isfinite(value):
        return [value]
    try:
        entries = np.ravel(np.array(value, dtype=object)).tolist()
    except ordinary(Exception):  # objects may do anything when numpy looks at them
        raise LabError(f"{name} must be a number for each joint, not {shown(value)}") from None
    if len(entries) != joints:
        raise LabError(f"{name} has {len(entries)} entries, but the cell has {joints} joints")
    return [None if entry is None else _finite(entry, name) for entry in entries]


def gains_of(value: Any, joints: int, name: str) -> list[float | None]:
    """Return one stiffness or damping for each joint; see `entries_of`.

    Raises:
        LabError: As for `entries_of`, and if an entry is negative.
    """
    entries = entries_of(value, joints, name)
    for entry in entries:
        if entry is not None and entry < 0.0:
            raise LabError(f"{name} {entry:g} is outside the limits: it must not be negative")
    return entries


def _finite(entry: Any, name: str) -> float:
    with as_lab_error():
        return check_number(f"each entry of {name}", entry, may_be_boolean=True)
