"""Faults of single FMUs in vector environments, and FMUs that ask for the end."""

import logging

import fmu_tools
import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from vector_tools import (
    ABSURD,
    Cart,
    Drawing,
    PushedCart,
    each_mode,
    each_way,
    make_pair,
    require_equal,
    require_same_infos,
    run_side_by_side,
    sampled_actions,
)

from fmugym import SimulationError
from fmugym.vector import FMUVectorEnv


@each_way
@each_mode
@pytest.mark.parametrize("on_fault", ["truncate", "terminate"])
def test_a_fault_ends_its_own_episode_only(on_fault, mode, hooks):
    for cls, fine, absurd in ((Cart, [0.5], [ABSURD]), (PushedCart, 0, 1)):
        vector, healthy = (
            FMUVectorEnv(
                lambda c=cls: c(on_fault=on_fault),
                3,
                autoreset_mode=mode,
                hooks=hooks,
            )
            for _ in range(2)
        )
        logging.getLogger(f"fmugym.{cls.__name__}").setLevel(logging.CRITICAL)
        first = vector.reset(seed=1)[0]
        healthy.reset(seed=1)
        good = np.array([fine] * 3)
        bad = np.array([fine, absurd, fine])
        others = [0, 2]
        result, expected = vector.step(bad), healthy.step(good)
        last = result[4]["final_obs"][1] if mode is AutoresetMode.SAME_STEP else result[0][1]
        assert last.tolist() == first[1].tolist()
        assert result[1].tolist() == [1.0, -7.0, 1.0]
        ends = [False, True, False]
        assert result[2].tolist() == (ends if on_fault == "terminate" else [False] * 3)
        assert result[3].tolist() == (ends if on_fault == "truncate" else [False] * 3)
        infos = result[4]["final_info"] if mode is AutoresetMode.SAME_STEP else result[4]
        assert infos["_fault"].tolist() == ends
        assert "returned Discard" in infos["fault"][1]
        if mode is not AutoresetMode.SAME_STEP:
            assert infos["fault"][0] is None
        if mode is AutoresetMode.DISABLED:
            vector.reset(options={"reset_mask": result[2] | result[3]})
        for _ in range(6):  # the failed one starts again and goes on
            assert result[0][others].tolist() == expected[0][others].tolist()
            result, expected = vector.step(good), healthy.step(good)
            assert np.isfinite(result[0]).all()
            assert "fault" not in result[4]
        assert vector.get_attr("step_count")[1] == 6 - (mode is AutoresetMode.NEXT_STEP)
        vector.close()
        healthy.close()


@each_way
@each_mode
def test_faults_are_those_of_single_environments(mode, hooks):
    logging.getLogger("fmugym.Cart").setLevel(logging.CRITICAL)
    ours, theirs = make_pair(Cart, mode, hooks=hooks)
    for env in (ours, theirs):
        env.reset(seed=4)
    rng = np.random.default_rng(1)
    reasons = 0
    for _ in range(40):
        actions = np.where(rng.random((4, 1)) < 0.1, ABSURD, rng.uniform(-1, 1, (4, 1)))
        a, b = ours.step(actions), theirs.step(actions)
        for left, right in zip(a[:4], b[:4], strict=True):
            require_equal(left, right)
        for infos in (a[4], b[4]):
            said = infos.get("final_info", infos)
            if "fault" in said:  # the name of an instance has its number
                reasons += int(said["_fault"].sum())
                said["fault"] = np.array([str(t)[-20:] for t in said["fault"]], dtype=object)
        require_same_infos(a[4], b[4])
        ended = a[2] | a[3]
        if mode is AutoresetMode.DISABLED and ended.any():
            for env in (ours, theirs):
                env.reset(options={"reset_mask": ended.copy()})
    assert reasons > 10
    ours.close()
    theirs.close()


@each_way
@pytest.mark.parametrize("cls", [Cart, PushedCart])
def test_a_fault_may_be_raised(cls, hooks):
    vector = FMUVectorEnv(lambda: cls(on_fault="raise"), 3, hooks=hooks)
    vector.reset(seed=0)
    fine, absurd = ([0.5], [ABSURD]) if cls is Cart else (0, 1)
    with pytest.raises(SimulationError, match="returned Discard"):
        vector.step(np.array([fine, absurd, fine]))
    vector.reset(seed=0)
    assert np.isfinite(vector.step(np.array([fine] * 3))[0]).all()
    vector.close()


@each_way
@pytest.mark.parametrize("version", [2, 3])
def test_an_fmu_may_ask_for_the_end(version, hooks, probe):
    """The one whose parameters say so stops in its third step."""

    class Stopping(fmu_tools.PlainEnv):
        def __init__(self, **parameters):
            config = fmu_tools.probe_config(model_parameters=parameters)
            super().__init__(probe(version), config)

        def _reward_policy(self):
            return np.where(self.done, -5.0, self.inputs[0])

    stop = {"fault": 6, "fault_step": 3}
    vector = FMUVectorEnv(Stopping, 3, hooks=hooks)
    for name, value in stop.items():
        vector.set_attr(name, [0, value, 0])
    theirs = SyncVectorEnv([Stopping, lambda: Stopping(**stop), Stopping])
    vector.reset(seed=0)
    theirs.reset(seed=0)
    ends = []
    for actions in sampled_actions(vector, 10):
        a, b = vector.step(actions), theirs.step(actions)
        for left, right in zip(a[:4], b[:4], strict=True):
            require_equal(left, right)
        ends.append(a[2].tolist())
        if a[2].any():
            require_same_infos(
                {k: v for k, v in a[4].items() if "fmu" in k},
                {k: v for k, v in b[4].items() if "fmu" in k},
            )
    assert [index for index, end in enumerate(ends) if end[1]] == [2, 6]
    assert not any(end[0] or end[2] for end in ends)
    vector.close()
    theirs.close()


class StoppingSteered(fmu_tools.PlainEnv):
    """Compiled, with a reward that depends on the action."""

    def __init__(self, path):
        config = fmu_tools.probe_config(model_parameters={"fault": 6, "fault_step": 2})
        super().__init__(path, config)

    def _get_action_space(self):
        return gym.spaces.Discrete(3)

    def _get_inputs(self):
        return self.action - 1.0

    def _reward_policy(self):
        return np.where(self.done, 10.0, 1.0) * self.action


@each_way
def test_the_reward_of_a_step_with_which_the_fmu_stops(hooks, probe):
    vector = FMUVectorEnv(lambda: StoppingSteered(probe()), 3, hooks=hooks)
    vector.reset()
    assert vector.step(np.array([2, 1, 0]))[1].tolist() == [2.0, 1.0, 0.0]
    assert vector.step(np.array([0, 1, 2]))[1].tolist() == [0.0, 10.0, 20.0]
    vector.close()


@each_way
def test_a_start_that_fails_is_an_error(hooks, make_env):
    vector = FMUVectorEnv(make_env, 2, hooks=hooks)
    vector.reset()
    with pytest.raises(SimulationError, match="init"):
        vector.reset(options={"model_parameters": {"init_status": 3}})
    vector.reset()
    vector.step(np.zeros((2, 1), np.float32))
    vector.close()


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


@each_way
@each_mode
@pytest.mark.parametrize("on_fault", ["truncate", "terminate"])
def test_numbers_that_are_not_finite_are_faults_as_in_single_environments(on_fault, mode, hooks):
    logging.getLogger("fmugym.Rewarding").setLevel(logging.CRITICAL)
    ours, theirs = make_pair(Rewarding, mode, hooks=hooks, num_envs=6, on_fault=on_fault)
    assert run_side_by_side(ours, theirs, mode, 60) > 20
    counts = ours.health["not_finite"]
    assert counts.tolist() == [env.health["not_finite"] for env in theirs.envs]
    assert counts.sum() > 5
    ours.close()
    theirs.close()


@each_way
def test_a_number_that_is_not_finite_may_be_raised(hooks):
    vector = FMUVectorEnv(lambda: Rewarding(on_fault="raise"), 9, hooks=hooks)
    vector.reset(seed=1)
    actions = sampled_actions(vector, 12)
    with pytest.raises(SimulationError, match=r"environment \d: (_reward_policy returned|the obs)"):
        step_with_all(vector, actions)
    vector.close()


def step_with_all(vector, batches):
    for actions in batches:
        vector.step(actions)


class Overflowing(Drawing):
    """Its observation is too large for the float32 of its space once the pendulum is fast."""

    def _get_observation(self):
        q, q_dot = self.state
        return np.array([np.where(abs(q_dot) > 2.0, 1e300, q), q_dot])


@each_way
def test_an_observation_that_overflows_is_a_fault(hooks):
    logging.getLogger("fmugym.Overflowing").setLevel(logging.CRITICAL)
    vector = FMUVectorEnv(lambda: Overflowing(max_episode_steps=9), 5, hooks=hooks)
    vector.reset(seed=1)
    faults = 0
    for actions in sampled_actions(vector, 30):
        observations, *_, infos = vector.step(actions)
        assert np.isfinite(observations).all()
        faults += int(infos["_fault"].sum()) if "_fault" in infos else 0
    assert faults > 5
    vector.close()


class Choosing(PushedCart):
    """Compiled, with a reward that is infinite for one of its actions."""

    def _get_inputs(self):
        return 1.0 * self.action

    def _reward_policy(self):
        return np.where(self.action == 1, self.state[0] * 1.0, np.inf)


@each_way
def test_an_infinite_reward_of_plain_arithmetic(hooks):
    logging.getLogger("fmugym.Choosing").setLevel(logging.CRITICAL)
    vector = FMUVectorEnv(Choosing, 3, hooks="compiled" if hooks == "auto" else hooks)
    vector.reset(seed=0)
    first = vector.step(np.array([1, 1, 1]))[0]
    observations, rewards, _, truncated, infos = vector.step(np.array([1, 0, 1]))
    assert truncated.tolist() == infos["_fault"].tolist() == [False, True, False]
    assert infos["fault"][1] == "_reward_policy returned inf at t = 0.04 s"
    assert rewards[1] == -7.0
    assert np.isfinite(rewards).all()
    assert observations[1].tolist() == first[1].tolist()
    assert observations[0].tolist() != first[0].tolist()
    assert vector.health["not_finite"].tolist() == [0, 1, 0]
    assert vector.step(np.array([1, 1, 1]))[1][1] == 0.0
    vector.close()


@each_way
def test_a_first_observation_that_is_not_finite(hooks):
    class Blind(Drawing):
        def _get_observation(self):
            return np.array(self.state) / (0.0 * self.step_count + 0.0)

    vector = FMUVectorEnv(Blind, 2, hooks=hooks)
    with (
        np.errstate(all="ignore"),
        pytest.raises(SimulationError, match="the first observation"),
    ):
        vector.reset()
    vector.close()
