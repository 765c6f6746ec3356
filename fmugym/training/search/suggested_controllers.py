"""Controllers that step tests of a task suggest."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations
from operator import itemgetter
from typing import Any, Final, Self

import numpy as np
from gymnasium import spaces

from fmugym.control.candidate_evaluation import CandidateEvaluator, most_steps_of
from fmugym.control.controller_table import text_of
from fmugym.errors import ConfigError
from fmugym.training.search.step_response import (
    FEWEST,
    MOST_PAIRED,
    StepResponses,
    best_pairing,
    episodes_of,
    step_test,
)

__all__ = [
    "MOST_TESTED",
    "Loops",
    "controllers_for",
    "guessed_controllers",
    "steps_of_test",
    "suggested_controllers",
]

MOST_TESTED: Final = 2000
"""Steps of a test, at most, unless somebody says another number."""

_GAINS: Final = 0.3, 30.0
"""Range of tried gains, as multiples of the inverse of the plant's gain."""

_BANDS: Final = 0.01, 0.5
"""Range of tried bands of thermostats, as parts of the change that the action causes."""

_TRIED: Final = 2
"""Steps that measure the time of a test."""

_USUAL_STEPS: Final = 100
"""Assumed length of an episode without an end, in steps."""

_KINDS: Final = "PI", "P"
_MOST_PAIRINGS: Final = 2
_MOST_FREE: Final = 10
"""Most values without a set point for which one is tuned: the values that actions move most,
relative to their limits."""


@dataclass(frozen=True)
class Loops:
    """Control loops of a task, in which each action controls a measured value.

    Attributes:
        actions: Their names.
        limits: Limits of each action.
        switches: The actions that are on or off.
        measured: The names of what is observed and measured.
        setpoints: Possible set points, names or numbers, by measured value.
        widths: The ranges of what is observed, by name; infinite without limits.
        time_step: Time step of the task in s.
        most_steps: Most steps of an episode.
    """

    actions: Sequence[str]
    limits: Sequence[tuple[float, float]]
    switches: frozenset[str]
    measured: Sequence[str]
    setpoints: Mapping[str, Sequence[str | float]]
    widths: Mapping[str, float]
    time_step: float
    most_steps: int

    @classmethod
    def of(cls, document: Mapping[str, Any], env: Any) -> Self | None:
        """Find the control loops of a task.

        Args:
            document: Declarations.
            env: Its environment in the physical form.

        Returns:
            The loops; None if the actions are no numbers with names, or if no expression of the
            task, such as its reward, has a difference between something measured that the agent
            observes, and a set point that it observes, or a number.
        """
        space, seen, names = env.action_space, env.observation_space, env.observation_names
        if not isinstance(space, spaces.Box) or names is None:
            return None
        limits = list(zip(space.low.ravel().tolist(), space.high.ravel().tolist(), strict=True))
        actions = env.action_names or ("action",) * (len(limits) == 1)
        setpoints = _setpoints(document, env)
        if not setpoints or len(actions) != len(limits):
            return None
        variables = document.get("variables", {})
        levels = {name: variables.get(name, {}).get("levels", ()) for name in actions}
        return cls(
            actions,
            limits,
            frozenset(name for name, given in levels.items() if len(given) == 2),
            _measured(document, names),
            setpoints,
            dict(zip(names, (seen.high - seen.low).tolist(), strict=True)),
            env.config.time_step,
            most_steps_of(env) or _USUAL_STEPS,
        )


def _measured(document: Mapping[str, Any], names: Sequence[str]) -> list[str]:
    """Measured values of the observation: no set points, data, memory, forecasts or histories."""
    given = {
        one for section in ("setpoints", "data", "memory") for one in document.get(section, ())
    }
    listed = document.get("agent", {}).get("observations", names)
    listed = {listed} if isinstance(listed, str) else {*listed}
    return [name for name in names if name in listed and name not in given]


def _setpoints(document: Mapping[str, Any], env: Any) -> dict[str, list[str | float]]:
    """Possible set points of measured values: the other sides of differences in expressions.

    Set points come before what is measured itself, and names before numbers.
    """
    names = env.observation_names
    measured, found = {*_measured(document, names)}, dict[str, list[str | float]]()
    for expression in getattr(env, "expressions", ()):
        for left, right in expression.differences():
            for of, other in ((left, right), (right, left)):
                if of in measured and (isinstance(other, float) or other in names):
                    found.setdefault(of, []).append(other)
    for others in found.values():
        others.sort(key=lambda one: (isinstance(one, float), one in measured))
    return found


def steps_of_test(loops: Loops, most: int = MOST_TESTED) -> int:
    """The steps of a test, if no episode ends early; at most as many as are given."""
    return episodes_of(len(loops.actions)) * _steps_of_episode(loops, most)


def _steps_of_episode(loops: Loops, most: int) -> int:
    return min(most // episodes_of(len(loops.actions)), loops.most_steps)


def suggested_controllers(
    evaluator: CandidateEvaluator, loops: Loops, most: int = MOST_TESTED
) -> dict[str, str]:
    """Test the plant of an evaluator by steps, and guess controllers; see ``guessed_controllers``.

    Args:
        evaluator: Evaluator of a task.
        loops: Control loops of the task.
        most: The largest number of steps.

    Raises:
        ConfigError: If there is no guess. The text says why.
    """
    if len(loops.actions) > MOST_PAIRED:
        raise ConfigError(f"there are more than {MOST_PAIRED} actions")
    evaluator.most_steps = _steps_of_episode(loops, most)
    if evaluator.most_steps <= FEWEST:
        raise ConfigError(f"{most} steps are too few for a test of the actions")
    return guessed_controllers(loops, step_test(evaluator, loops.limits))


def controllers_for(make_env: Callable[[], Any], seconds: float) -> dict[str, str]:
    """Make an environment and guess controllers of its task; see ``guessed_controllers``.

    Args:
        make_env: A function that makes the environment of a task file, in the physical form.
        seconds: Real time of the test, about.
    """
    with closing(make_env()) as env:
        loops = Loops.of(env.task.document, env)
    if loops is None:
        raise ConfigError("no expression of the task has the difference to a set point")
    with closing(CandidateEvaluator(make_env, most_steps=_TRIED)) as evaluator:
        step_test(evaluator, loops.limits)
        most = seconds * evaluator.steps / max(evaluator.seconds, 1e-9)
        return suggested_controllers(evaluator, loops, int(min(MOST_TESTED, most)))


def guessed_controllers(loops: Loops, responses: StepResponses) -> dict[str, str]:
    """The controllers that step responses suggest: one for each action, paired by its gains.

    Args:
        loops: Control loops of the task.
        responses: Results of a step test.

    Returns:
        Texts for ``search_of`` by name, the least coupled pairing first. If there are several
        actions, they are tables.

    Raises:
        ConfigError: If there is none. The text says why.
    """
    return dict(_Guess(loops, responses).controllers())


@dataclass(frozen=True)
class _Guess:
    """Controllers of some loops, whose step responses are known."""

    loops: Loops
    responses: StepResponses

    def controllers(self) -> Iterator[tuple[str, str]]:
        """See ``guessed_controllers``."""
        if not np.isfinite(self.responses.responses).any():
            raise ConfigError(f"constant actions end episodes in {FEWEST} steps or less")
        away = self.responses.runs_away
        if away:
            raise ConfigError(f"constant actions let {', '.join(away)} run away")
        for number, pairs in enumerate(self._pairings(), 1):
            texts = {self._text(pairs, kind): kind for kind in reversed(_KINDS)}
            for text, kind in reversed(texts.items()):
                name = kind if "pid" in text else "thermostat"
                yield (name if number == 1 else f"{name} {number}"), text

    # Pairings.

    @cached_property
    def _moved(self) -> Mapping[str, bool]:
        """Whether actions move an observation, by its name."""
        rows = zip(self.responses.names, self.responses.gains, strict=True)
        return {name: bool(row.any()) for name, row in rows}

    def _setpoint(self, of: str) -> str | float | None:
        """The set point of a value, which no action moves; None if it has none."""
        given = self.loops.setpoints.get(of, ())
        return next((one for one in given if not self._moved.get(str(one))), None)

    def _pairings(self) -> list[dict[int, int]]:
        """The row of each action that controls something, the least coupled pairings first.

        As many actions as possible control something, and as many set points as possible count.
        """
        acting = np.flatnonzero(self.responses.gains.any(axis=0)).tolist()
        wanted, free = self._wanted(), self._free()
        for size in range(min(len(acting), len(wanted) + len(free)), 0, -1):
            found = [
                (number, pairs)
                for first in combinations(wanted, min(size, len(wanted)))
                for more in combinations(free, size - len(first))
                for columns in combinations(acting, size)
                for number, pairs in self._paired((*first, *more), columns)
            ]
            if found:
                return [pairs for _, pairs in sorted(found, key=itemgetter(0))][:_MOST_PAIRINGS]
        raise ConfigError("no pairing of actions with measured values has positive gains")

    def _paired(
        self, rows: Sequence[int], columns: Sequence[int]
    ) -> Iterator[tuple[float, dict[int, int]]]:
        """The best pairing of some rows and columns, if there is one, after its RGA number."""
        found = best_pairing(self.responses.gains[np.ix_(rows, columns)])
        if found is not None:
            pairing, number = found
            yield number, {j: rows[i] for j, i in zip(columns, pairing, strict=True)}

    def _moving(self, has_setpoint: bool) -> list[int]:
        """The rows of measured values that move, with a set point or without one."""
        return [
            self.responses.names.index(name)
            for name in self.loops.measured
            if self._moved[name] and (self._setpoint(name) is not None) == has_setpoint
        ]

    def _wanted(self) -> list[int]:
        """The rows that have a set point."""
        wanted = self._moving(has_setpoint=True)
        if not wanted:
            names = ", ".join(self.loops.setpoints)
            raise ConfigError(f"no action changes {names} in the same direction at all points")
        return wanted

    def _free(self) -> list[int]:
        """Rows whose set point is to be found, without rows that only tell what an action is."""
        rows = self._moving(has_setpoint=False)
        slow = [row for row in rows if not self.responses.is_instant[row]]
        return sorted(slow or rows, key=self._movement, reverse=True)[:_MOST_FREE]

    def _movement(self, row: int) -> float:
        """Range over which actions move each value, relative to its limits."""
        width = self.loops.widths[self.responses.names[row]]
        largest = float(np.abs(self.responses.ends[:, row]).max())
        moved = float(np.abs(self.responses.gains[row]).max())
        return moved / (width if 0 < width < np.inf else largest)

    # Texts.

    def _text(self, pairs: Mapping[int, int], kind: str) -> str:
        texts = {
            name: self._controller(column, pairs[column], kind)
            if column in pairs
            else self._constant(column)
            for column, name in enumerate(self.loops.actions)
        }
        return text_of(texts) if len(texts) > 1 else next(iter(texts.values()))

    def _controller(self, column: int, row: int, kind: str) -> str:
        """A P or PI controller, or a thermostat for an action that is on or off.

        A set point that is tuned takes the place of the action where the error is zero.
        """
        of, gain = self.responses.names[row], self.responses.gains[row, column]
        change = max(abs(gain), abs(self.responses.final[row, column]))
        setpoint, ends = self._setpoint(of), self.responses.ends[:, row]
        words = [f"of={of}", f"setpoint={_range(*ends) if setpoint is None else setpoint}"]
        low, high = self.loops.limits[column]
        if self.loops.actions[column] in self.loops.switches:
            band = _range(*(change * part for part in _BANDS))
            below, above = (high, low) if gain > 0 else (low, high)
            words += [f"band={band}", f"below={below}", f"above={above}"]
            return shlex.join(["hysteresis", *words])
        usual = np.sign(gain) * (high - low) / change
        words.append(f"kp={_range(*(usual * part for part in _GAINS))}")
        if kind == "PI":
            step = self.loops.time_step
            words.append(f"ti={_range(step, step * self.loops.most_steps)}")
        elif setpoint is not None:
            words.append(f"offset={_range(low, high)}")
        return shlex.join(["pid", *words])

    def _constant(self, column: int) -> str:
        """A constant action: a controller without a gain."""
        of, offset = self.responses.names[0], _range(*self.loops.limits[column])
        return shlex.join(["pid", f"of={of}", f"setpoint={of}", "kp=0", f"offset={offset}"])


def _range(*values: float) -> str:
    """The range of some values, as a controller has it."""
    return f"{min(values):.4g}..{max(values):.4g}"
