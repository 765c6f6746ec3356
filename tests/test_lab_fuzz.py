"""A short form of ``python tests/fuzz_lab.py``; the full one is in docs/reliability.md."""

import fuzz_lab
import pytest

from fmugym.lab import service

pytestmark = pytest.mark.filterwarnings("default")  # of numpy, about odd values


def test_odd_calls_raise_nothing_but_errors_of_the_lab(same_working_directory):
    counts, failures = fuzz_lab.run(300, seed="tests")
    assert failures == []
    assert sum(counts.values()) == 300
    assert min(counts[outcome] for outcome in ("accepted", "refused")) > 20


def test_a_failure_is_reported(monkeypatch):
    """The reference is able to fail: an exception, a lost start, and a cell that stays in use."""
    monkeypatch.setattr(service, "text_of", lambda kind, token: token.strip())
    _, failures = fuzz_lab.run(60, seed="tests")
    assert any("AttributeError" in failure for failure in failures)
