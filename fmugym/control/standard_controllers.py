"""Standard controllers: feedback, which reads the observation, and feedforward, which does not."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from functools import reduce
from operator import add
from typing import Any, Final

import numpy as np

from fmugym.checks import check_mapping, check_number, check_seed
from fmugym.control.controller import (
    Controller,
    Decided,
    Law,
    NumberOrArray,
    SignalReference,
    checked_numbers,
    either,
    limited,
)
from fmugym.control.linearization import LinearModel
from fmugym.control.linearization.linear_trajectory import discrete
from fmugym.errors import ConfigError, shown
from fmugym.expressions.graph import Value
from fmugym.extras import imported
from fmugym.pool.pool import FloatArray

__all__ = ["LQR", "PID", "Constant", "Hysteresis", "Random", "Schedule"]

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


class Hysteresis(Law):
    """Switches between two actions, as a thermostat does.

    Each number may be an array of shape (N,), with one for each environment.

    Args:
        of: The name of what is measured.
        setpoint: Set point: a name or a constant.
        band: The controller switches where the measured value leaves the set point by this much.
        below: The action below the band; it holds until the value is above the band.
        above: The action above the band.
    """

    signals = ("of", "setpoint")

    def __init__(
        self,
        of: str,
        setpoint: SignalReference,
        band: NumberOrArray,
        below: NumberOrArray = 1.0,
        above: NumberOrArray = 0.0,
    ) -> None:
        self.of, self.setpoint = of, setpoint
        self.band = checked_numbers("band", band, minimum=0.0)
        self.below, self.above = checked_numbers("below", below), checked_numbers("above", above)
        self.starts = (self.above,)

    def _prepare(self) -> None:
        self._limits()
        for name in ("band", "below", "above"):
            self._check_size(name, getattr(self, name))
        super()._prepare()

    def law(
        self, seen: Sequence[Any], state: Sequence[Any], holds: Any = False, added: Any = None
    ) -> Decided:
        """See ``Law.law``; the controller remembers its action."""
        error = self._value(seen, self.of) - self._value(seen, self.setpoint)
        kept = either(error > self.band, self.above, state[0])
        action = either(error < -self.band, self.below, kept)
        return [action], (action,)


class PID(Law):
    """A PID controller on one value, with limits and anti-windup.

    With the error e = setpoint - measured value y, the action is

        offset + kp (e + 1/ti * integral of e - td * dy/dt)

    It is limited to the action space. While it is at a limit, the integral does not grow further,
    so that it does not wind up. The derivative is that of the measured value, so that a step of the
    set point does not kick. (K. J. Åström and T. Hägglund, Advanced PID Control, 2006, chapter 3.)

    Each number may be an array of shape (N,), with one for each environment.

    Args:
        of: The name of what is measured.
        setpoint: Set point: a name or a constant.
        kp: The gain, in units of the action per unit of the measured value. A negative gain is for
            actions that lower the value.
        ti: The integral time in s; without one there is no integral part.
        td: The derivative time in s.
        offset: The action where the error is zero.
    """

    signals = ("of", "setpoint")

    def __init__(
        self,
        of: str,
        setpoint: SignalReference,
        kp: NumberOrArray,
        ti: NumberOrArray | None = None,
        td: NumberOrArray = 0.0,
        offset: NumberOrArray = 0.0,
    ) -> None:
        self.of, self.setpoint = of, setpoint
        self.kp = checked_numbers("kp", kp)
        self.ti = None if ti is None else checked_numbers("ti", ti, minimum=0.0, positive=True)
        self.td = checked_numbers("td", td, minimum=0.0)
        self.offset = checked_numbers("offset", offset)
        self.starts = (0.0, np.nan)

    def _prepare(self) -> None:
        self._low, self._high = self._limits()
        for name in ("kp", "ti", "td", "offset"):
            self._check_size(name, getattr(self, name))
        super()._prepare()

    @property
    def integrates(self) -> bool:
        """See ``Law.integrates``."""
        return self.ti is not None

    def law(
        self, seen: Sequence[Any], state: Sequence[Any], holds: Any = False, added: Any = None
    ) -> Decided:
        """See ``Law.law``; the controller remembers the integral and the last value."""
        value, rest, growth = self._parts(seen, state)
        if growth is None:
            return [rest], (state[0], value)
        wanted = rest + state[0] + growth
        inside = limited(wanted, self._low, self._high)
        beyond = wanted - inside
        if added is not None:
            total = inside + added[0]
            beyond = beyond + (total - limited(total, self._low, self._high))
        stays = beyond * growth > 0
        stays = stays if holds is False else stays | holds
        integral = either(stays, state[0], state[0] + growth)
        return [rest + integral], (integral, value)

    def wanted(self, seen: Sequence[Any], state: Sequence[Any]) -> Any:
        """See ``Law.wanted``."""
        _, rest, growth = self._parts(seen, state)
        return rest if growth is None else rest + state[0] + growth

    def _parts(self, seen: Sequence[Any], state: Sequence[Any]) -> tuple[Any, Any, Any]:
        """Measured value, action without the integral, and growth of the integral."""
        last, value = state[1], self._value(seen, self.of)
        error = self._value(seen, self.setpoint) - value
        change = either(last != last, 0.0, value - last)  # it is NaN in the first step
        rest = self.offset + self.kp * (error - self.td * change / self.time_step)
        return value, rest, None if self.ti is None else self.kp * error * self.time_step / self.ti


class LQR(Controller):
    """A linear-quadratic regulator for a linear model: u = u0 - K (x - x0).

    K minimizes the sum over the steps of (x - x0)' Q (x - x0) + (u - u0)' R (u - u0), for the model
    with inputs that are constant within a step. It comes from the discrete algebraic Riccati
    equation. Needs SciPy (the extra ``identification``).

    Args:
        model: The linear model, from ``fmugym.control.linearization.linearize`` at an equilibrium.
        q: The weights of the states: one each, or the matrix Q of shape (n, n).
        r: The weights of the inputs: one each, or the matrix R of shape (m, m).
        of: The names of the states in the observation; by default those of the model.

    Attributes:
        gain: The matrix K of shape (m, n), once the controller is bound.
    """

    def __init__(self, model: LinearModel, q: Any, r: Any, of: Sequence[str] | None = None) -> None:
        self.model = model
        self.of = tuple(model.states if of is None else of)
        if len(self.of) != len(model.states):
            raise ConfigError(
                f"the model has {len(model.states)} states, but of names {len(self.of)}"
            )
        self._q = _weights("q", q, len(model.states))
        self._r = _weights("r", r, len(model.inputs))

    def _prepare(self) -> None:
        for name in self.of:
            self._check_name("of", name)
        slopes = np.concatenate([self.model.A, self.model.B], axis=1)
        (a,), (b,) = discrete(slopes[np.newaxis], self.time_step)
        linalg = imported("scipy.linalg", "identification")
        try:
            cost = linalg.solve_discrete_are(a, b, self._q, self._r)
            self.gain = np.linalg.solve(self._r + b.T @ cost @ b, b.T @ cost @ a)
        except (ValueError, np.linalg.LinAlgError) as error:
            raise ConfigError(f"no regulator stabilizes this model: {error}") from None
        if np.abs(np.linalg.eigvals(a - b @ self.gain)).max() >= 1:
            raise ConfigError("no regulator stabilizes this model; do its inputs move its states?")
        self._places = [self._place_of(name) for name in self.of]

    def decision(
        self,
        observation: Sequence[Value],
        memory: Sequence[Value] = (),
        added: Sequence[Value] | None = None,
    ) -> tuple[Sequence[Value], Sequence[Value]]:
        """See ``Controller.decision``."""
        pairs = zip(self._places, self.model.x0, strict=True)
        deviation = [observation[place] - start for place, start in pairs]
        products = [[k * one for k, one in zip(row, deviation, strict=True)] for row in self.gain]
        pairs = zip(self.model.u0, products, strict=True)
        return [start - reduce(add, parts) for start, parts in pairs], []

    def _decide(self, rows: FloatArray) -> FloatArray:
        deviation = rows[:, self._places] - self.model.x0
        decided: FloatArray = self.model.u0 - deviation @ self.gain.T
        return decided


def _weights(what: str, value: Any, size: int) -> FloatArray:
    matrix = np.asarray(value, dtype=np.float64)
    matrix = np.diag(matrix) if matrix.ndim == 1 else matrix
    if matrix.shape != (size, size):
        raise ConfigError(f"{what} must have {size} weights or shape ({size}, {size})")
    return matrix
