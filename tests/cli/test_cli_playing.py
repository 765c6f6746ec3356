"""Commands that play episodes: ``simulate``, ``evaluate``, ``bench``."""

import csv
import json
import re
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
from command_tasks import PRICES, TURN
from fmu_tools import interrupted_after
from letters import wide

import fmugym
from fmugym.cli import episode_commands
from fmugym.records import TimeSeries
from fmugym.records.evaluation import Score, plot_scores

CART_POLE = str(Path(__file__).parents[2] / "examples" / "cart_pole.toml")
PID = "pid of=T setpoint=21 kp=0.3 ti=7200"
FROST = "--scenario", "frost", "--steps", "30"


class TestRecord:
    def test_a_table_of_chosen_variables_at_a_rate(self, tmp_path, cli):
        path = tmp_path / "a.csv"
        options = "--variables", "T*", "--variables", "u", "--every", "3600", "--output", path
        arguments = "--controller", PID, *FROST, *options
        code, out, err = cli("simulate", "fmugym/House-v0", *arguments, "--json")
        assert (code, err) == (0, "")
        (episodes,) = json.loads(out)["runs"].values()
        rows = list(csv.DictReader(path.read_text().splitlines()))
        assert list(rows[0])[3:7] == ["u", "T [degC]", "T_floor [degC]", "T_set [degC]"]
        assert [int(row["step"]) for row in rows] == [0, 4, 8, 12, 16, 20, 24, 28]
        played = cli("simulate", "fmugym/House-v0", "--controller", PID, *FROST, "--json")
        assert json.loads(played[1])["episodes"] == episodes

    def test_several_files_at_once(self, tmp_path, ran):
        pytest.importorskip("matplotlib", reason="needs Matplotlib: the extra plot")
        paths = [tmp_path / name for name in ("a.csv", "b.csv", "a.png", "a.html")]
        outputs = [text for path in paths for text in ("--output", path)]
        assert ran("simulate", CART_POLE, "--seed", "3", *outputs).startswith("seed 3: reward")
        assert paths[0].read_text() == paths[1].read_text() != ""
        assert paths[2].read_bytes().startswith(b"\x89PNG")
        page = paths[3].read_text(encoding="utf-8")
        task = Path(CART_POLE).read_text().splitlines()[-1]
        assert task in page
        assert "first seed" in page
        assert "<h1>cart_pole.toml</h1>" in page
        assert str(Path(CART_POLE).parent) not in page

    def test_a_report_compares_controllers(self, tmp_path, ran):
        pytest.importorskip("matplotlib", reason="needs Matplotlib: the extra plot")
        path = tmp_path / "a.html"
        who = "--action", "-10", "--action", "10"
        out = ran("simulate", CART_POLE, *who, "--output", path)
        assert [line.split(":")[0] for line in out.splitlines()] == ["action -10", "action 10"]
        page = path.read_text(encoding="utf-8")
        assert page.count("<figure>") == 2
        assert "<h2>action 10</h2>" in page

    def test_parquet(self, tmp_path, ran):
        pytest.importorskip("pyarrow", reason="needs pyarrow: the extra parquet")
        path = tmp_path / "a.parquet"
        ran("simulate", CART_POLE, "--output", path)
        assert TimeSeries.read(path)["reward"].sum() == len(TimeSeries.read(path)) - 1

    @pytest.mark.parametrize("error", [KeyboardInterrupt, fmugym.SimulationError])
    def test_an_interruption_keeps_what_is_there(self, error, tmp_path, cli, monkeypatch):
        pytest.importorskip("matplotlib", reason="needs Matplotlib: the extra plot")
        step = interrupted_after(5, fmugym.FMUEnv.step, error("enough"))
        monkeypatch.setattr(fmugym.FMUEnv, "step", step)
        outputs = "--output", tmp_path / "a.csv", "--output", tmp_path / "a.html"
        code, _, err = cli("simulate", CART_POLE, "--action", "0", *outputs)
        assert code == (130 if error is KeyboardInterrupt else 1)
        assert ("enough" in err) == (code == 1)
        assert len((tmp_path / "a.csv").read_text().splitlines()) == 7
        assert "stopped" in (tmp_path / "a.html").read_text(encoding="utf-8")


class TestEvaluate:
    @pytest.mark.parametrize(("random", "is_drawn"), [(-9.0, False), (-1.5, True)])
    def test_only_random_actions_that_are_the_worst_are_left_out(self, tmp_path, random, is_drawn):
        pytest.importorskip("matplotlib", reason="needs Matplotlib: the extra plot")
        path, rewards = tmp_path / "a.svg", {"random": random, "one": -1.00001, "two": -2.0}
        scores = [Score(name, (reward,), (), (1,), {}, 1.0) for name, reward in rewards.items()]
        plot_scores(scores, path, "three")
        drawn = re.findall("<!-- (.*) -->", path.read_text())
        assert ("random" in drawn) == is_drawn
        assert {"one", "two"} <= set(drawn)

    def test_nearly_equal_rewards_look_so(self, tmp_path):
        """Their ticks are whole numbers, not differences to one that stands elsewhere."""
        pytest.importorskip("matplotlib", reason="needs Matplotlib: the extra plot")
        path = tmp_path / "a.svg"
        scores = [Score(str(x), (x,), (), (1,), {}, 1.0) for x in (-33.28887, -33.28889)]
        plot_scores(scores, path, "two")
        ticks = re.findall("<!-- .(33.*) -->", path.read_text())
        assert len(ticks) > 2
        assert float(ticks[0]) - float(ticks[-1]) > 0.1

    def test_several_scenarios_and_a_picture(self, tmp_path, cli, ran):
        pytest.importorskip("matplotlib", reason="needs Matplotlib: the extra plot")
        path = tmp_path / "a.png"
        options = "--steps", "10", "--episodes", "2", "--action", "0", "--plot", path
        both = "--scenario", "frost", "--scenario", "spring"
        scores = json.loads(ran("evaluate", "fmugym/House-v0", *both, *options, "--json"))["scores"]
        assert [(one["name"], one["scenario"]) for one in scores] == [
            *(("random", "frost"), ("action 0", "frost")),
            *(("random", "spring"), ("action 0", "spring")),
        ]
        low, high = scores[1]["cost_interval_95"]
        assert low <= scores[1]["mean_cost"] <= high
        assert path.read_bytes().startswith(b"\x89PNG")
        alone = cli("evaluate", "fmugym/House-v0", *both[2:], *options[:-2], "--json")[1]
        assert json.loads(alone)["scores"][1]["rewards"] == scores[3]["rewards"]

    def test_scenarios_have_the_names_of_the_task(self, ran, refused):
        options = "--steps", "2", "--episodes", "1", "--scenario"
        given = wide("frost"), "--scenario", "frost", "--scenario", wide("spring")
        out = ran("evaluate", "fmugym/House-v0", *options, *given, "--json")
        assert [one["scenario"] for one in json.loads(out)["scores"]] == ["frost", "spring"]
        for name in ("frst", wide("frst")):
            err = refused("evaluate", "fmugym/House-v0", *options, "spring", "--scenario", name)
            assert "unknown scenario" in err
        assert "'frost'" in refused("evaluate", "fmugym/House-v0", *options, "frst")

    def test_scenarios_do_not_hide_other_mistakes(self, tmp_path, refused):
        task = tmp_path / "task.toml"
        text = (
            Path(CART_POLE).read_text().replace('"20ms"', "-0.02").replace("abs(phi)", "abs(psi)")
        )
        task.write_text(f'{text}\n[scenarios.late]\nstart = "1d"\nlength = "2d"\n')
        err = refused("evaluate", task, "--scenario", "all")
        assert all(fact in err for fact in ("time_step", "'psi'"))

    def test_an_interruption_keeps_the_scores_that_are_there(self, cli, monkeypatch):
        step = interrupted_after(200, fmugym.FMUEnv.step)
        monkeypatch.setattr(fmugym.FMUEnv, "step", step)
        options = "--episodes", "2", "--steps", "60", "--scenario", "frost", "--action", "0"
        code, out, _ = cli("evaluate", "fmugym/House-v0", *options, "--json")
        assert code == 130
        found = {one["name"]: len(one["rewards"]) for one in json.loads(out)["scores"]}
        assert found == {"random": 2, "action 0": 1}

    def test_all_scenarios(self, ran):
        options = "--scenario", "all", "--steps", "2", "--episodes", "1"
        out = ran("evaluate", "fmugym/House-v0", *options)
        assert [line.split("  ")[0] for line in out.splitlines()[1:]] == [
            f"random ({name})" for name in ("autumn", "frost", "spring")
        ]


class TestBench:
    def test_speeds_of_one_and_of_many(self, ran):
        options = "--envs", "4", "--envs", "16", "--seconds", "0.05"
        report = json.loads(ran("bench", CART_POLE, *options, "--json"))
        assert [one["envs"] for one in report["speeds"]] == [0, 4, 16]
        for one in report["speeds"]:
            count = max(1, one["envs"])
            assert one["steps_per_second"] * one["microseconds"] == pytest.approx(count * 1e6)
            assert 0 < one["fmu_share"] <= 1
            assert one["hooks"] == "expressions"
        assert report["time_step"] == 0.02

    def test_parameters_are_drawn_as_resets_draw_them(self, caplog):
        pendulum = {
            "fmu": {"bundled": "Pendulum"},
            "parameters": {"m": {"distribution": "uniform", "low": 0.05, "high": 0.1}},
            "agent": {"actions": ["tau"], "observations": ["q"]},
            "reward": "-abs(q)",
            "time_step": 0.05,
        }
        *_, report = episode_commands.bench(lambda: fmugym.load(pendulum), [4], 0.05)
        assert all(0 < one.fmu_share <= 1 for one in report.speeds)
        assert caplog.text == ""  # a pendulum without a mass would be an error

    def test_a_table_with_words_of_caution(self, ran):
        out = ran("bench", CART_POLE, "--envs", "4", "--seconds", "0.02")
        assert out.isascii()
        assert "single" in out
        assert "busy" in out


class TestProgress:
    @pytest.mark.parametrize("is_terminal", [False, True])
    def test_bars_are_for_terminals(self, is_terminal, ran, monkeypatch):
        bars = []

        class Bar:
            def __init__(self, **arguments):
                bars.append((arguments["total"], []))

            def __enter__(self):
                return self

            def __exit__(self, *error):
                return None

            def update(self, steps):
                bars[-1][1].append(steps)

        monkeypatch.setitem(sys.modules, "tqdm", SimpleNamespace(tqdm=Bar))
        monkeypatch.setattr(sys.stderr, "isatty", lambda: is_terminal)
        options = "--steps", "3", "--episodes", "2"
        ran("simulate", "fmugym/House-v0", *options)
        assert bars == ([(6, [1] * 6)] if is_terminal else [])

    def test_without_tqdm_there_are_none(self, cli, monkeypatch):
        monkeypatch.setitem(sys.modules, "tqdm", None)
        monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
        code, _, err = cli("simulate", "fmugym/House-v0", "--steps", "3")
        assert (code, err) == (0, "")


class TestInterruption:
    """Ctrl-C in an episode keeps those before it."""

    def test_of_bench(self, monkeypatch, cli):
        def interrupted(*_):
            raise KeyboardInterrupt

        monkeypatch.setattr(fmugym.FMUVectorEnv, "step", interrupted)
        code, out, _ = cli("bench", CART_POLE, "--seconds", "0.01", "--json")
        assert (code, [one["envs"] for one in json.loads(out)["speeds"]]) == (130, [0])


class TestSimulate:
    def test_random_episodes_have_the_seeds_that_were_given(self, cli):
        task = CART_POLE
        code, out, err = cli("simulate", task, "--episodes", "2", "--seed", "3", "--json")
        assert (code, err) == (0, "")
        episodes = json.loads(out)["episodes"]
        assert [episode["seed"] for episode in episodes] == [3, 4]
        assert episodes[0]["total_reward"] == episodes[0]["steps"] > 5

    def test_a_controller(self, cli):
        controller = "hysteresis of=T setpoint=21 band=0.3"
        options = "--scenario", "frost", "--steps", "96"
        code, out, err = cli(
            "simulate", "fmugym/House-v0", "--controller", controller, *options, "--json"
        )
        assert (code, err) == (0, "")
        (warm,) = json.loads(out)["episodes"]
        cold = cli("simulate", "fmugym/House-v0", "--action", "0", *options, "--json")[1]
        assert warm["total_cost"] < 0.2 * json.loads(cold)["episodes"][0]["total_cost"]

    def test_a_controller_begins_each_episode_anew(self, cli):
        controller = "pid of=T setpoint=21 kp=0.3 ti=7200"
        options = "--scenario", "frost", "--steps", "20", "--json"
        arguments = "simulate", "fmugym/House-v0", "--controller", controller, *options
        both = cli(*arguments, "--seed", "4", "--episodes", "2")[1]
        second = cli(*arguments, "--seed", "5")[1]
        assert json.loads(both)["episodes"][1] == json.loads(second)["episodes"][0]

    def test_a_table_of_all_steps(self, tmp_path, ran):
        fmugym.Task.from_dict(TURN | {"costs": {"effort": "abs(tau)"}}).write(tmp_path / "a.toml")
        arguments = "--action", "0.01", "--output", tmp_path / "run.csv"
        out = ran("simulate", tmp_path / "a.toml", *arguments)
        assert "cost 0.5 in 50 steps (1 s), truncated" in out
        with (tmp_path / "run.csv").open(newline="") as file:
            rows = list(csv.DictReader(file))
        assert list(rows[0]) == [
            *("episode", "step", "time [s]", "tau [N.m]", "q [rad]", "reward", "cost"),
            *("costs.effort", "terminated", "truncated", "fault"),
        ]
        assert len(rows) == 51
        assert rows[-1]["truncated"] == "1"


def test_a_log_of_local_time_needs_its_zone(refused, tmp_path):
    pytest.importorskip("minari", reason="needs Minari: the extra minari")
    task = tmp_path / "task.toml"
    task.write_text('timezone = "+01:00"' + PRICES.partition("[data]")[0].replace("-p", "-q**2"))
    more = PRICES[PRICES.index("[agent]") :].replace('"p", "q", "q_dot"', '"q", "q_dot"')
    task.write_text(task.read_text() + more, encoding="utf-8")
    rows = [f"2024-10-27 0{hour}:00,0,0,0" for hour in (1, 2, 2, 3)]
    (tmp_path / "log.csv").write_text("\n".join(["time,q,q_dot,tau", *rows]), encoding="utf-8")
    command = "simulate", task, "--output", "minari:test/log-v0", "--log", tmp_path / "log.csv"
    err = refused(*command)
    assert "row 4 (2024-10-27 02:00)" in err
    assert "timezone" in err
    assert "'Europe/Berlin'" in refused(*command, "--timezone", "Europe/Berln")
