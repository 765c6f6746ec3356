"""The table of quantities: expressions read the same of an episode as hooks do."""

import operator

import pytest
from ways import in_way

import fmugym
from fmugym.expressions.quantities import QUANTITIES

TASK = {
    "fmu": {"bundled": "Pendulum"},
    "time_step": 0.05,
    "variables": {"tau": {"min": -2, "max": 2}},
    "agent": {"actions": "tau", "observations": ["theta", "theta_dot"]},
    "parameters": {"theta_0": 1.0},
    "memory": {"sum": {"start": 0.5, "update": "sum + theta"}},
    "reward": {
        "outputs": "theta",
        "previous_outputs": "previous(theta)",
        "action": "tau",
        "previous_action": "previous(tau)",
        "parameters": "theta_0",
        "variables": "sum",
        "step_count": "step",
        "time": "time",
        "done": "1 if done else 0",
    },
    "terminated": "step > 18",
}
"""A term for each quantity but those of ``ELSEWHERE``."""

ELSEWHERE = {"inputs", "after_end"}
"""Task files have the actions in the place of inputs. Only classes go on after an end."""

KEYS = {
    **dict.fromkeys(("outputs", "previous_outputs", "action", "previous_action"), 0),
    "parameters": "theta_0",
    "variables": "sum",
}


def test_each_has_a_term():
    assert {*TASK["reward"], *ELSEWHERE} == set(QUANTITIES)


@pytest.mark.parametrize("hooks", ["expressions", "Python"])
def test_of_one_environment(load, hooks):
    env = load(TASK, way=hooks)
    env.reset(seed=1)
    env.action_space.seed(1)
    angles, terminated = set(), False
    while not terminated:
        *_, terminated, _, info = env.step(env.action_space.sample())
        for name, term in info["reward_terms"].items():
            value = operator.attrgetter(QUANTITIES[name].in_hooks)(env)
            assert term == (value[KEYS[name]] if name in KEYS else value), name
        angles.add(info["reward_terms"]["previous_outputs"])
    assert len(angles) == 19


def test_of_many_environments(make_envs):
    envs = make_envs(in_way("expressions", lambda: fmugym.load(TASK)), 3)
    envs.reset(seed=1)
    envs.action_space.seed(1)
    for _ in range(15):
        *_, infos = envs.step(envs.action_space.sample())
        for name in TASK["reward"]:
            attribute = QUANTITIES[name].attribute
            rows = envs.get_attr("state" if attribute == "outputs" else attribute)
            expected = [row[KEYS[name]] if name in KEYS else row for row in rows]
            assert infos["reward_terms"][name].tolist() == expected, name
