"""Actions of declared tasks that are limited in time, and the reward of failed steps."""

from functools import partial

import numpy as np
import pytest
from combinations import in_turn
from gymnasium import spaces
from vector_tools import require_same_alone
from ways import in_way

import fmugym
from fmugym.control import controller_of
from fmugym.errors import ConfigError, TaskError

DT = 0.1
PLAIN = {
    "fmu": {"bundled": "Pendulum"},
    "time_step": DT,
    "agent": {"actions": ["u"], "observations": ["q"]},
    "reward": "-u**2 - abs(q)",
}
KINDS = {
    "delta": {"name": "tau", "min": -0.05, "max": 0.1, "delta": 0.04},
    "rate": {"name": "tau", "min": -0.1, "max": 0.1, "rate": 0.5},
    "rate of levels": {"name": "tau", "levels": [-0.1, 0, 0.1], "rate": 0.5, "unit": "N.m"},
    "least times": {
        "name": "tau",
        "unit": "N.mm",
        "levels": [0, 20],
        "min_on": "0.3s",
        "min_off": "0.25s",
    },
    "least times of a continuous action": {
        "name": "tau",
        "min": 0,
        "max": 0.1,
        "min_on": 0.3,
        "min_off": 0.2,
    },
}


def task(kind, **agent):
    return PLAIN | {"variables": {"u": KINDS[kind]}, "agent": PLAIN["agent"] | agent}


def played(env, actions):
    """The inputs of an episode."""
    env.reset(seed=0)
    inputs = []
    for action in actions:
        env.step(action)
        inputs.append(env.inputs[0])
    env.close()
    return inputs


def test_an_action_may_be_a_change():
    env = fmugym.load(task("delta"))
    np.testing.assert_array_equal(env.action_space.high, np.float32([0.04]))
    inputs = played(
        env, [[0.03], [0.03], [-0.04], [-0.04], [-0.04], [0.04], [0.04], [0.04], [0.04]]
    )
    expected = [0.03, 0.06, 0.02, -0.02, -0.05, -0.01, 0.03, 0.07, 0.1]
    assert inputs == pytest.approx(expected)


def test_a_rescaled_change():
    env = fmugym.load(task("delta", rescale=True))
    np.testing.assert_array_equal(env.action_space.high, [1])
    assert played(env, [[1.0], [-0.5]]) == pytest.approx([0.04, 0.02])


@pytest.mark.parametrize("kind", ["rate", "rate of levels"])
def test_an_action_follows_at_a_rate(kind):
    wanted = [0.1, 0.1, -0.1, -0.1, -0.1, 0.0]
    actions = [[u] for u in wanted] if kind == "rate" else [1 + round(u / 0.1) for u in wanted]
    inputs = played(fmugym.load(task(kind)), actions)
    assert inputs == pytest.approx([0.05, 0.1, 0.05, 0.0, -0.05, 0.0])


def test_least_times_and_masks(load):
    env = load(task("least times"))
    env.reset(seed=0)
    rng = np.random.default_rng(0)
    is_on, since, kept = False, 10**9, 0
    for action in rng.integers(2, size=200).tolist():
        is_free = since >= 3  # 0.25 s take three steps, too
        masks = env.action_masks()
        assert masks.tolist() == [not is_on or is_free, is_on or is_free]
        kept += (action == 1) != is_on and not is_free
        now_on = (action == 1) if is_free else is_on
        since = since + 1 if now_on == is_on else 1
        is_on = now_on
        env.step(action)
        assert env.inputs[0] == pytest.approx(0.02 if is_on else 0.0)
    assert kept > 30


def test_a_continuous_action_may_change_while_it_is_on():
    wanted = [0.05, 0.0, 0.06, 0.0, 0.0, 0.04, 0.04]
    inputs = played(fmugym.load(task("least times of a continuous action")), [[u] for u in wanted])
    assert inputs == pytest.approx([0.05, 0.05, 0.06, 0.0, 0.0, 0.04, 0.04], rel=1e-6)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("hooks", ["expressions", "arrays", "one by one"])
def test_many_environments_equal_single_ones_to_the_last_bit(kind, hooks):
    make = partial(fmugym.load, task(kind, history={"of": "u", "length": "0.2s"}))
    method = "action_masks" if "levels" in KINDS[kind] else None
    require_same_alone(make, 25, method=method, way=hooks)


@pytest.mark.parametrize(
    ("variable", "fact"),
    [
        ({"name": "tau", "levels": [0, 1], "delta": 1}, "'delta'"),
        ({"min": 0, "max": 1, "rate": 1}, "'u' is no input"),
        ({"name": "tau", "rate": 1e-3, "min": 0, "max": "oops"}, "'oops'"),
    ],
)
def test_mistakes_are_placed(variable, fact):
    with pytest.raises(TaskError, match=rf"^variables\.u.*{fact}"):
        fmugym.load(PLAIN | {"variables": {"u": variable}})


def test_mistakes_in_levels_are_told_alone():
    variables = {"u": {"name": "tau", "levels": [0, 1]}, "v": {"levels": [1]}}
    agent = PLAIN["agent"] | {"actions": ["u", "v"]}
    with pytest.raises(TaskError) as caught:
        fmugym.load(PLAIN | {"variables": variables, "agent": agent})
    assert str(caught.value).count("\n") == 0
    assert "two or more" in str(caught.value)


def test_observations_have_no_delta():
    variables = {"u": {"name": "tau"}, "q": {"delta": 1}}
    with pytest.raises(TaskError, match=r"variables\.q.*observed"):
        fmugym.load(PLAIN | {"variables": variables})


def test_masks_need_levels(load):
    env = load(task("rate"))
    with pytest.raises(ConfigError, match="levels"):
        env.action_masks()


MIXED = {
    "fmu": {"bundled": "DoublePendulum"},
    "time_step": "20ms",
    "episode_length": "300ms",
    "variables": {"tau1": {"levels": [0.4, -0.2, 0]}, "tau2": {"min": -1, "max": 1}},
    "agent": {"actions": ["tau1", "tau2"], "observations": ["q1", "q2"]},
    "reward": "-q1**2 - q2**2 - 0.1 * previous(tau1)",
}
"""The switch has levels, the other action none."""


class TestLevelsBesideANumber:
    """The range of the number has a part for each level: a third of it, here."""

    @pytest.mark.parametrize(("rescale", "low", "high"), [(False, -0.2, 0.4), (True, -1.0, 1.0)])
    def test_parts_are_equal(self, rescale, low, high, load):
        env = load(MIXED | {"agent": MIXED["agent"] | {"rescale": rescale}})
        box = spaces.Box(np.float32([low, -1.0]), np.float32([high, 1.0]))
        assert env.action_space == box
        env.reset(seed=0)
        parts = {0.0: -0.2, 0.32: -0.2, 0.34: 0.0, 0.65: 0.0, 0.68: 0.4, 1.0: 0.4}
        for part, level in parts.items():
            env.step(np.array([low + part * (high - low), 0.25]))
            assert env.inputs == (level, 0.25)
        with pytest.raises(ConfigError, match="levels"):
            env.action_masks()

    def test_controllers_write_the_nearest_level(self, load):
        env = load(MIXED, physical=True)
        controller = controller_of({"tau1": "pid of=q1 setpoint=0 kp=1", "tau2": 0.5}).bind(env)
        env.reset(seed=0)
        for error, level in {0.09: 0.0, 0.21: 0.4, -0.09: 0.0, -0.11: -0.2, 0.5: 0.4}.items():
            env.step(controller.act(np.array([-error, 0.0])))
            assert env.inputs == (level, 0.5)

    @pytest.mark.parametrize("way", ["expressions", "one by one"])
    def test_many_environments_equal_single_ones(self, way):
        assert require_same_alone(partial(fmugym.load, MIXED), 30, "next_step", way=way)


FAILING = PLAIN | {
    "variables": {"u": {"name": "tau"}},
    "parameters": {"q_0": {"distribution": "uniform", "low": -1, "high": 1}},
    "terminated": "abs(q) > 100",
}
REWARDS = {
    "the worst step": ("-q**2 - done + 0 / (step - 6)", lambda rewards: min(rewards)),
    "positive rewards": ("1 + q**2 + 0 / (step - 6)", lambda rewards: 0.0),
    "the file": ("-q**2 + 0 / (step - 6)", lambda rewards: -7.0),
}


@in_turn(
    {
        "kind": list(REWARDS),
        "hooks": ["expressions", "arrays", "one by one"],
        "mode": ["next_step", "same_step"],
    }
)
def test_a_failed_step_costs_no_less_than(kind, hooks, mode, make_envs):
    reward, expected = REWARDS[kind]
    own = {"config": {"fault_reward": -7}} if kind == "the file" else {}
    make = partial(fmugym.load, FAILING | {"reward": reward} | own)
    envs, single = make_envs(in_way(hooks, make), 2, autoreset_mode=mode), make()
    envs.reset(seed=0)
    single.reset(seed=0)
    for _ in range(2):
        seen = []
        for step in range(1, 7):
            action = np.full((2, 1), 0.1 * (-1) ** step, np.float32)
            _, rewards, _, _, infos = envs.step(action)
            _, alone, *_, info = single.step(action[0])
            assert alone == rewards[0]
            seen.append(alone)
        assert "fault" in info
        assert "fault" in infos or "fault" in infos["final_info"]
        assert seen[-1] == expected(seen[:-1])
        single.reset()
        if mode == "next_step":
            envs.step(action)
    single.close()
