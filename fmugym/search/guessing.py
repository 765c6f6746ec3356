"""Controllers that a task suggests without declaring them."""

from __future__ import annotations

import ast
from collections.abc import Iterator, Mapping
from typing import Any, Final

import numpy as np
from gymnasium import spaces

__all__ = ["guessed_controller", "guessed_controllers"]

_DECADES: Final = 100.0
"""Gains are tried from this part of the ratio of the ranges to this multiple of it."""

_NOT_MEASURED: Final = ("setpoints", "data", "memory")


def guessed_controllers(document: Mapping[str, Any], env: Any) -> list[str]:
    """PI controllers for the differences in the reward, each with both signs of the gain.

    Args:
        document: What the task declares.
        env: Its environment in the physical form, with one action that is a number.

    Returns:
        Texts for ``search_of``; none if the reward has no difference between something measured
        that the agent observes, and a set point that it observes, or a number.
    """
    space: Any = env.action_space
    names = env.observation_names
    if not isinstance(space, spaces.Box) or space.shape not in ((), (1,)) or names is None:
        return []
    low, high = env.observation_space.low, env.observation_space.high
    widths = dict(zip(names, (high - low).tolist(), strict=True))
    points = {name for section in _NOT_MEASURED for name in document.get(section, {})}
    reach = float(np.ptp([space.low, space.high]))
    longest = (env.config.max_episode_steps or 100) * env.config.time_step
    times = env.config.time_step, longest
    found = {
        guessed_controller(of, setpoint, reach / _width(widths[of], setpoint), times, sign)
        for of, setpoint in _pairs(document, set(names), points)
        for sign in ("", "-")
    }
    return sorted(found)


def guessed_controller(
    of: str, setpoint: str | float, gain: float, times: tuple[float, float], sign: str = ""
) -> str:
    """A PI controller with ranges.

    Args:
        of: What is measured.
        setpoint: What it shall be.
        gain: A likely gain; smaller and larger ones are tried, too.
        times: The shortest and the longest integral time in s.
        sign: ``"-"`` for actions that lower the value.
    """
    ends = [f"{sign}{gain * factor:.3g}" for factor in (1 / _DECADES, _DECADES)]
    kp = "..".join(reversed(ends) if sign else ends)
    return f"pid of={of} setpoint={setpoint} kp={kp} ti={times[0]:.6g}..{times[1]:.6g}"


def _width(width: float, setpoint: str | float) -> float:
    """The range of what is measured, as far as it is known."""
    known = abs(setpoint) if isinstance(setpoint, float) else 0.0
    return width if np.isfinite(width) else known or 1.0


def _pairs(
    document: Mapping[str, Any], observed: set[str], points: set[str]
) -> Iterator[tuple[str, str | float]]:
    """What is measured, and its set point: from the set points, and the differences in rewards."""
    for name, entry in document.get("setpoints", {}).items():
        of = entry.get("of") if isinstance(entry, Mapping) else None
        if of in observed and name in observed:
            yield of, name
    for section in ("reward", "costs", "expressions"):
        for text in _texts(document.get(section, {})):
            for left, right in _differences(text):
                for of, setpoint in ((left, right), (right, left)):
                    is_known = isinstance(setpoint, float) or setpoint in observed
                    if of in observed - points and setpoint is not None and is_known:
                        yield str(of), setpoint
                        break


def _texts(section: Any) -> Iterator[str]:
    terms = section.values() if isinstance(section, Mapping) else [section]
    for term in terms:
        text = term.get("expr") if isinstance(term, Mapping) else term
        if isinstance(text, str):
            yield text


def _differences(text: str) -> Iterator[tuple[str | float | None, str | float | None]]:
    """What is on both sides of each minus."""
    for node in ast.walk(ast.parse(text.strip(), mode="eval")):
        if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Sub):
            yield _side(node.left), _side(node.right)


def _side(node: ast.expr) -> str | float | None:
    """A name or a number; None for anything else."""
    match node:
        case ast.Name(name):
            return name
        case ast.Constant(int() | float() as number):
            return float(number)
    return None
