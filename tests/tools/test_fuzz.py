"""Short forms of programs that make odd values; tests/README.md has the full ones."""

import contextlib
import time

import fuzz
import fuzz_driver
import pytest
from fuzz_driver import Case, CaseError

from fmugym import ConfigError

ODD = {
    fuzz: (400, 20),
}
"""By program: how many cases, and how many are accepted, and refused, at least."""


@pytest.mark.parametrize("module", ODD, ids=lambda module: module.__name__)
def test_what_is_odd_raises_nothing_but_our_own_errors(module, same_working_directory):
    count, least = ODD[module]
    tally = fuzz_driver.run(module.program, count, seed="tests")
    assert tally.failures == []
    assert tally.total("accepted") + tally.total("refused") == count
    assert min(tally.total("accepted"), tally.total("refused")) > least
    if module is fuzz:
        assert len({kind for kind, _ in tally.counts}) == len(module.KINDS)


def test_a_failure_is_reported(monkeypatch):
    """The fuzzing is able to fail: with a folder that is left."""
    monkeypatch.setattr(fuzz, "use", lambda path: (path.parents[1] / "trace").mkdir(exist_ok=True))
    first, last = fuzz_driver.run(fuzz.program, 1, seed="tests").failures
    assert "left ['trace']" in first
    assert last == "left ['trace'] at the end"


class TestDriver:
    """What becomes of cases that are known."""

    def run(self, *plays, **case):
        """Run one case after another."""
        calls = iter(plays)

        def program():
            return contextlib.nullcontext(lambda rng, folder: Case(next(calls), **case))

        return fuzz_driver.run(program, len(plays), seed="0")

    def fail(self, error):
        def play():
            raise error

        return play

    def test_outcomes(self):
        own, long = ZeroDivisionError("mine"), ConfigError("x" * 10_000)
        errors = ConfigError("no"), ZeroDivisionError("zero"), CaseError("wrong"), long, own
        tally = self.run(lambda: None, *map(self.fail, errors), is_own=lambda error: error is own)
        assert tally.line() == "1 accepted, 1 refused, 1 the caller's own, 1 outside, 2 failed"
        assert [one.partition(": ")[0] for one in tally.failures] == [
            "case 2",
            "case 3",
            "case 4",
        ]
        assert "ZeroDivisionError: zero" in tally.failures[0]

    def test_a_slow_case(self, monkeypatch):
        monkeypatch.setattr(fuzz_driver, "SLOW", 0.01)

        def work():
            end = time.process_time() + 0.02
            while time.process_time() < end:
                pass

        tally = self.run(work, lambda: time.sleep(0.02))
        assert tally.total("failed") == 1
        assert tally.failures[0].startswith("case 0")

    def test_a_case_is_repeated(self):
        """The random numbers of a case depend on its number and the seed alone."""
        drawn = []

        def program():
            return contextlib.nullcontext(
                lambda rng, folder: Case(lambda: drawn.append(rng.random()))
            )

        fuzz_driver.run(program, 5, seed="7")
        fuzz_driver.run(program, 1, seed="7", first=3)
        assert drawn[5] == drawn[3]
        assert len(set(drawn)) == 5
