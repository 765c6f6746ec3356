"""A short form of ``python tests/fuzz_hooks.py``."""

import fuzz_hooks

from fmugym.vector.engines.batch import BatchEngine


def test_odd_hooks_raise_nothing_but_our_own_errors():
    counts, failures = fuzz_hooks.run(500, seed="tests")
    assert failures == []
    assert counts.total() == 500
    for way in fuzz_hooks.WAYS:
        assert counts[way, "refused"] > 20
    assert counts["array", "accepted"] > 10


def test_a_failure_is_reported(monkeypatch):
    """The fuzzing is able to fail: with an exception, and with a reward that is passed on."""
    monkeypatch.setattr(BatchEngine, "_evaluate", lambda *given: 1 / 0)
    _, failures = fuzz_hooks.run(60, seed="tests")
    assert any("ZeroDivisionError: division by zero" in failure for failure in failures)
    monkeypatch.undo()
    monkeypatch.setattr(BatchEngine, "_handle_faults", lambda *given: None)
    _, failures = fuzz_hooks.run(200, seed="tests")
    assert any("ResultError: rewards" in failure for failure in failures)
