"""Controllers from a line of text, for the command line."""

from __future__ import annotations

import contextlib
import inspect
import math
import re
import shlex
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final, TypeGuard

import numpy as np

from fmugym.checks import check_text
from fmugym.control.controller import Controller
from fmugym.control.controller_table import (
    ControllerTable,
    Signal,
    controller_in,
    is_table,
    named_controllers,
    naming,
    table_in,
    text_of,
    with_controller,
)
from fmugym.control.mpc import MPC
from fmugym.control.standard_controllers import PID, Hysteresis, Schedule
from fmugym.environment.distributions import LogUniform, Uniform
from fmugym.errors import ConfigError, shown, unknown_name
from fmugym.pool.pool import FloatArray

__all__ = [
    "TunableController",
    "controller_of",
    "has_range",
    "plans_ahead",
    "search_of",
    "simple_controllers",
    "warmed",
]

_KINDS: Final[dict[str, type[Controller]]] = {"hysteresis": Hysteresis, "mpc": MPC, "pid": PID}

_UNTUNED: Final = {"mpc", "schedule"}

_EXAMPLES: Final[dict[type[Controller], str]] = {
    Hysteresis: "hysteresis of=T setpoint=21 band=0.5",
    MPC: "mpc horizon=24h",
    PID: "pid of=T setpoint=21 kp=0.5",
}

_RANGE: Final = re.compile(r"\.\.(?=[^.])")

_DECADE: Final = 10.0
"""Ranges whose ends differ by this factor are searched on a logarithmic scale."""

_DIGITS: Final = 5
"""Significant digits of the numbers of a search, so that a text holds all of them."""

_MARGIN: Final = 0.01
"""A number is at an end of its range within this fraction of the range."""


def controller_of(text: str | Mapping[str, Any]) -> Controller:
    """Make the controller that a text names.

    Args:
        text: ``"pid of=T setpoint=21 kp=0.5 ti=14400"``, ``"hysteresis of=T setpoint=T_set
            band=0.5"`` with the arguments of the classes, ``"schedule 06:00=1 22:00=0.3"``, or
            ``"mpc horizon=24h warm='pid of=T setpoint=21 kp=0.5'"``. Or a dict with such a text,
            or a number, for each action; its text is a table of TOML,
            ``'{ u = "pid of=T setpoint=21 kp=0.5", v = 0 }'``.

    Raises:
        ConfigError: If there is no such controller, or its arguments are wrong.
    """
    if is_table(text):
        return _table(table_in(text), {})
    kind, arguments = _parts(check_text("controller", text))
    if kind == "schedule":
        return Schedule(arguments)
    for name, value in arguments.items():
        if has_range(value):
            raise ConfigError(
                f"{name}={value} is a range, of which 'fmugym tune' and 'fmugym train' find the "
                "best number"
            )
    if isinstance(arguments.get("warm"), str):
        arguments["warm"] = controller_of(arguments["warm"])
    return _made(_KINDS[kind], arguments)


def _parts(text: str) -> tuple[str, dict[str, Any]]:
    """The kind of a controller and its arguments."""
    try:
        kind, *words = shlex.split(text)
    except ValueError:  # empty, or a quotation mark without its other half
        raise ConfigError(f"expected a controller and its arguments, got {shown(text)}") from None
    if kind not in (*_KINDS, "schedule"):
        raise unknown_name("controller", kind, [*_KINDS, "schedule"])
    return kind, dict(map(_argument, words))


class TunableController(ABC):
    """A controller some of whose numbers are to be found.

    Attributes:
        ranges: The numbers to be found, each with the values to be tried.
    """

    ranges: Mapping[str, Uniform | LogUniform]

    @abstractmethod
    def make(self, **numbers: Any) -> Controller:
        """Make the controller with some numbers, which are rounded as in ``text``."""

    @abstractmethod
    def text(self, numbers: Mapping[str, Any]) -> str:
        """The controller with some numbers, as ``controller_of`` reads it."""

    @abstractmethod
    def numbers(self, found: Mapping[str, Any]) -> dict[str, Any]:
        """The numbers as ``text`` has them."""

    def middle(self) -> Controller:
        """Make the controller with the middle of each range."""
        middles = {
            name: math.sqrt(one.low * one.high)
            if isinstance(one, LogUniform)
            else (one.low + one.high) / 2
            for name, one in self.ranges.items()
        }
        return self.make(**middles)

    def at_an_end(self, found: Mapping[str, float]) -> list[str]:
        """The numbers that are within a hundredth of an end of their ranges."""
        return [name for name, one in self.ranges.items() if _is_at_an_end(one, found[name])]


@dataclass(frozen=True)
class TextSearch(TunableController):
    """The search for numbers of a controller that a text names.

    Attributes:
        kind: The name of its class in texts.
        fixed: The arguments that are given.
        ranges: See ``TunableController``.
        negative: The names of those whose values are minus those in ``ranges``.
    """

    kind: str
    fixed: Mapping[str, Any]
    ranges: Mapping[str, Uniform | LogUniform]
    negative: frozenset[str] = frozenset()

    def make(self, **numbers: Any) -> Controller:
        """See ``TunableController.make``."""
        return _made(_KINDS[self.kind], {**self.fixed, **self.numbers(numbers)})

    def text(self, numbers: Mapping[str, Any]) -> str:
        """See ``TunableController.text``."""
        found = self.numbers(numbers)
        given = {name: found.get(name, value) for name, value in self._in_order().items()}
        words = [f"{name}={str(value).removesuffix('.0')}" for name, value in given.items()]
        return shlex.join([self.kind, *words])

    def numbers(self, found: Mapping[str, Any]) -> dict[str, Any]:
        """See ``TunableController.numbers``."""
        return {
            name: _rounded(-value if name in self.negative else value)
            for name, value in found.items()
        }

    def _in_order(self) -> dict[str, Any]:
        everything = {**self.fixed, **self.ranges}
        order = list(inspect.signature(_KINDS[self.kind]).parameters)
        return {name: everything[name] for name in order if name in everything}


@dataclass(frozen=True)
class TableSearch(TunableController):
    """The search for all numbers of a table, whose names are such as ``"u.kp"``.

    Attributes:
        entries: Entries of the table.
        searches: By entry, those of the controllers that have ranges.
    """

    entries: Mapping[str, Any]
    searches: Mapping[str, TunableController]

    @property
    def ranges(self) -> Mapping[str, Uniform | LogUniform]:  # type: ignore[override]  # a field there
        """See ``TunableController``."""
        return {
            f"{name}.{key}": one
            for name, search in self.searches.items()
            for key, one in search.ranges.items()
        }

    def make(self, **numbers: Any) -> Controller:
        """See ``TunableController.make``."""
        own = self._divided(numbers)
        return _table(self.entries, {n: one.make(**own[n]) for n, one in self.searches.items()})

    def text(self, numbers: Mapping[str, Any]) -> str:
        """See ``TunableController.text``."""
        own = self._divided(numbers)
        texts = {name: one.text(own[name]) for name, one in self.searches.items()}
        return text_of(
            {
                name: with_controller(entry, texts.get(name, controller_in(entry)))
                for name, entry in self.entries.items()
            }
        )

    def numbers(self, found: Mapping[str, Any]) -> dict[str, Any]:
        """See ``TunableController.numbers``."""
        own = self._divided(found)
        return {
            f"{name}.{key}": value
            for name, search in self.searches.items()
            for key, value in search.numbers(own[name]).items()
        }

    def _divided(self, numbers: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
        """The numbers of each entry."""
        found: dict[str, dict[str, Any]] = {name: {} for name in self.searches}
        for name, value in numbers.items():
            entry, _, key = name.rpartition(".")
            found[entry][key] = value
        return found


def search_of(text: str | Mapping[str, Any]) -> TunableController:
    """Read a controller of which some numbers are ranges.

    Args:
        text: As for ``controller_of``, with ``LOW..HIGH`` in the place of numbers that are to be
            found: ``"pid of=T setpoint=20..22 kp=0.05..5 ti=1800..400000"``. A range whose ends
            have one sign and differ by a factor of ten or more is searched on a logarithmic scale.
            The ranges of all entries of a table count.

    Raises:
        ConfigError: If there is no such controller, nothing is to be found, or an argument is
            wrong.
    """
    search = _table_search(table_in(text)) if is_table(text) else _text_search(str(text))
    if not search.ranges:
        raise ConfigError(
            f"nothing in {shown(text)} is to be found; give a range in the place of a number, "
            "such as kp=0.05..5"
        )
    for end in ("low", "high"):  # raises for wrong arguments
        search.make(**{name: getattr(one, end) for name, one in search.ranges.items()})
    return search


def _table_search(entries: Mapping[str, Any]) -> TableSearch:
    given = {name: controller_in(entry) for name, entry in entries.items()}
    searches = {}
    for name, one in given.items():
        if has_range(one):
            with naming(name):
                searches[name] = search_of(one)
    return TableSearch(entries, searches)


def _text_search(text: str) -> TextSearch:
    kind, arguments = _parts(text)
    if kind in _UNTUNED:
        known = ", ".join(sorted(_KINDS.keys() - _UNTUNED))
        raise ConfigError(f"{kind!r} cannot be tuned; known are: {known}")
    ends = {name: _ends(name, value) for name, value in arguments.items() if has_range(value)}
    negative = frozenset(name for name, (_, high) in ends.items() if high < 0)
    ranges = {
        name: _range(-high, -low) if name in negative else _range(low, high)
        for name, (low, high) in ends.items()
    }
    fixed = {name: value for name, value in arguments.items() if name not in ranges}
    return TextSearch(kind, fixed, ranges, negative)


def plans_ahead(text: Any) -> bool:
    """Whether a text names a controller that plans with copies, and so takes its time."""
    return isinstance(text, str) and text.split()[:1] == ["mpc"]


def simple_controllers(texts: Mapping[str, Any]) -> list[Controller]:
    """The controllers of a task file that do not plan; ranges in them have their middle."""
    named = named_controllers(texts).values()
    given = [one for one in named if isinstance(one, str) and not plans_ahead(one)]
    return [search_of(one).middle() if has_range(one) else controller_of(one) for one in given]


def warmed(text: str, warm: str | None) -> str:
    """A controller that plans ahead, and begins with the plan of another one if it names none."""
    _, arguments = _parts(text)
    return text if warm is None or "warm" in arguments else f"{text} {shlex.quote(f'warm={warm}')}"


def has_range(text: Any) -> TypeGuard[str]:
    """Whether a text has ``LOW..HIGH`` in the place of a number."""
    return isinstance(text, str) and _RANGE.search(text) is not None


def _ends(name: str, value: str) -> tuple[float, float]:
    try:
        low, high = map(float, _RANGE.split(value, maxsplit=1))
    except ValueError:
        raise ConfigError(f"expected a range such as {name}=0.05..5, got {shown(value)}") from None
    if low > high:
        raise ConfigError(f"{name}={value}: the first end of a range is the lower one")
    return low, high


def _range(low: float, high: float) -> Uniform | LogUniform:
    is_wide = low > 0 and high >= _DECADE * low
    return LogUniform(low, high) if is_wide else Uniform(low, high)


def _is_at_an_end(given: Uniform | LogUniform, value: float) -> bool:
    low, high = given.low, given.high
    if isinstance(given, LogUniform):
        low, high, value = math.log(low), math.log(high), math.log(value)
    return min(value - low, high - value) <= _MARGIN * (high - low)


def _rounded(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        rounded: FloatArray = np.array([_rounded(one) for one in value.tolist()])
        return rounded
    return float(f"{value:.{_DIGITS}g}")


def _argument(word: str) -> tuple[str, Any]:
    name, separator, value = word.partition("=")
    if not separator:
        raise ConfigError(f"expected an argument such as 'kp=0.5', got {shown(word)}")
    for read in (int, float):
        with contextlib.suppress(ValueError):
            return name, read(value)
    return name, {"true": True, "false": False}.get(value, value)


def _table(entries: Mapping[str, Any], made: Mapping[str, Controller]) -> ControllerTable:
    """Make a table, some of whose controllers are made already."""
    found: dict[str, Any] = {}
    for name, entry in entries.items():
        one: Any = made.get(name, controller_in(entry))
        with naming(name):
            one = controller_of(one) if isinstance(one, str) else one
            is_signal = isinstance(entry, Mapping)
            found[name] = Signal(one, entry["min"], entry["max"]) if is_signal else one
    return ControllerTable(found)


def _made(cls: type[Controller], arguments: dict[str, Any]) -> Controller:
    parameters = inspect.signature(cls).parameters
    for name in arguments:
        if name not in parameters:
            raise unknown_name(f"argument of {cls.__name__}", name, parameters)
    for name, parameter in parameters.items():
        if parameter.default is parameter.empty and name not in arguments:
            raise ConfigError(
                f"{cls.__name__} needs the argument {name!r}, as in {_EXAMPLES[cls]!r}"
            )
    return cls(**arguments)
