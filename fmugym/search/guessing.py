"""Controllers that a task suggests without declaring them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, Final

import numpy as np
from gymnasium import spaces

from fmugym.baselines.arena import most_steps_of

__all__ = ["both_controllers", "guessed_controllers"]

_DECADES: Final = 100.0
"""Gains are tried from this part of the ratio of the ranges to this multiple of it."""


def guessed_controllers(document: Mapping[str, Any], env: Any) -> list[str]:
    """PI controllers for the differences in a task, each with both signs of the gain.

    Args:
        document: What the task declares.
        env: Its environment in the physical form, with one action that is a number.

    Returns:
        Texts for ``search_of``; none if no expression of the task, such as its reward, has a
        difference between something measured that the agent observes, and a set point that it
        observes, or a number.
    """
    space, seen, names = env.action_space, env.observation_space, env.observation_names
    if not isinstance(space, spaces.Box) or space.shape not in ((), (1,)) or names is None:
        return []
    widths = dict(zip(names, (seen.high - seen.low).tolist(), strict=True))
    reach = (space.high - space.low).item()
    longest = (most_steps_of(env) or 100) * env.config.time_step
    found: set[str] = set()
    for of, setpoint in _pairs(document, env):
        known = abs(setpoint) if isinstance(setpoint, float) else 0.0
        width = widths[of] if np.isfinite(widths[of]) else known or 1.0
        found |= {*both_controllers(of, setpoint, reach / width, (env.config.time_step, longest))}
    return sorted(found)


def both_controllers(
    of: str, setpoint: str | float, gain: float, times: tuple[float, float]
) -> tuple[str, str]:
    """PI controllers with ranges: one that raises the action to raise the value, and the reverse.

    Args:
        of: What is measured.
        setpoint: What it shall be.
        gain: A likely gain; smaller and larger ones are tried, too.
        times: The shortest and the longest integral time in s.
    """
    low, high = (f"{gain * factor:.3g}" for factor in (1 / _DECADES, _DECADES))
    rest = f"ti={times[0]:.6g}..{times[1]:.6g}"
    text = f"pid of={of} setpoint={setpoint} kp="
    return f"{text}{low}..{high} {rest}", f"{text}-{high}..-{low} {rest}"


def _pairs(document: Mapping[str, Any], env: Any) -> Iterator[tuple[Any, Any]]:
    """What is measured, and what it shall be: the two sides of a minus in an expression."""
    observed = {*env.observation_names}
    given = (document.get(section, {}) for section in ("setpoints", "data", "memory"))
    measured = observed.difference(*given)
    for expression in getattr(env, "expressions", ()):
        for sides in expression.differences():
            for of, setpoint in (sides, sides[::-1]):
                if of in measured and (isinstance(setpoint, float) or setpoint in observed):
                    yield of, setpoint
                    break
