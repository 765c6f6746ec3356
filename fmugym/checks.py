"""Checks of single values that many arguments share.

Each check takes the name of the value for the error, and any object at all, also one whose own
methods fail. It returns the value in its plain Python type, or raises ``ConfigError``.
"""

from __future__ import annotations

import errno
import inspect
import math
import operator
import os
import re
import stat
import unicodedata
from collections.abc import Callable, Collection, Iterable, Mapping
from contextlib import suppress
from functools import cache
from numbers import Real
from pathlib import Path
from typing import Any, Final, Self, TypeVar

import numpy as np

from fmugym.errors import ArgumentError, ConfigError, shown, unknown_argument, unknown_name

__all__ = [
    "LARGEST_COUNT",
    "KnownArguments",
    "Spellings",
    "by_own_names",
    "check_count",
    "check_dict",
    "check_flag",
    "check_integer",
    "check_mapping",
    "check_number",
    "check_option",
    "check_path",
    "check_seed",
    "check_text",
    "duration",
    "flattened",
    "float_or_nan",
    "has_method",
    "integer_of",
    "normal_form",
    "number_of",
    "parts_of_array",
    "refuse_positional",
    "require_regular",
]

_Value = TypeVar("_Value")

LARGEST_COUNT: Final = 2**31 - 1
"""The largest number of steps or threads that can be asked for."""

_SECONDS: Final = {"ms": 1e-3, "s": 1.0, "min": 60.0, "h": 3600.0, "d": 86400.0}
_NEGATIVE: Final = re.compile(r"\s*-\s*\d")
_PART: Final = re.compile(r"\s*(\d+(?:\.\d*)?(?:[eE][+-]?\d+)?)\s*(ms|s|min|h|d)(?![A-Za-z])")

_BY_NAME: Final = (inspect.Parameter.POSITIONAL_OR_KEYWORD, inspect.Parameter.KEYWORD_ONLY)


class KnownArguments:
    """Base of classes whose constructors name the nearest argument for a misspelt one.

    Raises:
        ArgumentError: If there is no argument of a name; that is a ``TypeError``, too.
    """

    __slots__ = ()

    def __new__(cls, *_: Any, **given: Any) -> Self:
        """Check the names; the class's own ``__init__`` gets the arguments."""
        if given:
            own = list(inspect.signature(cls.__init__).parameters.values())[1:]
            known = [one.name for one in own if one.kind in _BY_NAME]
            takes_any = any(one.kind is one.VAR_KEYWORD for one in own)
            unknown = [] if takes_any else [name for name in given if name not in known]
            for name in unknown:
                raise unknown_argument(cls.__name__, name, known)
        return super().__new__(cls)


def check_number(
    what: str,
    value: Any,
    minimum: float = -math.inf,
    maximum: float = math.inf,
    *,
    positive: bool = False,
    may_be_infinite: bool = False,
    may_be_boolean: bool = False,
) -> float:
    """Return a value as a float of a range.

    Args:
        what: The name of the value, for the error.
        value: Any object.
        minimum: The lowest number allowed.
        maximum: The highest number allowed.
        positive: Whether 0 is refused too.
        may_be_infinite: Whether infinity is allowed.
        may_be_boolean: Whether True and False are allowed, as for variables that may be Booleans.

    Raises:
        ConfigError: If it is no number, NaN, or out of its range.
    """
    number = number_of(what, value, may_be_boolean=may_be_boolean)
    in_range = minimum <= number <= maximum and (number > 0 or not positive)
    if in_range and (may_be_infinite or math.isfinite(number)):
        return number
    wanted = _range(minimum, maximum, positive, may_be_infinite)
    raise ConfigError(f"{what} must be {wanted}, got {shown(value)}")


def _range(minimum: float, maximum: float, positive: bool, may_be_infinite: bool) -> str:
    kind = "a number" if may_be_infinite else "finite"
    if maximum < math.inf:
        return f"{kind} from {minimum:g} to {maximum:g}"
    if positive:
        return "positive" if may_be_infinite else "positive and finite"
    if minimum == 0:
        return f"{kind} and not negative"
    return kind if minimum == -math.inf else f"{kind} and at least {minimum:g}"


def number_of(what: str, value: Any, *, may_be_boolean: bool = False) -> float:
    """Return a value as a float, finite or not.

    Raises:
        ConfigError: If it is no real number.
    """
    if type(value) is float:
        return value
    if _is_real(value) and (may_be_boolean or not _is_boolean(value)):
        with suppress(Exception):  # the number is too large, or the object's own method fails
            return float(value)
    raise ConfigError(f"{what} must be a number, got {shown(value)}")


def float_or_nan(value: Any) -> float:
    """Return a value as a float; NaN if it is no real number."""
    try:
        return number_of("", value, may_be_boolean=True)
    except ConfigError:
        return math.nan


def _is_real(value: Any) -> bool:
    if issubclass(type(value), np.ndarray | np.generic):
        return value.ndim == 0 and value.dtype.kind in "fiubO"
    return issubclass(type(value), Real) or (
        hasattr(type(value), "__float__") and not issubclass(type(value), str | bytes)
    )


def _is_boolean(value: Any) -> bool:
    if issubclass(type(value), np.ndarray):
        return bool(value.ndim == 0 and value.dtype == np.bool_)
    return issubclass(type(value), bool | np.bool_)


def check_count(what: str, value: Any, largest: int = LARGEST_COUNT) -> int:
    """Return a value as a positive integer.

    Raises:
        ConfigError: With the name and the value.
    """
    number = integer_of(value)
    if number is None or not 0 < number <= largest:
        bound = "" if number is None or number < 1 else f" of at most {largest}"
        raise ConfigError(f"{what} must be a positive integer{bound}, got {shown(value)}")
    return number


def check_integer(what: str, value: Any, minimum: int, maximum: int) -> int:
    """Return a value as an integer of a range.

    Raises:
        ConfigError: With the name and the value.
    """
    number = integer_of(value)
    if number is None or not minimum <= number <= maximum:
        raise ConfigError(
            f"{what} must be an integer from {minimum} to {maximum}, got {shown(value)}"
        )
    return number


def refuse_positional(given: tuple[object, ...]) -> None:
    """Refuse arguments of ``reset`` that are given without their names.

    Raises:
        ArgumentError: If there are some.
    """
    if given:
        raise ArgumentError(f"reset takes its arguments by name: reset(seed={shown(given[0])})")


def check_seed(value: Any) -> int | None:
    """Return a seed as Gymnasium takes it: an integer that is not negative, or None.

    Raises:
        ConfigError: With the value.
    """
    if value is None:
        return None
    number = integer_of(value)
    if number is None or number < 0:
        raise ConfigError(f"seed must be an integer of at least 0, or None, got {shown(value)}")
    return number


def integer_of(value: Any) -> int | None:
    """Return a value as an int; None if it is no integer, or a Boolean."""
    if type(value) is int:
        return value
    if isinstance(value, bool | np.bool_):
        return None
    try:
        return int(operator.index(value))
    except Exception:  # a TypeError; or the object's own method fails
        return None


def check_flag(what: str, value: Any) -> bool:
    """Return a value as True or False; 0 and 1 will do.

    Raises:
        ConfigError: If it is something else.
    """
    if isinstance(value, bool | np.bool_):
        return bool(value)
    number = integer_of(value)
    if number not in {0, 1}:
        raise ConfigError(f"{what} must be True or False, got {shown(value)}")
    return bool(number)


def items_of(value: Any) -> list[Any]:
    """Items of a list, a tuple or an array; none of anything else, or if its own methods fail."""
    try:
        return list(value) if isinstance(value, list | tuple | np.ndarray) else []
    except Exception:  # the object's own method fails, or the array has no axis
        return []


def has_method(value: object, name: str) -> bool:
    """Whether a value has a method of this name; no, if asking it raises an error."""
    try:
        return callable(getattr(value, name, None))
    except Exception:  # the object's own method fails
        return False


def check_text(what: str, value: Any) -> str:
    """Return a value as a plain text.

    Raises:
        ConfigError: If it is no text.
    """
    if not isinstance(value, str):
        raise ConfigError(f"{what} must be a text, got {shown(value)}")
    return str.__str__(value)  # a subclass may have odd methods


def check_option(kind: str, value: Any, known: Iterable[str]) -> str:
    """Return a value if it is one of some texts.

    Raises:
        ConfigError: With the nearest of them.
    """
    known = list(known)
    if not isinstance(value, str) or str.__str__(value) not in known:
        raise unknown_name(kind, value, known)
    return str.__str__(value)


def check_mapping(what: str, value: Any) -> dict[str, Any]:
    """Return a mapping with names as keys as a new dict.

    Raises:
        ConfigError: If it is none.
    """
    items = check_dict(what, value)
    if all(isinstance(name, str) for name in items):
        return {str.__str__(name): item for name, item in items.items()}
    raise ConfigError(f"{what} must be a dict with names as keys, got {shown(value)}")


def check_dict(what: str, value: Any) -> dict[Any, Any]:
    """Return a mapping as a new dict.

    Raises:
        ConfigError: If it is none.
    """
    if issubclass(type(value), Mapping):
        with suppress(Exception):  # a mapping of the caller's whose methods fail
            return dict(value)
    raise ConfigError(f"{what} must be a dict, got {shown(value)}")


def require_regular(path: Path) -> None:
    """Refuse pipes, devices and files of the kernel, which may never end.

    Raises:
        OSError: If the path is none of a regular file. No path with a NUL character is.
    """
    if "\0" in str(path):
        raise OSError(errno.EINVAL, "no file has a NUL character in its name")
    status = path.stat()
    if not stat.S_ISREG(status.st_mode):
        raise OSError(errno.EINVAL, "it is no regular file")
    if status.st_dev in _devices_of_kernel():
        raise OSError(errno.EINVAL, "it is no regular file, but one of the kernel")


@cache
def _devices_of_kernel() -> frozenset[int]:
    """The devices of the folders in which Linux makes files as they are read."""
    return frozenset(one.stat().st_dev for one in map(Path, ("/proc", "/sys")) if one.is_mount())


def check_path(what: str, value: Any) -> Path:
    """Return a value as a path; ``~`` stands for the home folder.

    Raises:
        ConfigError: If it is no path.
    """
    try:
        return Path(os.fsdecode(value)).expanduser()
    except Exception:  # nobody has this home, or the object's method fails
        raise ConfigError(f"{what} must be a path, got {shown(value)}") from None


class Spellings:
    """Names, of which each is also found by letters that only look other.

    ``µ`` is the micro sign or a Greek letter, ``ü`` is one letter or two, and there are ligatures.
    Names count as equal if their normal forms NFKC are, as in Python. An exact name wins.

    Args:
        kind: Kind of the named things, for the error.
        names: The names.
    """

    def __init__(self, kind: str, names: Collection[str]) -> None:
        self._kind, self._names = kind, names
        self._others: dict[str, list[str]] = {}
        for name in names:
            if not name.isascii():
                self._others.setdefault(normal_form(name), []).append(name)

    def find(self, name: Any) -> str | None:
        """The name that is meant; None if there is none.

        Raises:
            ConfigError: If it may be several. The text tells their letters by numbers.
        """
        if not isinstance(name, str):
            return None
        plain = str.__str__(name)  # a subclass may have odd methods
        if plain in self._names:
            return plain
        normal = normal_form(plain)
        found = [*self._others.get(normal, ())]
        if normal in self._names and normal not in found:
            found.append(normal)
        if len(found) > 1:
            told = ", ".join(map(ascii, found))
            raise ConfigError(
                f"{self._kind} {plain!a} may be any of {told}, which only look the same; write "
                "one of them exactly"
            )
        return found[0] if found else None

    def require(self, name: Any) -> str:
        """The name that is meant.

        Raises:
            ConfigError: If there is none, with the nearest name; or as ``find``.
        """
        found = self.find(name)
        if found is None:
            raise unknown_name(self._kind, name, self._names)
        return found


def by_own_names(
    what: str, given: Mapping[str, _Value], own_name: Callable[[str], str]
) -> dict[str, _Value]:
    """Resolve the names of a dict to the own names of the named things.

    Args:
        what: Name of the given thing, for the error.
        given: Values by name.
        own_name: Finds the own name for a given one.

    Raises:
        ConfigError: If two names stand for the same, which may look the same, too.
    """
    names: dict[str, str] = {}
    for name in given:
        first = names.setdefault(own_name(name), name)
        if first != name:
            raise ConfigError(f"{what}: {first!a} and {name!a} are one name; leave one of both out")
    return {own: given[name] for own, name in names.items()}


def normal_form(name: str) -> str:
    """A name in the form in which names are compared: NFKC."""
    return name if name.isascii() else unicodedata.normalize("NFKC", name)


def flattened(value: Any, around: tuple[Any, ...] = ()) -> tuple[tuple[int, ...] | None, list[Any]]:
    """The shape of nested lists, and their elements; no shape if the lists differ in length.

    A list that contains itself counts as an element there.

    Args:
        value: The lists, or anything else.
        around: The lists that this one is in.
    """
    is_list = isinstance(value, list | tuple) or (isinstance(value, np.ndarray) and value.ndim)
    if not is_list or any(value is one for one in around):
        return (), [value]
    if not len(value):
        return (0,), []
    parts = [flattened(one, (*around, value)) for one in value]
    shapes = {shape for shape, _ in parts}
    elements = [element for _, own in parts for element in own]
    inner = shapes.pop() if len(shapes) == 1 else None
    return (None if inner is None else (len(parts), *inner)), elements


def parts_of_array(name: str, shape: tuple[int, ...], value: Any) -> list[Any]:
    """Give each element of an array its part of a value.

    Args:
        name: Name of the array, for the error.
        shape: Shape of the array.
        value: Nested lists of this shape, a flat list in row-major order, or one value for all.

    Raises:
        ConfigError: If the value has another shape.
    """
    count = math.prod(shape)
    found, parts = flattened(value)
    if found == ():
        return parts * count
    if found not in {shape, (count,)}:
        what = "lists of different lengths" if found is None else f"the shape {found}"
        raise ConfigError(f"{name!r} is an array of shape {shape}, got {what}: {shown(value)}")
    return parts


def duration(what: str, value: Any) -> float:
    """Return a duration in seconds.

    Args:
        what: Its name, for the error.
        value: A number of seconds, or a text such as ``"15min"``, ``"0.02s"`` or ``"1h 30min"``.
            The units are ms, s, min, h and d.

    Raises:
        ConfigError: If it is no duration, or negative.
    """
    if not isinstance(value, str):
        return check_number(what, value, minimum=0)
    if _NEGATIVE.match(value):
        raise ConfigError(f"{what} must not be negative, got {shown(value)}")
    total, place = 0.0, 0
    while match := _PART.match(value, place):
        total, place = total + float(match[1]) * _SECONDS[match[2]], match.end()
    if not place or value[place:].strip() or not math.isfinite(total):
        raise ConfigError(
            f"{what} must be a number of seconds, or a text such as '15min' or '1h 30min' "
            f"(units: {', '.join(_SECONDS)}), got {shown(value)}"
        )
    return total
