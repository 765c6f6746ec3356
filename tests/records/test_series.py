"""Time series of environments, compared with what the environments return."""

import csv
import html.parser
import re
import sys
from itertools import pairwise

import gymnasium
import numpy as np
import pytest
from combinations import in_turn
from letters import wide
from ways import in_way

import fmugym
from fmugym import ConfigError
from fmugym.environment.episode import Quantity
from fmugym.records import RecordSeries, RecordVectorSeries, TimeSeries, plot, write_report
from fmugym.records.plots import as_svg
from fmugym.records.recorded_quantities import Infos

TASK = {
    "fmu": {"bundled": "Pendulum"},
    "time_step": 0.05,
    "episode_length": "0.6s",
    "variables": {
        "angle": {"name": "q", "unit": "deg", "min": -360, "max": 360, "noise": 0.1},
        "tau": {"min": -0.1, "max": 0.1},
        "gain": {"min": 0, "max": 1},
    },
    "agent": {"actions": ["tau", "gain"], "observations": ["angle", "q_dot", "T_set"]},
    "setpoints": {"T_set": {"schedule": {"00:00": 5, "00:01": 7}}},
    "memory": {"sum": {"start": 0, "update": "sum + angle"}},
    "expressions": {"error": "angle - T_set", "again": "previous(angle)"},
    "data": {"load": {"values": [0, 1, 3], "step": 0.2, "unit": "N"}},
    "parameters": {"q_0": {"distribution": "uniform", "low": -3, "high": 3}},
    "reward": {"near": "-abs(error)", "effort": {"expr": "-abs(tau) * gain", "weight": 2}},
    "costs": {"fast": {"expr": "abs(q_dot)", "limit": 3}, "far": "abs(angle) > 90"},
    "kpis": {"largest": {"max": "abs(angle)"}},
    "terminated": "abs(angle) > 200",
}


def make():
    return fmugym.load(TASK)


@pytest.fixture
def record(opened):
    """Record environments until the end of the test."""

    def begin(*arguments, task=TASK, **options):
        return opened(RecordSeries(fmugym.load(task), *arguments, **options))

    return begin


def played(env, seed, steps):
    """Play episodes with actions from one stream; return what the steps give."""
    env.action_space.seed(7)
    results = [env.reset(seed=seed)]
    for _ in range(steps):
        results.append(env.step(env.action_space.sample()))
        if results[-1][2] or results[-1][3]:
            results.append(env.reset())
    return results


class TestSingle:
    def test_rows_are_what_the_environment_gives(self, record, load):
        env, twin = record(), load(TASK)
        results = played(env, 3, 20)
        series = env.series
        assert len(series) == len(results)
        env.action_space.seed(7)
        twin.reset(seed=3)
        for row, result in enumerate(results):
            is_start = len(result) == 2
            if row and is_start:
                twin.reset()
            elif row:
                twin.step(action := env.action_space.sample())
                assert series["tau"][row] == pytest.approx(float(action[0]), abs=1e-12)
                assert series["gain"][row] == float(action[1])
            info = result[-1]
            assert series["time"][row] == twin.time
            assert series["angle"][row] == pytest.approx(np.degrees(twin.out["q"]), rel=1e-12)
            assert series["sum"][row] == twin.variables["sum"]
            assert series["error"][row] == series["angle"][row] - series["T_set"][row]
            assert series["reward"][row] == (0.0 if is_start else result[1])
            assert series["reward_terms.near"][row] == info["reward_terms"]["near"]
            assert series["costs.fast"][row] == info["costs"]["fast"]
            assert series["cost"][row] == info["cost"]
            assert series["kpis.largest"][row] == info["kpis"]["largest"]
        before = zip(
            pairwise(series["angle"]), series["again"][1:], series["step"][1:], strict=True
        )
        assert all(again == last for (last, _), again, step in before if step > 0)
        ends = [len(result) == 5 and result[3] for result in results]
        assert series["truncated"].tolist() == ends
        assert series.cost_limits == {"fast": 3}

    def test_units_kinds_and_limits(self, record):
        env = record()
        env.reset(seed=0)
        found = {column.name: column for column in env.series.columns}
        assert found["angle"].unit == "deg"
        assert (found["angle"].low, found["angle"].high) == (-360, 360)
        assert (found["load"].kind, found["load"].unit) == ("data", "N")
        assert [c.name for c in env.series.of_kind("action")] == ["tau", "gain"]
        assert found["tau"].unit == "N.m"
        assert "q_0" not in found

    def test_a_setpoint_has_the_unit_of_its_variable(self, record):
        env = record()
        env.reset(seed=0)
        (setpoint,) = env.series.of_kind("setpoint")
        assert (setpoint.of, setpoint.unit, setpoint.holds) == ("angle", "deg", True)
        task = {
            "fmu": {"bundled": "Pendulum"},
            "agent": {"actions": "tau", "observations": ["q", "q_dot"]},
            "setpoints": {"goal": {"value": 1, "of": "q_dot"}},
            "reward": "-abs(q)",
        }
        env = record(task=task)
        env.reset(seed=0)
        assert [one.of for one in env.series.of_kind("setpoint")] == ["q_dot"]

    def test_globs_choose_variables(self, record):
        env = record(["a*", "theta*", "q_0", "m", "observation.q?dot"])
        observation, _ = env.reset(seed=0)
        names = [c.name for c in env.series.columns]
        kept = names[names.index("time") + 1 : names.index("reward")]
        assert kept == [
            *("angle", "again", "q_0", "theta", "theta_dot", "theta_ddot", "m"),
            "observation.q_dot",
        ]
        assert env.series["observation.q_dot"][0] == observation[1]
        found = env.unwrapped.read_variables("theta", "m")
        assert env.series["theta"][0] == found["theta"]
        assert env.series["m"][0] == found["m"]

    def test_the_rows_of_compiled_steps(self, load):
        config = TASK | {"episode_length": "1s"}
        compiled = RecordSeries(load(config, way="expressions"))
        plain = RecordSeries(load(config, way="Python"))
        for env in (compiled, plain):
            played(env, 1, 60)
            env.step(np.array([0.01, 0.5], np.float32))
        assert compiled.unwrapped.is_compiled
        assert np.array_equal(compiled.series.values, plain.series.values)

    def test_a_class_without_a_task_file(self, opened):
        env = opened(RecordSeries(gymnasium.make("fmugym/CartPole-v0")))
        results = played(env, 0, 50)
        names = [column.name for column in env.series.columns]
        assert names[2:8] == ["time", "f", "x", "x_dot", "phi", "phi_dot"]
        assert env.series["phi"].astype(np.float32).tolist() == [r[0][2] for r in results]
        assert env.series.units["phi"] == "rad"

    def test_columns_are_found_by_letters_that_look_the_same(self, record):
        env = record()
        played(env, 0, 3)
        assert env.series[wide("angle")].tolist() == env.series["angle"].tolist()
        with pytest.raises(ConfigError, match="unknown column"):
            env.series[wide("angel")]

    def test_at_a_rate_sums_stay_right(self, record):
        whole, part = record(), record(every=0.25)
        for env in (whole, part):
            played(env, 3, 30)
        assert part.series["step"].tolist()[:5] == [0, 5, 10, 12, 0]
        for key, one in part.series.episodes().items():
            other = whole.series.episodes()[key]
            for name in ("reward", "reward_terms.near", "cost", "costs.far"):
                last = np.isin(other["step"], np.arange(one["step"][-1] + 1))
                assert one[name].sum() == pytest.approx(other[name][last].sum())
        assert part.series["angle"][1] == whole.series["angle"][5]

    def test_a_fault_has_its_reason(self, record):
        env = record(task=TASK | {"reward": "1 / (step - 3)"})
        results = played(env, 0, 4)
        assert env.series.faults == {3: results[3][4]["fault"]}

    @pytest.mark.parametrize(
        ("arguments", "fact"),
        [
            ({"variables": "angel"}, "'angle'"),
            ({"every": 0.07}, "0.05"),
            ({"every": -0.05}, "-0.05"),
            ({"most_rows": 0}, "most_rows"),
            ({"path": "run.xls"}, "run.xls"),
        ],
    )
    def test_mistakes(self, arguments, fact, tmp_path, load):
        if "path" in arguments:
            arguments = {"path": tmp_path / arguments["path"]}
        env = load(TASK)
        with pytest.raises(ConfigError, match=re.escape(fact)):
            RecordSeries(env, **arguments).reset()

    def test_other_environments_are_refused(self, record):
        with pytest.raises(ConfigError):
            RecordSeries(gymnasium.make("CartPole-v1"))
        env = record()
        with pytest.raises(fmugym.SimulationError):
            _ = env.series


@in_turn({"hooks": ["expressions", "arrays", "one by one"], "mode": ["next_step", "same_step"]})
def test_a_vector_environment_gives_the_rows_of_single_ones(hooks, mode, record, make_envs):
    envs = make_envs(in_way(hooks, make), 3, autoreset_mode=mode)
    wanted = ["*", "observation.*"]
    many = RecordVectorSeries(envs, wanted, environments=[0, 2])
    many.action_space.seed(5)
    actions = [many.action_space.sample() for _ in range(40)]
    many.reset(seed=9)
    for action in actions:
        many.step(action)
    for index in (0, 2):
        one = record(wanted)
        one.reset(seed=9 + index)
        ended = False
        for action in actions:
            if ended and mode == "next_step":
                one.reset()
                ended = False
                continue
            ended = any(one.step(action[index])[2:4])
            if ended and mode == "same_step":
                one.reset()
        rows = many.series.values[many.series["environment"] == index][:, 1:]
        expected = one.series.values.copy()
        assert one.series["truncated"].sum() >= 2
        assert np.array_equal(rows, expected, equal_nan=True)
    assert set(many.series["environment"]) == {0, 2}


def driven(make_envs, mode, begins):
    """Everything that 30 steps of three environments return, and a recording from a step on."""
    envs = make_envs(make, 3, autoreset_mode=mode)
    envs.action_space.seed(5)
    used = RecordVectorSeries(envs) if begins == 0 else envs
    used.reset(seed=9)
    told = []
    for number in range(30):
        if number == begins > 0:
            used = RecordVectorSeries(envs)
        told += used.step(envs.action_space.sample())[:4]
    return np.concatenate(told, None), used.series


@pytest.mark.parametrize("mode", ["next_step", "same_step"])
def test_a_recorder_changes_nothing_and_may_begin_late(mode, make_envs):
    results, whole = driven(make_envs, mode, 0)
    assert whole["truncated"].sum() > 3
    for begins in (1, 5):  # in the first episodes
        same, late = driven(make_envs, mode, begins)
        assert np.array_equal(results, same)
        missing = 3 * (begins + 1)  # the resets and the steps before
        kept = [column.name != "episode" for column in whole.columns]
        assert np.array_equal(whole.values[missing:, kept], late.values[:, kept], equal_nan=True)


def test_a_recorder_of_one_environment_may_begin_late(load):
    env = load(TASK)
    env.reset(seed=3)
    env.step(env.action_space.sample())
    late = RecordSeries(env)
    late.step(env.action_space.sample())
    assert late.series["step"].tolist() == [2]


def test_steps_in_the_background_and_masked_resets(make_envs):
    envs = make_envs(make, 2, autoreset_mode="disabled")
    many = RecordVectorSeries(envs, "angle")
    many.reset(seed=0)
    action = many.action_space.sample()
    many.step_async(action)
    many.step_wait()
    many.reset(options={"reset_mask": np.array([False, True])})
    assert many.series["environment"].tolist() == [0, 1, 0, 1, 1]
    assert many.series["step"].tolist() == [0, 0, 1, 1, 0]
    assert many.series["episode"].tolist() == [0, 0, 0, 0, 1]
    with pytest.raises(ConfigError, match="0 to 1"):
        RecordVectorSeries(envs, environments=[2])


def play_until_an_error(env):
    while True:
        _, _, terminated, truncated, _ = env.step(env.action_space.sample())
        if terminated or truncated:
            env.reset()


class TestFiles:
    def test_a_csv_file_has_units_and_exact_numbers(self, tmp_path, record):
        env = record(["angle", "T_set"], path=tmp_path / "a.csv")
        played(env, 0, 15)
        env.close()
        with (tmp_path / "a.csv").open(newline="") as file:
            rows = list(csv.DictReader(file))
        assert list(rows[0])[:5] == ["episode", "step", "time [s]", "angle [deg]", "T_set [deg]"]
        assert [float(row["angle [deg]"]) for row in rows] == env.series["angle"].tolist()
        assert [row["truncated"] for row in rows] == ["0"] * 12 + ["1"] + ["0"] * 4
        env.series.write(tmp_path / "b.csv")
        assert (tmp_path / "b.csv").read_text() == (tmp_path / "a.csv").read_text()
        with pytest.raises(FileExistsError):
            env.series.write(tmp_path / "a.csv")

    def test_faults_of_ended_episodes_are_in_their_last_infos(self):
        now = {"fault": ["of the next", "own"], "_fault": np.array([True, True])}
        last = {"fault": ["at the end", ""], "_fault": np.array([True, False])}
        infos = Infos(now, 2, last, np.array([True, False]))
        assert infos.each("fault") == {0: "at the end", 1: "own"}

    def test_a_cell_without_a_number_is_empty(self, tmp_path):
        columns = Quantity("step", "index"), Quantity("angle", "output", "rad")
        series = TimeSeries(columns, np.array([[0.0, np.nan], [1.0, 0.5]]), {1: "broken"})
        series.write(tmp_path / "a.csv")
        assert (tmp_path / "a.csv").read_text() == "step,angle [rad],fault\n0,,\n1,0.5,broken\n"

    @pytest.mark.parametrize("suffix", ["csv", "parquet"])
    def test_nothing_is_lost_when_an_exception_stops_the_run(self, suffix, tmp_path):
        if suffix == "parquet":
            pytest.importorskip("pyarrow", reason="needs pyarrow: the extra parquet")
        path = tmp_path / f"a.{suffix}"
        env = RecordSeries(make(), "angle", path=path)
        env.reset(seed=0)
        expected = [env.series["angle"][0]]
        for _ in range(5):
            env.step(env.action_space.sample())
            expected.append(env.series["angle"][-1])
        with pytest.raises(ConfigError):
            env.step([np.nan, 0])
        assert env.series["angle"].tolist() == expected
        if suffix == "csv":  # before it is closed
            rows = list(csv.DictReader(path.read_text().splitlines()))
            assert [float(row["angle [deg]"]) for row in rows] == expected
        else:
            inner = env.unwrapped
            del env  # as the end of the interpreter does
            assert TimeSeries.read(path)["angle"].tolist() == expected
            inner.close()

    @pytest.mark.skipif(sys.platform == "win32", reason="Windows limits no size of files")
    def test_a_full_disk_names_the_file(self, tmp_path, record):
        import resource

        path, limits = tmp_path / "a.csv", resource.getrlimit(resource.RLIMIT_FSIZE)
        env = record("angle", path=path)
        env.reset(seed=0)
        resource.setrlimit(resource.RLIMIT_FSIZE, (4096, limits[1]))
        try:
            with pytest.raises(OSError, match="too large") as caught:
                play_until_an_error(env)
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        assert caught.value.filename == str(path)
        env.close()
        env.close()
        assert path.stat().st_size == 4096

    def test_a_parquet_file_has_units_and_can_be_read_again(self, tmp_path, record):
        parquet = pytest.importorskip("pyarrow.parquet", reason="needs the extra parquet")
        task = TASK | {"reward": "1 / (step - 3)"}
        env = record(task=task, path=tmp_path / "a.parquet")
        played(env, 0, 20)
        env.close()
        table = parquet.read_table(tmp_path / "a.parquet")
        assert table.schema.field("angle").metadata[b"unit"] == b"deg"
        assert table.column("step").to_pylist() == env.series["step"].tolist()
        again = TimeSeries.read(tmp_path / "a.parquet")
        assert again.columns == env.series.columns
        assert np.array_equal(again.values, env.series.values)
        assert again.faults == env.series.faults != {}
        (tmp_path / "b.parquet").write_bytes(b"PAR1")
        with pytest.raises(ConfigError, match=r"b\.parquet"):
            TimeSeries.read(tmp_path / "b.parquet")

    def test_pandas(self, record):
        pytest.importorskip("pandas", reason="needs pandas: the extra pandas")
        env = record()
        played(env, 0, 5)
        frame = env.series.to_pandas()
        assert frame["angle"].tolist() == env.series["angle"].tolist()
        assert frame["step"].dtype == np.int64
        assert frame.attrs["units"]["angle"] == "deg"

    @pytest.mark.parametrize(("module", "extra"), [("pyarrow", "parquet"), ("pandas", "pandas")])
    def test_a_missing_library_names_its_extra(self, module, extra, tmp_path, monkeypatch, record):
        monkeypatch.setitem(__import__("sys").modules, module, None)
        env = record()
        env.reset(seed=0)
        with pytest.raises(ConfigError, match=f"'{extra}'"):
            env.series.to_pandas() if extra == "pandas" else env.series.write(
                tmp_path / "a.parquet"
            )

    def test_memory_is_bounded(self, tmp_path, record):
        env = record("angle", most_rows=2_000, path=tmp_path / "a.csv")
        played(env, 0, 5_000)
        assert 2_000 <= len(env.series) <= 4_000
        with (tmp_path / "a.csv").open() as file:
            lines = sum(1 for _ in file)
        assert lines > 5_000
        assert env.series["episode"][-1] > 300


class Page(html.parser.HTMLParser):
    """What a page consists of."""

    def __init__(self, text):
        super().__init__()
        self.tags, self.attributes, self.open, self.text = [], [], [], ""
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.attributes += attrs
        if tag not in ("meta", "br", "path", "use", "rect"):
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.tags.append(tag)
        self.attributes += attrs

    def handle_endtag(self, tag):
        if self.open and self.open[-1] == tag:
            self.open.pop()

    def handle_data(self, data):
        self.text += data


@pytest.fixture
def series(record):
    pytest.importorskip("matplotlib", reason="needs Matplotlib: the extra plot")
    env = record()
    played(env, 0, 14)
    return env.series


class TestPictures:
    def test_each_unit_has_a_panel(self, series):
        (first, *_) = series.episodes().values()
        figure = plot(first)
        labels = [axis.get_ylabel() for axis in figure.axes]
        assert labels[0] == "angle in deg"
        assert "tau in N.m" in labels
        assert labels[-2:] == ["sum of rewards", "sum of costs"]
        lines = {line.get_label(): line for line in figure.axes[-1].get_lines()}
        assert lines["fast"].get_ydata()[-1] == pytest.approx(first["costs.fast"].sum())
        (action,) = (axis for axis in figure.axes if axis.get_ylabel() == "tau in N.m")
        limits = {line.get_ydata()[0] for line in action.get_lines()[1:]}
        assert limits == {-0.1, 0.1}

    def test_two_set_points_are_the_edges_of_a_band(self, record):
        pytest.importorskip("matplotlib", reason="needs Matplotlib: the extra plot")
        task = {
            "fmu": {"bundled": "Pendulum"},
            "time_step": 0.05,
            "agent": {"actions": "tau", "observations": ["q"]},
            "setpoints": {"least": -1, "most": {"value": 2}},
            "reward": "-max(least - q, 0) - max(q - most, 0)",
        }
        env = record(task=task)
        env.reset(seed=0)
        for _ in range(5):
            env.step(env.action_space.sample())
        axis = plot(env.series).axes[0]
        (band,) = axis.collections
        heights = band.get_paths()[0].vertices[:, 1]
        assert (heights.min(), heights.max()) == (-1, 2)
        assert [line.get_label() for line in axis.get_lines()[:3]] == ["q", "least", "most"]

    def test_files(self, series, tmp_path):
        (first, *_) = series.episodes().values()
        plot(first, tmp_path / "a.png", title="$a_b")
        assert (tmp_path / "a.png").read_bytes().startswith(b"\x89PNG")
        with pytest.raises(ConfigError, match="xyz"):
            plot(first, tmp_path / "a.xyz")
        with pytest.raises(ConfigError, match="one episode"):
            plot(series)

    def test_long_episodes_keep_their_extremes(self, record):
        env = record("angle", task=TASK | {"episode_length": "1h", "terminated": False})
        env.reset(seed=0)
        for _ in range(10_000):
            env.step([0.1 * np.sin(env.unwrapped.time), 0])
        (first, *_) = env.series.episodes().values()
        (line, *_) = plot(first).axes[0].get_lines()
        assert 1_000 < len(line.get_xdata()) < 5_000
        assert line.get_ydata().max() == first["angle"].max()
        assert line.get_ydata().min() == first["angle"].min()
        assert len(as_svg(first)) < 400_000


class TestReport:
    def test_it_is_one_page_that_needs_nothing_else(self, series, tmp_path):
        path = tmp_path / "a.html"
        facts = {"FMU": "<b>Pendulum</b>"}
        write_report(path, {"a <i>": series, "b": series}, title="T & T", facts=facts, text="<x>")
        page = Page(path.read_text(encoding="utf-8"))
        assert page.tags.count("svg") == 2 * len(series.episodes())
        assert "script" not in page.tags
        assert "img" not in page.tags
        assert "link" not in page.tags
        for name, value in page.attributes:
            assert name != "src"
            if name in ("href", "xlink:href"):
                assert value.startswith("#")
        ids = [value for name, value in page.attributes if name == "id"]
        assert len(ids) == len(set(ids))
        assert "i" not in page.tags
        assert "<b>Pendulum</b>" in page.text
        assert page.open == []
        with pytest.raises(FileExistsError):
            write_report(path, {"a": series}, title="T")

    def test_it_has_the_interval_of_the_mean(self, series, tmp_path):
        stats = pytest.importorskip("scipy.stats", reason="needs scipy: the extra test")
        path = tmp_path / "a.html"
        write_report(path, {"a": series, "b": series}, title="T")
        rewards = [one["reward"].sum() for one in series.episodes().values()]
        half = stats.t.ppf(0.975, len(rewards) - 1) * stats.sem(rewards)
        assert f"<td>{half:.4g}</td>" in path.read_text(encoding="utf-8")

    def test_it_has_the_totals(self, series, tmp_path):
        path = tmp_path / "a.html"
        write_report(path, {"a": series}, title="T")
        page = path.read_text(encoding="utf-8")
        text = Page(page).text
        for one in series.episodes().values():
            assert f"<td>{one['kpis.largest'].sum():.4g}</td>" not in page
            for name in ("reward", "reward_terms.near", "costs.fast", "costs.far"):
                shown = f"{one[name].sum():.4g}".replace("-", "\u2212")
                assert shown in text
            assert f"{np.abs(one['angle'][1:]).max():.4g}" in text
        assert "largest" in text
        assert "at most 3" in text
        assert "truncated" in text


class Bounded(fmugym.FMUEnv):
    """A class of a user, whose config says more of variables than the FMU does."""

    def __init__(self):
        config = {
            "model_input_names": "f",
            "model_output_names": "x",
            "monitor_names": "theta",
            "model_parameters": {"phi_0": 0.1},
            "bounds": {"f": (-2, 2.5), "x": (-3, 3), "phi_0": (-0.5, 0.5)},
            "samplings": {"theta": "mean"},
            "start_time": [1.0],
            "time_step": 0.02,
        }
        super().__init__(fmugym.bundled_fmu("CartPole"), config)

    def _is_done(self):
        return abs(self.state[0]) > 2


def test_columns_of_a_class_have_the_bounds_of_its_config(opened):
    env = opened(RecordSeries(Bounded(), ["f", "x", "theta", "phi_0", "start_time"]))
    played(env, 0, 3)
    series = env.series
    limits = {one.name: (one.low, one.high) for one in series.columns}
    assert [limits[name] for name in ("f", "x", "phi_0")] == [(-2, 2.5), (-3, 3), (-0.5, 0.5)]
    assert limits["theta"] == (-np.inf, np.inf)
    assert series["start_time"].tolist() == [1.0] * 4
