"""Rollouts: what candidates would lead to equals what single environments do from a snapshot."""

import numpy as np
import pytest
from combinations import in_turn
from fmu_tools import PlainEnv, probe_config
from test_snapshots import Track
from ways import in_way

from fmugym import ConfigError, SimulationError
from fmugym.envs import CartPoleEnv, PendulumEnv

N, HORIZON = 5, 9
WAYS = {
    "arrays": {"way": "arrays"},
    "one by one": {"way": "one by one"},
    "process": {"isolation": "process"},
}


def actions_for(env, n=N, horizon=HORIZON, seed=0):
    env.action_space.seed(seed)
    return np.array([[env.action_space.sample() for _ in range(horizon)] for _ in range(n)])


def halfway(cls=Track, steps=5, **changes):
    env = cls(**changes)
    env.reset(seed=4)
    for action in actions_for(env, 1, steps)[0]:
        env.step(action)
    return env


def one_by_one(env, snapshot, actions):
    """The same rollout with a single environment."""
    rows = []
    for index, candidate in enumerate(actions):
        env.restore_state(snapshot[index] if len(snapshot) > 1 else snapshot)
        row, over = [], False
        for action in candidate:
            if over:
                row.append((row[-1][0], 0.0, False, False))
                continue
            observation, reward, *ends, _ = env.step(action)
            over = any(ends)
            row.append((observation.tolist(), reward, *ends))
        rows.append(row)
    return rows


def rows_of(rollout):
    observations, rewards, terminated, truncated, _ = (part.tolist() for part in rollout)
    return [
        list(zip(*candidate, strict=True))
        for candidate in zip(observations, rewards, terminated, truncated, strict=True)
    ]


class TestValues:
    @in_turn(
        {
            "way": WAYS,
            "version": ["2.0", "1.0", "3.0"],
            "mode": ["Disabled", "NextStep", "SameStep"],
        }
    )
    def test_are_those_of_single_environments(self, way, version, mode, make_envs):
        env = halfway(fmi_version=version)
        envs = make_envs(lambda: Track(fmi_version=version), 3, autoreset_mode=mode, **way)
        snapshot, actions = env.save_state(), actions_for(env)
        found = envs.rollout(snapshot, actions)
        assert rows_of(found) == one_by_one(env, snapshot, actions)
        assert found.lengths.tolist() == [7] * N  # the limit of 12 steps
        assert found.observations.shape == (N, HORIZON, 2)
        env.close()

    @in_turn({"threads": [1, 2], "cls": [CartPoleEnv, PendulumEnv]})
    def test_of_many_candidates_in_several_rounds(self, cls, threads, vector_of):
        env = halfway(cls)
        envs = vector_of(in_way("arrays", cls), 67, threads=threads)
        snapshot, actions = env.save_state(), actions_for(env, 150, 40)
        found = envs.rollout(snapshot, actions)
        picked = [0, 31, 66, 67, 149]
        few = type(found)(*(part[picked] for part in found))
        assert rows_of(few) == one_by_one(env, snapshot, actions[picked])
        alone = vector_of(cls, 1).rollout(snapshot, actions[picked])
        assert rows_of(alone) == rows_of(few)

    @pytest.mark.parametrize("way", WAYS.values(), ids=WAYS)
    def test_from_the_present_episodes_which_go_on_afterwards(self, way, vector_of):
        envs = vector_of(Track, N, **way)
        envs.reset(seed=0)
        actions = actions_for(envs.prototype)
        envs.step(actions[:, 0])
        before = envs.save_state()
        found = envs.rollout(None, actions)
        assert envs.save_state() == before
        assert rows_of(envs.rollout(before, actions)) == rows_of(found)
        with Track() as env:
            assert rows_of(found) == one_by_one(env, before, actions)
        observations, *_ = envs.step(actions[:, 0])
        assert observations.tolist() == found.observations[:, 0].tolist()

    @pytest.mark.parametrize("hooks", ["arrays", "one by one"])
    def test_of_a_policy(self, hooks, vector_of):
        def policy(observations):
            return np.clip(-0.05 * observations[:, :1], -0.01, 0.01).astype(np.float32)

        envs = vector_of(in_way(hooks, Track), N)
        envs.reset(seed=2)
        envs.step(np.zeros((N, 1), np.float32))
        snapshot = envs.save_state()
        found = envs.rollout(None, policy, horizon=HORIZON)
        with Track() as env:
            for index in range(N):
                observation = env.restore_state(snapshot[index])
                for step in range(HORIZON):
                    observation, reward, *_ = env.step(policy(observation[None])[0])
                    assert observation.tolist() == found.observations[index, step].tolist()
                    assert reward == found.rewards[index, step]


def test_a_policy_is_not_asked_once_all_have_ended(vector_of):
    asked = []

    def policy(observations):
        asked.append(len(observations))
        return np.zeros((N, 1), np.float32)

    envs = vector_of(Track, N)
    envs.reset(seed=2)
    found = envs.rollout(None, policy, horizon=20)
    assert found.lengths.tolist() == [12] * N
    assert asked == [N] * 12
    assert (found.observations[:, 12:] == found.observations[:, 11:12]).all()
    assert not found.rewards[:, 12:].any()


class TestParameters:
    @in_turn({"way": WAYS, "version": ["2.0", "3.0"]})
    def test_of_each_candidate(self, way, version, vector_of):
        """A tunable friction, also read by a hook; the same values set before the reset."""

        class Rubbing(Track):
            def __init__(self, b=1e-4):
                parameters = {"b": b, "q_0": 0.5, "m": 0.06}
                super().__init__(fmi_version=version, model_parameters=parameters)

            def _reward_policy(self):
                return self.out["q"] * self.parameters["b"]

        frictions = np.array([0.0, 1e-4, 2e-4, 3e-4, 1e-3])
        with Rubbing() as env:
            env.reset(seed=0)
            snapshot, actions = env.save_state(), actions_for(env)
        envs = vector_of(Rubbing, 3, **way)
        found = envs.rollout(snapshot, actions, parameters={"b": frictions})
        for index, b in enumerate(frictions):
            with Rubbing(b) as env:
                env.reset(seed=0)
                for step in range(HORIZON):
                    observation, reward, *_ = env.step(actions[index, step])
                    assert observation.tolist() == found.observations[index, step].tolist()
                    assert reward == found.rewards[index, step]
        same = envs.rollout(snapshot, actions, parameters={"b": 1e-4})
        assert rows_of(same) == rows_of(envs.rollout(snapshot, actions))

    def test_that_are_refused(self, vector_of):
        env, envs = halfway(), vector_of(Track, 2)
        snapshot, actions = env.save_state(), actions_for(env, 2)
        for parameters, reason in (
            ({"m": 0.1}, "fixed parameter"),
            ({"tau": 0.1}, "continuous input"),
            ({"bb": 0.1}, "'b'"),
            ({"b": [0.1]}, "1 values of 'b', expected 2"),
            ({"b": [0.1, float("nan")]}, "finite"),
            ("b", "parameters"),
        ):
            with pytest.raises(ConfigError, match=reason):
                envs.rollout(snapshot, actions, parameters=parameters)


class TestFaults:
    @in_turn({"hooks": ["arrays", "one by one"], "policy": ["truncate", "terminate"]})
    def test_end_a_candidate(self, probe, hooks, policy, vector_of):
        faults = {"fault": 3, "fault_step": 4}
        config = probe_config(model_parameters=faults, fault_reward=-7.0, on_fault=policy)
        envs = vector_of(in_way(hooks, lambda: PlainEnv(probe(), config)), 2)
        envs.reset(seed=0)
        actions = np.zeros((2, 6, *envs.single_action_space.shape), np.float32)
        found = envs.rollout(None, actions)
        length = int(found.lengths[0])
        assert 0 < length < 6
        ends = {"truncate": found.truncated, "terminate": found.terminated}[policy]
        assert ends[0].tolist() == [step == length - 1 for step in range(6)]
        assert found.rewards[0, length - 1 :].tolist() == [-7.0] + [0.0] * (6 - length)
        assert not envs.step(actions[:, 0])[3].any()

    def test_raise_if_asked_for(self, probe, vector_of):
        faults = {"fault": 3, "fault_step": 2}
        config = probe_config(model_parameters=faults, on_fault="raise")
        envs = vector_of(lambda: PlainEnv(probe(), config), 2)
        envs.reset(seed=0)
        with pytest.raises(SimulationError, match="environment 0"):
            envs.rollout(None, np.zeros((2, 6, *envs.single_action_space.shape), np.float32))


class TestRefusals:
    def test_of_actions(self, vector_of):
        env = halfway(CartPoleEnv)
        snapshot = env.save_state()
        envs = vector_of(CartPoleEnv, 2)
        for actions, reason in (
            (np.zeros((2, 3, 1), int), "shape"),
            (np.zeros(3, int), "shape"),
            (np.zeros((0, 3), int), "shape"),
            ([[0, 1], [0, 2]], "candidate 1: action 2 of step 1"),
            ("left", "shape"),
            (lambda observations: [0, 0], "horizon.*positive integer, got None"),
        ):
            with pytest.raises(ConfigError, match=reason):
                envs.rollout(snapshot, actions)
        with pytest.raises(ConfigError, match="3 steps, but horizon = 4"):
            envs.rollout(snapshot, np.zeros((2, 3), int), horizon=4)

    def test_of_snapshots(self, vector_of):
        env, envs = halfway(CartPoleEnv), vector_of(CartPoleEnv, 2)
        actions = np.zeros((3, 4), int)
        with pytest.raises(SimulationError, match="before the first reset"):
            envs.rollout(None, actions)
        envs.reset(seed=0)
        with pytest.raises(ConfigError, match="3 candidates, but 2 episodes"):
            envs.rollout(None, actions)
        with pytest.raises(ConfigError, match="expected a snapshot"):
            envs.rollout("here", actions)
        with Track() as other:
            other.reset(seed=0)
            with pytest.raises(ConfigError, match="FMU"):
                envs.rollout(other.save_state(), actions)
        while not env.step(1)[2]:
            pass
        with pytest.raises(SimulationError, match="has ended"):
            envs.rollout(env.save_state(), actions)

    def test_leaves_no_episodes_behind(self, vector_of):
        env, envs = halfway(CartPoleEnv), vector_of(CartPoleEnv, 3)
        envs.rollout(env.save_state(), np.zeros((3, 4), int))
        with pytest.raises(SimulationError, match="before the first reset"):
            envs.step([0, 0, 0])
