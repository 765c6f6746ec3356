"""Variables of an FMU, in one form for the three FMI versions: scalars, arrays and clocks.

These types hold the rules for which variable may be set when.

Numbers stand for the start values of Strings: between the draws and an FMU all start values are
float64. A String holds the texts that it may get as items, as an Enumeration does; the number of a
text is its place among them. It means nothing without the variable: what outlives a list of
variables holds the text.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from itertools import product
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt

from fmugym.checks import check_number, integer_of
from fmugym.errors import ConfigError, shown, unknown_name

__all__ = [
    "CLOCK_KINDS",
    "LARGEST_EXACT_INTEGER",
    "MOST_ELEMENTS",
    "MOST_FRACTIONS",
    "OWN",
    "UNKNOWN",
    "Interval",
    "Texts",
    "Variable",
    "checked_value",
    "start_of",
    "texts_at",
    "texts_of",
    "unknown_rest",
    "unlisted",
    "values_by_name",
    "with_texts",
]

_KINDS = {
    "Real": "real",
    "Float32": "real",
    "Float64": "real",
    "Boolean": "boolean",
    "Enumeration": "enumeration",
    "String": "string",
    "Binary": "binary",
    "Clock": "boolean",
    "StartTime": "real",  # no type of FMI; see ``fmugym.pool.pool_spec.START_TIME``
}
_INTEGERS = {"Integer": "int32", "Enumeration": "int64"}
"""The types that numpy calls otherwise."""


_NO_LIMIT: Final = 1e30
_LARGEST_FLOAT32: Final = float(np.finfo(np.float32).max)
LARGEST_EXACT_INTEGER: Final = 2.0**53
"""Up to here, float64 holds every integer."""

MOST_ELEMENTS: Final = 100_000
"""The most elements of an array whose elements have names."""

CLOCK_KINDS = (
    "constant",
    "fixed",
    "calculated",
    "tunable",
    "changing",
    "countdown",
    "triggered",
)
"""Interval variabilities of clocks; all but the last one have ticks of their own."""

MOST_FRACTIONS: Final = 2**52
"""The largest counter and resolution of an interval: float64 can hold a few of them exactly."""


OWN: Final = ("name", "value_reference", "start", "description")
"""Attributes in which most variables differ, in the order in which ``Variable.sibling`` takes
them."""


class Interval(NamedTuple):
    """A time between two ticks of a clock, or before the first one.

    Attributes:
        seconds: NaN where only the FMU knows.
        counter: The same in units of a second divided by the resolution, which is exact.
        resolution: 0 where the time is no such fraction.
    """

    seconds: float
    counter: int = 0
    resolution: int = 0

    @classmethod
    def of_fraction(cls, counter: int, resolution: int) -> Interval:
        """Make one from a fraction of a second; both numbers are at most ``MOST_FRACTIONS``."""
        return cls(counter / resolution, counter, resolution)


UNKNOWN: Final = Interval(math.nan)
"""Only the FMU knows the interval."""


@dataclass(frozen=True, eq=False)
class Variable:
    """One variable of the model description, in the terms of the FMI standard.

    A task adds bounds and a sampling to what it uses.

    Attributes:
        type: The standard's own name: ``Real``, ``Float64``, ``Int32``, ...
        start: The start value as the XML has it.
        minimum, maximum: Infinite where neither the variable nor its declared type gives a number.
        relative: Whether it is a difference, whose unit is converted without an offset.
        nominal: None where neither the variable nor its declared type gives a finite number.
        items: Names and values of an enumeration. Of a String, the texts that it may get and their
            places among these; see ``fmugym.fmi.variable``.
        shape: The shape of an array (FMI 3.0); () for a scalar.
        dimensions: Of an array, for each dimension the structural parameter that gives its length;
            "" for a fixed length.
        array: Of an element of an array, the array; None for other variables.
        place: Of an element, its place in the array, in row-major order. 0 in systems.
        driven: Of an array of a system, the places of the elements that something else drives;
            None for arrays of FMUs. FMUs get and set arrays as a whole; in systems each element has
            a value reference of its own, the first one that of the array.
        negated: Whether its value is that behind its value reference with the other sign, or of a
            Boolean the opposite: a negated alias of FMI 1.0. All other attributes are its own.
        clocks: The value references of the clocks that must tick whenever the value changes.
        ticking: Of a clock: one of ``CLOCK_KINDS``; "" for other variables.
        interval, shift: Of a clock: the time between its ticks and that before the first one.
        by_fractions: Of a clock: whether the FMU takes and tells these times as fractions.
        bounds: The limits that a task gives in the place of minimum and maximum; None if it gives
            none.
        sampling: What a step of a task gives of the values after each substep, one of
            ``fmugym.pool.pool_spec.SAMPLINGS``.
    """

    name: str
    type: str
    value_reference: int
    causality: str
    variability: str
    initial: str | None
    start: str | None = None
    unit: str | None = None
    relative: bool = False
    minimum: float = -math.inf
    maximum: float = math.inf
    nominal: float | None = None
    description: str = ""
    items: tuple[tuple[str, int], ...] = ()
    shape: tuple[int, ...] = ()
    dimensions: tuple[str, ...] = ()
    array: Variable | None = None
    place: int = 0
    driven: frozenset[int] | None = None
    negated: bool = False
    clocks: tuple[int, ...] = ()
    ticking: str = ""
    interval: Interval = UNKNOWN
    shift: Interval = UNKNOWN
    by_fractions: bool = False
    bounds: tuple[float, float] | None = None
    sampling: str = "last"

    @cached_property
    def shared(self) -> Mapping[str, Any]:
        """Attributes by name that siblings share, all but the ones that ``sibling`` takes."""
        return {f.name: getattr(self, f.name) for f in fields(self) if f.name not in OWN}

    def sibling(
        self, name: str, value_reference: int, start: str | None, description: str
    ) -> Variable:
        """Make a variable that has these attributes, and all others of this one.

        ``replace`` takes many times as long, which counts where there are 50,000 variables.
        """
        other = object.__new__(Variable)
        attributes = other.__dict__
        attributes.update(self._attributes)
        attributes["name"] = name
        attributes["value_reference"] = value_reference
        attributes["start"] = start
        attributes["description"] = description
        return other

    @cached_property
    def _attributes(self) -> Mapping[str, Any]:
        """Attributes that ``sibling`` copies, and ``shared``, which need not be made again."""
        return {f.name: getattr(self, f.name) for f in fields(self)} | {"shared": self.shared}

    @cached_property
    def kind(self) -> str:
        """Kind of the type: real, integer, boolean, enumeration, string or binary.

        A clock is a Boolean: whether it ticks.
        """
        return _KINDS.get(self.type, "integer")

    @property
    def is_scalar(self) -> bool:
        """Whether it is neither an array nor an element of one."""
        return not self.shape and self.array is None

    @property
    def numeric(self) -> bool:
        """Whether a float64 can hold it: a scalar real, integer, Boolean or enumeration.

        A clock has no value between its ticks.
        """
        return self.is_number and not self.shape and not self.ticking

    @property
    def is_number(self) -> bool:
        """Whether float64 can hold the value, or the values of the elements."""
        return self.kind in {"real", "integer", "boolean", "enumeration"}

    @property
    def is_text(self) -> bool:
        """Whether it is a scalar String."""
        return self.kind == "string" and self.is_scalar

    @property
    def is_structural(self) -> bool:
        """Whether it is a structural parameter: arrays get their sizes by it."""
        return self.causality == "structuralParameter"

    @property
    def settable_at_start(self) -> bool:
        """Whether a value may be set between instantiation and initialization."""
        if self.variability == "constant" or self.ticking:
            return False
        return self.causality == "input" or self.initial in {"exact", "approx"}

    @property
    def settable_in_step(self) -> bool:
        """Whether a value may be set between two steps."""
        tunable = self.causality == "parameter" and self.variability == "tunable"
        if self.ticking:
            return self.causality == "input" and self.ticking == "triggered"
        return self.causality == "input" or tunable

    @property
    def number(self) -> int:
        """Of a clock: its kind as ``enum ClockKind`` of ``native/model_exchange/clock.h``."""
        is_output = self.ticking == "triggered" and self.causality != "input"
        return len(CLOCK_KINDS) if is_output else CLOCK_KINDS.index(self.ticking)

    @property
    def range(self) -> tuple[float, float]:
        """The bounds of the task, or else minimum and maximum."""
        return (self.minimum, self.maximum) if self.bounds is None else self.bounds

    @property
    def extremes(self) -> tuple[float, float]:
        """The lowest and the highest value: of a Boolean, of the items, or else of the range."""
        if self.kind == "boolean":
            return 0.0, 1.0
        values = [value for _, value in self.items]
        return (min(values), max(values)) if values else self.range

    @property
    def limits(self) -> tuple[float, float]:
        """Minimum and maximum that mean something; infinite for others.

        Some exporters write the largest number, or the same one twice, where there is none.
        """
        low, high = self.minimum, self.maximum
        if low >= high:
            return -math.inf, math.inf
        return (low if low > -_NO_LIMIT else -math.inf), (high if high < _NO_LIMIT else math.inf)

    @property
    def start_number(self) -> float:
        """The start value of a numeric scalar or element; 0 if the FMU gives none.

        Raises:
            ConfigError: If it is not a finite number.
        """
        return _number(self.name, "0" if self.start is None else self.start)

    @cached_property
    def start_numbers(self) -> tuple[float, ...]:
        """The start values of the elements of a numeric array, in row-major order.

        A single start value is that of all elements; without any they are 0.

        Raises:
            ConfigError: If there is another number of them, or one is not a finite number.
        """
        return tuple(element.start_number for element in self.elements)

    @property
    def size(self) -> int:
        """The number of values that FMI moves when it moves this variable; 1 for a scalar."""
        if self.array is None or self.is_apart:
            return math.prod(self.shape)
        return math.prod(self.array.shape)

    @property
    def is_apart(self) -> bool:
        """Whether it is an element that is got and set by itself, as elements of systems are."""
        return self.array is not None and self.array.driven is not None

    @cached_property
    def elements(self) -> tuple[Variable, ...]:
        """The elements of an array in row-major order: ``y[1,1]``, ``y[1,2]``, ...

        A scalar is its own only element.

        Raises:
            ConfigError: If there are too many to name each.
        """
        if not self.shape:
            return (self,)
        if self.size > MOST_ELEMENTS:
            raise ConfigError(
                f"{self.name!r} is an array of {self.size} elements, at most {MOST_ELEMENTS} can "
                "be used"
            )
        places = list(product(*map(range, self.shape)))
        starts = self._starts_of(len(places))
        elements = (
            replace(
                self,
                name=f"{self.name}[{_index(place)}]",
                shape=(),
                dimensions=(),
                array=self,
                place=number,
                start=starts[number],
                driven=None,
            )
            for number, place in enumerate(places)
        )
        return tuple(elements if self.driven is None else map(self._apart, elements))

    def _apart(self, element: Variable) -> Variable:
        """Element of an array of a system; a driven one cannot be set."""
        assert self.driven is not None
        reference = self.value_reference + element.place
        alone = replace(element, value_reference=reference, place=0)
        if element.place not in self.driven:
            return alone
        return replace(alone, causality="local", initial=None)

    def _starts_of(self, count: int) -> list[str | None]:
        """Start value of each element; all of them where their number is wrong."""
        texts = (self.start or "").split()
        return [*texts] if len(texts) == count else [self.start] * count

    def resized(self, sizes: Mapping[str, int]) -> Variable:
        """The same variable with these values of structural parameters.

        The start values of an array of another size are those of the FMU, and not known.
        """
        if self.name in sizes:
            return replace(self, start=str(sizes[self.name]))
        pairs = zip(self.dimensions, self.shape, strict=True) if self.dimensions else ()
        shape = tuple(sizes.get(name, length) for name, length in pairs) or self.shape
        return self if shape == self.shape else replace(self, shape=shape, start=None)

    @property
    def integer_limits(self) -> tuple[int, int]:
        """The range of the C type of an integer or enumeration."""
        limits = np.iinfo(_INTEGERS.get(self.type, self.type.lower()))
        low, high = int(limits.min), int(limits.max)
        return (-high, -low) if self.negated else (low, high)


def checked_value(variable: Variable, value: Any) -> float:
    """Convert a value for a variable to a number, without loss.

    Of a String, this is the place of the text among those that the variable knows.

    Raises:
        ConfigError: If the value is not finite, not of the variable's kind, or outside its type's
            range.
    """
    if isinstance(value, str) and variable.items:
        return _item_value(variable, str.__str__(value))
    if variable.kind == "string":
        raise ConfigError(f"{variable.name!r} is a String, got {shown(value)}")
    number = check_number(repr(variable.name), value, may_be_boolean=variable.kind == "boolean")
    if variable.type == "Float32" and abs(number) > _LARGEST_FLOAT32:
        raise ConfigError(f"{variable.name!r} is a Float32, too narrow for {number}")
    if variable.kind == "boolean" and number not in {0.0, 1.0}:
        raise ConfigError(f"{variable.name!r} is a Boolean, got {number}")
    if variable.kind in {"integer", "enumeration"}:
        whole = integer_of(value)  # which no float has rounded
        _check_integer(variable, number if whole is None else whole)
    return number


def _item_value(variable: Variable, name: str) -> float:
    items = dict(variable.items)
    if name not in items:
        raise unknown_name(f"item of {variable.name!r}", name, items)
    return float(items[name])


def _check_integer(variable: Variable, number: float) -> None:
    low, high = variable.integer_limits
    if not float(number).is_integer() or not low <= number <= high:
        raise ConfigError(
            f"{variable.name!r} is of type {variable.type}: expected an integer from {low} to "
            f"{high}, got {number}"
        )
    if abs(number) > LARGEST_EXACT_INTEGER:
        raise ConfigError(f"{variable.name!r}: integers beyond 2**53 are not exact, got {number}")
    values = [value for _, value in variable.items]
    if values and number not in values:
        listing = ", ".join(f"{value} ({name})" for name, value in variable.items)
        raise ConfigError(f"{variable.name!r}: expected one of {listing}, got {number:g}")


def unlisted(variables: Sequence[Variable]) -> list[Variable]:
    """Find missing elements of arrays of which some elements are listed.

    FMI moves whole arrays only. Elements that are not listed keep their start values.
    """
    listed = {variable.name for variable in variables}
    arrays = dict.fromkeys(v.array for v in variables if v.array is not None and not v.is_apart)
    return [one for array in arrays for one in array.elements if one.name not in listed]


def unknown_rest(variables: Sequence[Variable]) -> tuple[Variable, Variable] | None:
    """Find an unlisted element whose start value nobody knows, since its array was resized.

    Returns:
        The element and its array; None if there is no such element.
    """
    for missing in unlisted(variables):
        array = missing.array
        if array is not None and array.start is None and array.dimensions:
            return missing, array
    return None


def _number(name: str, text: str) -> float:
    try:
        number = float({"true": "1", "false": "0"}.get(text, text))
    except ValueError:
        number = math.nan
    if not math.isfinite(number):
        raise ConfigError(f"the start value of {name!r} is {text!r}, expected a finite number")
    return number


def _index(place: tuple[int, ...]) -> str:
    """The index of an element as Modelica writes it: the first one is 1."""
    return ",".join(str(number + 1) for number in place)


Texts = Sequence[str] | npt.NDArray[np.object_]
"""Texts by their places; in an array may be None."""


def with_texts(variable: Variable, texts: Iterable[str]) -> Variable:
    """The same String with the texts that it may get as items, each once, in their order.

    The same arguments give the same variable.
    """
    return _with_texts(variable, tuple(dict.fromkeys(map(str.__str__, texts))))


@functools.lru_cache(4096)
def _with_texts(variable: Variable, texts: tuple[str, ...]) -> Variable:
    return replace(variable, items=tuple((text, place) for place, text in enumerate(texts)))


def start_of(variable: Variable, value: Any) -> tuple[Variable, float]:
    """A variable that starts with a value, and the number for it; a String knows only this text.

    Raises:
        ConfigError: If the value is neither a number that fits nor the text of a String.
    """
    is_text = variable.kind == "string" and isinstance(value, str)
    own = with_texts(variable, [value]) if is_text else variable
    return own, checked_value(own, value)


def texts_of(variable: Variable) -> tuple[str, ...]:
    """The texts that a String may get, in the order of their numbers."""
    return tuple(text for text, _ in variable.items)


def texts_at(texts: Texts, numbers: Any) -> Any:
    """The text at the place that a number tells, or None if there is none.

    Args:
        texts: The texts.
        numbers: A number, or an array of numbers.

    Returns:
        The text; of an array, an array of objects of the same shape.
    """
    if isinstance(numbers, float):
        return texts[int(numbers)] if 0 <= numbers < len(texts) else None
    found = np.full(np.shape(numbers), None, object)
    present = (numbers >= 0) & (numbers < len(texts))
    found[present] = np.array(texts, object)[numbers[present].astype(np.int64)]
    return found


def values_by_name(
    variables: Iterable[Variable], numbers: Iterable[float]
) -> dict[str, float | str]:
    """Values of variables by name, with texts for Strings."""
    return {
        variable.name: variable.items[int(number)][0] if variable.kind == "string" else number
        for variable, number in zip(variables, numbers, strict=True)
    }
