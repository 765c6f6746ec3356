"""The commands of the command line that write, check and run tasks."""

import csv
import json
import tomllib
from pathlib import Path

import pytest
from fmu_tools import edited_fmu
from plants import ONCE

import fmugym
from fmugym.cli.validation import validate

EXAMPLES = Path(__file__).parents[2] / "examples"


class TestNew:
    @pytest.mark.parametrize(("model", "version"), ONCE)
    def test_what_it_writes_passes_validate(self, model, version, tmp_path, cli):
        path = tmp_path / "task.toml"
        fmu = fmugym.bundled_fmu(model, version)
        code, out, err = cli("new", fmu, "--output", path)
        assert (code, out) == (0, "")
        assert "reward and set point are guesses" in err
        code, out, err = cli("validate", path, "--json")
        findings = json.loads(out)["findings"]
        assert (code, err) == (0, "")
        bad = {finding["check"] for finding in findings if finding["verdict"] != "ok"}
        # sizes of temperatures and powers differ, nothing writes the weather, and the FMU's default
        # experiment is shorter than the time constant of its walls
        of_house = {"inputs", "observations", "length"}
        assert bad <= (of_house if model == "House" else {"observations"})

    def test_names_that_are_no_names_of_python(self, tmp_path, ran, load):
        odd = {'name="tau"': 'name="a.b[1] &quot;x&quot;\\ \u00e4"', 'name="q"': 'name="step"'}
        fmu = edited_fmu(fmugym.bundled_fmu("Pendulum"), tmp_path, odd)
        out = ran("new", fmu)
        assert out.isascii()
        env = load(tomllib.loads(out))
        assert env.config.model_input_names == ('a.b[1] "x"\\ \u00e4',)
        assert "step" in env.config.model_output_names

    def test_the_path_of_an_fmu_below_the_file_is_relative(self, tmp_path, cli):
        (tmp_path / "fmus").mkdir()
        fmu = tmp_path / "fmus" / "Pendulum.fmu"
        fmu.write_bytes(fmugym.bundled_fmu("Pendulum").read_bytes())
        cli("new", fmu, "--output", tmp_path / "task.toml")
        assert 'fmu = "fmus/Pendulum.fmu"' in (tmp_path / "task.toml").read_text()
        fmugym.load(tmp_path / "task.toml").close()


TASK = {
    "fmu": {"bundled": "Pendulum"},
    "time_step": 0.02,
    "episode_length": "1s",
    "variables": {"tau": {"min": -0.01, "max": 0.01}, "q": {"min": -20, "max": 20}},
    "agent": {"actions": ["tau"], "observations": ["q"]},
    "reward": "-abs(q - 1)",
}

DEFECTS = {
    "useless action": (
        {
            "variables": {"idle": {"min": 0, "max": 1}} | TASK["variables"],
            "agent": {"actions": ["tau", "idle"], "observations": ["q"]},
        },
        ("warning", "actions", "element 1"),
    ),
    "an action that only the reward knows": (
        {
            "variables": {"fee": {"min": 0, "max": 1}} | TASK["variables"],
            "agent": {"actions": ["tau", "fee"], "observations": ["q"]},
            "reward": "-abs(q - 1) - fee",
        },
        ("warning", "actions", "no effect on observations: element 1"),
    ),
    "a reward that no action changes": (
        {"reward": "-abs(time - 1)"},
        ("warning", "reward", "the same in 50 steps, whatever the actions"),
    ),
    "a tiny reward": (
        {"reward": "-1e-7 * abs(q - 1)"},
        ("warning", "reward", "from -3"),
    ),
    "a reward that hardly differs": (
        {"reward": "-1 - 1e-11 * abs(q - 1)"},
        ("warning", "reward", "from -1 to -1 with random actions, a difference of"),
    ),
    "an end that pays": (
        {"terminated": "step == 20"},
        ("warning", "reward", "until the task ends: never positive"),
    ),
    "constant reward": ({"reward": 1}, ("warning", "reward", "always 1")),
    "no limit": ({"episode_length": None}, ("warning", "length", "no limit")),
    "outside": (
        {"variables": {"tau": {}, "q": {"min": 0, "max": 1e-3}}},
        ("warning", "observations", "q "),
    ),
    "sizes": (
        {
            "agent": {"actions": "tau", "observations": ["q", "big"]},
            "expressions": {"big": "1e5 * q"},
        },
        ("warning", "observations", "big reaches"),
    ),
    "useless parameter": (
        {"parameters": {"v_c": {"distribution": "uniform", "low": 0.1, "high": 0.2}, "c": 0}},
        ("warning", "parameters", "v_c"),
    ),
    "useless constant": (
        {"parameters": {"v_c": 0.1, "c": 0}},
        ("warning", "parameters", "v_c"),
    ),
    "idle inputs": (
        {
            "fmu": {"bundled": "DoublePendulum"},
            "variables": {"tau1": {"min": -0.01, "max": 0.01}},
            "agent": {"actions": ["tau1"], "observations": ["q1"]},
            "reward": "-abs(q1 - 1)",
        },
        ("warning", "inputs", "tau2"),
    ),
    "fault": ({"reward": "1 / (step - 3)"}, ("error", "run", "step 3")),
    "unknown to a controller": (
        {"agent": {"actions": ["tau"], "observations": ["q", "l"]}},
        ("warning", "export", "'l', which is no output"),
    ),
}


class TestValidate:
    @pytest.mark.parametrize(("change", "expected"), DEFECTS.values(), ids=DEFECTS)
    def test_defects_are_found_and_cured(self, change, expected):
        task = {key: value for key, value in (TASK | change).items() if value is not None}
        report = validate(lambda: fmugym.load(task))
        verdict, check, text = expected
        (finding,) = [one for one in report.findings if one.verdict != "ok"]
        assert (finding.verdict, finding.check) == (verdict, check)
        assert text in finding.text
        assert finding.cure
        assert report.verdict == verdict
        assert report.recommended.get("normalize", False) == ("big reaches" in text)

    @pytest.mark.parametrize("normalize", [False, True])
    def test_figures_are_in_the_units_of_the_task(self, normalize):
        variables = {"tau": {"min": -0.01, "max": 0.01}, "q": {"unit": "deg", "min": 1, "max": 5}}
        task = TASK | {"variables": variables, "agent": TASK["agent"] | {"normalize": normalize}}
        (finding,) = [one for one in validate(lambda: fmugym.load(task)).findings if one.cure]
        assert "limits: q (-" in finding.text
        assert "to 180.1 deg)" in finding.text

    def test_a_sound_task(self):
        report = validate(lambda: fmugym.load(TASK))
        assert report.verdict == "ok"
        assert report.hooks == "expressions"
        (export,) = [one.text for one in report.findings if one.check == "export"]
        assert "can be exported; it measures q" in export
        assert 0 < report.costs["step"] < 1
        assert 0 < report.costs["reset"] < 1
        assert 0 < report.costs["restore"] < 1
        assert report.recommended["envs"] in (8, 16, 64)
        assert report.recommended["reset_method"] == report.reset_method

    def test_an_error_gives_the_exit_code(self, tmp_path, cli):
        fmugym.Task.from_dict(TASK | {"reward": "1 / (step - 3)"}).write(tmp_path / "a.toml")
        code, out, _ = cli("validate", tmp_path / "a.toml")
        assert code == 1
        assert "error    run: step 3" in out

    def test_an_fmu_an_id_and_a_class(self, ran):
        targets = fmugym.bundled_fmu("CartPole"), "fmugym/CartPole-v0", "fmugym.envs:CartPoleEnv"
        for target in targets:
            out = ran("validate", target)
            assert "hooks in a vector environment: " in out
            assert "vector environment: one by one" not in out
            assert ("length: an episode takes at most 500 steps" in out) is (target == targets[1])


class TestSimulate:
    def test_random_episodes_are_repeatable(self, cli):
        task = EXAMPLES / "cart_pole.toml"
        code, out, err = cli("simulate", task, "--episodes", "2", "--seed", "3", "--json")
        assert (code, err) == (0, "")
        episodes = json.loads(out)["episodes"]
        assert [episode["seed"] for episode in episodes] == [3, 4]
        assert episodes[0]["total_reward"] == episodes[0]["steps"] > 5
        again = cli("simulate", task, "--episodes", "2", "--seed", "3", "--json")[1]
        assert again == out

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
        fmugym.Task.from_dict(TASK | {"costs": {"effort": "abs(tau)"}}).write(tmp_path / "a.toml")
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
