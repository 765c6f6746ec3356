"""A short form of ``python tests/tools/fuzz_hooks.py``."""

import fuzz_driver
import fuzz_hooks

from fmugym.environment.vector import array_faults


def test_odd_hooks_raise_nothing_but_our_own_errors():
    tally = fuzz_driver.run(fuzz_hooks.program, 500, seed="tests")
    assert tally.failures == []
    for way in fuzz_hooks.WAYS:
        assert tally.counts[way, "refused"] > 20
    assert tally.counts["arrays", "accepted"] > 10
    assert tally.total("the caller's own") > 10


def test_a_failure_is_reported(monkeypatch):
    """The fuzzing is able to fail: with a reward that is passed on."""
    monkeypatch.setattr(array_faults, "_handle", lambda *given: None)
    failures = fuzz_driver.run(fuzz_hooks.program, 60, seed="tests", first=640).failures
    assert any(": rewards" in failure for failure in failures)
