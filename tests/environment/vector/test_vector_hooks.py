"""Hooks read and return in a vector environment what they do in a single one."""

import fmu_tools
import numpy as np
import pytest
from combinations import in_turn
from vector_tools import (
    CART_POLE,
    HOOKS,
    Drawing,
    Historic,
    Reaching,
    Remembering,
    Shifted,
    each_mode,
    each_way,
    require_pair_equal,
    sampled_actions,
)
from ways import in_way

import fmugym
from fmugym import ConfigError, Uniform
from fmugym.pool.native_pool import NativePool


@each_way
@each_mode
def test_hooks_read_what_they_read_in_a_single_environment(mode, hooks):
    ends = require_pair_equal(Remembering, mode=mode, way=hooks, substeps=2, warm_up=0.04)
    assert ends > 10


class Imprecise(Drawing):
    def _get_observation(self):
        return np.array(self.state)  # float64


class Delegating(fmugym.envs.CartPoleEnv):
    """Keeps bound methods of its own in attributes."""

    def __init__(self):
        super().__init__()
        self.judge = self._lean

    def _lean(self):
        return 1.0 - abs(self.state[2])

    def _reward_policy(self):
        return self.judge()


@each_way
@pytest.mark.parametrize("cls", [Imprecise, Reaching, Historic, Shifted, Delegating])
def test_tasks(cls, hooks):
    """Of a float64, goals, several numbers in one variable, another start, and bound methods."""
    require_pair_equal(cls, way=hooks)


@each_way
def test_the_rewards_of_goals(hooks, make_envs):
    vector = make_envs(in_way(hooks, Reaching), 3)
    vector.reset(seed=0)
    observations, rewards, *_, infos = vector.step(sampled_actions(vector, 1)[0])
    goals = observations["achieved_goal"], observations["desired_goal"]
    assert vector.call("compute_reward", *goals, infos)[0].tolist() == rewards.tolist()


@pytest.mark.parametrize("hooks", ["arrays"])
@pytest.mark.parametrize(
    "config",
    [
        {"model_input_names": ["c", "a", "b"], "model_output_names": ["mix", "sum"]},
        {"model_input_names": ["a", "n", "on"], "model_output_names": ["n_out", "on_out", "sum"]},
        {"model_input_names": "n", "model_output_names": ["n_out", "steps"]},
        {"model_input_names": "mode", "model_output_names": ["mode_out", "mix"]},
        {"model_input_names": "on", "model_output_names": "on_out"},
        {"model_input_names": ["on", "trim"], "model_output_names": ["on_out", "mix"]},
        {"model_parameters": {"a": 0.5, "trim": Uniform(0, 1)}, "monitor_names": "steps"},
    ],
    ids=["reals", "mixed", "integer", "enumeration", "boolean", "tunable", "start"],
)
def test_types_of_inputs_and_outputs(config, hooks, probe):
    class Typed(fmu_tools.PlainEnv):
        def __init__(self):
            defaults = {"max_episode_steps": 4, "episode_variables": {"x": Uniform(0, 1)}}
            super().__init__(probe(), fmu_tools.probe_config(**defaults | config))

        def _get_info(self):
            return {"inputs": np.array(self.inputs), "x": self.variables["x"]}

    has_array = config.get("model_output_names") != "on_out"
    require_pair_equal(Typed, steps=30, way=hooks if has_array else "one by one")


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


class Branching(CART_POLE):
    def _is_done(self):
        return True if abs(self.out["x"]) > 0.1 else super()._is_done()


def test_fmus_step_together_whatever_the_hooks_are(monkeypatch, make_envs):
    vector = make_envs(in_way("one by one", Branching), 5)
    vector.reset(seed=0)
    calls, step = [], NativePool.step
    monkeypatch.setattr(NativePool, "step", lambda *given: calls.append(1) or step(*given))
    for actions in sampled_actions(vector, 30):
        vector.step(actions)
    assert len(calls) == 30
