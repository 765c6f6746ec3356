"""Odd values, and the running of cases that use them; see ``fuzz_lab.py`` and its siblings."""

import argparse
import contextlib
import datetime
import decimal
import faulthandler
import fractions
import itertools
import os
import random
import sys
import tempfile
import time
import warnings
from collections import Counter
from pathlib import Path

import numpy as np
from fuzz import HANG, SLOW, say, temporary_folder

# Odd values


class Unspeakable:
    """An object that can be neither shown, compared, counted nor converted."""

    def _refuse(self, *arguments):
        raise ZeroDivisionError("this object refuses everything")

    __repr__ = __str__ = __eq__ = __hash__ = __bool__ = __len__ = __iter__ = _refuse
    __float__ = __int__ = __index__ = __lt__ = __le__ = __gt__ = __ge__ = __fspath__ = _refuse
    __array__ = __getitem__ = __call__ = __contains__ = _refuse


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


def nested():
    """Make a list that contains itself."""
    circle = []
    circle.append(circle)
    return circle


NUMBERS = (
    *(None, True, 0, 0.0, -0.0, -1, 1, 7, -1e-300, 1e-320, 1e308, -1e308, 10**400, -(10**400)),
    *(2**31, 2**63, 2**64, float("nan"), float("inf"), -float("inf"), 1j, Slippery(2.0)),
    *(Slippery("nan"), decimal.Decimal("1.5"), decimal.Decimal("sNaN"), fractions.Fraction(1, 3)),
    *(np.float32(0.1), np.float64("nan"), np.int8(-3), np.uint64(2**64 - 1), np.bool_(True)),
    *(np.datetime64("2020-01-01"), np.timedelta64(1, "s"), datetime.timedelta(seconds=1)),
)
TEXTS = (
    *("", " ", "5", "5 s", "nan", "SimplePendulum", "DoublePendulum", "simplependulum", "None"),
    *("\0", "\ud800", "%s%n{0}", "x" * 5000, "\u200b", "1" * 19, b"5", bytearray(b"5")),
    *(OddText("5"), OddText("SimplePendulum"), "ideal", "hardware", "rgb_array", "../x"),
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
    *(nested, lambda: iter([1.0]), lambda: itertools.repeat(1.0), lambda: [nested()]),
    *(lambda: (1 / 0 for _ in range(2)), lambda: [Unspeakable()], lambda: {"a": Unspeakable()}),
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


def check_text(error):
    """Return what is wrong with the text of an error."""
    return "" if str(error).isprintable() and len(str(error)) < 1000 else f"text: {str(error)!r}"


# Cases


def run_cases(case, count, seed, first=0, report=lambda line: None):
    """Run cases one after another.

    Args:
        case: Gets a random generator and an empty folder; returns an outcome, and what is wrong
            with it or "".
        count: How many to run.
        seed: Part of the seed of each case.
        first: The number of the first case.
        report: Gets each failure at once.

    Returns:
        How many cases had which outcome, and the failures as texts.
    """
    counts, failures = Counter(), []
    with temporary_folder() as folder:
        for number in range(first, first + count):
            outcome, trouble = watch(case, random.Random(f"{seed}/{number}"), folder)
            counts[outcome] += 1
            if trouble:
                failures.append(f"case {number}: {trouble}")
                report(failures[-1])
    return counts, failures


def watch(case, rng, folder):
    """Run one case; returns its outcome and what is wrong with it."""
    faulthandler.dump_traceback_later(HANG, exit=True)
    begin = time.process_time()  # the machine may be busy with something else
    try:
        with tempfile.TemporaryDirectory(dir=folder) as own, warnings.catch_warnings():
            warnings.simplefilter("ignore")  # numpy's, about odd values
            here = Path(own, "here")
            here.mkdir()
            with contextlib.chdir(here):  # odd texts may be names of folders
                outcome, trouble = case(rng, Path(own))
    except Exception as error:
        return "failed", f"{type(error).__name__}: {error}"
    finally:
        faulthandler.cancel_dump_traceback_later()
    duration = time.process_time() - begin
    left = os.listdir(folder)
    slow = f"{duration:.1f} s" if duration > SLOW else ""
    return outcome, trouble or slow or (f"left {left}" if left else "")


def main(run, about):
    """Run what the command line asks for; returns the exit code."""
    parser = argparse.ArgumentParser(description=about.splitlines()[0])
    parser.add_argument("--count", type=int, default=4000)
    parser.add_argument("--seed", default="0")
    parser.add_argument("--first", type=int, default=0)
    arguments = parser.parse_args()
    faulthandler.enable()
    begin = time.perf_counter()
    counts, failures = run(arguments.count, arguments.seed, arguments.first, say)
    say(f"{dict(counts)}, {len(failures)} failures, {time.perf_counter() - begin:.0f} s")
    return 1 if failures else 0
