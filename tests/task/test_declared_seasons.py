"""When in the year episodes of declared tasks begin."""

from functools import partial

import gymnasium
import pytest
from vector_tools import require_same_alone

import fmugym
from fmugym import Task
from fmugym.errors import TaskError

DAY = 86400.0
TASK = {
    "fmu": {"bundled": "Pendulum"},
    "time_step": "6h",
    "episode_length": "2d",
    "parameters": {"q_0": 0, "g": 0, "max_step": 1e6},
    "data": {"day": {"values": list(range(365)), "step": "1d", "interpolation": "previous"}},
    "setpoints": {"T": {"schedule": {"06:00": 21, "22:00": 17}}},
    "variables": {"tau": {"min": -1, "max": 1}},
    "agent": {
        "actions": ["tau"],
        "observations": ["day", "T", "q", "now"],
        "forecast": {"of": "day", "horizon": "1d", "step": "1d"},
    },
    "expressions": {"now": "clock / 86400"},
    "reward": "day",
}


def first_days(env, episodes):
    days = [env.reset(seed=0 if i == 0 else None)[0][0] for i in range(episodes)]
    env.close()
    return days


@pytest.mark.parametrize(
    ("clock", "day"),
    [("01-15", 14), ("2024-03-01", 59), ("02-28 12:00", 58.5), ("3d 12h", 3.5), (0, 0), (DAY, 1)],
)
def test_an_episode_begins_at_a_time_of_the_year(clock, day, load):
    env = load(TASK | {"clock": clock})
    observation, _ = env.reset(seed=0)
    is_day = 0.25 <= day % 1 < 22 / 24
    assert observation.tolist() == [int(day), 21 if is_day else 17, 0, day, int(day) + 1]
    for step in range(1, 8):
        observation, reward, *_ = env.step([0.0])
        assert observation[0] == int(day + step * 0.25)
        assert reward == int(day + (step - 1) * 0.25)
        assert env.time == step * DAY / 4


def test_the_turn_of_the_year(load):
    env = load(TASK | {"clock": "12-31"})
    assert env.reset(seed=0)[0][0] == 364
    seen = [env.step([0.0])[0][0] for _ in range(4)]
    assert seen == [364, 364, 364, 0]


def test_one_of_several():
    days = first_days(fmugym.load(TASK | {"clock": ["01-02", "03-01", "3d"]}), 30)
    assert set(days) == {1, 59, 3}


def test_a_distribution_is_drawn_last_and_reported(load):
    clock = {"distribution": "uniform", "low": 0, "high": 10 * DAY}
    env = load(TASK | {"clock": clock})
    observation, info = env.reset(seed=1)
    assert observation[0] == int(info["drawn"]["clock"] / DAY)


def test_a_season_leaves_scenarios_out():
    task = TASK | {
        "clock": {"from": "12-20", "to": "01-20", "exclude": "scenarios"},
        "scenarios": {"peak": {"start": "01-05", "length": "5d"}},
    }
    days = {int(day) for day in first_days(fmugym.load(task), 400)}
    # The last episodes begin on 12-20 and 01-20; one of two days must end before 01-05, day 4,
    # and the next begins when the scenario has ended, on day 9.
    assert days == {*range(353, 365), *range(3), *range(9, 20)}


@pytest.mark.parametrize("hooks", ["expressions", "arrays", "one by one"])
def test_many_environments_equal_single_ones(hooks):
    task = TASK | {"clock": {"from": "10-01", "to": "04-15", "step": "6h"}}
    assert require_same_alone(partial(fmugym.load, task), 20, way=hooks)


SCENARIOS = TASK | {
    "clock": {"from": "10-01", "to": "10-10", "exclude": ["peak"]},
    "scenarios": {"peak": {"start": "01-15", "length": "1d"}, "mild": {"start": 0, "length": "6h"}},
}


def test_a_scenario_is_an_environment(tmp_path, refused, ran):
    Task.from_dict(SCENARIOS).write(tmp_path / "task.toml")
    path = str(tmp_path / "task.toml")
    env = gymnasium.make("fmugym/FMU-v0", config=path, scenario="peak").unwrapped
    assert env.reset(seed=0)[0][0] == 14
    assert [env.step([0.0])[3] for _ in range(4)] == [False, False, False, True]
    assert Task.from_dict(env.task.document) == env.task
    env.close()
    envs = gymnasium.make_vec("fmugym/FMU-v0", num_envs=2, config=path, scenario="mild")
    assert envs.reset(seed=0)[0][:, 0].tolist() == [0, 0]
    envs.close()
    assert "reward 56 in 4 steps" in ran("simulate", path, "--scenario", "peak")
    assert "'peak'" in refused("simulate", path, "--scenario", "peek")


@pytest.mark.parametrize(
    ("change", "fact"),
    [
        ({"start_time": {"from": "01-01", "to": "02-01"}}, "start_time.*clock"),
        ({"clock": "1st of May"}, "clock.*1st of May"),
        ({"clock": {"from": "01-01", "to": "01-02", "exclude": "peek"}}, "clock.*'peak'"),
        ({"clock": {"from": "01-15", "to": "01-15", "exclude": "peak"}}, "clock: no day"),
        ({"clock": {"from": "01-01", "to": "12-31", "step": "1min"}}, "clock.*60 s"),
        ({"scenarios": {"peak": {"start": "01-15"}}}, "scenarios.peak.*'length'"),
    ],
)
def test_mistakes_are_placed(change, fact):
    with pytest.raises(TaskError, match=f"^{fact}"):
        fmugym.load(SCENARIOS | change)
