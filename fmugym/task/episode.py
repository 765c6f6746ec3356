"""The draws at the start of an episode: parameters of the FMU and variables of the task."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from fmugym.archive.description import Variable
from fmugym.checks import check_number
from fmugym.distributions import Uniform, draw, is_distribution
from fmugym.pool.base import FloatArray
from fmugym.task.interface import checked_value
from fmugym.trial.rehearsal import Starts

__all__ = ["Episode", "EpisodePlan", "Sampler"]


class Episode(NamedTuple):
    """The values of one episode.

    Attributes:
        start_values: The parameters in the order of the plan, shape (P, 1).
        parameters: The parameters by name.
        variables: The episode variables by name.
        drawn: The parameters and variables that were drawn or overridden, by name.
    """

    start_values: FloatArray
    parameters: Mapping[str, Any]
    variables: dict[str, Any]
    drawn: dict[str, Any]


class EpisodePlan:
    """The draws of an episode, prepared once so that a reset only has to draw.

    The parameters are drawn first, then the episode variables, each in the order of their dict.

    Args:
        model_variables: The FMU's variables for the parameters.
        parameters: Constants (checked) or distributions by name, in the same order.
        episode_variables: Constants or distributions by name.
        overridden: The parameters that infos report as drawn even if they are constants.

    Attributes:
        model_variables: As given.
        constants: The parameters' values, shape (P,); 0 for those that are drawn.
        told: The overridden parameters and their values, which infos report.
    """

    def __init__(
        self,
        model_variables: tuple[Variable, ...],
        parameters: Mapping[str, Any],
        episode_variables: Mapping[str, Any],
        overridden: Collection[str] = (),
    ) -> None:
        self.model_variables = model_variables
        self._parameters = dict(parameters)
        self._variables = dict(episode_variables)
        self.constants = np.array(
            [0.0 if is_distribution(value) else value for value in parameters.values()],
            dtype=np.float64,
        )
        self.told = {name: parameters[name] for name in overridden}
        self._random_parameters = [
            (index, name, not _always_fits(value, model_variables[index]))
            for index, (name, value) in enumerate(parameters.items())
            if is_distribution(value)
        ]
        self._random_variables = [n for n, v in episode_variables.items() if is_distribution(v)]
        names = [name for _, name, _ in self._random_parameters]
        distributions = [parameters[name] for name in names]
        distributions += [episode_variables[name] for name in self._random_variables]
        self._sampler = Sampler(distributions)
        limits = np.array(self._sampler.limits).reshape(-1, 2)
        self._low, self._width = limits[:, :1], limits[:, 1:]
        self._start_values = self.constants.reshape(-1, 1).copy()

    @property
    def parameter_names(self) -> list[str]:
        """The names of the parameters, in the order of ``constants``."""
        return list(self._parameters)

    @property
    def limits(self) -> tuple[FloatArray, FloatArray]:
        """The lower ends and widths of the uniform distributions, each of shape (draws,)."""
        return self._low[:, 0].copy(), self._width[:, 0].copy()

    @property
    def drawn_names(self) -> list[str]:
        """The names of the drawn parameters and variables, in the order of the draws."""
        return [name for _, name, _ in self._random_parameters] + self._random_variables

    @property
    def constant_parameters(self) -> dict[str, Any]:
        """The parameters that are not drawn."""
        drawn = set(self.drawn_names)
        return {name: value for name, value in self._parameters.items() if name not in drawn}

    @property
    def constant_variables(self) -> dict[str, Any]:
        """The episode variables that are not drawn."""
        drawn = set(self.drawn_names)
        return {name: value for name, value in self._variables.items() if name not in drawn}

    @property
    def num_uniform(self) -> int | None:
        """The number of draws if all are uniform draws of Reals; otherwise None."""
        if any(may_not_fit for *_, may_not_fit in self._random_parameters):
            return None
        return len(self._sampler.limits) if self._sampler.all_uniform else None

    def scaled(self, fractions: FloatArray) -> FloatArray:
        """Scale uniform numbers from [0, 1) to the drawn values; both have shape (draws, M)."""
        return self._low + self._width * fractions

    def starts(self) -> Starts:
        """Draw two episodes for the trial of resets, from a separate random stream."""
        rng = np.random.default_rng(0)
        columns = [self.draw(rng).start_values[:, 0].tolist() for _ in range(2)]
        return Starts(self.model_variables, tuple(zip(*columns, strict=True)))

    def draw(self, rng: np.random.Generator) -> Episode:
        """Draw one episode.

        Raises:
            ConfigError: If a drawn value does not fit its variable's type.
        """
        if not self._random_parameters and not self._random_variables:
            return self._episode(self._parameters.copy(), self._variables.copy(), {})
        values = iter(self._sampler.draw(rng))
        parameters, drawn = self._draw_parameters(values)
        variables = self._variables.copy()
        for name, value in zip(self._random_variables, values, strict=True):
            if type(value) is not float:
                value = check_number(f"episode variable {name!r}", value)
            drawn[name] = variables[name] = value
        return self._episode(parameters, variables, drawn)

    def _draw_parameters(self, values: Iterator[float]) -> tuple[dict[str, Any], dict[str, Any]]:
        parameters, drawn = self._parameters.copy(), {}
        for index, name, may_not_fit in self._random_parameters:
            value = next(values)
            if may_not_fit:
                value = checked_value(self.model_variables[index], value)
            drawn[name] = parameters[name] = value
            self._start_values[index, 0] = value
        return parameters, drawn

    def _episode(
        self, parameters: dict[str, Any], variables: dict[str, Any], drawn: dict[str, Any]
    ) -> Episode:
        if self.told:
            drawn = self.told | drawn
        return Episode(self._start_values, MappingProxyType(parameters), variables, drawn)


def _always_fits(distribution: Any, variable: Variable) -> bool:
    return isinstance(distribution, Uniform) and variable.kind == "real"


class Sampler:
    """Draws from a fixed list of distributions, in order.

    A single call makes successive uniform draws. The results equal those of single draws, because
    ``rng.uniform(low, high)`` is ``low + (high - low) * rng.random()``.

    Attributes:
        limits: Lower end and width of each uniform distribution.
        all_uniform: Whether all distributions are uniform.
    """

    def __init__(self, distributions: Sequence[Any]) -> None:
        self._distributions = list(distributions)
        self.limits = [(d.low, d.high - d.low) for d in distributions if isinstance(d, Uniform)]
        self.all_uniform = len(self.limits) == len(distributions)

    def draw(self, rng: np.random.Generator) -> list[float]:
        """Draw one value from each distribution."""
        if not self.all_uniform:
            return [draw(distribution, rng) for distribution in self._distributions]
        fractions = rng.random(len(self.limits)).tolist()
        return [
            low + width * fraction
            for (low, width), fraction in zip(self.limits, fractions, strict=True)
        ]
