"""The same seed and actions give the same bits, wherever and in whatever company the FMU runs."""

import functools
import itertools
from pathlib import Path

import foreign_tank
import numpy as np
import pytest
from pythonfmu.builder import FmuBuilder
from test_foreign_fmu import TankEnv

import fmugym
from fmugym.archive.bundled import FMI_VERSIONS
from fmugym.envs import CartPoleEnv, PendulumEnv
from fmugym.vector.making import make_with_pool

NUM_ENVS = 3
STEPS = 60
"""Long enough for random actions to let poles fall, and for tanks to run to their limit."""

SINGLE = {
    "native": {},
    "process": {"isolation": "process"},
}
VECTOR = {
    **{f"{threads} threads": {"threads": threads} for threads in (1, 2, 3)},
    "per env": {"hooks": "per_env"},
    **{f"{n} workers": {"isolation": "process", "workers": n} for n in (1, 2, 3)},
}
"""Options of single and of vector environments, each a way to run the same FMU."""


class ShortPendulum(PendulumEnv):
    """Its episodes end."""

    def _is_truncated(self):
        return self.step_count >= 25


@pytest.fixture(scope="module", name="tank_fmu")
def fixture_tank_fmu(tmp_path_factory):
    return Path(FmuBuilder.build_FMU(foreign_tank.__file__, tmp_path_factory.mktemp("tank")))


@pytest.fixture(
    scope="module",
    params=[
        *itertools.product((CartPoleEnv, ShortPendulum), FMI_VERSIONS),
        (TankEnv, ""),
    ],
    ids=lambda param: f"{param[0].__name__}{param[1]}",
)
def task(request, tank_fmu):
    """What makes the environment, and what it does alone."""
    cls, version = request.param
    if version:
        make = functools.partial(cls, fmi_version=version)
    else:
        make = functools.partial(cls, tank_fmu, max_episode_steps=25)
    return make, [alone(make, index)[0] for index in range(NUM_ENVS)]


def actions_in(space, index):
    """The same for an environment alone and for the one with this index among others."""
    space.seed(100 + index)
    return [space.sample() for _ in range(STEPS)]


def alone(make, index=0, episodes=1, **options):
    """Make rollouts of an environment of its own; one in bytes for each seeded reset."""
    env = make_with_pool(make, **options)
    try:
        actions = actions_in(env.action_space, index)
        return [_rollout(env, 7 + index, actions) for _ in range(episodes)]
    finally:
        env.close()


def _rollout(env, seed, actions):
    """A step after the end is a reset, as in a vector environment."""
    rows, ended = [_row(env.reset(seed=seed)[0])], False
    for action in actions:
        if ended:
            rows.append(_row(env.reset()[0]))
            ended = False
        else:
            observation, *rest = env.step(action)[:4]
            rows.append(_row(observation, *rest))
            ended = rest[1] or rest[2]
    return rows


def _row(observation, reward=0.0, terminated=False, truncated=False):
    numbers = np.float64(reward), np.bool_(terminated), np.bool_(truncated)
    return observation.tobytes(), *(number.tobytes() for number in numbers)


def together(make, rollouts=1, **options):
    """Make rollouts of a vector environment; for each the rows of each environment."""
    env = fmugym.FMUVectorEnv(make, NUM_ENVS, **options)
    try:
        columns = [actions_in(env.single_action_space, index) for index in range(NUM_ENVS)]
        actions = [np.stack(row) for row in zip(*columns, strict=True)]
        return [_vector_rollout(env, actions) for _ in range(rollouts)]
    finally:
        env.close()


def _vector_rollout(env, actions):
    observations = env.reset(seed=[7 + index for index in range(NUM_ENVS)])[0]
    rows = [[_row(observation)] for observation in observations]
    for action in actions:
        results = zip(*env.step(action)[:4], strict=True)
        for row, result in zip(rows, results, strict=True):
            row.append(_row(*result))
    return rows


def test_rollouts_differ_where_they_should(task):
    """The comparison below is able to fail: seeds and actions matter, and episodes end."""
    _, reference = task
    assert reference[0] != reference[1] != reference[2]
    ends = [row[2] + row[3] for rollout in reference for row in rollout]
    assert len(set(ends)) > 1


@pytest.mark.parametrize("way", SINGLE)
def test_alone(task, way):
    """Twice with one environment, once with another one."""
    make, reference = task
    assert alone(make, 0, episodes=2, **SINGLE[way]) == [reference[0]] * 2
    assert alone(make, 1, **SINGLE[way]) == [reference[1]]


@pytest.mark.parametrize("way", VECTOR)
def test_together(task, way):
    """Twice in a row."""
    make, reference = task
    assert together(make, 2, **VECTOR[way]) == [reference] * 2
