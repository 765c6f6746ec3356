"""A short form of ``python tests/fuzz_face.py``; the full one is in tests/README.md."""

import fuzz_driver
import fuzz_face

import fmugym


def test_odd_values_raise_nothing_but_our_own_errors(same_working_directory):
    tally = fuzz_driver.run(fuzz_face.program, 700, seed="tests")
    assert tally.failures == []
    assert tally.total("accepted") + tally.total("refused") == 700
    assert min(tally.total("accepted"), tally.total("refused")) > 50
    assert {kind for kind, _ in tally.counts} == {kind.__name__ for kind in fuzz_face.KINDS}


def test_a_failure_is_reported(monkeypatch):
    """The fuzzing is able to fail: with an exception, and with a folder that is left."""
    monkeypatch.setattr(fmugym.env, "check_seed", lambda seed: 1 / 0)
    failures = fuzz_driver.run(fuzz_face.program, 40, seed="tests").failures
    assert any("ZeroDivisionError" in failure for failure in failures)
    monkeypatch.undo()
    monkeypatch.setattr(fmugym.archive.fmu, "remove_folder", lambda folder, process: None)
    failures = fuzz_driver.run(fuzz_face.program, 60, seed="tests").failures
    assert any(": left ['" in failure for failure in failures)
