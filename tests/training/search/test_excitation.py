"""Excitation: what it does depends on its seed only, and shows all of the range."""

from contextlib import closing
from types import SimpleNamespace

import numpy as np
import pytest

from fmugym.control.candidate_evaluation import CandidateEvaluator
from fmugym.control.surrogate.recorded_trajectories import Trajectories
from fmugym.envs import CartPoleEnv, PendulumEnv
from fmugym.training.search.excitation import excite
from fmugym.training.search.policy import ResidualAgent


def excited(make_env, envs, steps=60, count=7):
    trajectories = Trajectories()
    acting = {PendulumEnv: 1, CartPoleEnv: 2}[make_env]  # two levels
    probe = SimpleNamespace(agents=[ResidualAgent("constant action", acting=acting)], is_same=False)
    with closing(CandidateEvaluator(make_env, envs, steps, backend=trajectories)) as evaluator:
        excite(evaluator, trajectories, probe, count, np.random.default_rng(5))
        assert evaluator.steps == trajectories.steps
    return [one for one in trajectories.all() if one.steps]


@pytest.mark.parametrize("make_env", [PendulumEnv, CartPoleEnv])
def test_it_does_not_depend_on_the_number_of_environments(make_env):
    """Actions of the second are levels."""
    several, few = (
        sorted(excited(make_env, envs), key=lambda one: one.starts.tolist()) for envs in (7, 3)
    )
    assert len(several) == len(few) == 7
    for one, other in zip(several, few, strict=True):
        assert np.array_equal(one.inputs, other.inputs)
        assert np.array_equal(one.outputs, other.outputs)


def test_actions_reach_the_ends_and_differ_from_episode_to_episode():
    torques = np.array([one.inputs[:, 0] for one in excited(PendulumEnv, 7)])
    assert (torques.min(), torques.max()) == pytest.approx((-2, 2))
    assert len(np.unique(torques.round(6))) > 30
    assert len(np.unique(torques, axis=0)) == 7
