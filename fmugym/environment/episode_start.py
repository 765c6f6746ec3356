"""Start of an episode: drawn parameters of the FMU and drawn variables of the task.

The C extension makes some of the draws: from random streams, and by generators of numpy.
"""

from __future__ import annotations

import ctypes
import functools
import math
import sys
from collections.abc import Callable, Collection, Mapping, Sequence
from functools import cached_property, partial
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from fmugym.checks import check_number
from fmugym.environment.distributions import Recipe, draw_all, is_distribution, recipe_of, together
from fmugym.environment.value_mappings import ParameterValues
from fmugym.fmi.variable import Variable, checked_value, texts_at, texts_of
from fmugym.pool.pool import FloatArray
from fmugym.pool.pool_form import form_of_draws
from fmugym.pool.trial.trial_episodes import Starts

if TYPE_CHECKING:
    from fmugym._native import Draws

__all__ = ["Draw", "EpisodeStart", "EpisodeValues", "native_draws", "no_draws"]


def native_draws(recipes: Sequence[Recipe] | None, rows: Sequence[int]) -> Draws | None:
    """Prepare draws.

    Args:
        recipes: How each value is drawn; None if only Python can do it.
        rows: For each, the row of the start value that it sets, or -1.

    Returns:
        None if the C extension cannot make one of the draws.
    """
    if recipes is None:
        return None
    needed = {"normal": _standard_normal, "log_uniform": _exponential}
    if any(recipe.kind in needed and not needed[recipe.kind]() for recipe in recipes):
        return None
    return _draws(tuple(recipes), tuple(rows))


def no_draws() -> Draws:
    """Draws that are none, because Python starts the episodes."""
    return _draws((), ())


@functools.lru_cache(64)
def _draws(recipes: tuple[Recipe, ...], rows: tuple[int, ...]) -> Draws:
    from fmugym import _native

    known = _native.DISTRIBUTIONS
    counts = [len(recipe.numbers) for recipe in recipes]
    firsts = np.cumsum([0, *counts])[:-1]
    columns = [known.index(recipe.kind) for recipe in recipes], rows, firsts, counts
    table = np.array(columns, np.int64).reshape(4, -1).T
    numbers = np.array([number for recipe in recipes for number in recipe.numbers])
    return form_of_draws(table, numbers), _standard_normal(), _exponential()


@functools.cache
def _standard_normal() -> int:
    """The address of numpy's function for normal distributions; 0 if it cannot be found.

    numpy's documentation, "Extending via CFFI", finds the functions of its ``distributions.h`` in
    the same way. It keeps the values those of the numpy at hand.
    """
    return _address(np.random._generator.__file__, "random_standard_normal")


@functools.cache
def _exponential() -> int:
    """The address of the C library's ``exp``, which ``math.exp`` calls; 0 if it cannot be found."""
    if sys.platform == "win32":
        return _address("ucrtbase", "exp")
    return _address(getattr(math, "__file__", None), "exp")  # or it is a part of Python itself


def _address(library: str | None, name: str) -> int:
    try:
        function = getattr(ctypes.CDLL(library), name)
    except (AttributeError, OSError):  # the system does not export it
        return 0
    return ctypes.cast(function, ctypes.c_void_p).value or 0


class Draw(NamedTuple):
    """One of the numbers that are drawn for an episode.

    Attributes:
        name: The parameter or the episode variable.
        element: Its place in the array, in C order; None if the variable is a single number.
    """

    name: str
    element: int | None


class EpisodeValues(NamedTuple):
    """Start values of one episode, or rows of N start values.

    Attributes:
        start_values: The parameters in their order, shape (P, 1) or (P, N).
        parameters: The parameters by name.
        variables: The episode variables by name.
        drawn: The parameters and variables that were drawn or overridden, by name.
    """

    start_values: FloatArray
    parameters: Mapping[str, Any]
    variables: dict[str, Any]
    drawn: dict[str, Any]


class EpisodeStart:
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
            the places of the texts.
        told: The overridden parameters and their values, which infos report.
        strings: The parameters that are Strings, with the texts that they may get. Hooks and infos
            get these, and all else their places; see ``fmugym.fmi.variable``.
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
        self.told = {name: parameters[name] for name in overridden}
        self._random_parameters = {
            name: index
            for index, (name, value) in enumerate(parameters.items())
            if is_distribution(value)
        }
        constants = [
            0.0 if name in self._random_parameters else _number(variable, value)
            for variable, (name, value) in zip(model_variables, parameters.items(), strict=True)
        ]
        self.constants = np.array(constants, np.float64)
        self.strings = {v.name: texts_of(v) for v in model_variables if v.kind == "string"}
        self._arrays = {n: _DrawnArray.of(v) for n, v in episode_variables.items() if is_drawn(v)}
        self._variables.update((name, array.constants) for name, array in self._arrays.items())
        self._random_variables = {
            name: self._arrays.get(name)
            for name, value in episode_variables.items()
            if is_distribution(value) or name in self._arrays
        }
        self._distributions = [parameters[name] for name in self._random_parameters]
        for name, array in self._random_variables.items():
            own = [episode_variables[name]] if array is None else array.distributions
            self._distributions.extend(own)
        self._start_values = self.constants.reshape(-1, 1).copy()
        self._row = self._start_values.reshape(-1)
        self._starts: Any = self._row.data  # faster to write to

    @cached_property
    def parameter_names(self) -> list[str]:
        """The names of the parameters, in the order of ``constants``."""
        return list(self._parameters)

    @cached_property
    def drawn(self) -> list[Draw]:
        """The draws in their order."""
        draws = [Draw(name, None) for name in self._random_parameters]
        for name, array in self._random_variables.items():
            draws.extend(Draw(name, e) for e in ([None] if array is None else array.elements))
        return draws

    @cached_property
    def drawn_names(self) -> list[str]:
        """The names of the drawn parameters and variables, in the order of the draws."""
        return [*self._random_parameters, *self._random_variables]

    @cached_property
    def drawn_rows(self) -> list[int]:
        """For each draw, the index of its parameter; -1 for an episode variable."""
        rows = list(self._random_parameters.values())
        return rows + [-1] * (len(self.drawn) - len(rows))

    @cached_property
    def native(self) -> Draws | None:
        """The draws for the C extension; None if only Python can make them."""
        return native_draws(self.recipes, self.drawn_rows)

    @cached_property
    def _draw_natively(self) -> Callable[[object, FloatArray, FloatArray], None]:
        """``_native.draw_from`` with the draws."""
        from fmugym import _native

        assert self.native is not None
        return partial(_native.draw_from, self.native)

    @cached_property
    def _drawn(self) -> FloatArray:
        """Memory for the drawn values of an episode."""
        return np.empty(len(self.drawn))

    def named(self, values: Sequence[Any] | FloatArray) -> dict[str, Any]:
        """The drawn values of one episode, or of M, by name.

        Args:
            values: In the order of the draws: numbers, or an array of shape (draws, M).

        Returns:
            For each name a number or an array of shape (M,). For a variable that is an array, one
            of its shape, or with a last axis for the episodes.
        """
        if not self._arrays:
            return dict(zip(self.drawn_names, values, strict=True))
        named: dict[str, Any] = {}
        place = 0
        for name in self.drawn_names:
            array = self._arrays.get(name)
            count = 1 if array is None else len(array.elements)
            rows = values[place : place + count]
            named[name] = rows[0] if array is None else array.filled(rows)
            place += count
        return named

    @property
    def recipes(self) -> list[Recipe] | None:
        """The draws for the C extension; None if only Python can draw them."""
        rows = zip(self.drawn, self._distributions, self.drawn_rows, strict=True)
        recipes = [
            recipe_of(one, partial(check_number, draw_.name))
            if row < 0
            else _recipe_of(one, self.model_variables[row])
            for draw_, one, row in rows
        ]
        known = [recipe for recipe in recipes if recipe is not None]
        return together(self._distributions, known) if len(known) == len(recipes) else None

    def shown(self, values: Sequence[Any] | FloatArray) -> dict[str, Any]:
        """The same as ``named``, but Strings are texts, or arrays of them."""
        named = self.named(values)
        if not self.strings:
            return named
        own = self.strings.keys() & named.keys()
        return named | {name: texts_at(self.strings[name], named[name]) for name in own}

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
        drawn = {name for name, array in self._random_variables.items() if array is None}
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

    def draw(self, rng: np.random.Generator, *, natively: bool = False) -> EpisodeValues:
        """Draw one episode.

        Args:
            rng: The generator.
            natively: Whether the C extension steps the FMU, and makes the draws that it can.

        Raises:
            ConfigError: If a drawn value does not fit its variable's type.
        """
        parameters, variables = ParameterValues(self._parameters), self._variables.copy()
        drawn: dict[str, Any] = {}
        if self._distributions:
            drawn = self.shown(self.draw_values(rng, natively=natively))
            for name in self._random_parameters:
                parameters[name] = drawn[name]
            for name in self._random_variables:
                variables[name] = drawn[name]
        told = self.told | drawn
        return EpisodeValues(self._start_values, MappingProxyType(parameters), variables, told)

    def draw_values(self, rng: np.random.Generator, *, natively: bool = False) -> list[float]:
        """Draw the values of one episode; its parameters become start values.

        The C extension draws the same numbers as Python.

        Args:
            rng: The generator.
            natively: Whether the C extension makes the draws that it can.

        Returns:
            The drawn values in the order of ``drawn``.

        Raises:
            ConfigError: If a drawn value does not fit its variable's type.
        """
        prepared = natively and not self.told  # options serve for one reset: not worth it
        if not prepared or self.native is None:
            values = self._drawn_by(rng)
            for index, value in zip(self._random_parameters.values(), values, strict=False):
                self._starts[index] = value
            return values
        bits = rng.bit_generator
        with bits.lock:
            self._draw_natively(bits.capsule, self._row, self._drawn)
        drawn: list[float] = self._drawn.tolist()
        return drawn

    def _drawn_by(self, rng: np.random.Generator) -> list[float]:
        values = draw_all(self._distributions, rng)
        for place, index in enumerate(self._random_parameters.values()):
            variable = self.model_variables[index]
            if type(values[place]) is not float or not _is_double(variable):
                values[place] = checked_value(variable, values[place])
        for place in range(len(self._random_parameters), len(values)):
            if type(values[place]) is not float:
                what = f"episode variable {self.drawn[place].name!r}"
                values[place] = check_number(what, values[place], may_be_boolean=True)
        return values


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

    def filled(self, drawn: Any) -> FloatArray:
        """The array of one episode, or of M on the last axis, of numbers or rows of shape (M,)."""
        rows = np.asarray(drawn)
        flat = np.empty((self.constants.size, *rows.shape[1:]))
        flat.T[...] = self.constants.reshape(-1)
        flat[self.elements] = rows
        return _unchangeable(flat.reshape(*self.constants.shape, *rows.shape[1:]))


def _unchangeable(array: FloatArray) -> FloatArray:
    """Let hooks assign new arrays only, as they must with constant ones."""
    array.setflags(write=False)
    return array


def is_drawn(value: Any) -> bool:
    """Whether an episode variable of the config is an array with distributions in it."""
    return isinstance(value, np.ndarray) and value.dtype == object


def _number(variable: Variable, value: Any) -> Any:
    """A checked value of a parameter as a number."""
    return checked_value(variable, value) if variable.kind == "string" else value


def _is_double(variable: Variable) -> bool:
    """Whether any float that a distribution draws is a value of the variable."""
    return variable.type in {"Real", "Float64"}


def _recipe_of(distribution: Any, variable: Variable) -> Recipe | None:
    convert = float if _is_double(variable) else partial(checked_value, variable)
    recipe = recipe_of(distribution, convert)
    discrete = recipe is not None and recipe.kind in {"choice", "weighted"}
    return recipe if discrete or variable.kind == "real" else None
