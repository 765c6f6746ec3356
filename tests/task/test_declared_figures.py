"""Figures of episodes, deviations from set points, and normalization by nominal values."""

from functools import partial

import numpy as np
import pytest
from vector_tools import require_same_alone

import fmugym
from fmugym.errors import TaskError

DT = 0.05
TASK = {
    "fmu": {"bundled": "Pendulum"},
    "time_step": DT,
    "episode_length": "0.6s",
    "variables": {
        "angle": {"name": "q", "unit": "deg", "min": -200, "max": 200},
        "tau": {"min": -0.02, "max": 0.02},
    },
    "parameters": {"q_0": {"distribution": "uniform", "low": -1, "high": 1}},
    "agent": {"actions": ["tau"], "observations": ["angle"]},
    "reward": {"near": {"expr": "-abs(angle)", "weight": 2}, "calm": "-tau**2"},
    "costs": {"far": "abs(angle) > 20"},
    "kpis": {
        "total": {"sum": "angle * dt"},
        "average": {"mean": "angle"},
        "lowest": {"min": "angle"},
        "highest": {"max": "angle - 500"},
        "left": {"last": "angle"},
        "reward": {"sum": "near"},
        "cost": {"mean": "far"},
        "often": {"sum": "angle > 0 and not done"},
        "span": "highest + 500 - lowest",
        "now": "2 * angle",
    },
}


def figures(angles, rewards, costs):
    """What the figures of ``TASK`` should be after steps with these values."""
    angles = np.array(angles)
    return {
        "total": np.sum(angles * DT),
        "average": angles.mean(),
        "lowest": angles.min(),
        "highest": angles.max() - 500,
        "left": angles[-1],
        "reward": np.sum(rewards),
        "cost": np.mean(costs),
        "often": np.sum(angles > 0),
        "span": np.ptp(angles),
        "now": 2 * angles[-1],
    }


def test_figures_are_those_of_the_steps(load):
    env = load(TASK, way="expressions")
    for seed in (0, None):
        _, info = env.reset(seed=seed)
        assert set(info["kpis"].values()) == {0.0}
        angles, rewards, costs = [], [], []
        for _ in range(12):
            *_, cut, info = env.step(np.array([0.01], np.float32))
            angles.append(np.rad2deg(env.state[0]))
            rewards.append(info["reward_terms"]["near"])
            costs.append(info["cost"])
            assert info["kpis"] == pytest.approx(figures(angles, rewards, costs), rel=1e-12)
        assert cut


@pytest.mark.parametrize("hooks", ["expressions", "arrays", "one by one"])
@pytest.mark.parametrize("mode", ["next_step", "same_step"])
def test_figures_of_many_environments(hooks, mode):
    assert require_same_alone(partial(fmugym.load, TASK), 14, mode, way=hooks)


@pytest.mark.parametrize(
    ("kpis", "fact"),
    [
        ({"a": {}}, r"kpis\.a: .*mean"),
        ({"a": {"sum": "angle", "max": "angle"}}, r"kpis\.a: "),
        ({"aa": "bb", "bb": "aa"}, r"kpis\.aa: .*'bb'"),
    ],
)
def test_mistakes_are_placed(kpis, fact):
    with pytest.raises(TaskError, match=fact):
        fmugym.load(TASK | {"kpis": kpis})


SETPOINTS = {
    "constant": {"value": 5, "min": 0, "max": 10},
    "drawn": {"value": {"distribution": "uniform", "low": 0, "high": 9}, "min": 0, "max": 9},
    "schedule": {"schedule": {"00:00": 7}},
    "steps": {"steps": {"low": 0, "high": 9, "every": "0.1s"}},
    "sine": {"sine": {"amplitude": 4, "period": "1s"}, "min": -4, "max": 4},
    "data": {"data": "profile", "min": 0, "max": 9},
}


def aiming(kind, **sensor):
    return {k: v for k, v in TASK.items() if k not in ("kpis", "costs")} | {
        "variables": {
            "angle": {"name": "q", "unit": "deg", "min": -200, "max": 200} | sensor,
            "tau": {"min": -0.02, "max": 0.02},
        },
        "setpoints": {"goal": SETPOINTS[kind] | {"of": "angle"}},
        "data": {"profile": {"values": [0, 9, 4], "step": "0.2s"}},
        "agent": {"actions": ["tau"], "observations": ["angle", "goal", "goal_error"]},
        "reward": "-abs(goal_error)",
    }


@pytest.mark.parametrize("kind", SETPOINTS)
def test_a_deviation_is_observed(kind, load):
    env = load(aiming(kind))
    observation, _ = env.reset(seed=1)
    assert env.observation_names == ("angle", "goal", "goal_error")
    low, high = env.observation_space.low, env.observation_space.high
    assert low[2] == low[1] - 200
    assert high[2] == high[1] + 200
    for _ in range(6):
        angle, goal, error = map(float, observation)
        assert error == pytest.approx(goal - angle, abs=1e-4)
        observation, reward, *_ = env.step([0.01])
        if kind in ("constant", "drawn", "sine", "data"):
            assert reward == pytest.approx(-abs(observation[2]), rel=1e-6)


def test_a_deviation_is_what_the_sensor_measures(load):
    env = load(aiming("constant", noise=5.0, delay="0.1s"))
    observation, _ = env.reset(seed=1)
    for _ in range(6):
        assert observation[2] == pytest.approx(5 - observation[0], abs=1e-4)
        observation, *_ = env.step([0.01])
    alone = aiming("constant", noise=5.0, delay="0.1s")
    alone["agent"] = {"actions": ["tau"], "observations": ["goal_error"]}
    only = load(alone)
    assert abs(only.reset(seed=1)[0][0] - (5 - np.rad2deg(only.state[0]))) > 0.1


def test_a_name_that_a_set_point_brings_with_it():
    wrong = aiming("constant") | {"expressions": {"goal_error": "1"}}
    with pytest.raises(TaskError, match="'goal_error'"):
        fmugym.load(wrong)


class TestNominal:
    def task(self, **variable):
        return {k: v for k, v in TASK.items() if k not in ("kpis", "costs")} | {
            "variables": {"q_dot": {"min": -60, "max": 60} | variable, "tau": {"max": 1, "min": 0}},
            "setpoints": {"goal": {"value": 3, "min": -4, "max": 2}},
            "agent": {
                "actions": ["tau"],
                "observations": ["q_dot", "goal"],
                "normalize": "nominal",
            },
            "reward": "q_dot",
        }

    @pytest.mark.parametrize(("variable", "nominal"), [({"nominal": 8}, 8.0), ({}, None)])
    def test_values_are_divided_by_it(self, variable, nominal, load):
        env = load(self.task(**variable))
        nominal = nominal or env.fmu.variable("q_dot").nominal or 60.0
        env.reset(seed=0)
        seen, reward, *_ = env.step([0.5])
        assert seen[0] == np.float32(reward / nominal)
        assert seen[1] == 0.75
        assert env.observation_space.high[0] == np.float32(60 / nominal)
        assert env.observation_space.low[1] == -1.0

    def test_of_what_has_none(self):
        wrong = self.task()
        wrong["setpoints"] = {"goal": 3}
        with pytest.raises(TaskError, match=r"^agent\.observations: .*'goal'.*nominal"):
            fmugym.load(wrong)
