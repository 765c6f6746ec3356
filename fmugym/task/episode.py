"""The draws at the start of an episode: parameters of the FMU and variables of the task."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from functools import cached_property, partial
from itertools import islice
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from fmugym.archive.texts import number_of, text_of, texts_of
from fmugym.archive.variable import Variable, checked_value
from fmugym.checks import check_number
from fmugym.distributions import (
    Recipe,
    Uniform,
    draw_all,
    is_distribution,
    recipe_of,
    together,
)
from fmugym.pool.base import FloatArray
from fmugym.task.values import ParameterValues
from fmugym.trial.trial_episodes import Starts

__all__ = ["Draw", "Episode", "EpisodeDraws"]


class Draw(NamedTuple):
    """One of the numbers that are drawn for an episode.

    Attributes:
        name: The parameter or the episode variable.
        element: Its place in the array, in C order; None if the variable is a single number.
    """

    name: str
    element: int | None


class Episode(NamedTuple):
    """The values of one episode.

    Attributes:
        start_values: The parameters in their order, shape (P, 1).
        parameters: The parameters by name.
        variables: The episode variables by name.
        drawn: The parameters and variables that were drawn or overridden, by name.
    """

    start_values: FloatArray
    parameters: Mapping[str, Any]
    variables: dict[str, Any]
    drawn: dict[str, Any]


class EpisodeDraws:
    """The draws of an episode, prepared once so that a reset only has to draw.

    The parameters are drawn first, then the episode variables, each in the order of their dict. A
    start time that is drawn is the last of the parameters. The elements of an array are drawn in C
    order: the last index changes first.

    Args:
        model_variables: The FMU's variables for the parameters.
        parameters: Constants (checked) or distributions by name, in the same order.
        episode_variables: By name constants, distributions, or arrays of floats and distributions.
        overridden: The parameters that infos report as drawn even if they are constants.

    Attributes:
        model_variables: As given.
        constants: The parameters' values, shape (P,); 0 for those that are drawn, and of Strings
            the number of a text.
        told: The overridden parameters and their values, which infos report.
        strings: The parameters that are Strings. Hooks and infos get their texts, and all else the
            numbers that stand for these; see ``fmugym.archive.texts``.
    """

    def __init__(
        self,
        model_variables: tuple[Variable, ...],
        parameters: Mapping[str, Any],
        episode_variables: Mapping[str, Any],
        overridden: Collection[str] = (),
    ) -> None:
        self.model_variables = model_variables
        self._parameters = ParameterValues(parameters)
        self._variables = dict(episode_variables)
        pairs = zip(model_variables, parameters.values(), strict=True)
        self.constants = np.array([_constant(v, value) for v, value in pairs], np.float64)
        self.told = {name: parameters[name] for name in overridden}
        self._random_parameters = [
            (index, name, not _always_fits(value, model_variables[index]))
            for index, (name, value) in enumerate(parameters.items())
            if is_distribution(value)
        ]
        strings = (v.name for v in model_variables if v.kind == "string")
        self.strings = frozenset(strings)
        self._all_fit = not any(may_not_fit for *_, may_not_fit in self._random_parameters)
        self._arrays = {n: _DrawnArray.of(v) for n, v in episode_variables.items() if is_drawn(v)}
        self._variables.update((name, array.constants) for name, array in self._arrays.items())
        self._random_variables = [
            (name, self._arrays.get(name))
            for name, value in episode_variables.items()
            if is_distribution(value) or name in self._arrays
        ]
        self._distributions = [parameters[name] for _, name, _ in self._random_parameters]
        for name, array in self._random_variables:
            own = [episode_variables[name]] if array is None else array.distributions
            self._distributions.extend(own)
        uniform = [d for d in self._distributions if type(d) is Uniform]
        self._limits = [(d.low, d.high - d.low) for d in uniform]
        self._start_values = self.constants.reshape(-1, 1).copy()
        self._starts: Any = self._start_values.reshape(-1).data  # faster to write to

    @cached_property
    def parameter_names(self) -> list[str]:
        """The names of the parameters, in the order of ``constants``."""
        return list(self._parameters)

    @cached_property
    def drawn(self) -> list[Draw]:
        """The draws in their order."""
        draws = [Draw(name, None) for _, name, _ in self._random_parameters]
        for name, array in self._random_variables:
            draws.extend(Draw(name, e) for e in ([None] if array is None else array.elements))
        return draws

    @cached_property
    def drawn_names(self) -> list[str]:
        """The names of the drawn parameters and variables, in the order of the draws."""
        return list(dict.fromkeys(draw.name for draw in self.drawn))

    @cached_property
    def drawn_rows(self) -> list[int]:
        """For each draw, the index of its parameter; -1 for an episode variable."""
        rows = [index for index, *_ in self._random_parameters]
        return rows + [-1] * (len(self.drawn) - len(rows))

    def named(self, values: FloatArray) -> dict[str, Any]:
        """The drawn values of M episodes by name.

        Args:
            values: In the order of the draws, shape (draws, M).

        Returns:
            For each name, an array of shape (M,), or (M, ...) for a variable that is an array.
        """
        if not self._arrays:
            return dict(zip(self.drawn_names, values, strict=True))
        named: dict[str, Any] = {}
        place = 0
        for name in self.drawn_names:
            array = self._arrays.get(name)
            count = 1 if array is None else len(array.elements)
            rows = values[place : place + count]
            named[name] = rows[0] if array is None else array.of_episodes(rows)
            place += count
        return named

    @property
    def recipes(self) -> list[Recipe] | None:
        """The draws for the C extension; None if only Python can draw them."""
        recipes = []
        variables: list[Any] = [self.model_variables[i] for i, *_ in self._random_parameters]
        variables += [None] * (len(self.drawn) - len(variables))
        for draw_, one, variable in zip(self.drawn, self._distributions, variables, strict=True):
            if variable is None:
                recipes.append(recipe_of(one, partial(check_number, draw_.name)))
            else:
                recipes.append(_recipe_of(one, variable))
        known = [recipe for recipe in recipes if recipe is not None]
        return together(self._distributions, known) if len(known) == len(recipes) else None

    def shown(self, values: FloatArray) -> dict[str, Any]:
        """The same as ``named``, but Strings are texts: arrays of objects."""
        named = self.named(values)
        return named | {n: texts_of(named[n]) for n in self.strings & named.keys()}

    @cached_property
    def constant_parameters(self) -> dict[str, Any]:
        """The parameters that are not drawn; numbers, also for Strings."""
        drawn = set(self.drawn_names)
        pairs = zip(self._parameters, self.constants.tolist(), strict=True)
        return {name: value for name, value in pairs if name not in drawn}

    @cached_property
    def constants_shown(self) -> dict[str, Any]:
        """The parameters that are not drawn, as hooks read them."""
        return {name: self._parameters[name] for name in self.constant_parameters}

    @cached_property
    def constant_variables(self) -> dict[str, Any]:
        """The episode variables that are not drawn, and arrays with 0 for drawn elements."""
        drawn = {name for name, array in self._random_variables if array is None}
        return {name: value for name, value in self._variables.items() if name not in drawn}

    @cached_property
    def variable_starts(self) -> dict[str, FloatArray]:
        """The constant episode variables, with an axis for environments at the end."""
        return {name: np.array(value)[..., None] for name, value in self.constant_variables.items()}

    def starts(self) -> Starts:
        """Draw two episodes for the trial of resets, from a separate random stream."""
        values = self.draw_starts(np.random.default_rng(0), 2)
        return Starts(self.model_variables, tuple(map(tuple, values.tolist())))

    def draw_starts(self, rng: np.random.Generator, count: int) -> FloatArray:
        """Draw the parameters of some episodes, in their order, shape (P, count)."""
        return np.hstack([self.draw(rng).start_values.copy() for _ in range(count)])

    def draw(self, rng: np.random.Generator) -> Episode:
        """Draw one episode.

        Raises:
            ConfigError: If a drawn value does not fit its variable's type.
        """
        if not self._random_parameters and not self._random_variables:
            return self._episode(self._parameters.copy(), self._variables.copy(), {})
        values = iter(self.draw_values(rng))
        parameters, variables = self._parameters.copy(), self._variables.copy()
        drawn: dict[str, Any] = {}
        starts = self._starts
        for (index, name, _), value in zip(self._random_parameters, values, strict=False):
            drawn[name] = starts[index] = value
        for name in self.strings & drawn.keys() if self.strings else ():
            drawn[name] = text_of(drawn[name])
        parameters.update(drawn)
        for name, array in self._random_variables:
            own = next(values) if array is None else array.of_episode(values)
            drawn[name] = variables[name] = own
        return self._episode(parameters, variables, drawn)

    def draw_values(self, rng: np.random.Generator) -> list[float]:
        """Draw one episode.

        A single call makes all draws if they are uniform. The results equal those of single draws,
        because ``rng.uniform(low, high)`` is ``low + (high - low) * rng.random()``.

        Returns:
            The drawn values in the order of ``draws``.

        Raises:
            ConfigError: If a drawn value does not fit its variable's type.
        """
        if len(self._limits) < len(self._distributions):
            values = draw_all(self._distributions, rng)
        else:
            fractions = rng.random(len(self._limits)).tolist()
            pairs = zip(self._limits, fractions, strict=True)
            values = [low + width * fraction for (low, width), fraction in pairs]
            if self._all_fit:
                return values
        for place, (index, _, may_not_fit) in enumerate(self._random_parameters):
            if may_not_fit:
                values[place] = checked_value(self.model_variables[index], values[place])
        for place in range(len(self._random_parameters), len(values)):
            if type(values[place]) is not float:
                name = self.drawn[place].name
                values[place] = check_number(
                    f"episode variable {name!r}", values[place], may_be_boolean=True
                )
        return values

    def _episode(
        self, parameters: dict[str, Any], variables: dict[str, Any], drawn: dict[str, Any]
    ) -> Episode:
        if self.told:
            drawn = self.told | drawn
        return Episode(self._start_values, MappingProxyType(parameters), variables, drawn)


class _DrawnArray(NamedTuple):
    """An episode variable that is an array with drawn elements.

    Attributes:
        constants: The array, with 0 for the drawn elements.
        elements: The places of the drawn elements in C order.
        distributions: What they are drawn from.
    """

    constants: FloatArray
    elements: list[int]
    distributions: list[Any]

    @classmethod
    def of(cls, value: Any) -> _DrawnArray:
        """Take the distributions out of an array of objects."""
        flat = value.reshape(-1).tolist()
        constants = [0.0 if is_distribution(one) else one for one in flat]
        elements = [place for place, one in enumerate(flat) if is_distribution(one)]
        shaped = _unchangeable(np.array(constants, np.float64).reshape(value.shape))
        return cls(shaped, elements, [flat[place] for place in elements])

    def of_episode(self, values: Iterator[float]) -> FloatArray:
        """The array of one episode, of the next of these values."""
        array = self.constants.copy()
        array.reshape(-1)[self.elements] = list(islice(values, len(self.elements)))
        return _unchangeable(array)

    def of_episodes(self, rows: FloatArray) -> FloatArray:
        """The arrays of M episodes, shape (M, ...), of rows of drawn values."""
        count = rows.shape[1]
        arrays = np.repeat(self.constants[None], count, axis=0)
        arrays.reshape(count, -1)[:, self.elements] = rows.T
        return arrays


def _unchangeable(array: FloatArray) -> FloatArray:
    """Let hooks assign new arrays only, as they must with constant ones."""
    array.setflags(write=False)
    return array


def is_drawn(value: Any) -> bool:
    """Whether an episode variable of the config is an array with distributions in it."""
    return isinstance(value, np.ndarray) and value.dtype == object


def _constant(variable: Variable, value: Any) -> float:
    if is_distribution(value):
        return float(variable.items[0][1]) if variable.kind == "string" else 0.0
    return number_of(value) if variable.kind == "string" else value


def _always_fits(distribution: Any, variable: Variable) -> bool:
    return type(distribution) is Uniform and variable.kind == "real"


def _recipe_of(distribution: Any, variable: Variable) -> Recipe | None:
    recipe = recipe_of(distribution, partial(checked_value, variable))
    discrete = recipe is not None and recipe.kind in {"choice", "weighted"}
    return recipe if discrete or variable.kind == "real" else None
