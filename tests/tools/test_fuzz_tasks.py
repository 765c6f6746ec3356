"""A short form of ``python tests/tools/fuzz_tasks.py``."""

import copy

import fuzz_driver
import fuzz_tasks
import pytest

from fmugym.errors import TaskError
from fmugym.task.task_entries import Entry


@pytest.mark.parametrize("task", [fuzz_tasks.PENDULUM, fuzz_tasks.SWITCHED])
def test_without_mutations_they_are_accepted(task):
    fuzz_tasks.play(copy.deepcopy(task), None)


def test_mutated_tasks_are_played_or_refused_with_their_place():
    tally = fuzz_driver.run(fuzz_tasks.program, 150, seed="tests")
    assert tally.failures == []
    assert tally.total("accepted") > 8
    assert tally.total("refused") > 80


def test_a_failure_is_reported(monkeypatch):
    """The fuzzing is able to fail: with errors without a place."""
    monkeypatch.setattr(Entry, "error", lambda self, text: TaskError("something is wrong"))
    failures = fuzz_driver.run(fuzz_tasks.program, 5, seed="tests").failures
    assert any("does not say where" in failure for failure in failures)
