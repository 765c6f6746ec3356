"""Locating the first crossing of an event indicator within a step.

This is the arithmetic of ``native/crossings.c``, operation by operation.
"""

from __future__ import annotations

from typing import NamedTuple

from fmugym.fmi.methods import State

__all__ = ["Bracket", "crosses"]


def crosses(before: State, after: State) -> bool:
    """Whether an indicator becomes positive or ceases to be: FMI's events."""
    return any((a > 0.0) != (b > 0.0) for a, b in zip(before, after, strict=True))


class Bracket(NamedTuple):
    """An interval of fractions of a step: nothing has crossed at low, something has at high.

    The weight of an end is halved while it stays where it is (Illinois method).
    """

    low: float
    high: float
    low_weight: float
    high_weight: float
    low_z: State
    high_z: State

    def _first_crossing(self) -> float:
        """The fraction at which straight lines between the ends cross first."""
        first = 1.0
        for low, high in zip(self.low_z, self.high_z, strict=True):
            a, b = self.low_weight * low, self.high_weight * high
            if (a > 0.0) != (b > 0.0) and a / (a - b) < first:
                first = a / (a - b)
        return self.low + first * (self.high - self.low)

    def next_guess(self, guesses: int, least: float) -> float:
        """A guess that moves an end by at least this much; each fourth halves the interval."""
        middle = 0.5 * (self.low + self.high)
        guess = middle if guesses % 4 == 3 else self._first_crossing()
        if not guess > self.low + least:
            return min(self.low + least, middle)
        return guess if guess < self.high - least else max(self.high - least, middle)

    def narrowed(self, guess: float, z: State, crossed: bool) -> Bracket:
        """Move the end to a guess on whose side it is."""
        if crossed:
            return Bracket(self.low, guess, 0.5 * self.low_weight, 1.0, self.low_z, z)
        return Bracket(guess, self.high, 1.0, 0.5 * self.high_weight, z, self.high_z)
