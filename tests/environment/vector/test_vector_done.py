"""``done`` of each environment, as a single environment has it, in every way of calling hooks."""

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode
from vector_tools import (
    CART_POLE,
    PushedCart,
    each_mode,
    in_each_mode,
    require_equal,
    results_of_both,
)
from ways import in_way

import fmugym
from fmugym import SimulationError
from fmugym.environment.vector import FMUVectorEnv
from fmugym.records import RecordVectorSeries

KINDS = "arrays"
each_kind = pytest.mark.parametrize("hooks", KINDS)


class Faulty(PushedCart):
    """Episodes end by the task, by their length, and by faults."""

    policy = "terminate"

    def __init__(self):
        super().__init__(max_episode_steps=6, on_fault=self.policy, fault_reward=-7.0)


class Truncating(Faulty):
    """A fault is not the end of the task."""

    policy = "truncate"


class Raising(Faulty):
    """A fault is an exception."""

    policy = "raise"


@pytest.fixture
def pair(make_envs):
    def make(task, hooks, mode, num_envs=6):
        return tuple(
            make_envs(in_way(way, task), num_envs, autoreset_mode=mode)
            for way in (hooks, "one by one")
        )

    return make


@in_each_mode({"task": [CART_POLE, Faulty, Truncating]}, KINDS)
def test_done_is_that_of_single_environments(task, mode, hooks, pair):
    ours, theirs = pair(task, hooks, mode)
    seen = set()
    for result in results_of_both(ours, theirs):
        done = ours.get_attr("done")
        assert done == theirs.get_attr("done")
        assert all(type(value) is bool for value in done)
        if mode is not AutoresetMode.SAME_STEP:
            assert list(done) == result[2].tolist()
        seen |= set(zip(result[2].tolist(), result[3].tolist(), strict=True))
    assert len(seen) > 1


@each_kind
def test_the_callers_array_is_not_done(hooks, pair):
    ours, theirs = pair(CART_POLE, hooks, AutoresetMode.NEXT_STEP)
    for result in results_of_both(ours, theirs):
        expected = tuple(result[2].tolist())
        result[2][:] = ~result[2]
        assert ours.get_attr("done") == theirs.get_attr("done") == expected
        result[2][:] = expected


@each_kind
def test_rollouts_leave_done_and_snapshots_have_it(hooks, make_envs):
    envs = make_envs(in_way(hooks, CART_POLE), 4, autoreset_mode=AutoresetMode.DISABLED)
    envs.reset(seed=0)
    while not any(done := envs.get_attr("done")):
        envs.step(np.ones(4, np.int64))
    candidate = envs.save_state(int(np.argmin(done)))
    envs.rollout(candidate, np.ones((8, 30), np.int64))
    other = make_envs(in_way("one by one", CART_POLE), 4)
    other.restore_state(envs.save_state())
    assert envs.get_attr("done") == other.get_attr("done") == done


@each_kind
def test_an_error_in_episodes_with_options_leaves_no_other_done(hooks, pair):
    """Such episodes are played on arrays, and an error may come within a step."""
    ours, theirs = pair(Raising, hooks, AutoresetMode.DISABLED, 3)
    for envs in ours, theirs:
        envs.reset(seed=4, options={"model_parameters": {"m_cart": 2.0}})
        envs.step(np.zeros(3, np.int64))
        with pytest.raises(SimulationError, match="environment 1"):
            envs.step(np.array([0, 1, 0]))
    for _ in results_of_both(ours, theirs, [np.zeros(3, np.int64)] * 12, seed=5):
        for name in ("done", "action", "step_count", "previous_state"):
            assert ours.get_attr(name) == theirs.get_attr(name)


TASK = {
    "fmu": {"bundled": "Pendulum"},
    "time_step": 0.05,
    "variables": {"angle": {"name": "q"}, "tau": {"min": -0.1, "max": 0.1}},
    "agent": {"actions": ["tau"], "observations": ["angle", "q_dot"]},
    "parameters": {"q_0": {"distribution": "uniform", "low": -1, "high": 1}},
    "reward": {"end": "10 * done", "near": "-abs(angle)"},
    "costs": {"last": "done"},
    "terminated": "abs(angle) > 0.9",
}


@each_kind
@each_mode
def test_costs_in_a_series_have_the_done_of_their_step(mode, hooks):
    """They come from the infos; where ``done`` is a cost, it is what the row says of the end."""
    ours, theirs = (
        RecordVectorSeries(
            FMUVectorEnv(
                in_way(way, lambda: fmugym.load(TASK)), 3, max_episode_steps=9, autoreset_mode=mode
            )
        )
        for way in (hooks, "one by one")
    )
    list(results_of_both(ours, theirs))
    rows = [{c.name: envs.series[c.name] for c in envs.series.columns} for envs in (ours, theirs)]
    require_equal(*rows)
    is_step = rows[0]["step"] > 0
    assert rows[0]["costs.last"].any()
    np.testing.assert_array_equal(rows[0]["costs.last"][is_step], rows[0]["terminated"][is_step])
    ours.close()
    theirs.close()


class Judged(Faulty):
    """Rewards are not numbers at times; the info tells what a hook reads then."""

    def _get_inputs(self):
        return self.action

    def _reward_policy(self):
        return np.where(self.state[1] < -0.006, np.nan, 0.0)

    def _get_info(self):
        return {"done": self.done}


class Cut(Judged, Truncating):
    """A fault is not the end of the task."""


class Broken(Faulty):
    """The FMU fails at times; observations and infos tell what a hook reads then."""

    def _is_done(self):
        return (self.step_count > 1) & (self.state[0] > 0.0)

    def _get_observation_space(self):
        return gym.spaces.Box(-np.inf, np.inf, (2,), np.float64)

    def _get_observation(self):
        return np.stack([self.state[0], 1.0 * self.done])

    def _get_info(self):
        return {"done": self.done}


class BrokenCut(Broken, Truncating):
    """A fault is not the end of the task."""


class Doomed(Broken):
    """Episodes may start where they end."""

    def _get_inputs(self):
        return self.action

    def _is_done(self):
        return self.state[0] > 0.2


@in_each_mode({"task": [Broken, BrokenCut, Doomed]}, KINDS)
def test_observations_have_done(task, mode, hooks, pair):
    """Of a step whose FMU failed it is what the fault makes it; of a start, it is False."""
    ours, theirs = pair(task, hooks, mode)
    seen = {flag for result in results_of_both(ours, theirs) for flag in result[0][:, 1].tolist()}
    assert seen == ({0.0} if mode is AutoresetMode.SAME_STEP else {0.0, 1.0})


@in_each_mode({"task": [Judged, Cut]}, KINDS)
def test_infos_of_faults_have_done(task, mode, hooks, pair):
    ours, theirs = pair(task, hooks, mode)
    infos = [result[4].get("final_info", result[4]) for result in results_of_both(ours, theirs)]
    assert any(np.any(told.get("_fault", False)) for told in infos)
