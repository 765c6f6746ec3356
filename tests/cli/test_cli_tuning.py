"""The command that finds the numbers of a controller: tune."""

import json
import signal
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

import fmugym
from fmugym.control import PID
from fmugym.control.controller_parsing import search_of
from fmugym.control.controller_table import table_in

HOUSE = "fmugym/House-v0"
RANGES = "pid of=T setpoint=20..22 kp=0.05..5 ti=14400"
FEW = "--rounds", "2", "--candidates", "8", "--episodes", "2", "--steps", "100"


def rewards(cli, *arguments):
    """Those of single environments."""
    code, out, _ = cli("simulate", *arguments, "--json")
    assert code == 0
    return [one["total_reward"] for one in json.loads(out)["episodes"]]


class TestTune:
    def test_its_reward_is_that_of_the_controller_it_prints(self, cli):
        code, out, err = cli("tune", HOUSE, RANGES, *FEW, "--seed", "5", "--json")
        found = json.loads(out)
        assert code == 0
        assert len(found["rewards_of_rounds"]) == 2 == err.count("round ")
        assert found["mean_reward"] == max(found["rewards_of_rounds"])
        options = "--episodes", "2", "--seed", "5", "--steps", "100"
        played = rewards(cli, HOUSE, "--controller", found["controller"], *options)
        assert found["mean_reward"] == pytest.approx(sum(played) / 2, rel=1e-12)
        assert found["controller"].endswith("ti=14400")
        numbers = [float(word.partition("=")[2]) for word in found["controller"].split()[2:4]]
        assert list(found["parameters"].values()) == numbers

    def test_the_file_that_it_writes_is_a_task_with_the_controller(
        self, tmp_path, cli, refused, ran
    ):
        base, output = tmp_path / "house.toml", tmp_path / "more" / "tuned.toml"
        output.parent.mkdir()
        fmugym.Task.read(Path(fmugym.__file__).parent / "envs" / "house.toml").write(base)
        options = "--scenario", "frost", "--output", output, "--name", "best"
        out = ran("tune", base, RANGES, *FEW, *options)
        written = tomllib.loads(output.read_text())
        assert written == {"extends": "../house.toml", "controllers": {"best": out.strip()}}
        frost = "--scenario", "frost", "--steps", "50"
        named = rewards(cli, output, "--controller", "best", *frost)
        assert named == rewards(cli, base, "--controller", out.strip(), *frost)
        assert "'best'" in refused("evaluate", output, "--controller", "bset")

    def test_an_end_of_a_range_is_told(self, cli):
        pid = "pid of=T setpoint=10..11 kp=1"
        _, _, err = cli("tune", HOUSE, pid, *FEW, "--rounds", "6")
        assert "setpoint" in err.splitlines()[-1]

    @pytest.mark.skipif(sys.platform == "win32", reason="needs the signal of Ctrl-C")
    def test_ctrl_c_keeps_the_best_until_then(self, tmp_path):
        path = tmp_path / "tuned.toml"
        command = [sys.executable, "-m", "fmugym", "tune", HOUSE, RANGES, *FEW, "--rounds", "9999"]
        with subprocess.Popen(
            [*command, "--output", str(path)],
            text=True,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
        ) as process:
            assert "round 1" in process.stderr.readline()
            process.send_signal(signal.SIGINT)
            out, err = process.communicate(timeout=60)
        assert process.returncode == 130
        assert "Traceback" not in err
        assert tomllib.loads(path.read_text()) == {"controllers": {"tuned": out.strip()}}
        assert out.startswith("pid of=T")

    def test_a_table_is_tuned_together(self, tmp_path, cli):
        """By its name; what comes out is a table in a task file, and a text that acts."""
        base, output = tmp_path / "two.toml", tmp_path / "tuned.toml"
        base.write_text(TWO)
        code, out, _ = cli("tune", base, "both", *FEW, "--output", output, "--json")
        found = json.loads(out)
        assert code == 0
        assert list(found["parameters"]) == ["tau1.kp", "tau1.td", "tau2.kp"]
        written = tomllib.loads(output.read_text())["controllers"]["tuned"]
        assert written == table_in(found["controller"])
        assert written["rate"] == {"controller": "pid of=q2 setpoint=0 kp=1", "min": -1, "max": 1}
        options = "--episodes", "2", "--steps", "100"
        rows = [
            rewards(cli, output, "--controller", who, *options)
            for who in ("tuned", found["controller"])
        ]
        assert rows[0] == rows[1]
        assert sum(rows[0]) / 2 == pytest.approx(found["mean_reward"], rel=1e-12)


TWO = """
fmu = { bundled = "DoublePendulum" }
time_step = "20ms"
episode_length = "1s"
reward = "-q1**2 - q2**2"
[variables]
tau1 = { min = -1, max = 1 }
tau2 = { min = -1, max = 1 }
[parameters]
q1_0 = { distribution = "uniform", low = -0.3, high = 0.3 }
[agent]
actions = ["tau1", "tau2"]
observations = ["q1", "q2", "q1_dot", "q2_dot"]
[controllers]
steady = "pid of=q2_dot setpoint=rate kp=0.01..1"
[controllers.both]
tau1 = "pid of=q1 setpoint=0 kp=0.01..1 td=0..1"
tau2 = "steady"
rate = { controller = "pid of=q2 setpoint=0 kp=1", min = -1, max = 1 }
"""


class TestSearch:
    def test_scales(self):
        search = search_of("pid of=T setpoint=-1..1 kp=0.1..1 ti=5..49 td=0..9")
        assert search.ranges == {
            "setpoint": fmugym.Uniform(-1, 1),
            "kp": fmugym.LogUniform(0.1, 1),
            "ti": fmugym.Uniform(5, 49),
            "td": fmugym.Uniform(0, 9),
        }

    def test_the_text_names_all_arguments_and_nothing_is_lost(self):
        search = search_of("pid ti=14400.123456789 kp=1..2 of='zone 1' setpoint=21")
        assert search.text({"kp": 1.23456789}) == (
            "pid 'of=zone 1' setpoint=21 kp=1.2346 ti=14400.123456789"
        )
        made = search.make(kp=1.23456789)
        assert isinstance(made, PID)
        assert (made.of, made.kp, made.ti) == ("zone 1", 1.2346, 14400.123456789)
