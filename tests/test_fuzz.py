"""A short form of ``python tests/fuzz.py``; the full one is in docs/reliability.md."""

import fuzz


def test_broken_fmus_raise_nothing_but_our_own_errors(same_working_directory):
    counts, failures = fuzz.run(400, seed="tests")
    assert failures == []
    assert sum(counts.values()) == 400
    assert min(counts[stage] for stage in ("refused", "described", "extracted")) > 20


def test_a_failure_is_reported(monkeypatch):
    """The reference is able to fail: an exception, and a folder that is left."""
    monkeypatch.setattr(fuzz, "as_text", lambda facts: 1 / 0)
    _, failures = fuzz.run(30, seed="tests")
    assert any(failure.endswith("ZeroDivisionError: division by zero") for failure in failures)
    monkeypatch.setattr(fuzz, "use", lambda path: (path.parent / "trace").mkdir(exist_ok=True))
    assert fuzz.run(1, seed="tests")[1] == ["case 0: left ['trace']"]
