"""Controllers that do not look at the observation."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from fmugym.baselines.controller import Controller, FloatArray
from fmugym.checks import check_mapping, check_number, check_seed
from fmugym.errors import ConfigError, shown

__all__ = ["Constant", "Random", "Schedule"]

_DAY: Final = 86400.0


class Constant(Controller):
    """Gives the same action in every step.

    Args:
        action: One action; its shape is that of the action space.
    """

    def __init__(self, action: Any) -> None:
        self.action = action

    def _prepare(self) -> None:
        try:
            taken = self._as_actions(self._decide(np.empty((1, 0))))[0]
            is_element = np.allclose(taken, self.action)  # but for its rounding to float32
        except (TypeError, ValueError):  # of another shape, or no numbers
            is_element = False
        if not is_element:
            raise ConfigError(f"the action {shown(self.action)} is not in {shown(self.space)}")

    def _decide(self, rows: FloatArray) -> FloatArray:
        return np.stack([np.asarray(self.action, dtype=np.float64)] * len(rows))


class Random(Controller):
    """Samples the action space.

    Args:
        seed: Of the samples; the same seed gives the same actions after each ``bind``.
    """

    is_physical = False

    def __init__(self, seed: int = 0) -> None:
        self.seed = check_seed(seed)

    def _prepare(self) -> None:
        self.space.seed(self.seed)

    def _decide(self, rows: FloatArray) -> FloatArray:
        samples = [self.space.sample() for _ in rows]
        return np.asarray(samples, dtype=np.float64)


class Schedule(Controller):
    """Gives actions by the time of day, counted from the beginning of the episode.

    Args:
        actions: The action from each time on, such as ``{"06:00": 1.0, "22:00": 0.0}``. Before the
            first time, the last one of the day before holds.
        start: The time of day at which an episode begins.
    """

    def __init__(self, actions: Mapping[str, float], start: str = "00:00") -> None:
        times = {
            _seconds(time): check_number(f"the action at {time}", action, may_be_boolean=True)
            for time, action in check_mapping("actions", actions).items()
        }
        if not times:
            raise ConfigError("a schedule needs at least one time")
        self._times = np.array(sorted(times))
        self._actions = np.array([times[time] for time in self._times])
        self._start = _seconds(start)

    @property
    def values(self) -> list[float]:
        """The actions, in the order of their times."""
        return [float(action) for action in self._actions]

    def _prepare(self) -> None:
        self._limits()
        self._steps = np.zeros(self.count)

    def _forget(self, mask: npt.NDArray[np.bool_]) -> None:
        self._steps = np.where(mask, 0.0, self._steps)

    def _decide(self, rows: FloatArray) -> FloatArray:
        time = self._start + self._steps * self.time_step
        self._steps = self._steps + 1
        return self.at(time)

    def at(self, time: FloatArray) -> FloatArray:
        """The actions at some times.

        Args:
            time: In seconds since any midnight.
        """
        places = np.searchsorted(self._times, time % _DAY, side="right") - 1
        found: FloatArray = np.take(self._actions, places % len(self._actions))
        return found


def _seconds(time: Any) -> float:
    """The seconds since midnight of a time such as "06:30"."""
    match = re.fullmatch(r"(\d\d?):(\d\d)(?::(\d\d))?", str(time))
    hours, minutes, seconds = (int(part or 0) for part in match.groups()) if match else (99, 0, 0)
    if hours > 23 or minutes > 59 or seconds > 59:
        raise ConfigError(f'expected a time of day such as "06:30", got {shown(time)}')
    return 3600.0 * hours + 60.0 * minutes + seconds
