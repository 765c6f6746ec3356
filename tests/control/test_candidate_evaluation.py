"""The vector environment in which candidates play the same episodes."""

from contextlib import closing
from functools import partial

import numpy as np
import pytest

import fmugym
from fmugym.control import Controller
from fmugym.control.candidate_evaluation import CandidateEvaluator
from fmugym.envs import PendulumEnv
from fmugym.pool.machine_limits import available_processors
from fmugym.pool.processes.process_pool import ProcessPool


class Constant(Controller):
    """Takes the same action in each step of an environment."""

    def __init__(self, numbers):
        self.numbers = numbers

    def _decide(self, rows):
        return self.numbers


def played(evaluator, numbers, seeds):
    return evaluator.play(Constant, np.reshape(numbers, (-1, 1)), seeds).returns


def test_who_plays_beside_whom_does_not_matter():
    with (
        closing(CandidateEvaluator(PendulumEnv, most_steps=50)) as evaluator,
        closing(CandidateEvaluator(PendulumEnv, 3, 50)) as few,
    ):
        alone = played(evaluator, [0.5, -1.0], range(2))
        many = played(evaluator, np.linspace(-2, 2, 9), range(4))
        again = played(evaluator, [0.5, -1.0], range(2))  # among 36 environments
        assert np.array_equal(alone, again)
        assert np.array_equal(played(few, np.linspace(-2, 2, 9), range(4)), many)


def test_environments_without_a_job_are_not_touched():
    """Those that play are spread over all, as neighbours step in one thread or process."""
    with closing(CandidateEvaluator(PendulumEnv, most_steps=5)) as evaluator:
        played(evaluator, np.zeros(8), range(1))
        pool = evaluator.open(8).pool
        before = pool.health()
        played(evaluator, [1.0, 2.0], range(1))
        after = pool.health()
        assert (after["resets"] - before["resets"]).tolist() == [1, 0, 0, 0, 1, 0, 0, 0]
        assert (after["steps"] - before["steps"]).tolist() == [5, 0, 0, 0, 5, 0, 0, 0]
        assert evaluator.jobs.tolist() == [0, -1, -1, -1, 1, -1, -1, -1]


@pytest.mark.skipif(available_processors() < 2, reason="needs two processors")
@pytest.mark.parametrize("isolation", [None, "none"])
def test_fmus_that_call_python_step_in_processes(isolation, example, tmp_path):
    """Unless the config says otherwise; the results are the same."""
    pytest.importorskip("pythonfmu", reason="needs pythonfmu: the extra test")
    zones = example("two_zones")
    path = zones.make_task(tmp_path)
    config = {} if isolation is None else {"config": {"isolation": isolation}}
    fmugym.Task.from_dict({"extends": "two_zones.toml", **config}, tmp_path).write(
        tmp_path / "task.toml"
    )
    make_env = partial(fmugym.load, tmp_path / "task.toml", physical=True)
    with closing(CandidateEvaluator(make_env, most_steps=10)) as evaluator:
        found = evaluator.play(lambda numbers: zones.ByHand(), np.zeros((2, 1)), range(2)).returns
        assert isinstance(evaluator.open(4).pool, ProcessPool) == (isolation is None)
    with closing(CandidateEvaluator(partial(fmugym.load, path, physical=True), 1, 10)) as evaluator:
        alone = evaluator.play(lambda numbers: zones.ByHand(), np.zeros((2, 1)), range(2)).returns
        assert not isinstance(evaluator.open(1).pool, ProcessPool)
    assert np.array_equal(found, alone)
