"""A short form of ``python tests/fuzz_face.py``; the full one is in docs/reliability.md."""

import fuzz_face

import fmugym


def test_odd_values_raise_nothing_but_our_own_errors(same_working_directory):
    counts, failures = fuzz_face.run(700, seed="tests")
    assert failures == []
    totals = fuzz_face.totals(counts)
    assert totals["accepted"] + totals["refused"] == 700
    assert min(totals.values()) > 50
    assert {kind for kind, _ in counts} == {kind.__name__ for kind in fuzz_face.KINDS}


def test_a_failure_is_reported(monkeypatch):
    """The reference is able to fail: an exception, a folder that is left, a broken environment."""
    monkeypatch.setattr(fmugym.env, "check_seed", lambda seed: 1 / 0)
    _, failures = fuzz_face.run(40, seed="tests")
    assert any("ZeroDivisionError" in failure for failure in failures)
    monkeypatch.undo()
    monkeypatch.setattr(fmugym.archive.fmu, "remove_folder", lambda folder, process: None)
    _, failures = fuzz_face.run(60, seed="tests")
    assert any(": left ['" in failure for failure in failures)
