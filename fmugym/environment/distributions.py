"""Distributions of start values and parameters, which an environment draws at each reset.

Wherever a config takes a number for a start value, a parameter or an episode variable, it also
takes a distribution. The environment then draws from it with its own seeded generator.

A distribution may be written as a dict: ``{"distribution": "uniform", "low": 0, "high": 1}`` is
``Uniform(0, 1)``. JSON and YAML files can hold this form, and Gymnasium's ``EnvSpec.to_json``
writes it. All numbers become Python floats, whatever type they were given in.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import MISSING, dataclass, field, fields, replace
from functools import partial
from typing import Any, Final, NamedTuple, Protocol

import numpy as np

from fmugym.checks import (
    KnownArguments,
    check_mapping,
    check_number,
    check_option,
    has_method,
    number_of,
)
from fmugym.errors import ConfigError, shown, unknown_name

__all__ = [
    "DISTRIBUTIONS",
    "OWN_DISTRIBUTIONS",
    "Choice",
    "Distribution",
    "DrawnColumn",
    "LogUniform",
    "Normal",
    "Recipe",
    "Uniform",
    "as_distribution",
    "draw",
    "draw_all",
    "is_distribution",
    "recipe_of",
    "support_of",
    "together",
    "truncated",
]


class Distribution(Protocol):
    """Anything with ``sample(rng)``; frozen ``scipy.stats`` distributions are taken as well."""

    def sample(self, rng: np.random.Generator) -> float:
        """Draw one value with the given generator."""
        ...


class Recipe(NamedTuple):
    """Form of a distribution in which the C extension draws exactly the values of ``sample``.

    Attributes:
        kind: One of the kinds of ``native/program/draws.h``.
        numbers: The numbers that this kind needs.
        limits: All values lie between these.
    """

    kind: str
    numbers: tuple[float, ...]
    limits: tuple[float, float]


def _kind(name: str) -> Any:
    """A constant field, which tells the kind of a distribution that was turned into a dict."""
    return field(default=name, init=False, repr=False, compare=False)


@dataclass(frozen=True)
class Uniform(KnownArguments):
    """The uniform distribution over ``[low, high)``, drawn as ``rng.uniform(low, high)``.

    Raises:
        ConfigError: If ``low`` is greater than ``high``, or the interval is no finite one.
    """

    low: float
    high: float
    distribution: str = _kind("uniform")

    def __post_init__(self) -> None:
        _take(self, check_number, "low", "high")
        if self.low > self.high:
            raise ConfigError(f"{self}: low must not be greater than high")
        if not math.isfinite(self.high - self.low):
            raise ConfigError(f"{self}: the width must be finite")

    def sample(self, rng: np.random.Generator) -> float:
        """Draw one value."""
        return self.low + (self.high - self.low) * rng.random()

    def support(self) -> tuple[float, float]:
        """Lowest and highest possible value."""
        return float(self.low), float(self.high)

    def _recipe(self, convert: Callable[[Any], float]) -> Recipe:
        return Recipe("uniform", (self.low, self.high - self.low), (self.low, self.high))


@dataclass(frozen=True)
class LogUniform(KnownArguments):
    """The distribution whose logarithm is uniform; ``0 < low <= high``.

    Raises:
        ConfigError: If the bounds are no such numbers.
    """

    low: float
    high: float
    distribution: str = _kind("log_uniform")

    def __post_init__(self) -> None:
        _take(self, check_number, "low", "high")
        if not 0 < self.low <= self.high:
            raise ConfigError(f"{self}: the bounds must satisfy 0 < low <= high")

    def sample(self, rng: np.random.Generator) -> float:
        """Draw one value."""
        return math.exp(rng.uniform(math.log(self.low), math.log(self.high)))

    def support(self) -> tuple[float, float]:
        """Lowest and highest possible value."""
        return float(self.low), float(self.high)

    def _recipe(self, convert: Callable[[Any], float]) -> Recipe:
        low, high = math.log(self.low), math.log(self.high)
        return Recipe("log_uniform", (low, high - low), (0.0, self.high * (1 + 1e-9)))


@dataclass(frozen=True)
class Normal(KnownArguments):
    """The normal distribution, redrawn until the value is finite and lies in ``[low, high]``.

    Raises:
        ConfigError: If the numbers do not make a distribution, or fewer than one draw in a hundred
            would lie within the limits.
    """

    mean: float
    std: float
    low: float = -math.inf
    high: float = math.inf
    distribution: str = _kind("normal")

    def __post_init__(self) -> None:
        _take(self, check_number, "mean", "std")
        _take(self, number_of, "low", "high")
        if self.std < 0:
            raise ConfigError(f"{self}: std must not be negative")
        object.__setattr__(self, "std", abs(self.std))  # numpy refuses -0.0
        if not self.low <= self.mean <= self.high:
            raise ConfigError(f"{self}: mean must lie between low and high")
        if self._probability_within() < _LEAST_SHARE:
            raise ConfigError(f"{self}: low and high are too close for redraws; use Uniform")

    def _probability_within(self) -> float:
        if self.std == 0:
            return 1.0
        limits = (self.low, self.high)
        low, high = (math.erf((limit - self.mean) / self.std / math.sqrt(2)) for limit in limits)
        return (high - low) / 2

    def sample(self, rng: np.random.Generator) -> float:
        """Draw one value; at least one draw in a hundred lies within the limits."""
        while True:
            value = float(rng.normal(self.mean, self.std))
            if self.low <= value <= self.high and math.isfinite(value):
                return value

    def support(self) -> tuple[float, float]:
        """Lowest and highest possible value."""
        return float(self.low), float(self.high)

    def _recipe(self, convert: Callable[[Any], float]) -> Recipe:
        limits = max(self.low, -_LARGEST), min(self.high, _LARGEST)
        return Recipe("normal", (self.mean, self.std, self.low, self.high), limits)


@dataclass(frozen=True)
class Choice(KnownArguments):
    """Distribution over some values, with equal or the given probabilities.

    The values are numbers; for a parameter that is an Enumeration they may be names of its items.

    Raises:
        ConfigError: If there is no value, or the probabilities do not fit.
    """

    values: Sequence[Any]
    probabilities: Sequence[float] | None = None
    distribution: str = _kind("choice")

    def __post_init__(self) -> None:
        values = _items(self.values)
        if not values:
            raise ConfigError(f"Choice: expected a list of at least one value, {_got(self.values)}")
        check = partial(check_number, f"{type(self).__name__}: a value", may_be_boolean=True)
        values = [value if isinstance(value, str) else check(value) for value in values]
        object.__setattr__(self, "values", tuple(values))
        if self.probabilities is not None:
            object.__setattr__(self, "probabilities", self._checked_probabilities())

    def _checked_probabilities(self) -> tuple[float, ...]:
        weights = [number_of("Choice: a probability", one) for one in _items(self.probabilities)]
        fits = len(weights) == len(self.values) and min(weights) >= 0
        if not (fits and abs(sum(weights) - 1) <= 1e-9):
            raise ConfigError(
                "Choice: expected one probability per value, adding up to 1, "
                f"{_got(self.probabilities)}"
            )
        return tuple(weights)

    def sample(self, rng: np.random.Generator) -> Any:
        """Draw one value."""
        index = rng.choice(len(self.values), p=self.probabilities)
        return self.values[int(index)]

    def support(self) -> tuple[float, float]:
        """Lowest and highest possible value."""
        numbers = list(map(float, self.values))
        return min(numbers), max(numbers)

    def _recipe(self, convert: Callable[[Any], float]) -> Recipe:
        values = tuple(map(convert, self.values))
        limits = min(values), max(values)
        if self.probabilities is None:
            return Recipe("choice", values, limits)
        cumulated = np.cumsum(np.array(self.probabilities))
        return Recipe("weighted", (*(cumulated / cumulated[-1]).tolist(), *values), limits)


@dataclass(frozen=True)
class DrawnColumn(Choice):
    """A column of a table of which each episode draws one row, for all of the table's columns.

    By itself it is a ``Choice``.

    Attributes:
        table: Tells which columns belong together.
    """

    table: str = ""


@dataclass(frozen=True)
class Truncated:
    """A distribution of any kind, redrawn until the value lies in ``[low, high]``.

    Raises:
        ConfigError: See ``truncated``.
    """

    distribution: Any
    low: float
    high: float

    def __post_init__(self) -> None:
        if self._probability_within() < _LEAST_SHARE:
            raise ConfigError(f"{shown(self.distribution)}, which hardly ever draws that")

    def _probability_within(self) -> float:
        below = math.nextafter(self.low, -math.inf)
        try:
            return float(self.distribution.cdf(self.high) - self.distribution.cdf(below))
        except Exception:  # no distribution of scipy.stats: it is not known
            return 1.0

    def sample(self, rng: np.random.Generator) -> float:
        """Draw one value.

        Raises:
            ConfigError: If no draw of very many lies within the limits.
        """
        for _ in range(_MOST_REDRAWS):
            value = check_number(f"what {self} draws", draw(self.distribution, rng))
            if self.low <= value <= self.high:
                return value
        raise ConfigError(
            f"{shown(self.distribution)} has not drawn a value between {self.low} and {self.high} "
            f"in {_MOST_REDRAWS} draws"
        )

    def support(self) -> tuple[float, float]:
        """The limits."""
        return self.low, self.high


DISTRIBUTIONS: Final[Mapping[str, type[Any]]] = {
    kind.distribution: kind for kind in (Uniform, LogUniform, Normal, Choice)
}
OWN_DISTRIBUTIONS: Final[tuple[type[Any], ...]] = (*DISTRIBUTIONS.values(), DrawnColumn)
_LARGEST: Final = float(np.finfo(np.float64).max)
_LEAST_SHARE: Final = 0.01
"""Of the draws that must lie within limits, so that there are few redraws."""

_MOST_REDRAWS: Final = 10_000


def support_of(distribution: Any) -> tuple[float, float]:
    """Lowest and highest possible value; infinite if it is not known."""
    if isinstance(distribution, OWN_DISTRIBUTIONS):
        own: tuple[float, float] = distribution.support()
        return own
    with suppress(Exception):  # of scipy.stats, unless it is not of single numbers
        low, high = map(float, distribution.support())
        return low, high
    return -math.inf, math.inf


def truncated(distribution: Any, low: float, high: float) -> Any:
    """The same distribution, whose values are drawn again until they lie in ``[low, high]``.

    So the draws that lie there stay what they are.

    Raises:
        ConfigError: If fewer than one draw in a hundred would lie there, as far as that is known.
    """
    if type(distribution) is Normal:
        low, high = max(low, distribution.low), min(high, distribution.high)
        return replace(distribution, low=low, high=high)
    return Truncated(distribution, low, high)


def as_distribution(what: str, value: Any) -> Any:
    """Turn a dict with the key ``"distribution"`` into the distribution that it describes.

    Args:
        what: The name of the value, for the error.
        value: Such a dict, or anything else, which is returned as it is.

    Raises:
        ConfigError: If there is no such distribution, or the other keys do not fit it.
    """
    if not isinstance(value, Mapping):
        return value
    arguments = check_mapping(what, value)
    if "distribution" not in arguments:
        raise ConfigError(
            f"{what} must be a number or a distribution; a dict needs the key 'distribution', "
            f"{_got(value)}"
        )
    kind = DISTRIBUTIONS[check_option("distribution", arguments.pop("distribution"), DISTRIBUTIONS)]
    known = [one.name for one in fields(kind) if one.init]
    for name in arguments:
        if name not in known:
            raise unknown_name(f"key of the distribution {kind.__name__}", name, known)
    try:
        return kind(**arguments)
    except TypeError:
        missing = [one.name for one in fields(kind) if one.default is MISSING]
        needed = ", ".join(repr(name) for name in missing if name not in arguments)
        raise ConfigError(f"{what}: {kind.__name__} needs {needed}, too") from None


def is_distribution(value: object) -> bool:
    """Whether a value of a config is to be drawn anew at each reset."""
    if value is None or isinstance(value, (float, str, type)):  # quickly: `time` asks it
        return False
    return (
        isinstance(value, OWN_DISTRIBUTIONS)
        or has_method(value, "sample")
        or has_method(value, "rvs")
    )


def draw(value: Any, rng: np.random.Generator) -> Any:
    """Draw from a distribution; anything else is returned as it is.

    Args:
        value: A constant, a ``Distribution`` or a frozen distribution of ``scipy.stats``.
        rng: The generator of the environment.

    Returns:
        The constant, or one number. From a ``Choice`` it may be the name of an item.

    Raises:
        ConfigError: If a distribution of the caller's own fails, or draws no finite number.
    """
    if isinstance(value, OWN_DISTRIBUTIONS):
        return value.sample(rng)
    if not is_distribution(value):
        return value
    try:
        drawn = value.sample(rng) if has_method(value, "sample") else value.rvs(random_state=rng)
    except Exception as error:
        raise ConfigError(f"{shown(value)} cannot be drawn from: {shown(error)}") from error
    if isinstance(drawn, str):
        return drawn
    return check_number(f"what {shown(value)} draws", drawn, may_be_boolean=True)


def draw_all(distributions: Iterable[Any], rng: np.random.Generator) -> list[Any]:
    """Draw from distributions in turn; the first column of a table draws the row of the others.

    Raises:
        ConfigError: As ``draw``.
    """
    places: dict[str, int] = {}
    values = []
    for one in distributions:
        if type(one) is not DrawnColumn:
            values.append(draw(one, rng))
            continue
        if one.table not in places:
            places[one.table] = int(rng.choice(len(one.values)))
        values.append(one.values[places[one.table]])
    return values


def together(distributions: Sequence[Any], recipes: Sequence[Recipe]) -> list[Recipe] | None:
    """Let recipes draw as ``draw_all`` does.

    Args:
        distributions: Distributions to draw from.
        recipes: Recipe of each distribution.

    Returns:
        The recipes; None if columns of a table do not stand side by side.
    """
    found, tables, before = list(recipes), set[str](), ""
    for place, one in enumerate(distributions):
        table = one.table if type(one) is DrawnColumn else ""
        if table and table == before:
            found[place] = found[place]._replace(kind="same_row")
        elif table in tables:
            return None
        tables |= {table} - {""}
        before = table
    return found


def recipe_of(distribution: Any, convert: Callable[[Any], float]) -> Recipe | None:
    """Describe a distribution for the C extension.

    Args:
        distribution: A distribution.
        convert: Turns a value into a number for its variable; raises ``ConfigError`` if it cannot.

    Returns:
        The description, or None if only Python can draw from it.
    """
    if type(distribution) not in OWN_DISTRIBUTIONS:  # a subclass may have its own sample
        return None
    make = getattr(distribution, "_recipe", None)
    if make is None:  # only Python draws from it
        return None
    try:
        recipe: Recipe = make(convert)
        for limit in recipe.limits:
            convert(limit)
    except ConfigError:  # some draws may be errors
        return None
    return recipe


def _items(values: Any) -> list[Any]:
    """Elements of a list; none for other values."""
    if isinstance(values, str | bytes) or not isinstance(values, Iterable):
        return []
    try:
        return list(values)
    except Exception:  # an iterable of the caller's that fails
        return []


def _take(distribution: Any, check: Callable[[str, Any], float], *names: str) -> None:
    """Turn fields into floats that a check lets through."""
    for name in names:
        value = check(f"{type(distribution).__name__}: {name}", getattr(distribution, name))
        object.__setattr__(distribution, name, value)


def _got(value: Any) -> str:
    return f"got {shown(value)}"
