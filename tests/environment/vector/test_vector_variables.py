"""Episode variables: which hooks write them, and which types they have in each way of calling."""

import gymnasium as gym
import numpy as np
import pytest
from combinations import in_turn
from gymnasium.vector import AutoresetMode
from vector_tools import Drawing, require_equal, require_pair_equal, sampled_actions
from ways import in_way

import fmugym
from fmugym import Uniform
from fmugym.environment.env_checker import check_hooks
from fmugym.environment.hooks import ORDER


class Summing(Drawing):
    """Adds to variables in place, as one writes sums in Python."""

    def __init__(self, **changes):
        variables = {"sum": 0.0, "left": Uniform(0.0, 1.0), "count": 0}
        super().__init__(episode_variables=variables, **changes)

    def _update(self):
        self.variables["sum"] += self.state[0]
        self.variables["left"] -= 0.1 * self.state[1]
        self.variables["count"] += 1

    def _reward_policy(self):
        return self.variables["sum"] + self.variables["left"] * self.variables["count"]


def test_sums_in_place():
    """``+=`` changes an array in place, where a number is replaced."""
    for mode in AutoresetMode:
        assert require_pair_equal(Summing, steps=20, mode=mode, way="arrays") > 5


class Swapping(Drawing):
    """Assigns arrays that the environment keeps itself, and parts of them."""

    def __init__(self):
        super().__init__(episode_variables={"one": 0.5, "other": 0.0, "pair": [1.0, 2.0]})

    def _update(self):
        one, other, pair = self.variables["one"], self.variables["other"], self.variables["pair"]
        self.variables["one"], self.variables["other"] = other, one + self.state[0]
        self.variables["pair"] = np.stack([pair[1], one + 0.0 * pair[0]])

    def _reward_policy(self):
        pair = self.variables["pair"]
        return self.variables["one"] + 10 * self.variables["other"] + 100 * pair[0] - pair[1]


def test_variables_may_be_swapped():
    for mode in AutoresetMode:
        assert require_pair_equal(Swapping, steps=20, mode=mode, way="arrays") > 5


class Changing(Drawing):
    """``_update`` assigns types that cannot hold all values that episodes start with."""

    def __init__(self):
        starts = {"level": 0.5, "drawn": Uniform(-1.0, 1.0), "last": 0.1, "past": [0.1, 2.0]}
        super().__init__(episode_variables=starts | {"on": 1.0, "mode": 3.0})

    def _update(self):
        high = self.state[0] > 0.0
        self.variables["level"] = np.where(high, 1, 2)
        self.variables["drawn"] = np.where(high, 1, 2)
        self.variables["last"] = np.float32(0.5) * self.action[0]
        self.variables["past"] = np.stack([self.action[0], self.action[0]])
        self.variables["on"] = high
        self.variables["mode"] = np.where(high, 4, 5)

    def _get_observation_space(self):
        return gym.spaces.Box(-np.inf, np.inf, (7,), np.float64)

    def _get_observation(self):
        level, drawn, last, past, on, mode = self.variables.values()
        parts = [level, drawn, last, past[0], past[1], on, mode]
        return np.stack([0.0 * self.state[0] + part for part in parts])


@in_turn({"mode": list(AutoresetMode), "hooks": ["arrays"]})
def test_each_episode_starts_with_the_whole_value(mode, hooks):
    """The first episode and later ones, while others have other types."""
    assert require_pair_equal(Changing, steps=20, mode=mode, way=hooks) > 5


def writing(hook):
    """A class whose hook writes an episode variable that the reward reads."""

    class Writing(Drawing):
        def __init__(self):
            super().__init__(episode_variables={"n": 0.5})

        def _reward_policy(self):
            return 2.0 * self.variables["n"] - self.state[0]

    good = getattr(Writing, hook)

    def write(self):
        result = good(self)
        self.variables["n"] = 0.5 * self.variables["n"] + 1.0
        return result

    setattr(Writing, hook, write)
    return Writing


@pytest.mark.parametrize("hook", [one for one in ORDER if one != "_update"])
def test_what_another_hook_than_update_writes_is_kept(hook):
    """Only ``_update`` may do so. Where another hook does, no way of calling it may lose that."""
    assert require_pair_equal(writing(hook), way="one by one", steps=20) > 5
    if hook != "_get_inputs":
        with pytest.raises(fmugym.ContractError, match=f"{hook} changes self.variables"):
            check_hooks(writing(hook))


class Queueing(Drawing):
    """A delay of discrete actions, and a table of pulses that is indexed with what it holds."""

    pulses = np.array([[0, 0, 0, 1], [0, 0, 1, 1], [0, 1, 1, 1], [1, 1, 1, 1]])

    def __init__(self):
        super().__init__(episode_variables={"queue": [0, 0, 0], "bits": 0, "mode": 1.0})

    def _get_action_space(self):
        return gym.spaces.MultiDiscrete([4, 2])

    def _get_inputs(self):
        level = self.pulses[self.variables["queue"][-1].astype(np.int64), self.step_count % 4]
        return 0.01 * level * (1 - 2 * self.action[1])

    def _update(self):
        newest = np.stack([self.action[0]])
        self.variables["queue"] = np.concatenate([newest, self.variables["queue"][:-1]])
        self.variables["bits"] = self.action[0] * (self.step_count % 3) + 2 * self.step_count
        self.variables["mode"] = np.where(self.state[0] > 0.0, 1.5, self.variables["mode"])

    def _reward_policy(self):
        whole, rest = divmod(self.step_count, 3)
        return np.sum(self.variables["queue"], axis=0) - self.variables["bits"] + whole / (1 + rest)


def test_a_variable_may_be_an_index():
    assert require_pair_equal(Queueing, way="arrays", steps=30) > 5


class Mixed(Drawing):
    """Actions in parts."""

    def _get_action_space(self):
        torque = gym.spaces.Box(-1.0, 1.0, (2,), np.float32)
        return gym.spaces.Dict(torque=torque, gear=gym.spaces.Tuple([gym.spaces.Discrete(3)]))

    def _get_inputs(self):
        return 0.01 * self.action["torque"][0] * self.action["gear"][0]

    def _reward_policy(self):
        return self.previous_action["gear"][0] - self.previous_action["torque"][1]


def test_before_the_first_action_in_parts_are_zeros():
    assert require_pair_equal(Mixed, way="one by one", steps=8) > 0
    with Mixed() as env:
        env.reset(seed=1)
        assert env.step(env.action_space.sample())[1] == 0.0


class Adding(Summing):
    """Assigns new arrays."""

    def _update(self):
        self.variables["sum"] = self.variables["sum"] + self.state[0]


def test_sums_go_on_while_an_episode_has_parameters_of_its_own(make_envs):
    ours, theirs = (
        make_envs(in_way(hooks, lambda: Adding(max_episode_steps=50)), 3, autoreset_mode="Disabled")
        for hooks in ("arrays", "one by one")
    )
    first = np.array([True, False, False])
    overriding = {"reset_mask": first, "model_parameters": {"m": 0.06}}
    for options in ({}, overriding, {"reset_mask": first}):
        for envs in ours, theirs:
            envs.reset(seed=1 if not options else None, options=options)
        for actions in sampled_actions(ours, 4):
            for mine, other in zip(ours.step(actions)[:4], theirs.step(actions)[:4], strict=True):
                require_equal(mine, other)
