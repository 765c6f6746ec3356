"""Terms of surrogates, whose weighted sum is the change of the outputs in a step.

The outputs at the start of episodes are functions of the values that are set before.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Final

import numpy as np

from fmugym.control.surrogate.recorded_trajectories import EpisodeTrajectory
from fmugym.expressions.graph import Graph, Value, where
from fmugym.fmi.variable import Variable
from fmugym.pool.pool import FloatArray

__all__ = ["Start", "SurrogateForm", "Terms", "regressors_of", "rows_in", "simulated"]

_BEYOND: Final = 0.2
"""Numbers are clipped to their range in the trajectories, which is so much wider on both sides."""

_STEEPNESS: Final = 1.5
"""Root mean square of the argument of a tanh."""

Number = Callable[[float], Any]


@dataclass(frozen=True)
class SurrogateForm:
    """Form of a surrogate: the regressors and terms of the changes of outputs.

    Attributes:
        lags: How many earlier outputs and inputs it depends on, beside the present ones.
        angles: The outputs of which it sees sine and cosine in their place.
        thresholds: Inputs and their values; beyond these, other numbers hold.
        quadratic: Whether all products of two count.
        tanhs: How many functions tanh of random sums there are.
        starts: Whether it depends on what is set before initialization.
        limited: The outputs that an end of their range in the trajectories limits.
    """

    lags: int = 0
    angles: tuple[int, ...] = ()
    thresholds: tuple[tuple[int, float], ...] = ()
    quadratic: bool = False
    tanhs: int = 0
    starts: bool = False
    limited: tuple[int, ...] = ()

    def __str__(self) -> str:
        words = ["quadratic" if self.quadratic else "linear"]
        words += [f"{self.lags} lags"] * bool(self.lags)
        words += [f"threshold {value:.4g}" for _, value in self.thresholds]
        words += [f"{self.tanhs} tanh"] * bool(self.tanhs)
        words += ["parameters"] * self.starts
        words += [f"{len(self.limited)} limited"] * bool(self.limited)
        return ", ".join(words)

    def with_threshold(self, place: int, value: float) -> SurrogateForm:
        """The form with another threshold of an input."""
        return replace(self, thresholds=(*self.thresholds, (place, value)))


def regressors_of(form: SurrogateForm, trajectory: EpisodeTrajectory) -> FloatArray:
    """Regressors of the steps of a trajectory, shape (d, T).

    These are the outputs, their changes in earlier steps, the inputs, their changes, and the
    values set before initialization. Before an episode, nothing has changed.
    """
    parts = [trajectory.outputs[:-1].T]
    parts += [_changes(trajectory.outputs[:-1].T, lag) for lag in range(form.lags)]
    parts += [trajectory.inputs.T]
    parts += [_changes(trajectory.inputs.T, lag) for lag in range(form.lags)]
    if form.starts:
        parts.append(np.repeat(trajectory.starts[:, None], trajectory.steps, axis=1))
    return np.concatenate(parts)


def _changes(values: FloatArray, lag: int) -> FloatArray:
    """The changes so many steps ago, shape (k, T)."""
    changes = np.diff(values, axis=1, prepend=values[:, :1])
    return np.concatenate([np.zeros((len(values), lag)), changes], axis=1)[:, : values.shape[1]]


@dataclass(frozen=True)
class Terms:
    """The terms of a form. They are products of one or two factors, and 1.

    Attributes:
        form: The form.
        widths: How many outputs and inputs there are.
        mean, deviation, low, high: Statistics of the regressors, shape (d,).
        mixing: The weights in each tanh, and a constant, shape (tanhs, factors + 1).
        pairs: The factors of each product, shape (2, q).
    """

    form: SurrogateForm
    widths: tuple[int, int]
    mean: FloatArray
    deviation: FloatArray
    low: FloatArray
    high: FloatArray
    mixing: FloatArray = field(init=False)
    pairs: Any = field(init=False)

    @classmethod
    def fitted_to(cls, form: SurrogateForm, rows: FloatArray, widths: tuple[int, int]) -> Terms:
        """Make the terms of a form, with the scales and ranges of rows of ``regressors_of``."""
        low, high = rows.min(axis=1), rows.max(axis=1)
        beyond = _BEYOND * (high - low)
        deviation = rows.std(axis=1)
        return cls(form, widths, rows.mean(axis=1), deviation, low - beyond, high + beyond)

    def __post_init__(self) -> None:
        graph = Graph()
        plain = len(self._scaled([Value.read(graph, "x", i) for i in range(len(self.mean))]))
        rng = np.random.default_rng(plain)
        mixing = rng.standard_normal((self.form.tanhs, plain + 1))
        mixing *= _STEEPNESS / np.sqrt(plain + 1)
        flags = plain + self.form.tanhs
        places = [(i, j) for i in range(plain) for j in range(i, plain) if self.form.quadratic]
        for number in range(len(self.form.thresholds)):
            places += [(flags + number, j) for j in range(plain)]
        object.__setattr__(self, "mixing", mixing)
        object.__setattr__(self, "pairs", np.array(places, int).reshape(-1, 2).T)

    @property
    def first_input(self) -> int:
        """The place of the first input in a row."""
        return self.widths[0] * (1 + self.form.lags)

    @property
    def count(self) -> int:
        """Number of terms."""
        return 1 + self.factor_count + int(self.pairs.shape[1])

    @property
    def factor_count(self) -> int:
        """Number of factors."""
        return int(self.mixing.shape[1]) - 1 + len(self.mixing) + len(self.form.thresholds)

    def _scaled(self, row: Sequence[Any], number: Number = float) -> list[Value]:
        """Factors that are scaled numbers, without those that the trajectories never change."""
        outputs = self.widths[0]
        found: list[Value] = []
        for place, value in enumerate(row):
            if place < outputs and place in self.form.angles:
                found += [np.sin(value), np.cos(value)]
            elif self.deviation[place] > 0.0:
                low, high, mean = map(number, (self.low[place], self.high[place], self.mean[place]))
                inside: Any = np.minimum(np.maximum(value, low), high)
                found.append((inside - mean) * number(1.0 / self.deviation[place]))
        return found

    def factors(self, row: Sequence[Value], number: Number = float) -> list[Value]:
        """All factors of the regressors of a step.

        Args:
            row: Its values.
            number: Makes an operand of a number, of which a program may have too many.
        """
        scaled = self._scaled(row, number)
        found = [*scaled]
        for *weights, constant in self.mixing.tolist():
            total = row[0].beside(number(constant))
            for weight, value in zip(weights, scaled, strict=True):
                total = total + value * number(weight)
            found.append(np.tanh(total))
        return found + [
            where(row[self.first_input + place] > value, 1.0, 0.0)
            for place, value in self.form.thresholds
        ]

    def values(self, rows: FloatArray) -> FloatArray:
        """The terms of rows, by numpy: shape (f, n) from (d, n)."""
        outputs, first = self.widths[0], self.first_input
        angles = [place for place in range(outputs) if place in self.form.angles]
        plain = [place for place, scale in enumerate(self.deviation) if scale > 0.0]
        parts = {place: np.stack([np.sin(rows[place]), np.cos(rows[place])]) for place in angles}
        plain = [place for place in plain if place not in parts]
        inside = np.clip(rows[plain].T, self.low[plain], self.high[plain])
        scaled = ((inside - self.mean[plain]) * (1.0 / self.deviation[plain])).T
        parts |= dict(zip(plain, scaled[:, None], strict=True))
        factors = np.concatenate([parts[place] for place in sorted(parts)])
        sums = self.mixing[:, :-1] @ factors + self.mixing[:, -1:]
        flags = [rows[first + place] > value for place, value in self.form.thresholds]
        factors = np.concatenate([factors, np.tanh(sums), np.reshape(flags, (-1, rows.shape[1]))])
        one, two = self.pairs
        return np.concatenate([np.ones((1, rows.shape[1])), factors, factors[one] * factors[two]])

    def total(self, factors: Sequence[Value], weights: Sequence[Any]) -> Value:
        """The sum of the terms, each with its weight."""
        first, *others = weights
        products = [*factors, *(factors[i] * factors[j] for i, j in self.pairs.T.tolist())]
        total = factors[0].beside(first)
        for weight, one in zip(others, products, strict=True):
            total = total + weight * one
        return total


def rows_in(graph: Graph, name: str, count: int) -> list[Value]:
    """Values that a program reads in so many rows."""
    return [Value.read(graph, name, place) for place in range(count)]


def simulated(
    terms: Terms,
    weights: Sequence[FloatArray],
    bounds: tuple[FloatArray, FloatArray],
    rows: FloatArray,
) -> Iterator[FloatArray]:
    """Simulate by numpy, from places in trajectories on.

    Args:
        terms: Terms of the changes of outputs.
        weights: Sets of weights, each of shape (f, k).
        bounds: Between what outputs stay, each of shape (k,).
        rows: As of ``regressors_of``, of n simulations, shape (d, n, steps): the first ones tell
            where they begin, and all tell the inputs.

    Yields:
        The outputs after each step, shape (k, sets * n).
    """
    low, high = bounds
    outputs, count, first = terms.widths[0], len(weights), terms.first_input
    now = np.tile(rows[:, :, 0], count)
    for step in range(rows.shape[2]):
        now[first:] = np.tile(rows[first:, :, step], count)
        parts = np.split(terms.values(now), count, axis=1)
        changes = [one.T @ part for one, part in zip(weights, parts, strict=True)]
        change = np.concatenate(changes, axis=1)
        after = np.clip(now[:outputs] + change, low[:, None], high[:, None])
        if terms.form.lags:
            now[2 * outputs : first] = now[outputs : first - outputs].copy()
            now[outputs : 2 * outputs] = after - now[:outputs]
        now[:outputs] = after
        yield after


_PENALTY: Final = 1e-8
_BEYOND_AT_START: Final = 0.5
"""Outputs begin in their range in the trajectories, which is so much wider on both sides."""


@dataclass(frozen=True)
class Start:
    """Outputs at the start of an episode, as a sum of terms of the start values.

    Attributes:
        names: The variables that are set.
        mean, deviation: Mean and standard deviation of their values, shape (p,).
        low, high: The range of the outputs, shape (k,).
        weights: Weights of the terms, shape (k, f).
    """

    names: tuple[str, ...]
    mean: FloatArray
    deviation: FloatArray
    low: FloatArray
    high: FloatArray
    weights: FloatArray

    @classmethod
    def of(cls, variables: Sequence[Variable], trajectories: Sequence[EpisodeTrajectory]) -> Start:
        """The fit to the starts of trajectories, equal ones once."""
        several = list({one.starts.tobytes(): one for one in trajectories}.values())
        given = np.array([one.starts for one in several])
        first = np.array([one.outputs[0] for one in several])
        deviation = given.std(axis=0)
        names = tuple(one.name for one in variables)
        beyond = _BEYOND_AT_START * np.ptp(first, axis=0)
        low, high = first.min(axis=0) - beyond, first.max(axis=0) + beyond
        about = names, given.mean(axis=0), deviation, low, high
        terms = cls(*about, np.zeros(0))._terms(given.T)
        square = terms @ terms.T / len(given) + _PENALTY * np.eye(len(terms))
        return cls(*about, np.linalg.solve(square, terms @ first / len(given)).T)

    def _terms(self, given: FloatArray) -> FloatArray:
        """Shape (f, n): 1, the scaled values that differ, and their products."""
        differ = self.deviation > 0.0
        scaled = ((given.T - self.mean) / np.where(differ, self.deviation, 1.0)).T[differ]
        first, second = np.triu_indices(len(scaled))
        ones = np.ones((1, given.shape[1]))
        return np.concatenate([ones, scaled, scaled[first] * scaled[second]])

    def values(self, given: Sequence[Value]) -> list[Value]:
        """Outputs as values of a graph, from the start values."""
        scaled = [
            (one - mean) * (1.0 / deviation)
            for one, mean, deviation in zip(given, self.mean, self.deviation, strict=True)
            if deviation > 0.0
        ]
        products = [one * two for place, one in enumerate(scaled) for two in scaled[place:]]
        found = []
        for (constant, *weights), low, high in zip(self.weights, self.low, self.high, strict=True):
            total: Any = given[0].beside(float(constant))
            for weight, one in zip(weights, [*scaled, *products], strict=True):
                total = total + one * float(weight)
            found.append(np.minimum(np.maximum(total, float(low)), float(high)))
        return found

    def outputs(self, given: FloatArray) -> FloatArray:
        """The outputs, shape (k, n), from values of shape (p, n)."""
        return np.clip((self.weights @ self._terms(given)).T, self.low, self.high).T
