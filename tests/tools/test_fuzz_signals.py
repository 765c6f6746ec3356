"""A short form of ``python tests/tools/fuzz_signals.py``; the full one is in tests/README.md."""

import os

import pytest
from fmu_tools import HERE
from process_tools import run_python


@pytest.mark.skipif(os.name != "posix", reason="Windows has no timer signals")
def test_signals_are_not_lost_and_break_nothing():
    """Not in this process: an exception out of a signal handler leaves coverage's lock locked."""
    done = run_python(HERE / "tools" / "fuzz_signals.py", "--count", 60, "--seed", "tests")
    assert done.returncode == 0, done.stdout
    assert "60 accepted, 0 refused, 0 outside" in done.stdout
