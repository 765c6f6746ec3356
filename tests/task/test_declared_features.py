"""Data, set points, forecasts, histories and scaled spaces of declared tasks."""

import datetime
import sys
from functools import partial

import numpy as np
import pytest
from vector_tools import require_same_alone

import fmugym
from fmugym.errors import TaskError

DT = 0.25

BASE = {
    "fmu": {"bundled": "Pendulum"},
    "time_step": DT,
    "variables": {
        "tau": {"min": -0.02, "max": 0.06},
        "q": {"min": -4, "max": 4},
        "q_dot": {"min": -60, "max": 60},
    },
    "parameters": {"q_0": {"distribution": "uniform", "low": -1, "high": 1}},
    "agent": {"actions": ["tau"], "observations": ["q"]},
    "reward": 0,
}

AT_REST = {"q_0": 0, "g": 0, "max_step": 3600}
"""Parameters of a pendulum that nothing moves, for steps of hours."""

PRICES = [0.2, 0.5, 0.1]
EVERYTHING = BASE | {
    "data": {
        "price": {"values": PRICES, "step": "1s", "interpolation": "previous"},
        "load": {"values": [0, 2, 1], "step": "0.4s", "min": -1, "max": 4},
    },
    "setpoints": {
        "goal": {"value": {"distribution": "normal", "mean": 0, "std": 1}, "min": -9, "max": 9},
        "wave": {
            "sine": {
                "amplitude": {"distribution": "uniform", "low": 1, "high": 2},
                "period": "1.5s",
            },
            "min": -2,
            "max": 2,
        },
        "rise": {
            "ramp": {"from": -1, "to": 1, "begin": "1s", "duration": "2s"},
            "min": -1,
            "max": 1,
        },
        "night": {"schedule": {"06:00": 1, "22:00": 0}},
    },
    "memory": {"total": {"start": 0, "update": "total + price * dt", "min": 0, "max": 100}},
    "agent": {
        "actions": ["tau"],
        "observations": ["q", "tau", "price", "load", "goal", "wave", "rise", "night", "total"],
        "forecast": [
            {"of": ["price", "wave"], "horizon": "1s", "step": "0.5s"},
            {"of": "load", "horizon": "0.5s"},
        ],
        "history": {"of": ["q", "tau", "load"], "length": "0.75s"},
        "rescale": True,
        "normalize": True,
    },
    "reward": {"cost": "-price * tau**2", "track": "-abs(q - wave)", "late": "night - price"},
    "truncated": "time >= 3",
}


def named(observation):
    """The parts of an observation of ``EVERYTHING`` before it is normalized."""
    ranges = {
        "q": (-4, 4), "tau": (-0.02, 0.06), "price": (0.1, 0.5), "load": (-1, 4),
        "goal": (-9, 9), "wave": (-2, 2), "rise": (-1, 1), "night": (0, 1), "total": (0, 100),
    }  # fmt: skip
    order = [
        *((name, 1) for name in ranges),
        *(("price", 2), ("wave", 2), ("load", 2)),
        *(("q", 3), ("tau", 3), ("load", 3)),
    ]
    parts, place = [], 0
    for name, count in order:
        low, high = ranges[name]
        part = observation[place : place + count].astype(float)
        parts.append((name, low + (part + 1) / 2 * (high - low)))
        place += count
    assert place == len(observation)
    return parts


def price_at(time):
    return PRICES[int(time % 3.0 + 1e-9)]


def load_at(time):
    return np.interp(time % 1.2, [0, 0.4, 0.8, 1.2], [0, 2, 1, 0])


def test_an_episode_has_the_declared_values(load):
    env = load(EVERYTHING)
    assert env.action_space.low == [-1]
    assert env.observation_names[:3] == ("q", "tau", "price")
    assert env.observation_names[9:11] == ("price[+0.5 s]", "price[+1 s]")
    assert env.observation_names[-1] == "load[-0.75 s]"
    observation, info = env.reset(seed=4)
    amplitude, goal = info["drawn"]["wave_amplitude"], info["drawn"]["goal"]
    angles, torques, total = [env.state[0]], [0.0], 0.0
    rng = np.random.default_rng(0)
    for step in range(12):
        time = step * DT
        parts = named(observation)
        seen = {name: part[0] for name, part in parts[:9]}
        assert seen["q"] == pytest.approx(angles[-1], rel=1e-6)
        assert seen["tau"] == pytest.approx(torques[-1], abs=1e-6)
        assert seen["price"] == pytest.approx(price_at(time), abs=1e-6)
        assert seen["load"] == pytest.approx(load_at(time), abs=1e-6)
        assert seen["goal"] == pytest.approx(goal, abs=1e-5)
        wave = [amplitude * np.sin(2 * np.pi * t / 1.5) for t in (time, time + 0.5, time + 1)]
        assert seen["wave"] == pytest.approx(wave[0], abs=1e-6)
        assert seen["rise"] == pytest.approx(np.clip((time - 1) / 2, 0, 1) * 2 - 1, abs=1e-6)
        assert seen["night"] == pytest.approx(0.0, abs=1e-6)
        assert seen["total"] == pytest.approx(total, abs=1e-5)
        forecasts = [part for _, part in parts[9:12]]
        np.testing.assert_allclose(forecasts[0], [price_at(time + 0.5), price_at(time + 1)], 1e-5)
        np.testing.assert_allclose(forecasts[1], wave[1:], atol=1e-6)
        loads = [load_at(time + DT), load_at(time + 2 * DT)]
        np.testing.assert_allclose(forecasts[2], loads, atol=1e-6)
        past = [part for _, part in parts[12:]]
        np.testing.assert_allclose(past[0], last(angles[:-1], angles[0]), rtol=1e-6)
        np.testing.assert_allclose(past[1], last(torques, 0.0), atol=1e-6)
        np.testing.assert_allclose(past[2], [load_at(time - k * DT) for k in (1, 2, 3)], atol=1e-6)
        action = rng.uniform(-1, 1, 1).astype(np.float32)
        observation, reward, _, truncated, info = env.step(action)
        torque = -0.02 + (float(action[0]) + 1) / 2 * 0.08
        assert env.inputs[0] == pytest.approx(torque, rel=1e-12)
        angles.append(env.state[0])
        torques.append(torque)
        total += price_at(time) * DT
        terms = {
            "cost": -price_at(time) * torque**2,
            "track": -abs(angles[-1] - amplitude * np.sin(2 * np.pi * (time + DT) / 1.5)),
            "late": -price_at(time),
        }
        assert info["reward_terms"] == pytest.approx(terms)
        assert reward == pytest.approx(sum(terms.values()))
        assert truncated == (step == 11)


def last(values, first):
    """The last three values, the latest first."""
    return [first, first, first, *values][:-4:-1]


@pytest.mark.parametrize("declared", ["everything", "two names of a variable"])
@pytest.mark.parametrize("hooks", ["expressions", "arrays", "one by one"])
def test_many_environments_equal_single_ones_to_the_last_bit(hooks, declared):
    task = EVERYTHING if declared == "everything" else TWICE
    assert require_same_alone(partial(fmugym.load, task), 30, way=hooks)


CSV = "time;T_C;note\n0;10;a\n3600;20;b\n7200;15;c\n"


class TestFiles:
    name = "weather.csv"

    def load(self, folder, text=CSV, **column):
        (folder / self.name).write_text(text, encoding="utf-8")
        return self.task(folder, **column)

    def task(self, folder, **column):
        """A task whose agent observes a column."""
        data = {"T": {"file": str(folder / self.name), "column": "T_C"} | column}
        agent = {"actions": ["tau"], "observations": ["T", "q"]}
        task = {"data": data, "agent": agent, "time_step": 900, "parameters": AT_REST}
        return fmugym.load(BASE | task)

    def values(self, env, steps):
        """The observations of an episode; the steps are long, but nobody looks at the FMU."""
        seen = [env.reset(seed=0)[0][0]]
        seen += [env.step([0.0])[0][0] for _ in range(steps)]
        env.close()
        return seen

    def test_lines_between_the_rows(self, tmp_path):
        seen = self.values(self.load(tmp_path), 12)
        expected = np.interp(np.arange(13) * 900 % 10800, [0, 3600, 7200, 10800], [10, 20, 15, 10])
        np.testing.assert_allclose(seen, expected, rtol=1e-6)

    def test_a_value_holds_until_the_next_row(self, tmp_path):
        seen = self.values(self.load(tmp_path, interpolation="previous"), 13)
        assert seen == [10] * 4 + [20] * 4 + [15] * 4 + [10, 10]

    def test_dates_count_from_the_beginning_of_their_year(self, tmp_path):
        text = CSV.replace("0;10", "2023-01-01 00:00;10", 1)
        text = text.replace("3600;", "2023-01-01T01:00:00;").replace("7200;", "2023-01-01 02:00;")
        seen = self.values(self.load(tmp_path, text, interpolation="previous"), 4)
        assert seen == [10] * 4 + [20]

    def test_rows_at_even_times_with_commas(self, tmp_path):
        text = CSV.replace(";", ",").replace("time", "index")
        env = self.load(tmp_path, text, step="30min", interpolation="previous", period="2h")
        assert self.values(env, 8) == [10, 10, 20, 20, 15, 15, 15, 15, 10]

    @pytest.mark.parametrize(
        ("text", "column", "fact"),
        [
            (CSV, {"time": "tim"}, "'time'"),
            (CSV, {"period": "1h"}, "3600"),
            (CSV, {"values": [1]}, "either"),
            (CSV.replace("20", "n/a"), {}, "row 3.*'n/a'"),
            (CSV.replace("7200", "60"), {}, "60 s"),
            (CSV.replace("3600;20;b", "3600;20"), {}, "row 3 .* 2 cells, expected 3"),
            (CSV.replace("b", "b" * 200_000), {}, "is no table: field larger than"),
            (CSV.replace("time", "hour"), {}, "'hour'"),
            (CSV.replace("7200", "noon"), {}, "noon"),
            ("", {"file": None, "column": None, "values": [], "step": 1}, "at least one value"),
            ("time;T_C\n", {}, "no rows"),
            ("", {}, "no rows"),
        ],
    )
    def test_mistakes_are_explained(self, tmp_path, text, column, fact):
        with pytest.raises(TaskError, match=rf"data\.T.*{fact}"):
            self.load(tmp_path, text, **column)

    def test_a_task_with_data_survives_writing(self, tmp_path):
        env = self.load(tmp_path)
        (tmp_path / "folder").mkdir()
        env.task.write(tmp_path / "folder" / "task.toml")
        assert f'file = "../{self.name}"' in (tmp_path / "folder" / "task.toml").read_text()
        assert fmugym.Task.read(tmp_path / "folder" / "task.toml") == env.task
        env.close()


class TestParquet(TestFiles):
    """The same data with types."""

    name = "weather.parquet"

    def load(self, folder, times=(0, 3600, 7200), values=(10.0, 20.0, 15.0), **column):
        parquet = pytest.importorskip("pyarrow.parquet", reason="needs the extra parquet")
        pyarrow = pytest.importorskip("pyarrow", reason="needs the extra parquet")
        table = pyarrow.table({"time": list(times), "T_C": list(values), "note": ["a", "b", "c"]})
        parquet.write_table(table, folder / self.name)
        return self.task(folder, **column)

    def test_dates_count_from_the_beginning_of_their_year(self, tmp_path):
        times = [datetime.datetime(2023, 1, 1, hour) for hour in range(3)]
        env = self.load(tmp_path, times, interpolation="previous")
        assert self.values(env, 4) == [10] * 4 + [20]

    def test_rows_at_even_times_with_commas(self, tmp_path):
        env = self.load(tmp_path, step="30min", interpolation="previous", period="2h")
        assert self.values(env, 8) == [10, 10, 20, 20, 15, 15, 15, 15, 10]

    @pytest.mark.parametrize(
        ("values", "column", "fact"),
        [
            ((1.0, None, 2.0), {"gaps": "1h"}, "row 2.*row 4.*2 hours"),
            ((1, 2, 3), {"column": "note"}, "'a'"),
            ((1, 2, 3), {"column": "T_c"}, "'T_C'"),
        ],
    )
    def test_mistakes_are_explained(self, tmp_path, values, column, fact):
        with pytest.raises(TaskError, match=rf"data\.T.*{fact}"):
            self.load(tmp_path, values=values, **column)

    def test_a_file_of_something_else(self, tmp_path):
        self.load(tmp_path).close()
        (tmp_path / self.name).write_bytes(b"PAR1 but no more")
        with pytest.raises(TaskError, match=r"^data\.T\.file: weather\.parquet"):
            self.task(tmp_path)

    def test_without_pyarrow(self, tmp_path, monkeypatch):
        (tmp_path / self.name).write_bytes(b"PAR1")
        monkeypatch.setitem(sys.modules, "pyarrow", None)
        with pytest.raises(TaskError, match=r"data\.T\.file.*'parquet'"):
            self.task(tmp_path)


class TestArrays:
    def seen(self, **data):
        agent = {"actions": ["tau"], "observations": ["T", "q"]}
        env = fmugym.load(BASE | {"data": {"T": data}, "agent": agent})
        values = [env.reset(seed=0)[0][0], *(env.step([0.0])[0][0] for _ in range(5))]
        env.close()
        return values

    def test_of_numpy(self):
        values, times = np.array([0.0, 1.0, 5.0]), np.array([0.0, 0.25, 1.25])
        expected = np.interp(np.arange(6) * DT, times, values)
        np.testing.assert_allclose(self.seen(values=values, times=times), expected, rtol=1e-6)
        assert self.seen(values=values, step=DT)[:3] == [0, 1, 5]

    @pytest.mark.parametrize(
        ("data", "fact"),
        [
            ({"values": [1, 2], "times": [0, 1], "step": 1}, "'times'"),
            ({"values": [1.0, np.nan], "step": 1}, "finite"),
            ({"values": 3, "step": 1}, "list"),
            ({"values": np.ones((2, 2)), "step": 1}, "values"),
        ],
    )
    def test_mistakes_are_explained(self, data, fact):
        with pytest.raises(TaskError, match=rf"^data\.T.*{fact}"):
            self.seen(**data)


def test_data_are_written_to_an_input_in_its_unit(load):
    data = {"load": {"values": [1, 5], "step": DT, "unit": "N.mm", "input": "tau"}}
    agent = {"actions": ["gain"], "observations": ["q", "load"]}
    variables = {"gain": {"min": 0, "max": 1}}
    env = load(BASE | {"data": data, "agent": agent, "variables": variables})
    assert env.reset(seed=0)[0][1] == 1.0
    assert env.step([0.0])[0][1] == 5.0
    assert env.inputs == (pytest.approx(0.001),)
    env.step([0.0])
    assert env.inputs == (pytest.approx(0.005),)


def test_a_schedule_holds_over_midnight(load):
    setpoints = {"T": {"schedule": {"06:00": 21, "22:00": 17}}}
    agent = {"actions": ["tau"], "observations": ["T", "q"]}
    task = BASE | {"setpoints": setpoints, "agent": agent, "parameters": AT_REST}
    task |= {"time_step": "1h", "reward": "T"}
    env = load(task)
    seen, rewards = [env.reset(seed=0)[0][0]], []
    for _ in range(26):
        observation, reward, *_ = env.step([0.0])
        seen.append(observation[0])
        rewards.append(reward)
    assert seen == [17] * 6 + [21] * 16 + [17] * 5
    assert rewards == seen[:-1]
    assert env.observation_space.low[0] == 17


MISTAKES = {
    "forecast of a memory": ({"forecast": {"of": "total", "horizon": 1}}, "'total'"),
    "horizon": ({"forecast": {"of": "price", "horizon": 0.3}}, r"0\.25 s.*0\.3 s"),
    "history of an expression": ({"history": {"of": "total", "length": 1}}, "'total'"),
    "length": ({"history": {"of": "q", "length": "99d"}}, "at most 2000"),
    "no limits": ({"observations": ["unlimited"]}, "'unlimited'.*min"),
}


@pytest.mark.parametrize(("change", "fact"), MISTAKES.values(), ids=MISTAKES)
def test_mistakes_of_the_agent(change, fact):
    task = EVERYTHING | {
        "agent": EVERYTHING["agent"] | change,
        "expressions": {"unlimited": "q * 2"},
    }
    with pytest.raises(TaskError, match=fact):
        fmugym.load(task)


@pytest.mark.parametrize(
    ("setpoint", "fact"),
    [
        ({"schedule": {}}, "expected times"),
        ({"ramp": {"from": 1, "to": 2}}, "'duration'"),
        ({"value": 1, "ramp": {}}, "one of"),
    ],
)
def test_mistakes_of_set_points(setpoint, fact):
    with pytest.raises(TaskError, match=rf"(?s)^setpoints\.goal.*{fact}"):
        fmugym.load(BASE | {"setpoints": {"goal": setpoint}})


TWICE = BASE | {
    "variables": BASE["variables"]
    | {
        "angle": {"name": "q", "unit": "deg", "min": -230, "max": 230, "noise": 1.0},
        "rough": {"name": "q", "unit": "deg", "noise": 30.0, "delay": "0.5s"},
        "turned": {"name": "q_dot", "unit": "deg/s"},
    },
    "agent": {
        "actions": ["tau"],
        "observations": ["q", "angle", "rough"],
        "history": {"of": ["angle", "q"], "length": "0.5s"},
    },
    "reward": "angle + turned + q_dot - previous(angle)",
    "truncated": "time >= 3",
}


def test_a_variable_may_have_several_names(load):
    env = load(TWICE, way="expressions")
    assert len(env.config.model_output_names + env.config.monitor_names) == 2
    errors = []
    for seed in range(30):
        q, angle, rough, *_ = env.reset(seed=seed)[0]
        errors.append((angle - np.rad2deg(q), rough - np.rad2deg(q)))
        before = env.state[0]
        for _ in range(3):
            observation, reward, *_ = env.step(np.zeros(1, np.float32))
            (now,), rate = env.state, env.out["q_dot"]
            expected = np.rad2deg(now) + np.rad2deg(rate) + rate - np.rad2deg(before)
            assert reward == pytest.approx(expected, rel=1e-9)
            assert observation[5] == np.float32(before)
            before = now
    fine, rough = np.array(errors).T
    assert fine.std() == pytest.approx(1, rel=0.4)
    assert rough.std() == pytest.approx(30, rel=0.4)
    assert abs(np.corrcoef(fine, rough)[0, 1]) < 0.6


@pytest.mark.parametrize("names", [["q", "mean"], ["mean", "q"]])
def test_several_names_are_sampled_in_one_way(names):
    variables = BASE["variables"] | {"mean": {"name": "q", "sample": "mean"}}
    agent = {"actions": ["tau"], "observations": names}
    with pytest.raises(TaskError, match=rf"'{names[0]}' and '{names[1]}' .*'sample'"):
        fmugym.load(BASE | {"variables": variables, "agent": agent})
