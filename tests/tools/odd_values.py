"""Odd values as strategies of Hypothesis, and the rule for calls that get them.

A call with odd values works, or is refused with an error of the package.
"""

import contextlib
import datetime
import decimal
import enum
import fractions
import itertools
import logging
import os
import sys
import tempfile
import warnings
from pathlib import Path
from unittest import mock

import numpy as np
from hypothesis import strategies as st

from fmugym import FMUGymError

LONG = 5000
"""More characters than the text of an error may have, which tells of up to twenty mistakes."""


@contextlib.contextmanager
def working_or_refused():
    """Let calls in an empty working directory work or be refused, and leave no temporary file."""
    with tempfile.TemporaryDirectory() as empty, tempfile.TemporaryDirectory() as temporary:
        in_temporary = mock.patch.object(tempfile, "tempdir", temporary)
        with contextlib.chdir(empty), in_temporary, perhaps_refused():
            yield
        assert os.listdir(temporary) == []


@contextlib.contextmanager
def perhaps_refused():
    """Let calls work, or raise an error of the package whose text a terminal prints as it is."""
    with quiet():
        try:
            yield
        except FMUGymError as error:
            text = str(error)
            assert len(text) < LONG
            assert all(map(str.isprintable, text.split("\n"))), ascii(text)  # lines of a task


@contextlib.contextmanager
def quiet():
    """Without log messages and warnings, which odd values bring about by the thousand."""
    logging.disable(logging.CRITICAL)
    try:
        with warnings.catch_warnings(), np.errstate(all="ignore"):
            warnings.simplefilter("ignore")
            yield
    finally:
        logging.disable(logging.NOTSET)


class Named:
    """An object that Hypothesis shows by the name of its class, whatever its ``repr`` does."""

    def _repr_pretty_(self, printer, cycle):
        printer.text(type(self).__name__)


class Unspeakable(Named):
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


def hostile(names, base=object):
    """Make an object whose methods of these names raise."""
    name = f"hostile({names}, {base.__name__})"
    return type(name, (Named, base), dict.fromkeys(names, _refuse))()


def circular():
    """Make a list that contains itself."""
    values = [1.0]
    values.append(values)
    return values


def failing():
    """Make an iterator that fails."""
    return (1 / 0 for _ in range(2))


class Slippery(Named, float):
    """A float that cannot be shown."""

    def __repr__(self):
        raise ZeroDivisionError("this number has no text")

    __str__ = __format__ = __repr__


class OddText(Named, str):
    """A text that cannot be looked up."""

    def __hash__(self):
        raise ZeroDivisionError("this text has no hash")

    def __eq__(self, other):
        raise ZeroDivisionError("this text has no equal")


class Whole(Named, int):
    """An integer of a class of the caller's."""


def huge():
    """Make an integer that is too long for a text."""
    return Whole(10**5000)


class Colour(enum.Enum):
    """A choice of the caller's."""

    RED = 1


METHODS = (
    *("__repr__", "__str__", "__float__", "__index__", "__int__", "__array__", "__eq__"),
    *("__bool__", "__hash__", "__len__", "__iter__", "__getattr__", "__getitem__"),
    *("__fspath__", "__deepcopy__"),
)
NUMBERS = st.sampled_from(
    (
        *(None, True, 0, 0.0, -0.0, -1, 1, 7, -1e-300, 1e-320, 1e308, -1e308, 10**400, -(10**400)),
        *(2**31, 2**63, 2**64, float("nan"), float("inf"), -float("inf"), 1j),
        *(decimal.Decimal("1.5"), decimal.Decimal("sNaN"), decimal.Decimal("1e9999")),
        *(np.float32(0.1), np.float64("nan"), np.int8(-3), np.uint64(2**64 - 1), np.bool_(True)),
        *(np.datetime64("2020-01-01"), np.timedelta64(1, "s"), datetime.timedelta(seconds=1)),
        *(2, 3, 2**53 + 1, 10**4000, 0.1, 0.5, 1.5, 1e-9, np.float16(1), np.complex64(1)),
        *(Whole(2), np.longdouble("1e4000"), fractions.Fraction(1, 3), fractions.Fraction(10**400)),
    )
)
TEXTS = st.sampled_from(
    (
        *("", " ", "5", "5 s", "nan", "SimplePendulum", "DoublePendulum", "simplependulum"),
        *("None", "\0", "\x1b[31m", "\ud800", "%s%n{0}", "x" * 5000, "\u200b", "1" * 19, b"5"),
        *("ideal", "hardware", "rgb_array", "../x", "tau", "q_0", "q", "rk4", "process", "human"),
        *("\u00e4\u4e2d", bytearray(b"5"), memoryview(b"1"), Colour.RED),
    )
)
GROUPS = st.sampled_from(
    (
        *((), [], {}, set(), frozenset([1]), [1], [1.0, 2.0], (None,), [None, None], [[1]], [[]]),
        *([[1], [2, 3]], {"a": 1}, {1: 2}, ["up"], [float("nan")], [10**400]),
        *([1] * 1000, ["a", "b"], [(0, 1), (1, 0), (1, 1)], (0.0, 1.0), (1.0, 0.5, 2.0, 3.0)),
        *(range(3), range(10**12), np.zeros(2), np.zeros((2, 2)), np.array(1.0), np.array(["a"])),
        *(np.array([], float), np.ma.masked, np.array([None]), np.zeros(1, [("a", "f8")])),
    )
)
OBJECTS = st.sampled_from(
    (
        *(object(), type, len, lambda *_: None, Ellipsis, NotImplemented, Path("x"), sys),
        *(object, ValueError("a value"), datetime.datetime(2020, 1, 1)),
    )
)
UNSPEAKABLE = st.builds(Unspeakable)
HOSTILE = st.sampled_from(
    (
        *(UNSPEAKABLE, UNSPEAKABLE.map(lambda o: [o]), UNSPEAKABLE.map(lambda o: {"a": o})),
        *(st.builds(circular), st.builds(iter, st.just([1.0])), st.builds(failing)),
        *(st.builds(Slippery, st.sampled_from((2.0, float("nan")))), st.builds(huge)),
        st.builds(hostile, st.lists(st.sampled_from(METHODS), max_size=2, unique=True)),
        st.builds(hostile, st.sampled_from((["__repr__"], ["__float__"])), st.just(float)),
        st.builds(hostile, st.sampled_from((["__repr__"], ["__index__"])), st.just(int)),
        st.builds(hostile, st.just(["__iter__", "__len__"]), st.just(list)),
        st.builds(hostile, st.sampled_from((["keys"], ["__iter__", "items"])), st.just(dict)),
        st.builds(hostile, st.just(["__hash__"]), st.just(str)),
    )
).flatmap(lambda kind: kind)
ENDLESS = st.builds(itertools.repeat, st.just(1.0))
WITHOUT_HASH = st.builds(OddText, st.sampled_from(("5", "SimplePendulum")))

USUAL = NUMBERS | TEXTS | GROUPS | OBJECTS | HOSTILE
"""Odd values that can be counted, and of which texts can be looked up."""

ODD = USUAL | ENDLESS | WITHOUT_HASH


def spoiled(arguments, values=ODD):
    """A strategy of the arguments of a call, of which one or two are odd."""
    odd = st.dictionaries(st.sampled_from(sorted(arguments)), values, min_size=1, max_size=2)
    return odd.map(lambda chosen: arguments | chosen)


@st.composite
def odd_calls(draw, calls, values=ODD):
    """A strategy of a function of ``calls`` and its arguments, of which one or two are odd."""
    function, arguments = calls[draw(st.sampled_from(sorted(calls)))]
    return function, draw(spoiled(arguments, values))
