"""A short form of ``python tests/fuzz_lab.py``; the full one is in tests/README.md."""

import fuzz_driver
import fuzz_lab

from fmugym.lab import service


def test_odd_calls_raise_nothing_but_errors_of_the_lab(same_working_directory):
    tally = fuzz_driver.run(fuzz_lab.program, 300, seed="tests")
    assert tally.failures == []
    assert tally.total("accepted") + tally.total("refused") == 300
    assert min(tally.total("accepted"), tally.total("refused")) > 20


def test_a_failure_is_reported(monkeypatch):
    """The reference is able to fail: an exception, a lost start, and a cell that stays in use."""
    monkeypatch.setattr(service, "text_of", lambda kind, token: token.strip())
    failures = fuzz_driver.run(fuzz_lab.program, 60, seed="tests").failures
    assert any("AttributeError" in failure for failure in failures)
