"""Hooks in a vector environment: what comes of what they return, and what a mistake leaves."""

import numpy as np
import pytest
from combinations import in_turn
from contract_cases import FORMS, TwoTorques
from gymnasium import spaces
from vector_tools import (
    HOOKS,
    Drawing,
    Reaching,
    each_way,
    make_pair,
    results_of_both,
    sampled_actions,
)
from ways import in_way

import fmugym
from fmugym import Choice, ConfigError
from fmugym.environment.vector import FMUVectorEnv


@each_way
def test_the_rewards_of_goals(hooks, make_envs):
    vector = make_envs(in_way(hooks, Reaching), 3)
    vector.reset(seed=0)
    observations, rewards, *_, infos = vector.step(sampled_actions(vector, 1)[0])
    goals = observations["achieved_goal"], observations["desired_goal"]
    assert vector.call("compute_reward", *goals, infos)[0].tolist() == rewards.tolist()


def test_discrete_observations(make_env, make_envs):
    """The default hook looks a value up, which takes one environment at a time."""
    vector = make_envs(lambda: make_env(model_output_names="mode_out"), 3)
    observations, _ = vector.reset()
    assert observations.dtype == np.int64
    assert observations.tolist() == [0, 0, 0]


MISTAKES = [
    *(
        (hook, lambda env: None, ConfigError, f"{hook} returned None")
        for hook in ("_get_inputs", "_reward_policy", "_is_done", "_get_observation")
    ),
    ("_get_inputs", lambda env: [env.action[0]] * 2, ConfigError, "2 values, expected 1"),
]


@in_turn({"hook,value,error,text": MISTAKES, "hooks": HOOKS})
def test_mistakes_in_hooks(hook, value, error, text, hooks, make_envs):
    vector = make_envs(in_way(hooks, type("Mistaken", (Drawing,), {hook: value})), 2)
    with pytest.raises(error, match=text):
        vector.reset(seed=0), vector.step(np.zeros((2, 1), np.float32))


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
        super().__init__(episode_variables={"limit": Choice([2, 3])}, max_episode_steps=9)

    def _is_done(self):
        return self.step_count >= self.variables["limit"]

    def _get_info(self):
        return {"part": self.step_count / 2 if self.step_count else 0}


def test_infos_of_starts_and_of_steps_mix_in_the_order_of_the_environments(make_envs):
    envs = make_envs(in_way("one by one", Informing), 3, autoreset_mode="next_step")
    envs.reset(seed=0)
    mixed = 0
    for actions in np.zeros((12, 3, 1), np.float32):
        part = envs.step(actions)[-1]["part"]
        steps = np.array(envs.get_attr("step_count"))
        if steps[0]:  # the first environment says of which type the array is
            assert part.dtype == np.float64
            assert part.tolist() == (steps / 2).tolist()
            mixed += steps.min() == 0
    assert mixed > 0


class Torques(TwoTorques):
    """Notes when it is asked for infos; the reward of an environment breaks in step ``broken``."""

    broken = 0

    def __init__(self):
        super().__init__()
        self.informed = []

    def _reward_policy(self):
        return np.nan if self.step_count == self.broken else 1.0

    def _get_info(self):
        self.informed.append(self.step_count)
        return super()._get_info()


ACTIONS = np.random.default_rng(0).uniform(-1.0, 1.0, (4, len(FORMS), 2)).astype(np.float32)


def test_inputs_of_several_forms_are_those_of_single_environments():
    """An array that all environments return must not mix their inputs."""
    ours, theirs = make_pair(Torques, num_envs=len(FORMS), way="one by one")
    for envs in (ours, theirs):
        envs.set_attr("form", list(FORMS.values()))
    for _ in results_of_both(ours, theirs, list(ACTIONS)):
        assert ours.get_attr("inputs") == theirs.get_attr("inputs")
    ours.close()
    theirs.close()


@pytest.mark.parametrize("form", [None, np.float32, list])
def test_an_input_that_is_not_finite_names_its_environment(form, make_envs):
    envs = make_envs(in_way("one by one", Torques), 3)
    envs.reset(seed=0)
    envs.set_attr("form", form)
    envs.step(ACTIONS[0][:3])
    before = [envs.get_attr(name) for name in ("inputs", "action", "previous_action", "state")]
    envs.set_attr("form", [form, lambda values: np.array([values[0], np.inf]), form])
    with pytest.raises(ConfigError, match=r"environment 1: .*tau2 = inf"):
        envs.step(ACTIONS[1][:3])
    after = [envs.get_attr(name) for name in ("inputs", "action", "previous_action", "state")]
    for old, new in zip(before, after, strict=True):
        np.testing.assert_array_equal(old, new)
    envs.set_attr("form", form)
    envs.step(ACTIONS[1][:3])


@pytest.mark.parametrize("mode", ["next_step", "same_step", "disabled"])
def test_infos_are_asked_for_as_in_a_single_environment(mode):
    """The info of a fault is asked for once, in the state before the step."""
    envs = FMUVectorEnv(in_way("one by one", Torques), 3, autoreset_mode=mode)
    alone = Torques()
    envs.reset(seed=0)
    alone.reset(seed=1)
    envs.set_attr("broken", [0, 2, 0])
    alone.broken = 2
    for actions in ACTIONS[:2]:
        *_, infos = envs.step(actions[:3])
        *_, info = alone.step(actions[1])
    asked = envs.get_attr("informed")
    restarts = [0] if mode == "same_step" else []
    assert list(asked) == [[0, 1, 2], [*alone.informed, *restarts], [0, 1, 2]]
    last = infos["final_info"] if mode == "same_step" else infos
    assert (last["first"][1], last["steps"][1]) == (info["first"], info["steps"])
    assert last["fault"][1] == info["fault"]
    for env in (envs, alone):
        env.close()
