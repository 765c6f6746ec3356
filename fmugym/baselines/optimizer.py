"""Search for numbers by covariance matrix adaptation, which needs only the order of candidates."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from fmugym.baselines.controller import FloatArray

__all__ = ["MOST_CORRELATED", "Optimizer"]

MOST_CORRELATED: Final = 100
"""More numbers than these are searched without covariances, for which a round would take long."""

_UNUSED: Final = "_funhist_values"
"""A part of the state of ``cmaes`` that nothing here follows from. It begins as memory that was
never written."""


class Optimizer:
    """CMA-ES of the package ``cmaes`` for n numbers within limits.

    Where there are many numbers, it takes the separable form, which adapts a variance for each of
    them and no covariances. A candidate beyond a limit is moved to it. So steps do not grow for
    ever where rewards do not depend on their size.

    Args:
        mean: Where the search begins, shape (n,).
        sigma: The standard deviation of the first candidates.
        limits: The lowest and the highest value of each number.
        population: The candidates of a round.
        rng: Seeds the draws of each round.
    """

    def __init__(
        self,
        mean: FloatArray,
        sigma: float,
        limits: tuple[float, float],
        population: int,
        rng: np.random.Generator,
    ) -> None:
        from cmaes import CMA, SepCMA  # they load scipy, where it is installed

        n = mean.size
        common: dict[str, Any] = {"n_max_resampling": 0, "population_size": population}
        begin = np.clip(mean, *limits), sigma, np.tile(limits, (n, 1))
        if n > MOST_CORRELATED:
            self._cma: Any = SepCMA(*begin, **common)
        else:
            # axes of equal variances would be those that the processor happens to find
            self._cma = CMA(*begin, cov=np.diag(np.linspace(0.9, 1.1, n)), **common)
        self._rng = rng

    @property
    def mean(self) -> FloatArray:
        """The best guess until now, shape (n,)."""
        mean: FloatArray = self._cma.mean.copy()
        return mean

    @mean.setter
    def mean(self, mean: FloatArray) -> None:
        self._cma.mean[:] = mean  # what the property gives is the array itself

    @property
    def population(self) -> int:
        """The candidates of a round."""
        return int(self._cma.population_size)

    def state(self) -> dict[str, Any]:
        """What the next round follows from, but for ``rng``: numbers and arrays by name."""
        state = self._cma.__getstate__()
        return {name: value for name, value in state.items() if name != _UNUSED}

    def restore(self, state: Mapping[str, Any]) -> None:
        """Go on from a state of a search with as many numbers and candidates.

        Raises:
            KeyError: If something is missing.
            Exception: Of any kind, if the state is none of such a search.
        """
        own, population = self.state(), self.population
        for name, value in own.items():
            if _form(state[name]) != _form(value):
                raise ValueError(f"{name} is {_form(state[name])}, expected {_form(value)}")
        self._cma.__setstate__(self._cma.__getstate__() | {name: state[name] for name in own})
        if self.population != population:
            raise ValueError(f"{self.population} candidates, expected {population}")
        trial = copy.deepcopy(self)
        trial.ask()
        trial.tell(np.arange(population))
        if not np.isfinite(trial.ask()).all():
            raise ValueError("its candidates are not finite")

    def ask(self) -> FloatArray:
        """Draw the candidates of a round, shape (population, n)."""
        self._cma.reseed_rng(int(self._rng.integers(2**32)))  # copies of it have no generator
        self._candidates = np.array([self._cma.ask() for _ in range(self.population)])
        return self._candidates

    def tell(self, order: npt.NDArray[np.int64]) -> None:
        """Learn from the order of the candidates, the best one first."""
        self._cma.tell([(self._candidates[one], float(rank)) for rank, one in enumerate(order)])
        self._cma = copy.copy(self._cma)  # rounds its covariances as a state does


def _form(value: Any) -> tuple[str, tuple[int, ...]] | None:
    """The kind and the shape of a number or an array; None for None."""
    return None if value is None else (np.asarray(value).dtype.kind, np.shape(value))
