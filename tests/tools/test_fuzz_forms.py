"""A short form of ``python tests/tools/fuzz_forms.py``."""

import fuzz_driver
import fuzz_forms
from process_tools import posix_only

from fmugym.pool.processes import supervisor

pytestmark = posix_only


def test_damaged_forms_and_messages():
    tally = fuzz_driver.run(fuzz_forms.program, 120, seed="tests")
    assert tally.failures == []
    kinds = {kind for kind, _ in tally.counts}
    assert kinds == {"pool", "listing", "draws", "play", "program", "request", "answer"}


def test_a_parent_that_believes_everything_is_reported(monkeypatch):
    """The fuzzing is able to fail: here nobody expects an answer that is none."""
    monkeypatch.setattr(supervisor, "DamagedError", KeyError)
    failures = fuzz_driver.run(fuzz_forms.program, 60, seed="tests").failures
    assert any("answer" in failure for failure in failures)
