"""Hooks that are called one environment at a time: what comes of their observations and inputs."""

import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.vector import AutoresetMode
from vector_tools import (
    Drawing,
    make_pair,
    results_of_both,
)
from ways import in_way

import fmugym
from fmugym import ConfigError


class SharedArray(Drawing):
    """Each observation is written to the same array."""

    array = np.zeros(2, np.float32)

    def __init__(self):
        super().__init__(model_parameters={"q_0": fmugym.Uniform(-1.0, 1.0)})

    def _get_observation(self):
        self.array[:] = self.state
        return self.array


class SharedDict(SharedArray):
    def _get_observation_space(self):
        return spaces.Dict({"all": spaces.Box(-np.inf, np.inf, (2,), np.float32)})

    def _get_observation(self):
        return {"all": super()._get_observation()}


@pytest.mark.parametrize("cls", [SharedArray, SharedDict])
def test_an_array_that_hooks_share_does_not_mix_the_observations(cls, make_envs):
    envs = make_envs(in_way("one by one", cls), 3)
    seen = [envs.reset(seed=0)[0]]
    seen += [envs.step(np.zeros((3, 1), np.float32))[0] for _ in range(2)]
    states = [np.float32(env) for env in envs.get_attr("state")]
    rows = seen[-1] if cls is SharedArray else seen[-1]["all"]
    np.testing.assert_array_equal(rows, states)
    assert len(set(rows[:, 0])) == 3
    first = seen[0] if cls is SharedArray else seen[0]["all"]
    assert not np.array_equal(first, rows)  # a later step leaves earlier observations alone


class OfOtherTypes(Drawing):
    """Observations as hooks may return them: lists, float64, and a number for a Discrete."""

    def _get_observation_space(self):
        box = spaces.Box(-np.inf, np.inf, (2,), np.float32)
        parts = {"list": box, "wide": box, "sign": spaces.Discrete(2), "pair": spaces.Tuple([box])}
        return spaces.Dict(parts)

    def _get_observation(self):
        wide = np.array(self.state)
        return {
            "list": list(self.state),
            "wide": wide,
            "sign": int(self.state[0] > 0),
            "pair": (wide.astype(np.float32),),
        }


def test_observations_become_the_types_of_their_space(make_envs):
    envs = make_envs(in_way("one by one", OfOtherTypes), 3)
    envs.reset(seed=0)
    seen = envs.step(np.zeros((3, 1), np.float32))[0]
    states = np.float32(envs.get_attr("state"))
    assert seen in envs.observation_space
    for rows in (seen["list"], seen["wide"], seen["pair"][0]):
        np.testing.assert_array_equal(rows, states)
    np.testing.assert_array_equal(seen["sign"], states[:, 0] > 0)


class Observing(Drawing):
    """Returns what a test says."""

    observed = (0.0, 0.0)

    def _get_observation(self):
        return self.observed


@pytest.mark.parametrize("observed", [np.zeros(3, np.float32), np.zeros(1), "text", 2**70, None])
def test_an_observation_that_is_no_element_of_the_space_is_named(observed, monkeypatch, make_envs):
    envs = make_envs(in_way("one by one", Observing), 2)
    envs.reset(seed=0)
    monkeypatch.setattr(Observing, "observed", observed)
    with pytest.raises(ConfigError, match="_get_observation returned "):
        envs.step(np.zeros((2, 1), np.float32))


class Failing(Drawing):
    """Environments fail in ``_get_inputs`` if the action says so."""

    def _get_inputs(self):
        if self.action[0] > 0.009:
            raise ConfigError("no")
        return self.action


def test_a_step_that_one_environment_refuses_changes_none(make_envs):
    """The inputs too are those of the last step, in the environments and in the pool."""
    envs = make_envs(in_way("one by one", Failing), 3)
    envs.reset(seed=0)
    good = np.float32([[0.001], [0.002], [0.003]])
    envs.step(good)
    names = ("action", "previous_action", "state", "previous_state", "inputs", "step_count")
    before = [envs.get_attr(name) for name in names]
    given = envs.pool.inputs.copy()
    with pytest.raises(ConfigError, match="environment 2"):
        envs.step(np.float32([[0.004], [0.005], [0.01]]))
    for name, values in zip(names, before, strict=True):
        np.testing.assert_array_equal(envs.get_attr(name), values, err_msg=name)
    np.testing.assert_array_equal(envs.pool.inputs, given)


class Breaking(Drawing):
    """The observation, in one of several forms, or the reward breaks at an angle."""

    form = "arrays"

    def __init__(self):
        starts = {"q_0": fmugym.Uniform(0.2, 1.0)}
        changes = {"episode_variables": {"sum": 0.0}, "max_episode_steps": 30}
        super().__init__(model_parameters=starts, **changes)

    def _get_observation_space(self):
        box = spaces.Box(-np.inf, np.inf, (2,), np.float32)
        return spaces.Dict({"one": box, "two": box}) if self.form == "dict" else box

    def _update(self):
        self.variables["sum"] += self.state[0]

    def _is_done(self):
        return self.state[0] < 0.1

    def _reward_policy(self):
        breaks = self.form == "reward" and self.state[0] < 0.1
        return np.float64(np.nan if breaks else self.variables["sum"])

    def _get_observation(self):
        q, q_dot = self.state
        seen = np.float32([q_dot, np.inf if q < 0.1 and self.form != "reward" else q])
        if self.form == "dict":
            return {"one": np.float32(self.state), "two": seen}
        return seen.tolist() if self.form == "list" else seen


@pytest.mark.parametrize("form", ["arrays", "list", "dict", "reward"])
def test_a_number_that_breaks_is_a_fault_as_in_single_environments(form, monkeypatch):
    """Also where the hooks end the episode in that step; the variables are as before it."""
    monkeypatch.setattr(Breaking, "form", form)
    ours, theirs = make_pair(Breaking, AutoresetMode.DISABLED, 6, "one by one")
    faults = 0
    for result in results_of_both(ours, theirs, [np.zeros((6, 1), np.float32)] * 25, seed=0):
        faults += np.count_nonzero(result[4].get("_fault", False))
        for name in ("variables", "state"):
            assert ours.get_attr(name) == theirs.get_attr(name)
    assert faults >= 6
    ours.close()
    theirs.close()


class Replacing(Drawing):
    """A method replaces the default hook."""

    def replace(self):
        self._get_inputs = lambda: 0.5 * self.action[0]


def test_inputs_are_asked_of_a_hook_that_was_set_later(make_envs):
    """Before, the actions were the inputs without any hook."""
    envs = make_envs(in_way("one by one", Replacing), 2)
    envs.reset(seed=0)
    actions = np.full((2, 1), 0.004, np.float32)
    envs.step(actions)
    plain = float(np.float32(0.004))
    assert envs.get_attr("inputs") == ((plain,), (plain,))
    envs.call("replace")
    envs.step(actions)
    assert envs.get_attr("inputs") == ((0.5 * plain,), (0.5 * plain,))
    np.testing.assert_array_equal(envs.pool.inputs, [[0.5 * plain] * 2])


class Informing(Drawing):
    """Infos are whole numbers at the start of an episode and halves later."""

    def __init__(self):
        super().__init__(max_episode_steps=2)

    def _get_info(self):
        return {"part": self.step_count / 2 if self.step_count else 0}


def test_infos_of_starts_and_of_steps_mix_in_the_order_of_the_environments(make_envs):
    envs = make_envs(in_way("one by one", Informing), 2, autoreset_mode="next_step")
    envs.reset(seed=0)
    actions = np.zeros((2, 1), np.float32)
    envs.step(actions)
    envs.episodes.ended[:] = [False, True]
    envs.episodes.any_ended = True
    infos = envs.step(actions)[-1]
    assert infos["part"].tolist() == [1.0, 0.0]
    assert infos["part"].dtype == np.float64
