"""Cases that are known end as the driver of the fuzzing programs reports."""

import contextlib
import tempfile
import time

import fuzz_driver
from fuzz_driver import Case, CaseError

from fmugym import ConfigError


def run(*plays):
    """Run one case after another."""
    calls = iter(plays)

    def program():
        return contextlib.nullcontext(lambda rng, folder: Case(next(calls)))

    return fuzz_driver.run(program, len(plays), seed="0")


def fail(error):
    def play():
        raise error

    return play


def test_outcomes():
    long = ConfigError("x" * 10_000)
    errors = ConfigError("no"), ZeroDivisionError("zero"), CaseError("wrong"), long
    tally = run(lambda: None, *map(fail, errors))
    assert tally.line() == "1 accepted, 1 refused, 1 outside, 2 failed"
    assert [one.partition(": ")[0] for one in tally.failures] == ["case 2", "case 3", "case 4"]
    assert "ZeroDivisionError: zero" in tally.failures[0]


def test_a_slow_case(monkeypatch):
    monkeypatch.setattr(fuzz_driver, "SLOW", 0.01)

    def work():
        end = time.process_time() + 0.02
        while time.process_time() < end:
            pass

    tally = run(work, lambda: time.sleep(0.02))
    assert tally.total("failed") == 1
    assert tally.failures[0].startswith("case 0")


def test_a_case_is_repeated():
    """The random numbers of a case depend on its number and the seed alone."""
    drawn = []

    def program():
        return contextlib.nullcontext(lambda rng, folder: Case(lambda: drawn.append(rng.random())))

    fuzz_driver.run(program, 5, seed="7")
    fuzz_driver.run(program, 1, seed="7", first=3)
    assert drawn[5] == drawn[3]
    assert len(set(drawn)) == 5


def test_a_folder_that_is_left():
    tally = run(tempfile.mkdtemp)
    assert "left ['" in tally.failures[0]
    assert tally.failures[1].startswith("left ['")
