"""Faults of single FMUs in vector environments, and FMUs that ask for the end."""

import logging

import fmu_tools
import numpy as np
import pytest
from combinations import in_turn
from gymnasium.vector import SyncVectorEnv
from vector_tools import (
    ABSURD,
    HOOKS,
    Cart,
    Drawing,
    PushedCart,
    each_way,
    in_each_mode,
    make_pair,
    require_same_infos,
    results_of_both,
    sampled_actions,
)
from ways import in_way

from fmugym import SimulationError


def require_same_reasons(first, second):
    """All infos, without the name of an instance, which has its number."""
    for infos in (first, second):
        said = infos.get("final_info", infos)
        if "fault" in said:
            said["fault"] = np.array([str(text)[-20:] for text in said["fault"]], dtype=object)
    require_same_infos(first, second)


@in_each_mode({"on_fault": ["truncate", "terminate"], "cls": [Cart, PushedCart]})
def test_faults_are_those_of_single_environments(cls, on_fault, mode, hooks):
    logging.getLogger(f"fmugym.{cls.__name__}").setLevel(logging.CRITICAL)
    ours, theirs = make_pair(cls, mode, way=hooks, on_fault=on_fault)
    rng = np.random.default_rng(1)
    absurd = rng.random((60, 4)) < 0.1
    pushes = np.where(absurd, ABSURD, rng.uniform(-1, 1, (60, 4)))[..., None]
    actions = list(pushes if cls is Cart else absurd.astype(np.int64))
    reasons = 0
    for result in results_of_both(ours, theirs, actions, same_infos=require_same_reasons):
        reasons += np.count_nonzero(result[4].get("final_info", result[4]).get("_fault", False))
    assert reasons > 10
    ours.close()
    theirs.close()


@in_turn({"hooks": HOOKS, "cls": [Cart, PushedCart]})
def test_a_fault_may_be_raised(cls, hooks, make_envs):
    vector = make_envs(in_way(hooks, lambda: cls(on_fault="raise")), 3)
    vector.reset(seed=0)
    fine, absurd = ([0.5], [ABSURD]) if cls is Cart else (0, 1)
    with pytest.raises(SimulationError, match="returned Discard"):
        vector.step(np.array([fine, absurd, fine]))
    vector.reset(seed=0)
    assert np.isfinite(vector.step(np.array([fine] * 3))[0]).all()


@in_turn({"hooks": HOOKS, "version": [2, 3]})
def test_an_fmu_may_ask_for_the_end(version, hooks, probe, make_envs):
    """The one whose parameters say so stops in its third step."""

    class Stopping(fmu_tools.PlainEnv):
        def __init__(self, **parameters):
            config = fmu_tools.probe_config(model_parameters=parameters)
            super().__init__(probe(version), config)

        def _reward_policy(self):
            return np.where(self.done, -5.0, self.inputs[0])

    def require_same_wishes(*infos):
        require_same_infos(*({k: v for k, v in one.items() if "fmu" in k} for one in infos))

    stop = {"fault": 6, "fault_step": 3}
    vector = make_envs(in_way(hooks, Stopping), 3)
    for name, value in stop.items():
        vector.set_attr(name, [0, value, 0])
    theirs = SyncVectorEnv([Stopping, lambda: Stopping(**stop), Stopping])
    results = results_of_both(vector, theirs, 10, same_infos=require_same_wishes)
    ends = np.array([result[2] for result in results])
    assert np.argwhere(ends).tolist() == [[2, 1], [6, 1]]
    theirs.close()


@each_way
def test_a_start_that_fails_is_an_error(hooks, make_env, make_envs):
    vector = make_envs(in_way(hooks, make_env), 2)
    vector.reset()
    with pytest.raises(SimulationError, match="init"):
        vector.reset(options={"model_parameters": {"init_status": 3}})
    vector.reset()
    vector.step(np.zeros((2, 1), np.float32))


class Rewarding(Drawing):
    """Its reward is not finite in some steps, and its observation overflows in others."""

    def __init__(self, **changes):
        changes = {"fault_reward": -7.0, "episode_variables": {"sum": 0.0}} | changes
        super().__init__(max_episode_steps=12, **changes)

    def _update(self):
        self.variables["sum"] += self.state[0]

    def _reward_policy(self):
        q, q_dot = self.state
        wrong = np.where(self.step_count % 2 == 0, np.nan, -np.inf)
        return np.where(q_dot > 3.0, wrong, q)

    def _get_observation(self):
        q, q_dot = self.state
        return np.array([np.where(q_dot < -3.0, np.inf, q), q_dot], np.float32)

    def _get_info(self):
        return {"sum": self.variables["sum"], "count": self.step_count}


@in_each_mode({"on_fault": ["truncate", "terminate"]})
def test_numbers_that_are_not_finite_are_faults_as_in_single_environments(on_fault, mode, hooks):
    logging.getLogger("fmugym.Rewarding").setLevel(logging.CRITICAL)
    way = hooks
    ours, theirs = make_pair(Rewarding, mode, way=way, num_envs=6, on_fault=on_fault)
    ends = [result[2] | result[3] for result in results_of_both(ours, theirs, 60)]
    assert np.sum(ends) > 20
    counts = ours.health["not_finite"]
    assert counts.tolist() == [env.health["not_finite"] for env in theirs.envs]
    assert counts.sum() > 5
    ours.close()
    theirs.close()


@each_way
def test_a_number_that_is_not_finite_may_be_raised(hooks, make_envs):
    vector = make_envs(in_way(hooks, lambda: Rewarding(on_fault="raise")), 9)
    vector.reset(seed=1)
    actions = sampled_actions(vector, 12)
    with pytest.raises(SimulationError, match=r"environment \d: (_reward_policy returned|the obs)"):
        list(map(vector.step, actions))


class Overflowing(Drawing):
    """Its observation is too large for the float32 of its space once the pendulum is fast."""

    def _get_observation(self):
        q, q_dot = self.state
        return np.array([np.where(abs(q_dot) > 2.0, 1e300, q), q_dot])


@each_way
def test_an_observation_that_overflows_is_a_fault(hooks, make_envs):
    logging.getLogger("fmugym.Overflowing").setLevel(logging.CRITICAL)
    vector = make_envs(in_way(hooks, lambda: Overflowing(max_episode_steps=9)), 5)
    vector.reset(seed=1)
    faults = 0
    for actions in sampled_actions(vector, 30):
        observations, *_, infos = vector.step(actions)
        assert np.isfinite(observations).all()
        faults += int(infos["_fault"].sum()) if "_fault" in infos else 0
    assert faults > 5


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
