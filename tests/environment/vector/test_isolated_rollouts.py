"""Rollouts with FMUs in worker processes."""

from functools import partial

import numpy as np
import pytest
from contract_cases import PENDULUM
from example_tools import EXAMPLES
from process_tools import faulty_fmu, start_values
from vector_tools import require_equal
from ways import in_way

import fmugym
from fmugym import FMUVectorEnv

N, HORIZON = 7, 25


@pytest.fixture(name="make")
def fixture_make(opened):
    def make(cls, num_envs=N, workers=3, **options):
        if workers:
            options |= {"isolation": "process", "workers": workers}
        way = options.pop("way", "expressions")
        return opened(FMUVectorEnv(in_way(way, cls), num_envs, **options))

    return make


def begun(envs, steps=2):
    """Bring the environments to the middle of episodes; return candidates for what follows."""
    envs.action_space.seed(2)
    actions = np.array([envs.action_space.sample() for _ in range(steps + HORIZON)])
    for seed in range(0, 1000, N):
        envs.reset(seed=seed)
        results = [envs.step(action) for action in actions[:steps]]
        if not any((result[2] | result[3]).any() for result in results):
            break
    return actions[steps:].swapaxes(0, 1)


TASKS = {
    "cart-pole": partial(fmugym.load, EXAMPLES / "cart_pole.toml"),
    "pendulum": partial(fmugym.load, EXAMPLES / "pendulum.toml"),
    "memory and ends": partial(fmugym.load, PENDULUM),
}


@pytest.mark.parametrize("cls", TASKS.values(), ids=TASKS)
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


def faulty(path, **foreign):
    """Integrates its action until the FMU does what its parameters say."""
    task = {
        "fmu": str(path),
        "time_step": 0.5,
        "variables": {"u": {"min": -1, "max": 1}},
        "parameters": start_values("none"),
        "agent": {"actions": ["u"], "observations": ["y"]},
        "reward": "y",
        "config": {"isolation": "process"},
        "foreign": foreign,
    }
    return fmugym.load(task, log_level="ERROR")


def with_faults(make, path, fault, at, way="expressions", workers=3, **foreign):
    """A rollout in which some of three FMUs fail."""
    parameters = {
        name: [start_values(f, at=a)[name] for f, a in zip(fault, at, strict=True)]
        for name in ("fault", "stage", "at")
    }
    envs = make(lambda: faulty(path, **foreign), 3, workers, way=way)
    for name, values in parameters.items():
        envs.set_attr(name, values)
    envs.reset(seed=0)
    return envs, envs.rollout(None, np.full((3, 6, 1), 0.5, np.float32))


def test_faults_are_those_of_hooks_on_arrays(make, tmp_path):
    path = faulty_fmu(tmp_path)
    rolled = [
        with_faults(make, path, ("crash", "none", "none"), (3, 0, 0), way)[1]
        for way in ("expressions", "arrays")
    ]
    for ours, theirs in zip(*rolled, strict=True):
        require_equal(ours, theirs)
    assert rolled[0].lengths.tolist() == [3, 6, 6]
    assert rolled[0].truncated[0].tolist() == [False, False, True, False, False, False]


def test_a_hang_ends_after_the_time_limit_of_a_call(make, tmp_path):
    path = faulty_fmu(tmp_path)
    envs, found = with_faults(make, path, ("none", "hang", "none"), (0, 2, 0), call_timeout=0.5)
    assert found.lengths.tolist() == [6, 2, 6]
    assert envs.pool.health()["deaths"][1] > 0


def test_a_rollout_may_take_longer_than_a_call(make, tmp_path):
    """Three steps take 0.2 s each; one call may take 0.35 s."""
    path = faulty_fmu(tmp_path)
    pauses = ("pause",) * 3
    envs, found = with_faults(make, path, pauses, (1, 2, 3), call_timeout=0.35, workers=1)
    assert found.lengths.tolist() == [6, 6, 6]
    assert envs.pool.health()["deaths"].tolist() == [0, 0, 0]
