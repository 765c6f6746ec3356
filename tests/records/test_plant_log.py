"""Logs of plants: played through a task, they give what the task itself would have given."""

from functools import partial

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from letters import GREEK, MICRO, wide

import fmugym
from fmugym import ConfigError, bundled_fmu
from fmugym.envs.house import HOUSE_TASK
from fmugym.records import RecordSeries
from fmugym.records.plant_log import PlantLog, as_logged, play_log
from fmugym.records.recording import Recorder
from fmugym.task.series import read_data

IDS = ["fmugym/CartPole-v0", "fmugym/Pendulum-v0", "fmugym/House-v0"]


class Cart(fmugym.FMI2CSEnv):
    """A cart that is pushed by one of several actions."""

    space = spaces.Box(-1.0, 1.0, (1,), np.float32)

    def __init__(self, backend=None, **config):
        defaults = {
            "model_input_names": "f",
            "model_output_names": ["x", "x_dot"],
            "model_parameters": {"x_0": fmugym.Uniform(-0.5, 0.5)},
            "time_step": 0.02,
        }
        super().__init__(bundled_fmu("CartPole"), defaults | config, backend=backend)

    def _get_action_space(self):
        return self.space

    def _get_inputs(self):
        return 10.0 * np.ravel(self.action)[0]

    def _is_done(self):
        return False

    def _reward_policy(self):
        return -(self.out["x"] ** 2) - 0.001 * self.inputs[0] ** 2


class Pushed(Cart):
    space = spaces.MultiDiscrete([3, 2], start=[-1, 4])

    def _get_inputs(self):
        return 10.0 * self.action[0] + 1.0 * (self.action[1] - 4)


def written(make_env, path, episodes=2, steps=40):
    """Episodes of random actions, and the file that a recorder has made of them."""
    truth = []
    with RecordSeries(make_env(), path=path) as plant:
        recorder = Recorder(plant)
        recorder.action_space.seed(0)
        for seed in range(episodes):
            recorder.reset(seed=seed)
            over = False
            while not over and len(recorder.recording) < steps:
                _, _, terminated, truncated, _ = recorder.step(recorder.action_space.sample())
                over = terminated or truncated
            truth.append(recorder.recording)
    return truth


@pytest.mark.parametrize("make_env", [*(partial(gym.make, one) for one in IDS), Cart, Pushed])
def test_what_was_recorded_comes_out_again(make_env, tmp_path):
    truth = written(make_env, tmp_path / "run.csv")
    found = play_log(PlantLog.read(tmp_path / "run.csv"), make_env)
    assert len(found) == len(truth)
    for one, expected in zip(found, truth, strict=True):
        np.testing.assert_allclose(one.actions, expected.actions, atol=1e-6)
        np.testing.assert_allclose(one.observations, expected.observations, atol=1e-12)
        np.testing.assert_allclose(one.rewards, expected.rewards, atol=1e-7)
        np.testing.assert_array_equal(one.terminated, expected.terminated)
        assert one.truncated[-1] or one.terminated[-1]


def log_of(tmp_path, text, **options):
    path = tmp_path / "log.csv"
    path.write_text(text)
    return PlantLog.read(path, **options)


def test_units_times_and_names_are_those_of_the_plant(tmp_path):
    rows = ["time,Stellung [cm],speed [m/min],force [kN]"]
    rows += [f"{100 + 0.05 * k},{k},{60 * k},{0.001 * (k % 5)}" for k in range(11)]
    columns = {"Stellung": "x", "speed": "x_dot", "force": "f"}
    (one,) = play_log(log_of(tmp_path, "\n".join(rows)), Cart, columns=columns)
    assert len(one) == 25  # 0.5 s in steps of 0.02 s
    times = 0.02 * np.arange(26)
    np.testing.assert_allclose(one.observations[:, 0], times / 0.05 / 100, rtol=1e-6)
    np.testing.assert_allclose(one.observations[:, 1], times / 0.05, rtol=1e-6)
    held = np.floor(times[:-1] / 0.05 + 1e-9) % 5  # newtons, until the next row
    np.testing.assert_allclose(one.actions[:, 0], held / 10, atol=1e-6)


def test_a_tolerance_is_a_part_of_the_range_in_the_unit_of_the_fmu(tmp_path):
    """At most 10 N can be written: 10.005 N is off by half a thousandth of the range."""
    rows = ["time,x,x_dot,f [kN]", "0,0,0,0", "0.02,0,0,0.010005", "0.04,0,0,0"]
    (one,) = play_log(log_of(tmp_path, "\n".join(rows)), Cart)
    assert one.actions.ravel().tolist() == [0.0, 1.0]


def test_the_fmu_is_not_loaded(tmp_path, monkeypatch):
    rows = ["time,x,x_dot,f", "0,1,2,3", "0.02,1,2,3"]
    log = log_of(tmp_path, "\n".join(rows))
    monkeypatch.setattr(fmugym.FMU, "extract", lambda self: pytest.fail("extracted"))
    assert len(play_log(log, Cart)[0]) == 1


def test_episodes_end_where_the_task_ends_them(tmp_path):
    class Bounded(Cart):
        def _is_done(self):
            return self.out["x"] > 2.5

    rows = ["time,x,x_dot,f", *(f"{0.02 * k},{k},0,1" for k in range(8))]
    found = play_log(log_of(tmp_path, "\n".join(rows)), Bounded)
    assert [len(one) for one in found] == [3, 1, 1, 1, 1]
    assert [bool(one.terminated[-1]) for one in found] == [True] * 5
    starts = [one.observations[0][0] for one in found]
    assert starts == [0, 3, 4, 5, 6]  # in the row where the episode before has ended


def test_time_that_goes_back_begins_an_episode(tmp_path):
    rows = ["time,x,x_dot,f", "0,1,2,3", "0.02,1,2,3", "0,5,2,3", "0.02,5,2,3", "0.04,5,2,3"]
    found = play_log(log_of(tmp_path, "\n".join(rows)), Cart)
    assert [len(one) for one in found] == [1, 2]


def test_inputs_of_the_row_before(tmp_path):
    rows = ["time,x,x_dot,f", "0,0,0,99", "0.02,0,0,3", "0.04,0,0,4"]
    log = log_of(tmp_path, "\n".join(rows), inputs_before=True)
    (one,) = play_log(log, Cart)
    np.testing.assert_allclose(one.actions.ravel(), [0.3, 0.4], rtol=1e-6)


class TestMistakes:
    @pytest.mark.parametrize(
        ("text", "facts"),
        [
            ("", ["no rows"]),
            ("time,x", ["no rows"]),
            ("x,f\n1,2", ["'time'"]),
            ("time,x\n0,1,2", ["row 2", "2", "3"]),
            ("time,x\n0,1\n0,2", ["row 3", "rise"]),
            ("time,x\n0,1\n1,much", ["column 'x'", "'much'"]),
        ],
    )
    def test_files(self, tmp_path, text, facts):
        with pytest.raises(ConfigError) as caught:
            log_of(tmp_path, text)
        assert all(fact in str(caught.value) for fact in facts)

    def test_no_file(self, tmp_path):
        with pytest.raises(ConfigError, match=r"none\.csv"):
            PlantLog.read(tmp_path / "none.csv")

    @pytest.mark.parametrize(
        ("text", "facts"),
        [
            ("time,x,f\n0,1,2\n1,1,2", ["'x_dot'"]),
            ("time,x,x_dot\n0,1,2\n1,1,2", ["'f'"]),
            ("time,x,x_dot,f\n0,0,0,11\n1,0,0,0", ["f = 11", "10", "tolerance"]),
            ("time,x,x_dot,f\n0,0,0,11\n1,0,0,0\n2,0,0,", ["f = 11", "10", "tolerance"]),
            ("time,x [degC],x_dot,f\n0,1,2,3\n1,1,2,3", ["degC"]),
            ("time,x,x_dot,f\n0,0,0,1\n0.02,nan,0,1", ["0.02 s", "x", "f"]),
        ],
    )
    def test_columns(self, tmp_path, text, facts):
        with pytest.raises(ConfigError) as caught:
            play_log(log_of(tmp_path, text), Cart)
        assert all(fact in str(caught.value) for fact in facts)

    def test_a_warm_up(self, tmp_path):
        log = log_of(tmp_path, "time,x,x_dot,f\n0,1,2,3\n1,1,2,3")
        with pytest.raises(ConfigError, match="warm-up"):
            play_log(log, partial(Cart, warm_up=1.0))

    def test_actions_that_are_no_numbers(self, tmp_path):
        class Odd(Cart):
            space = spaces.Text(3)

        log = log_of(tmp_path, "time,x,x_dot,f\n0,1,2,3\n1,1,2,3")
        with pytest.raises(ConfigError, match="Text"):
            play_log(log, Odd)

    def test_too_many_actions(self, tmp_path):
        class Many(Cart):
            space = spaces.MultiDiscrete([101, 100])

        log = log_of(tmp_path, "time,x,x_dot,f\n0,1,2,3\n1,1,2,3")
        with pytest.raises(ConfigError, match="10000"):
            play_log(log, Many)


def test_the_record_of_a_shadow_at_the_end_of_a_year_has_its_own_data():
    """From noon of December 31 to noon of January 1; before and after, the house has its own."""
    day, year = 86400.0, 365 * 86400.0
    times = np.arange(364.5 * day, 365.5 * day, 900.0)
    log = PlantLog(times, {"price": np.full(len(times), 9.0)}, {}, np.zeros(len(times)))
    task = fmugym.Task.read(HOUSE_TASK)
    own, found = (
        read_data(one.root.child("data").child("price")) for one in (task, as_logged(task, log))
    )

    def at(series, moment):
        since = (moment - series.start) % series.period
        return series.values[np.searchsorted(series.times, since, side="right") - 1]

    assert found.period == year
    assert [at(found, moment * day) for moment in (364.6, 365.0, 0.1)] == [9.0] * 3
    for moment in (0.6, 100.0, 364.4):
        assert at(found, moment * day) == at(own, moment * day)


class TestTables:
    """Logs are read as data are: dates with zones, strict numbers, Parquet files."""

    def test_dates_with_offsets_are_on_standard_time(self, tmp_path):
        rows = [
            "time,x",
            "2023-06-30T23:00:00Z,1",
            "2023-07-01T03:00:00+02:00,2",
            "2023-07-01T02:00Z,3",
        ]
        july = 181 * 86400.0
        log = log_of(tmp_path, "\n".join(rows), standard=3600)
        assert log.times.tolist() == [july, july + 7200, july + 10800]
        assert log_of(tmp_path, "\n".join(rows)).times[0] == july - 3600

    def test_dates_of_a_zone(self, tmp_path):
        rows = ["time,x", *(f"2023-10-29 0{hour}:00,1" for hour in (1, 2, 2, 3))]
        with pytest.raises(ConfigError, match=r"row 4 \(2023-10-29 02:00\).*timezone"):
            log_of(tmp_path, "\n".join(rows))
        log = log_of(tmp_path, "\n".join(rows), timezone="Europe/Berlin")
        assert np.diff(log.times).tolist() == [3600] * 3
        with pytest.raises(ConfigError, match="'Europe/Berlin'"):
            log_of(tmp_path, "\n".join(rows), timezone="Europe/Berln")

    def test_an_episode_ends_before_29_february(self, tmp_path):
        rows = ["time,x", *(f"2024-0{day},{day[-1]}" for day in ("2-28", "2-29", "3-01", "3-02"))]
        log = log_of(tmp_path, "\n".join(rows))
        assert [part.columns["x"].tolist() for part in log.parts()] == [[8], [1, 2]]
        assert np.diff(log.times).tolist() == [86400] * 2

    def test_an_episode_ends_at_a_gap_in_regular_rows(self, tmp_path):
        times = [*range(20), *range(22, 40), 41, *range(300, 320)]
        rows = ["time,x,x_dot,f", *(f"{0.02 * k:g},{k},0,1" for k in times)]
        log = log_of(tmp_path, "\n".join(rows))
        lengths = [len(part.times) for part in log.parts()]
        assert lengths == [20, 19, 20]
        assert [len(one) for one in play_log(log, Cart)] == [19, 19, 19]

    def test_numbers_are_those_of_data(self, tmp_path):
        for cell, heading in (("1_000", "x"), ("\u0661", "x"), ("0x1", "x")):
            with pytest.raises(ConfigError, match=rf"log\.csv, row 3, column '{heading}'"):
                log_of(tmp_path, f"time,{heading}\n0,1\n1,{cell}\n")
        log = log_of(tmp_path, "time;x [cm]\n0,5;1,5\n1,5;2,5\n")
        assert (log.times.tolist(), log.columns["x"].tolist()) == ([0.5, 1.5], [1.5, 2.5])

    @pytest.mark.parametrize(
        ("text", "fact"),
        [
            ("time,x,x\n0,1,2\n", "two columns 'x'"),
            ("time,x [m],x [cm]\n0,1,2\n", "two columns 'x'"),
            ("time [h],x\n0,1\n1,2\n", "'time' of seconds"),
            ("time,x\n0,1\n,2\n", "row 3, column 'time'.*finite"),
        ],
    )
    def test_mistakes(self, tmp_path, text, fact):
        with pytest.raises(ConfigError, match=fact):
            log_of(tmp_path, text)

    def test_parquet(self, tmp_path):
        pd = pytest.importorskip("pandas", reason="needs the extra pandas")
        pytest.importorskip("pyarrow", reason="needs the extra parquet")
        index = pd.date_range("2023-03-01", periods=3, freq="h", tz="Europe/Berlin", name="time")
        pd.DataFrame({"x": [1.0, None, 3.0]}, index).to_parquet(tmp_path / "x.parquet")
        log = PlantLog.read(tmp_path / "x.parquet")
        assert log.times.tolist() == [59 * 86400.0 + 3600 * k for k in range(3)]
        np.testing.assert_array_equal(log.columns["x"], [1, np.nan, 3])


class TestLetters:
    """Columns are found by names whose letters only look the same."""

    ROWS = ("0,0,0,0", "0.02,0,0,3", "0.04,0,0,4")

    def text(self, heading):
        return "\n".join([heading, *self.ROWS])

    def test_variables(self, tmp_path):
        log = log_of(tmp_path, self.text(f"{wide('time,x,x_dot')} [m/s],{wide('f')}"))
        (one,) = play_log(log, Cart)
        np.testing.assert_allclose(one.actions.ravel(), [0, 0.3], rtol=1e-6)

    @pytest.mark.parametrize(("written", "given"), [(MICRO, GREEK), (GREEK, MICRO)])
    def test_columns_of_other_names(self, tmp_path, written, given):
        log = log_of(tmp_path, self.text(f"time,x,x_dot,{written}"))
        (one,) = play_log(log, Cart, columns={given: wide("f")})
        np.testing.assert_allclose(one.actions.ravel(), [0, 0.3], rtol=1e-6)
        with pytest.raises(ConfigError) as caught:
            play_log(log, Cart, columns={MICRO: "f", GREEK: "x"})
        assert all(ascii(name) in str(caught.value) for name in (MICRO, GREEK))

    def test_steps_and_episodes(self, tmp_path):
        rows = ["0,0,0,0,0,0", "0.02,0,0,3,0,1", "0.04,0,0,4,1,0", "0.06,0,0,5,1,1"]
        heading = f"time,x,x_dot,f,{wide('episode')},{wide('step')}"
        log = log_of(tmp_path, "\n".join([heading, *rows]))
        assert log.inputs_before
        actions = [one.actions.ravel().tolist() for one in play_log(log, Cart)]
        np.testing.assert_allclose(actions, [[0.3], [0.5]], rtol=1e-6)

    def test_what_was_proposed(self, tmp_path):
        rows = ["0,1,", "1,2,5"]
        log = log_of(tmp_path, "\n".join([f"time,{MICRO},proposed.{GREEK}", *rows])).proposed
        assert log.columns[MICRO].tolist() == [1, 5]

    @pytest.mark.parametrize(("declared", "logged"), [(MICRO, GREEK), (GREEK, MICRO)])
    def test_data_of_a_task(self, tmp_path, declared, logged):
        """The rows of a column of data have their own time, and the data its values."""
        config = {
            "fmu": {"bundled": "CartPole"},
            "time_step": 0.02,
            "clock": "0s",
            "data": {declared: {"values": [1.0, 2.0], "step": "1h", "input": "f"}},
            "agent": {"actions": [], "observations": ["x", declared]},
            "reward": "x",
        }
        task = fmugym.Task.from_dict(config)
        rows = ["time,step,x," + logged, "0,0,0,7", "0.02,1,0,8", "0.04,2,0,9"]
        log = log_of(tmp_path, "\n".join(rows))
        series = read_data(as_logged(task, log).root.child("data").child(declared))
        assert series.values[:3].tolist() == [7, 8, 9]

    def test_names_that_look_the_same_are_refused(self, tmp_path):
        with pytest.raises(ConfigError) as caught:
            log_of(tmp_path, self.text(f"time,x,{MICRO} [m],{GREEK} [cm]"))
        facts = "log.csv", "number 3", ascii(f"{MICRO} [m]"), "number 4", ascii(f"{GREEK} [cm]")
        assert all(fact in str(caught.value) for fact in facts)
        with pytest.raises(ConfigError) as caught:
            PlantLog(np.zeros(1), dict.fromkeys([MICRO, GREEK], np.zeros(1)), {}, np.zeros(1))
        assert all(ascii(name) in str(caught.value) for name in (MICRO, GREEK))
        with pytest.raises(ConfigError, match="time"):
            log_of(tmp_path, f"time,{wide('time')}\n0,1\n1,2\n")

    def test_a_misspelt_name_is_told(self, tmp_path):
        log = log_of(tmp_path, self.text(wide("time,x,x_dt,f")))
        with pytest.raises(ConfigError, match="unknown column of the log 'x_dot'") as caught:
            play_log(log, Cart)
        assert wide("x_dt") in str(caught.value)
        assert len([*log.parts(["x"])]) == 1
        with pytest.raises(ConfigError, match="unknown column of the log 'xx'"):
            next(log.parts(["xx"]))
