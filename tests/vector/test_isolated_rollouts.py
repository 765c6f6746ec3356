"""Rollouts with FMUs in worker processes, which do all steps of their environments."""

import os
import signal

import numpy as np
import pytest
from process_tools import FaultyEnv, faulty_fmu, start_values
from test_isolated_hooks import Sampled, Short, TwoPendulums
from test_vector_program import Task
from test_vector_tasks import Delayed, Goal, Tables, Tracking
from vector_tools import CART_POLE, require_equal

from fmugym import FMUVectorEnv
from fmugym.vector import episodes

N, HORIZON = 7, 25


@pytest.fixture(name="make")
def fixture_make(opened):
    def make(cls, num_envs=N, workers=3, **options):
        if workers:
            options |= {"isolation": "process", "workers": workers}
        return opened(FMUVectorEnv(cls, num_envs, **({"hooks": "compiled"} | options)))

    return make


@pytest.fixture(name="in_workers")
def fixture_in_workers(monkeypatch):
    """Nothing goes step by step through this process."""

    def refuse(*_):
        raise AssertionError("a rollout goes step by step")

    monkeypatch.setattr(episodes, "roll_out_by_steps", refuse)


def begun(envs, steps=2):
    """Bring the environments to the middle of episodes; return candidates for what follows."""
    envs.action_space.seed(2)
    actions = np.array([envs.action_space.sample() for _ in range(steps + HORIZON)])
    for seed in range(0, 1000, N):
        envs.reset(seed=seed)
        results = [envs.step(action) for action in actions[:steps]]
        if not any((result.terminated | result.truncated).any() for result in results):
            break
    return actions[steps:].swapaxes(0, 1)


TASKS = [CART_POLE, Short, Sampled, TwoPendulums, Tracking, Delayed, Goal, Tables]


@pytest.mark.usefixtures("in_workers")
@pytest.mark.parametrize("cls", TASKS)
def test_results_are_those_of_one_process(make, cls):
    """To the last bit; the episodes go on afterwards."""
    results = []
    for workers in (3, None):
        envs = make(cls, workers=workers)
        actions = begun(envs)
        snapshot = envs.save_state()
        found = [envs.rollout(None, actions), envs.rollout(snapshot[[2]], actions[:5, :9])]
        found += [envs.rollout(snapshot[[1]], np.concatenate([actions, actions[::-1]]))]
        results.append([*found, envs.step(actions[:, 0])[:4]])
    for ours, theirs in zip(*results, strict=True):
        for one, other in zip(ours, theirs, strict=True):
            require_equal(one, other)


class Weighted(Tracking):
    gain = 1.0

    def _reward_policy(self):
        return self.gain * super()._reward_policy()


@pytest.mark.usefixtures("in_workers")
def test_attributes_that_are_set_reach_the_workers(make):
    envs, here = make(Weighted), make(Weighted, workers=None)
    for gain in (2.0, 3.0):
        found = []
        for one in (envs, here):
            one.set_attr("gain", gain)
            found.append(one.rollout(None, begun(one)))
        require_equal(found[0].rewards, found[1].rewards)
    for one in (envs, here):
        one.set_attr("gain", list(range(N)))
    actions = begun(envs)
    begun(here)
    require_equal(envs.rollout(None, actions).rewards, here.rollout(None, actions).rewards)


@pytest.mark.usefixtures("in_workers")
def test_a_new_worker_gets_the_programs(make):
    envs = make(CART_POLE)
    actions = begun(envs)
    expected = envs.rollout(None, actions)
    os.kill(envs.inside.pool.processes()[1], signal.SIGKILL)
    envs.step(actions[:, 0])
    begun(envs)
    for ours, theirs in zip(envs.rollout(None, actions), expected, strict=True):
        require_equal(ours, theirs)


class Faulty(FaultyEnv):
    def __init__(self, path, **config):
        super().__init__(path, **config)
        self.logger.setLevel("ERROR")


def with_faults(make, path, hooks, fault, at, **config):
    """A rollout in which some of three FMUs fail."""
    parameters = {
        name: [start_values(f, at=a)[name] for f, a in zip(fault, at, strict=True)]
        for name in ("fault", "stage", "at")
    }
    envs = make(lambda: Faulty(path, **config), 3, config.pop("workers", 3), hooks=hooks)
    for name, values in parameters.items():
        envs.set_attr(name, values)
    envs.reset(seed=0)
    return envs, envs.rollout(None, np.full((3, 6, 1), 0.5, np.float32))


def test_faults_are_those_of_hooks_on_arrays(make, tmp_path):
    path = faulty_fmu(tmp_path)
    rolled = [
        with_faults(make, path, hooks, ("crash", "none", "none"), (3, 0, 0))[1]
        for hooks in ("compiled", "array")
    ]
    for ours, theirs in zip(*rolled, strict=True):
        require_equal(ours, theirs)
    assert rolled[0].lengths.tolist() == [3, 6, 6]
    assert rolled[0].truncated[0].tolist() == [False, False, True, False, False, False]


def test_a_hang_ends_after_the_time_limit_of_a_call(make, tmp_path):
    path = faulty_fmu(tmp_path)
    envs, found = with_faults(
        make, path, "compiled", ("none", "hang", "none"), (0, 2, 0), call_timeout=0.5
    )
    assert found.lengths.tolist() == [6, 2, 6]
    assert envs.inside.pool.health()["deaths"][1] > 0


@pytest.mark.usefixtures("in_workers")
def test_a_rollout_may_take_longer_than_a_call(make, tmp_path):
    """Three steps take 0.2 s each; one call may take 0.35 s."""
    path = faulty_fmu(tmp_path)
    pauses = ("pause",) * 3
    envs, found = with_faults(
        make, path, "compiled", pauses, (1, 2, 3), call_timeout=0.35, workers=1
    )
    assert found.lengths.tolist() == [6, 6, 6]
    assert envs.inside.pool.health()["deaths"].tolist() == [0, 0, 0]


class Outside(Task):
    """Looks values up in a table that is too short for long episodes."""

    def __init__(self):
        super().__init__(max_episode_steps=20)

    def _is_done(self):
        return self.state[0] > 90.0

    def _reward_policy(self):
        return np.take([1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0], self.step_count)


def test_an_index_outside_of_its_table(make):
    envs = make(Outside)
    envs.reset(seed=0)
    with pytest.raises(IndexError, match="outside of its table"):
        envs.rollout(None, np.zeros((N, 9, 2), np.float32))
    assert envs.rollout(None, np.zeros((N, 2, 2), np.float32)).lengths.tolist() == [2] * N
