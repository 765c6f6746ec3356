"""Hooks read and return in a vector environment what they do in a single one."""

import numpy as np
import pytest
from combinations import in_turn
from vector_tools import (
    HOOKS,
    Drawing,
    Reaching,
    each_way,
    sampled_actions,
)
from ways import in_way

from fmugym import ConfigError


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
