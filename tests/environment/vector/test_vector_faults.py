"""Faults of single FMUs in vector environments, and FMUs that ask for the end."""

import numpy as np
import pytest
from combinations import in_turn
from contract_cases import Faulty, NotFinite
from vector_tools import (
    ABSURD,
    HOOKS,
    Cart,
    Drawing,
    PushedCart,
    each_way,
    results_of_both,
    sampled_actions,
)
from ways import in_way

from fmugym import SimulationError


@in_turn({"hooks": HOOKS, "cls": [Cart, PushedCart]})
def test_a_fault_may_be_raised(cls, hooks, make_envs):
    vector = make_envs(in_way(hooks, lambda: cls(on_fault="raise")), 3)
    vector.reset(seed=0)
    fine, absurd = ([0.5], [ABSURD]) if cls is Cart else (0, 1)
    with pytest.raises(SimulationError, match="returned Discard"):
        vector.step(np.array([fine, absurd, fine]))
    vector.reset(seed=0)
    assert np.isfinite(vector.step(np.array([fine] * 3))[0]).all()


@each_way
def test_a_start_that_fails_is_an_error(hooks, make_env, make_envs):
    vector = make_envs(in_way(hooks, make_env), 2)
    vector.reset()
    with pytest.raises(SimulationError, match="init"):
        vector.reset(options={"model_parameters": {"init_status": 3}})
    vector.reset()
    vector.step(np.zeros((2, 1), np.float32))


@each_way
def test_a_number_that_is_not_finite_may_be_raised(hooks, make_envs):
    vector = make_envs(in_way(hooks, lambda: NotFinite(on_fault="raise")), 9)
    vector.reset(seed=1)
    actions = sampled_actions(vector, 12)
    with pytest.raises(SimulationError, match=r"environment \d: (_reward_policy returned|the obs)"):
        list(map(vector.step, actions))


@each_way
def test_a_first_observation_that_is_not_finite(hooks, make_envs):
    class Blind(Drawing):
        def _get_observation(self):
            return np.array(self.state) / (0.0 * self.step_count + 0.0)

    vector = make_envs(in_way(hooks, Blind), 2)
    with (
        np.errstate(all="ignore"),
        pytest.raises(SimulationError, match="the first observation"),
    ):
        vector.reset()


def test_an_error_in_episodes_with_options_leaves_no_other_done(make_envs):
    """Such episodes are played on arrays, and an error may come within a step."""
    ours, theirs = (
        make_envs(in_way(way, lambda: Faulty("raise")), 3, autoreset_mode="disabled")
        for way in HOOKS
    )
    for envs in ours, theirs:
        envs.reset(seed=4, options={"model_parameters": {"m_cart": 2.0}})
        envs.step(np.zeros(3, np.int64))
        with pytest.raises(SimulationError, match="environment 1"):
            envs.step(np.array([0, 1, 0]))
    for _ in results_of_both(ours, theirs, [np.zeros(3, np.int64)] * 12, seed=5):
        for name in ("done", "action", "step_count", "previous_state"):
            assert ours.get_attr(name) == theirs.get_attr(name)
