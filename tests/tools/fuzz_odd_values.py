"""Odd values for the programs that call public functions with them, such as ``fuzz_face.py``."""

import datetime
import decimal
import enum
import fractions
import itertools
import sys
from pathlib import Path

import numpy as np

# Odd values


class Unspeakable:
    """An object that can be neither shown, compared, counted nor converted."""

    def _refuse(self, *arguments):
        raise ZeroDivisionError("this object refuses everything")

    __repr__ = __str__ = __eq__ = __hash__ = __bool__ = __len__ = __iter__ = _refuse
    __float__ = __int__ = __index__ = __lt__ = __le__ = __gt__ = __ge__ = __fspath__ = _refuse
    __array__ = __getitem__ = __call__ = __contains__ = _refuse


class HostileError(Exception):
    """Raised by objects that cannot be asked anything."""


def _refuse(*arguments, **keywords):
    raise HostileError("do not touch me")


def hostile(*names, base=object):
    """Make an object whose special methods of these names raise."""
    return type("Hostile", (base,), dict.fromkeys(names, _refuse))()


def circular():
    """Make a list that contains itself."""
    values = [1.0]
    values.append(values)
    return values


class Slippery(float):
    """A float that cannot be shown."""

    def __repr__(self):
        raise ZeroDivisionError("this number has no text")

    __str__ = __format__ = __repr__


class OddText(str):
    """A text that cannot be looked up."""

    __slots__ = ()

    def __hash__(self):
        raise ZeroDivisionError("this text has no hash")

    def __eq__(self, other):
        raise ZeroDivisionError("this text has no equal")


class Whole(int):
    """An integer of a class of the caller's."""


class Colour(enum.Enum):
    """A choice of the caller's."""

    RED = 1


NUMBERS = (
    *(None, True, 0, 0.0, -0.0, -1, 1, 7, -1e-300, 1e-320, 1e308, -1e308, 10**400, -(10**400)),
    *(2**31, 2**63, 2**64, float("nan"), float("inf"), -float("inf"), 1j, Slippery(2.0)),
    *(Slippery("nan"), decimal.Decimal("1.5"), decimal.Decimal("sNaN"), fractions.Fraction(1, 3)),
    *(np.float32(0.1), np.float64("nan"), np.int8(-3), np.uint64(2**64 - 1), np.bool_(True)),
    *(np.datetime64("2020-01-01"), np.timedelta64(1, "s"), datetime.timedelta(seconds=1)),
    *(2, 3, 2**53 + 1, 10**5000, 0.1, 0.5, 1.5, 1e-9, np.float16(1), np.complex64(1), Whole(2)),
    *(np.longdouble("1e4000"), decimal.Decimal("1e9999"), fractions.Fraction(10**400)),
)
TEXTS = (
    *("", " ", "5", "5 s", "nan", "SimplePendulum", "DoublePendulum", "simplependulum", "None"),
    *("\0", "\ud800", "%s%n{0}", "x" * 5000, "\u200b", "1" * 19, b"5", bytearray(b"5")),
    *(OddText("5"), OddText("SimplePendulum"), "ideal", "hardware", "rgb_array", "../x"),
    *("tau", "q_0", "q", "rk4", "process", "human", "\u00e4\u4e2d", memoryview(b"1"), Colour.RED),
)
GROUPS = (
    *((), [], {}, set(), frozenset([1]), [1], [1.0, 2.0], (None,), [None, None], [[1]], [[]]),
    *([[1], [2, 3]], {"a": 1}, {1: 2}, ["up"], [float("nan")], [10**400]),
    *([1] * 1000, ["a", "b"], [(0, 1), (1, 0), (1, 1)], (0.0, 1.0), (1.0, 0.5, 2.0, 3.0)),
    *(range(3), range(10**12), np.zeros(2), np.zeros((2, 2)), np.array(1.0), np.array(["a"])),
    *(np.array([], float), np.ma.masked, np.array([None]), np.zeros(1, [("a", "f8")])),
)
OTHERS = (
    *(object(), Unspeakable(), Unspeakable, type, len, lambda *_: None, Ellipsis, NotImplemented),
    *(Path("x"), ValueError("a value"), sys, datetime.datetime(2020, 1, 1)),
)
MAKERS = (
    *(circular, lambda: iter([1.0]), lambda: itertools.repeat(1.0), lambda: [circular()]),
    *(lambda: (1 / 0 for _ in range(2)), lambda: [Unspeakable()], lambda: {"a": Unspeakable()}),
    lambda: hostile("__repr__"),
    lambda: hostile("__repr__", "__str__"),
    lambda: hostile(),
    lambda: hostile("__float__"),
    lambda: hostile("__index__"),
    lambda: hostile("__int__"),
    lambda: hostile("__array__"),
    lambda: hostile("__eq__"),
    lambda: hostile("__bool__"),
    lambda: hostile("__hash__"),
    lambda: hostile("__len__"),
    lambda: hostile("__iter__"),
    lambda: hostile("__getattr__"),
    lambda: hostile("__getitem__", "__len__"),
    lambda: hostile("__fspath__"),
    lambda: hostile("__deepcopy__"),
    lambda: hostile("__eq__", "__bool__", "__repr__", "__array__", "__float__", "__len__"),
    lambda: hostile("__repr__", base=float),
    lambda: hostile("__float__", base=float),
    lambda: hostile("__repr__", "__eq__", "__index__", "__float__", base=int),
    lambda: hostile("__iter__", "__len__", base=list),
    lambda: hostile("keys", base=dict),
    lambda: hostile("__iter__", "items", base=dict),
    lambda: hostile("__hash__", base=str),
)


def odd(rng, others=()):
    """Draw an odd value.

    Args:
        rng: What is drawn.
        others: More odd values; functions without arguments make new ones.
    """
    group = rng.choice(
        (NUMBERS, NUMBERS, TEXTS, TEXTS, GROUPS, GROUPS, OTHERS, MAKERS, others or TEXTS)
    )
    value = rng.choice(group)
    is_maker = group is MAKERS or getattr(value, "__name__", "") == "<lambda>"
    return value() if is_maker else value


def spoil(rng, arguments, others=()):
    """Replace one or two values of a dict of arguments by odd ones."""
    places = sorted(arguments)
    chosen = rng.sample(places, min(len(places), rng.choice((1, 1, 1, 2))))
    return arguments | {place: odd(rng, others) for place in chosen}
