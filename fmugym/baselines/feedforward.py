"""Feedforward controllers, which do not read the observation."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np

from fmugym.baselines.controller import Controller, either
from fmugym.baselines.law import Decided, Law
from fmugym.checks import check_mapping, check_number, check_seed
from fmugym.errors import ConfigError, shown
from fmugym.pool.base import FloatArray

__all__ = ["Constant", "Random", "Schedule"]

_DAY: Final = 86400.0


class Constant(Law):
    """Gives the same action in every step.

    Args:
        action: One action; its shape is that of the action space.
    """

    def __init__(self, action: Any) -> None:
        self.action = action

    def _prepare(self) -> None:
        super()._prepare()
        try:
            taken = self._as_actions(self._decide(np.empty((1, 0))))[0]
            is_element = np.allclose(taken, self.action)  # but for its rounding to float32
        except (TypeError, ValueError):  # of another shape, or no numbers
            is_element = False
        if not is_element:
            raise ConfigError(f"the action {shown(self.action)} is not in {shown(self.space)}")

    def law(
        self, seen: Sequence[Any], state: Sequence[Any], holds: Any = False, added: Any = None
    ) -> Decided:
        """See ``Law.law``."""
        return np.ravel(self.action).astype(np.float64).tolist(), ()


class Random(Controller):
    """Samples the action space.

    Args:
        seed: Seed of the samples; the same seed gives the same actions after each ``bind``.
    """

    is_physical = False

    def __init__(self, seed: int = 0) -> None:
        self.seed = check_seed(seed)

    def _prepare(self) -> None:
        self.space.seed(self.seed)

    def _decide(self, rows: FloatArray) -> FloatArray:
        samples = [self.space.sample() for _ in rows]
        return np.asarray(samples, dtype=np.float64)


class Schedule(Law):
    """Gives actions by the time of day, counted from the beginning of the episode.

    Args:
        actions: The action from each time on, such as ``{"06:00": 1.0, "22:00": 0.0}``. Before the
            first time, the last one of the day before holds.
        start: The time of day at which an episode begins.

    Attributes:
        clock: Name of the time in seconds since any midnight; None to count it from ``start``.
    """

    signals = ("clock",)
    starts = (0.0,)
    clock: str | None = None

    def __init__(self, actions: Mapping[str, float], start: str = "00:00") -> None:
        times = {
            _seconds(time): check_number(f"the action at {time}", action, may_be_boolean=True)
            for time, action in check_mapping("actions", actions).items()
        }
        if not times:
            raise ConfigError("a schedule needs at least one time")
        self._actions = dict(sorted(times.items()))
        self._start = _seconds(start)

    @property
    def values(self) -> list[float]:
        """The actions, in the order of their times."""
        return [*self._actions.values()]

    def _prepare(self) -> None:
        self._limits()
        super()._prepare()

    def law(
        self, seen: Sequence[Any], state: Sequence[Any], holds: Any = False, added: Any = None
    ) -> Decided:
        """See ``Law.law``; the controller remembers the number of steps."""
        (steps,) = state
        counted = self._start + steps * self.time_step
        time = counted if self.clock is None else self._value(seen, self.clock)
        return [self._at(time)], (steps + 1.0,)

    def _at(self, time: Any) -> Any:
        """The action at a time in seconds since any midnight."""
        action, now = self.values[-1], time % _DAY
        for begin, value in self._actions.items():
            action = either(now >= begin, value, action)
        return action


def _seconds(time: Any) -> float:
    """The seconds since midnight of a time such as "06:30"."""
    match = re.fullmatch(r"(\d\d?):(\d\d)(?::(\d\d))?", str(time))
    hours, minutes, seconds = (int(part or 0) for part in match.groups()) if match else (99, 0, 0)
    if hours > 23 or minutes > 59 or seconds > 59:
        raise ConfigError(f'expected a time of day such as "06:30", got {shown(time)}')
    return 3600.0 * hours + 60.0 * minutes + seconds
