"""The time for the longest episode of a trial."""

import itertools

import pytest

from fmugym.pool.trial import reference
from fmugym.pool.trial.reference import SMALL_BUDGET, Budget


@pytest.mark.parametrize(
    ("seconds", "expected"),
    [(1e-5, 5001), (4e-3, 30), (15e-3, 30), (0.03, 10), (2.0, 1)],
    ids=["fast", "delayed by a scheduler", "delayed by more", "slow", "very slow"],
)
def test_an_episode_has_thirty_steps_although_the_machine_delays_each(
    monkeypatch, seconds, expected
):
    now = 0.0
    monkeypatch.setattr(reference.time, "perf_counter", lambda: now)
    budget = Budget(SMALL_BUDGET)
    for steps in itertools.count(1):
        now += seconds
        if budget.is_reached(steps):
            break
    assert steps == pytest.approx(expected, abs=1)
