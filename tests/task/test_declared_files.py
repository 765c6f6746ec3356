"""Several files for one series, of which an episode draws one.

A task that has drawn a file must do what a task with this file alone does.
"""

import shutil
from contextlib import closing
from functools import partial

import numpy as np
import pytest
from export_tools import acting, closed_loop, network_for
from scipy import stats
from vector_tools import require_same_alone

import fmugym
from fmugym.deployment.export import agent_of
from fmugym.environment.vector import FMUVectorEnv
from fmugym.errors import TaskError
from fmugym.task import Task

DAY = 86400.0
YEARS = (2021, 2022, 2024)
NUMBER = "file number"


def weather(year):
    """The value of each hour of a year, the number of the year in front."""
    return 1e6 * (year - 2020) + np.arange(8760)


def price(year):
    """The value of each day of a year."""
    return 1000.0 * (year - 2020) + np.arange(365)


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """A folder that all tests share."""
    folder = tmp_path_factory.mktemp("files")
    for year in YEARS:
        start = np.datetime64(f"{year}-01-01T00")
        hours = start + np.arange(8784 if year == 2024 else 8760).astype("m8[h]")
        hours = [one for one in hours.astype(str) if "-02-29" not in one]
        rows = [f"{one},{value}" for one, value in zip(hours, weather(year), strict=True)]
        (folder / f"w{year}.csv").write_text("\n".join(["time,T", *rows]))
        rows = [f"{day * DAY},{value}" for day, value in enumerate(price(year))]
        (folder / f"p{year}.csv").write_text("\n".join(["time,price", *rows]))
    return folder


@pytest.fixture
def folder(files, tmp_path):
    """A folder with the same files that a test may change."""
    return shutil.copytree(files, tmp_path / "own")


def task_of(years=YEARS, **changes):
    def files(letter):
        found = [f"{letter}{year}.csv" for year in years]
        return found if len(found) > 1 else found[0]

    return {
        "fmu": {"bundled": "Pendulum"},
        "time_step": "6h",
        "episode_length": "2d",
        "parameters": {"q_0": 0, "g": 0, "max_step": 1e6},
        "clock": {"from": "01-01", "to": "12-31"},
        "data": {
            "T": {"file": files("w"), "column": "T", "min": 0, "max": 5e6},
            "price": {
                "file": files("p"),
                "column": "price",
                "interpolation": "previous",
                "min": 0,
                "max": 5e3,
            },
        },
        "variables": {"tau": {"min": -1, "max": 1}},
        "agent": {
            "actions": ["tau"],
            "observations": ["T", "price", "q"],
            "forecast": {"of": ["T", "price"], "horizon": "1d", "step": "6h"},
            "history": {"of": ["T"], "length": "6h"},
        },
        "reward": "price + 1e-3 * T",
    } | changes


@pytest.fixture
def load_in(request, files, opened, monkeypatch):
    own = "folder" in request.fixturenames
    monkeypatch.chdir(request.getfixturevalue("folder") if own else files)
    return lambda task, **options: opened(fmugym.load(task, **options)).unwrapped


def play(env, steps=8, **reset):
    """All that an episode gives."""
    observation, _ = env.reset(**reset)
    found = [*observation]
    for step in range(steps):
        observation, reward, *_ = env.step(np.array([step / 10], np.float32))
        found += [*observation, reward]
    return np.array(found)


def test_an_episode_has_one_file_of_all_lists(load_in):
    env = load_in(task_of())
    numbers = []
    for seed in range(60):
        _, info = env.reset(seed=seed)
        number, begin = int(info["drawn"][NUMBER]), info["drawn"]["clock"]
        numbers.append(number)
        if seed < 6:
            alone = load_in(task_of([YEARS[number]], clock=begin))
            np.testing.assert_array_equal(play(env, seed=seed), play(alone, seed=0))
    assert len(set(numbers[:6])) == 3
    assert stats.chisquare(np.bincount(numbers)).pvalue > 1e-3
    assert env.observation_space.high[0] == 5e6


@pytest.mark.parametrize("years", [YEARS, YEARS[:1]])
def test_values_are_those_of_the_file(load_in, years):
    env = load_in(task_of(years, clock="03-01"))
    for seed in range(5):
        observation, info = env.reset(seed=seed)
        year = years[int(info["drawn"].get(NUMBER, 0))]
        assert observation[:2].tolist() == [np.float32(weather(year)[59 * 24]), price(year)[59]]
        hours = 59 * 24 + 6 * np.arange(1, 5)
        assert observation[3:7].tolist() == weather(year)[hours].astype(np.float32).tolist()
        assert env.step([0.0])[1] == pytest.approx(price(year)[59] + weather(year)[hours[0]] / 1e3)


@pytest.mark.parametrize("hooks", ["expressions", "arrays", "one by one"])
@pytest.mark.parametrize("begin", ["clock", "start_time"])
def test_many_environments_equal_single_ones(load_in, hooks, begin):
    season = {"from": "10-01", "to": "04-15", "exclude": "scenarios"}
    scenarios = {"peak": {"start": "01-15", "length": "7d", "file": "w2022.csv"}}
    changes = {"clock": None} | {begin: season, "scenarios": scenarios}
    assert require_same_alone(partial(fmugym.load, task_of(**changes)), 20, way=hooks)


def test_the_pool_draws_files(load_in):
    season = {"from": "10-01", "to": "04-15", "exclude": "scenarios"}
    scenarios = {"peak": {"start": "01-15", "length": "7d", "file": "w2022.csv"}}
    for begin in ("clock", "start_time"):
        env = load_in(task_of(**{"clock": None, begin: season, "scenarios": scenarios}))
        assert env.episode_start.native is not None


class TestPatterns:
    def test_a_pattern_stands_for_its_files_in_order(self, load_in):
        task = task_of()
        task["data"]["T"]["file"], task["data"]["price"]["file"] = "w*.csv", ["p*.csv"]
        env, listed = load_in(task), load_in(task_of())
        for seed in range(5):
            np.testing.assert_array_equal(play(env, seed=seed), play(listed, seed=seed))

    def test_a_written_task_keeps_it(self, load_in, folder):
        task = task_of()
        task["data"]["T"]["file"] = "w*.csv"
        path = folder / "below" / "task.toml"
        path.parent.mkdir()
        Task.from_dict(task).write(path)
        text = path.read_text()
        assert "../w*.csv" in text
        assert "../p2024.csv" in text
        assert Task.read(path) == Task.from_dict(task)

    def test_its_files_may_be_listed(self, load_in, files):
        task = task_of()
        task["data"]["T"]["file"] = "w*.csv"
        found = Task.from_dict(task).with_listed_files()
        assert found == Task.from_dict(task_of()).with_listed_files()
        assert found.document["data"]["T"]["file"] == [str(files / f"w{y}.csv") for y in YEARS]

    def test_a_file_of_that_name_is_no_pattern(self, load_in, folder):
        (folder / "w[1].csv").write_text((folder / "w2021.csv").read_text())
        task = task_of([2021])
        task["data"]["T"]["file"] = "w[1].csv"
        assert NUMBER not in load_in(task).reset(seed=0)[1]["drawn"]


class TestOwn:
    def test_lists_of_unequal_length(self, load_in):
        task = task_of(clock="02-01")
        task["data"]["price"] |= {"file": ["p2021.csv", "p2022.csv"], "draw": "own"}
        env, pairs = load_in(task), set()
        for seed in range(40):
            observation, info = env.reset(seed=seed)
            first, second = (int(info["drawn"][n]) for n in (NUMBER, f"{NUMBER} of price"))
            seen = [weather(YEARS[first])[31 * 24], price(YEARS[second])[31]]
            assert observation[:2].tolist() == [np.float32(one) for one in seen]
            pairs.add((first, second))
        assert len(pairs) == 6

    def test_otherwise_they_are_refused(self, load_in):
        task = task_of()
        task["data"]["price"]["file"] = ["p2021.csv", "p2022.csv"]
        with pytest.raises(TaskError, match=r"'price' has 2 files, but 'T' has 3.*draw = \"own\""):
            load_in(task)


SCENARIOS = {
    "clock": {"from": "01-01", "to": "01-31", "exclude": "scenarios"},
    "scenarios": {
        "cold": {"start": "01-10", "length": "5d", "file": "w2022.csv"},
        "any": {"start": "01-25", "length": "1d"},
    },
}


class TestScenarios:
    def test_a_scenario_has_its_file(self, load_in):
        env, task = load_in(task_of(**SCENARIOS), scenario="cold"), load_in(task_of())
        assert env.observation_space == task.observation_space
        for seed in range(4):
            observation, info = env.reset(seed=seed)
            assert observation[:2].tolist() == [weather(2022)[9 * 24], price(2022)[9]]
            assert not info["drawn"]

    def test_one_without_file_draws_it(self, load_in):
        env = load_in(task_of(**SCENARIOS), scenario="any")
        assert {env.reset(seed=seed)[0][1] for seed in range(20)} == {1024, 2024, 4024}

    @pytest.mark.parametrize("begin", ["clock", "start_time"])
    def test_exclusion_counts_file_and_time(self, load_in, begin):
        task = task_of(**SCENARIOS)
        task[begin] = task.pop("clock")
        env, seen = load_in(task), set()
        for seed in range(1500):
            drawn = env.reset(seed=seed)[1]["drawn"]
            seen.add((int(drawn[NUMBER]), int(drawn[begin] / DAY)))
        free = [day for day in range(31) if not 23 <= day < 25]  # two days end before 01-25
        cold = [day for day in free if not 8 <= day < 14]
        assert seen == {(n, day) for n in range(3) for day in (cold if n == 1 else free)}

    def test_of_a_task_with_a_file_of_its_own(self, load_in):
        env = load_in(task_of(**SCENARIOS, file="p2022.csv"))
        days = {int(env.reset(seed=seed)[0][1]) - 2000 for seed in range(300)}
        assert days == {*range(8), *range(14, 23), *range(25, 31)}

    def test_means_leave_out_file_and_time(self, load_in):
        task = task_of(**SCENARIOS | {"clock": {"from": "01-01", "to": "12-31"}})
        task["episode_length"] = "1d"
        env = load_in(task)
        future = env.resolved.future
        values = np.array([price(year) for year in YEARS])
        kept = np.ones(values.shape, np.bool_)
        kept[1, 9:14] = kept[:, 24] = False
        mean = future.lookups["price"].mean(future.held_out)
        assert mean == pytest.approx(values[kept].mean(), rel=1e-12)

    @pytest.mark.parametrize(
        ("file", "fact"),
        [
            ("w2023.csv", r"scenarios.cold.file: .*'w2023.csv'.*'w202"),
            (["w2021.csv", "p2022.csv"], r"scenarios.cold.file: 'p2022.csv' is of another place"),
        ],
    )
    def test_mistakes_are_placed(self, load_in, file, fact):
        scenario = SCENARIOS["scenarios"]["cold"] | {"file": file}
        with pytest.raises(TaskError, match=fact):
            load_in(task_of(**SCENARIOS | {"scenarios": {"cold": scenario}}))


class TestMistakes:
    @pytest.mark.parametrize(
        ("given", "fact"),
        [
            ([], "data.T.file: expected at least one file"),
            ("x*.csv", r"data.T.file: .*'x\*.csv'"),
            (["w2021.csv", "w2022.csv", "w2023.csv"], "data.T.file: .*'w2023.csv'.*w202"),
            (["w2021.csv"] * 3, "data.T.file: .*w2021.csv' is listed twice"),
        ],
    )
    def test_they_are_placed(self, load_in, given, fact):
        task = task_of()
        task["data"]["T"]["file"] = given
        with pytest.raises(TaskError, match=fact) as caught:
            load_in(task)
        assert len(str(caught.value).splitlines()) == 1

    def test_those_in_a_file_name_it(self, load_in, folder):
        lines = (folder / "w2022.csv").read_text().splitlines()
        (folder / "w2022.csv").write_text("\n".join(lines[:50] + lines[60:]))
        with pytest.raises(TaskError, match=r"w2022\.csv"):
            load_in(task_of())


class TestLimits:
    def test_they_cover_all_files(self, load_in):
        task = task_of()
        for one in task["data"].values():
            del one["min"], one["max"]
        space = load_in(task).observation_space
        assert space.low[:2].tolist() == [np.float32(weather(2021)[0]), price(2021)[0]]
        assert space.high[:2].tolist() == [np.float32(weather(2024)[-1]), price(2024)[-1]]


def test_files_of_other_periods_and_starts(load_in, folder):
    """A file of ten days from March on, beside one of a year."""
    rows = [f"{(60 + day) * DAY},{day}" for day in range(10)]
    (folder / "short.csv").write_text("\n".join(["time,price", *rows]))
    task = task_of(clock="12-30")
    task["data"]["price"] |= {"file": ["p2021.csv", "short.csv"], "draw": "own", "period": "365d"}
    task["data"]["price"]["interpolation"] = "linear"
    env = load_in(task)
    number = f"{NUMBER} of price"
    seed = next(one for one in range(20) if env.reset(seed=one)[1]["drawn"][number] == 1)
    env.reset(seed=seed)
    days = np.arange(8) / 4 + 363
    expected = np.interp((days - 60) % 365, [*range(10), 365], [*range(10), 0])
    seen = [env.reset(seed=seed)[0][1], *(env.step([0.0])[0][1] for _ in range(7))]
    np.testing.assert_allclose(seen, expected, rtol=1e-6)


def test_holding_values_change_in_time(load_in, folder):
    """At 20 ms a step, at the end of a year, in the last of ten files."""
    for number in range(10):
        rows = [f"{day * DAY},{number * 1000 + day}" for day in range(365)]
        (folder / f"n{number}.csv").write_text("\n".join(["time,price", *rows]))
    task = task_of(time_step="20ms", episode_length="2s", clock=364 * DAY - 0.5, file="n9.csv")
    task["data"] = {"price": task["data"]["price"] | {"file": "n*.csv", "max": 1e4}}
    task["agent"], task["reward"] = {"actions": ["tau"], "observations": ["price", "q"]}, "price"
    env = load_in(task)
    seen = [env.reset(seed=0)[0][0], *(env.step([0.0])[0][0] for _ in range(50))]
    assert seen == [9363.0] * 25 + [9364.0] * 26


def test_a_snapshot_has_its_file(load_in):
    env = load_in(task_of())
    env.reset(seed=3)
    env.step([0.0])
    snapshot = env.save_state()
    after = [env.step([0.0])[0] for _ in range(3)]
    for seed in range(4):
        env.reset(seed=seed)
        env.restore_state(snapshot)
        np.testing.assert_array_equal([env.step([0.0])[0] for _ in range(3)], after)


def test_a_rollout_may_assume_other_rows(load_in):
    """The rows take the place of those of the file that the episode has."""
    task = task_of(clock="07-01")
    with closing(FMUVectorEnv(partial(fmugym.load, task), 3)) as envs:
        envs.reset(seed=0)
        begin = 181 * DAY
        given = {"price": ([begin, begin + DAY], [7.0, 8.0])}
        actions = np.zeros((3, 8, 1), np.float32)
        own = envs.rollout(envs.save_state(), actions)
        found = envs.rollout(envs.save_state(), actions, data=given)
    assert found.observations[..., 1].tolist() == [[7.0] * 3 + [8.0] * 5] * 3
    np.testing.assert_array_equal(found.observations[..., 0], own.observations[..., 0])
    assert len(np.unique(own.observations[:, 0, 0])) > 1


def test_an_exported_agent_has_all_files(load_in, tmp_path):
    """Its parameter chooses one; Python and C look up the same values."""
    env = load_in(task_of(clock="07-01"))
    network = network_for(env)
    agent = agent_of(env, network)
    assert [one.name for one in agent.logic.parameters] == [NUMBER]
    seeds = {int(env.reset(seed=seed)[1]["drawn"][NUMBER]): seed for seed in range(20)}
    assert seeds.keys() == {0, 1, 2}
    for number in (1, 2):
        own = tmp_path / str(number)
        own.mkdir()
        _, written, steps = closed_loop(env, acting(network), agent, own, 8, seeds[number])
        assert (written <= 1e-6, steps) == (True, 8)


def test_info_lists_files_with_their_numbers(load_in, folder, ran):
    Task.from_dict(task_of()).write(folder / "task.toml")
    text = ran("info", str(folder / "task.toml"))
    assert "T, file number 2: column 'T'" in text
    assert text.count("w2024.csv") == 1
