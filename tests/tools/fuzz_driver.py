"""The command line of the fuzzing programs, the running of their cases, and the report.

    python tests/tools/fuzz_PROGRAM.py --count 4000 --seed 0 [--first N]

A case ends in one of these ways:

* It is accepted, and what follows works.
* It is refused with an error of the package's own family, ``FMUGymError``.
* It ends outside: with any other exception. This must never happen.
* It fails otherwise, which must not happen either: with an error that a terminal could obey or that
  is very long, a wrong result, a file that is left, more than ``SLOW`` seconds of processor time,
  or ``LARGE`` more bytes of memory than any case before.

A crash, or a hang after ``HANG`` seconds, ends the program with the Python stack. Case number n of
a seed is always the same; ``--first n --count 1`` repeats it.
"""

import argparse
import contextlib
import faulthandler
import os
import random
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from odd_values import LONG, quiet

from fmugym import FMUGymError

SLOW, HANG = 5.0, 60.0
LARGE = 300 * 2**20

OUTCOMES = ("accepted", "refused", "outside", "failed")


class CaseError(Exception):
    """A case ended well, but not as it should."""


def require(holds, what):
    """Fail the case unless something holds."""
    if not holds:
        raise CaseError(what)


class Case(NamedTuple):
    """One case.

    Attributes:
        play: Does it; an error of the family means that it is refused.
        kind: What the report counts it under.
        values: What is odd in it, for the report of a failure.
    """

    play: Callable[[], Any]
    kind: str = "all"
    values: Any = ""


class Tally(NamedTuple):
    """What became of the cases.

    Attributes:
        counts: How many cases of which kind ended in which way.
        failures: What went wrong, as texts.
    """

    counts: Counter
    failures: list[str]

    def total(self, outcome):
        return sum(number for (_, end), number in self.counts.items() if end == outcome)

    def line(self, kind=None):
        """How many cases ended in each way, of one kind or of all."""
        numbers = [self.total(end) if kind is None else self.counts[kind, end] for end in OUTCOMES]
        return ", ".join(
            f"{number} {end}"
            for number, end in zip(numbers, OUTCOMES, strict=True)
            if number or end in {"accepted", "refused", "outside"}
        )


def run(program, count, seed, first=0, report=lambda line: None):
    """Run cases one after another.

    Args:
        program: A context in which the cases run; gives a function that makes a case of a random
            generator and an empty folder.
        count: How many to run.
        seed: Part of the seed of each case.
        first: The number of the first case.
        report: Gets each failure at once.
    """
    tally = Tally(Counter(), [])

    def fail(text):
        tally.failures.append(text)
        report(text)

    with temporary_folder() as folder, quiet():
        with program() as make:
            for number in range(first, first + count):
                kind, outcome, trouble = _run_one(make, f"{seed}/{number}", folder)
                tally.counts[kind, outcome] += 1
                if trouble:
                    fail(f"case {number}: {trouble}")
        if left := sorted(os.listdir(folder)):
            fail(f"left {left} at the end")
    return tally


def _run_one(make, seed, folder):
    """Run one case; returns its kind, how it ended, and what is wrong with it."""
    before = set(os.listdir(folder))
    with tempfile.TemporaryDirectory(dir=folder) as own:
        here = Path(own, "here")
        here.mkdir()
        with contextlib.chdir(here):  # odd texts may be names of folders
            case = make(random.Random(seed), Path(own))
            outcome, trouble = _watch(case)
    left = sorted(set(os.listdir(folder)) - before)
    if left and not trouble:
        outcome, trouble = "failed", f"left {left}"
    if trouble:
        trouble = f"{case.kind} {describe(case.values)}: {trouble}"
    return case.kind, outcome, trouble


def _watch(case):
    """Play a case; returns how it ended and what is wrong with that."""
    faulthandler.dump_traceback_later(HANG, exit=True)
    begin, memory = time.process_time(), peak_memory()  # other programs do not count
    try:
        outcome, trouble = _play(case)
    finally:
        faulthandler.cancel_dump_traceback_later()
    duration, growth = time.process_time() - begin, peak_memory() - memory
    if not trouble and duration > SLOW:
        trouble = f"{duration:.1f} s"
    if not trouble and growth > LARGE:
        trouble = f"{growth // 2**20} MiB"
    return "failed" if trouble and outcome != "outside" else outcome, trouble


def _play(case):
    try:
        case.play()
    except FMUGymError as error:
        return "refused", what_is_wrong_with(error)
    except CaseError as error:
        return "failed", str(error)
    except Exception as error:
        return "outside", f"{type(error).__name__}: {describe(error)} {place(error)}"
    return "accepted", ""


def what_is_wrong_with(error):
    """What is wrong with the text of an error, or ""."""
    text = str(error)
    is_printable = all(map(str.isprintable, text.split("\n")))  # a line for each mistake of a file
    return "" if is_printable and len(text) < LONG else f"text: {text[:LONG]!r}"


def describe(value):
    """A value in one line, even if it cannot be shown."""
    try:
        text = " ".join((str if isinstance(value, Exception | str) else repr)(value).split())
    except Exception:
        text = f"<{type(value).__name__} that raises in its repr>"
    return text if len(text) < 200 else f"{text[:180]}..."


def place(error):
    """Where in the package an exception came out."""
    trace, found = error.__traceback__, ""
    while trace is not None:
        name = Path(trace.tb_frame.f_code.co_filename)
        if "fmugym" in name.parts:
            found = f"({name.name}:{trace.tb_lineno})"
        trace = trace.tb_next
    return found


def peak_memory():
    """The most bytes that this process has had; 0 on Windows, where nothing is measured."""
    if sys.platform == "win32":
        return 0
    import resource

    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit


@contextlib.contextmanager
def temporary_folder():
    """A folder in which all others are made, so that it is seen when one is left."""
    before = tempfile.tempdir
    with tempfile.TemporaryDirectory() as folder:
        tempfile.tempdir = folder
        try:
            yield Path(folder)
        finally:
            tempfile.tempdir = before


def say(text):
    sys.stdout.write(f"{text}\n")
    sys.stdout.flush()


def main(program, about, count=4000):
    """Run what the command line asks for and report; returns the exit code.

    Args:
        program: As for ``run``.
        about: The docstring of the program.
        count: How many cases to run by default.
    """
    parser = argparse.ArgumentParser(description=about.splitlines()[0])
    parser.add_argument("--count", type=int, default=count)
    parser.add_argument("--seed", default="0")
    parser.add_argument("--first", type=int, default=0)
    arguments = parser.parse_args()
    faulthandler.enable()
    begin = time.perf_counter()
    tally = run(program, arguments.count, arguments.seed, arguments.first, say)
    kinds = sorted({kind for kind, _ in tally.counts})
    for kind in kinds if len(kinds) > 1 else ():
        say(f"{kind}: {tally.line(kind)}")
    duration = time.perf_counter() - begin
    say(f"{arguments.count} cases, seed {arguments.seed}: {tally.line()}; {duration:.0f} s")
    return 1 if tally.failures else 0
