"""The hook check finds hooks that work for one environment at a time only."""

import logging

import gymnasium as gym
import numpy as np
import pytest
from vector_tools import (
    IDS,
    Drawing,
    Historic,
    Reaching,
    Remembering,
    Shifted,
    each_mode,
    make_pair,
    require_pair_equal,
    sampled_actions,
)

from fmugym import ConfigError, ContractError
from fmugym.testing import check_hooks
from fmugym.vector import FMUVectorEnv


class Branching(Drawing):
    def _is_done(self):
        if abs(self.state[0]) > 0.5:
            return True
        return self.state[1] > 1.0


class FarLimit(Drawing):
    """The hook check's own steps do not reach the limit."""

    def _is_done(self):
        return np.any(self.state[0] > 40.0)


class NormOfArray(Drawing):
    def _reward_policy(self):
        return -np.linalg.norm(self.state)


class Mean(Drawing):
    def _get_observation(self):
        return np.array(self.state, np.float32) - np.mean(self.state)


class BranchingInputs(Drawing):
    def _get_inputs(self):
        return self.action if self.action[0] > 0 else -self.action


class BranchingUpdate(Drawing):
    def __init__(self):
        super().__init__(episode_variables={"count": 0.0})

    def _update(self):
        if self.state[0] > 0.3:
            self.variables["count"] = self.variables["count"] + 1.0

    def _get_info(self):
        return {"count": self.variables["count"]}


class BranchingTruncation(Drawing):
    def _is_truncated(self):
        return bool(self.state[0] > 0.8)


class BranchingInfo(Drawing):
    def _get_info(self):
        return {"fast": "yes" if self.state[1] > 0.1 else "no"}


class InPlace(Drawing):
    """Changes numbers of its own, but arrays of everyone's."""

    def _reward_policy(self):
        q, q_dot = self.state
        q *= 2.0
        return q + q_dot


class Table(Drawing):
    """Fails for states of other magnitudes."""

    def _reward_policy(self):
        return (1.0, 2.0, 3.0)[1 + int(np.sign(self.state[0]) * (abs(self.state[0]) < 2.0) * 1.0)]


class Counting(Drawing):
    """Remembers in attributes."""

    def __init__(self):
        super().__init__()
        self.seen = []
        self.total = 0.0

    def _update(self):
        self.seen.append(self.state[0])
        self.total += self.state[0]

    def _get_info(self):
        return {"seen": len(self.seen), "total": self.total}


class OwnGenerator(Drawing):
    def __init__(self):
        super().__init__()
        self.rng = np.random.default_rng(3)

    def _update(self):
        self.noise = self.rng.normal()

    def _reward_policy(self):
        return self.noise


class OwnStep(Drawing):
    """Overrides what the tutorial's class overrides."""

    def __init__(self):
        super().__init__()
        self.steps = 0

    def step(self, action):
        self.steps += 1
        observation, reward, *ends, info = super().step(action)
        return observation, reward + self.steps, *ends, info


class OwnReset(Drawing):
    def reset(self, *, seed=None, options=None):
        observation, info = super().reset(seed=seed, options=options)
        return observation + np.float32(1), info


DIFFERENT = {
    Branching: "_is_done fails on arrays",
    FarLimit: "_is_done gives other values",
    NormOfArray: "_reward_policy gives other values",
    Mean: "_get_observation gives other values",
    BranchingInputs: "_get_inputs fails on arrays",
    BranchingUpdate: "_update fails on arrays",
    BranchingTruncation: "_is_truncated fails on arrays",
    BranchingInfo: "_get_info fails on arrays",
    InPlace: "_reward_policy changes the arrays in self.state and self.out in place",
    Table: "_reward_policy fails on arrays",
    Counting: "_update changes self.seen",
    OwnGenerator: "_update changes self.rng",
    OwnStep: "step is overridden",
    OwnReset: "reset is overridden",
}


@pytest.mark.parametrize("cls", DIFFERENT, ids=lambda cls: cls.__name__)
def test_hooks_for_one_environment_only_are_called_one_by_one(cls, caplog):
    with caplog.at_level(logging.WARNING, "fmugym"):
        require_pair_equal(cls, steps=30, hooks="auto")
    (message,) = [r.getMessage() for r in caplog.records if "one environment" in r.getMessage()]
    assert message.startswith(f"{cls.__name__}: {DIFFERENT[cls]}")


@pytest.mark.parametrize("cls", DIFFERENT, ids=lambda cls: cls.__name__)
def test_they_can_be_found_ahead(cls):
    with pytest.raises(ContractError, match=DIFFERENT[cls]) as caught:
        check_hooks(cls)
    assert str(caught.value).startswith(cls.__name__)
    assert "numpy.where for 'if'" in str(caught.value)
    for hooks in ("array", "compiled"):
        with pytest.raises(ConfigError, match=DIFFERENT[cls]):
            FMUVectorEnv(cls, 2, hooks=hooks)


@pytest.mark.parametrize("cls", [Drawing, Remembering, Reaching, Historic, Shifted])
def test_element_wise_hooks_pass_without_a_word(cls, caplog):
    assert check_hooks(cls) is None
    vector = FMUVectorEnv(cls, 2)
    vector.close()
    assert not caplog.records


@pytest.mark.parametrize("env_id", IDS)
def test_hooks_of_all_ids_pass(env_id):
    check_hooks(gym.make, id=env_id)


def test_check_hooks_is_for_environments_of_this_package():
    with pytest.raises(ConfigError, match="expected an environment of fmugym, got CartPoleEnv"):
        check_hooks(lambda: gym.make("CartPole-v1"))


def test_a_prototype_that_does_not_fit_is_closed(temp_root):
    with pytest.raises(ConfigError):
        FMUVectorEnv(Branching, 2, hooks="array")
    assert not list(temp_root.iterdir())


class Unknown(Drawing):
    """NaN stands for what is not known, in attributes, variables and infos."""

    def __init__(self):
        super().__init__(episode_variables={"last": 0.0})
        self.unknown = float("nan")
        self.table = {"a": [float("nan"), np.float64("nan")], "b": np.array([np.nan, 1.0])}

    def _update(self):
        self.variables["last"] = np.where(self.state[0] > 0, np.nan, self.state[0])
        self.unknown = float("nan")

    def _get_info(self):
        return {
            "last": self.variables["last"],
            "unknown": self.unknown,
            "n": self.out["q"] * np.nan,
        }


def test_nan_equals_nan(caplog):
    check_hooks(Unknown)
    require_pair_equal(Unknown, steps=20, hooks="auto")
    assert not caplog.records


class TwoParts(Drawing):
    """Observations that are a tuple make no array."""

    def _get_observation_space(self):
        box = gym.spaces.Box(-np.inf, np.inf, (1,), np.float32)
        return gym.spaces.Tuple([box, box])

    def _get_observation(self):
        q, q_dot = self.state
        return np.array([q], np.float32), np.array([q_dot], np.float32)


@each_mode
def test_observations_of_several_parts(mode):
    ours, theirs = make_pair(TwoParts, mode, hooks="auto")
    for (first, _), (second, _) in [(ours.reset(seed=1), theirs.reset(seed=1))]:
        assert [part.tolist() for part in first] == [part.tolist() for part in second]
    for actions in sampled_actions(ours, 3):
        first, second = ours.step(actions), theirs.step(actions)
        assert [part.tolist() for part in first[0]] == [part.tolist() for part in second[0]]
    ours.close()
    theirs.close()
