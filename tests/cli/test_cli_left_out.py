"""Nothing that one who acts does ends a test: it is left out with the reason, the others play."""

import itertools
import json
import re
import sys

import numpy as np
import pytest

import fmugym
from fmugym.cli import options as watching
from fmugym.control import MPC
from fmugym.control.candidate_evaluation import CandidateEvaluator
from fmugym.control.controller_table import table_in
from fmugym.training import search_training
from fmugym.training.search.policy import ResidualAgent
from fmugym.training.search_training import judge, verdict

PLANNER = "mpc horizon=0.2s candidates=18 rounds=2"
ONE = {
    "fmu": {"bundled": "Pendulum"},
    "time_step": 0.05,
    "episode_length": "0.5s",
    "variables": {"a": {"min": -0.1, "max": 0.1}},
    "inputs": {"tau": "a"},
    "agent": {"actions": ["a"], "observations": ["theta", "theta_dot"]},
    "parameters": {"q_0": "pi", "theta_0": {"distribution": "uniform", "low": 0.1, "high": 1}},
    "controllers": {"thermostat": "hysteresis of=theta setpoint=0 band=0.1", "planner": PLANNER},
    "reward": "-theta**2",
}
TWO = ONE | {
    "variables": {"a": {"min": -0.1, "max": 0.1}, "b": {"min": 0, "max": 0.1}},
    "inputs": {"tau": "a - b"},
    "agent": {"actions": ["a", "b"], "observations": ["theta", "theta_dot"]},
}
SHORT = "--rounds", "12", "--episodes", "2"


@pytest.fixture
def written(tmp_path):
    def write(document, name="task"):
        fmugym.Task.from_dict(document).write(tmp_path / f"{name}.toml")
        return tmp_path / f"{name}.toml"

    return write


@pytest.fixture
def late(monkeypatch):
    """Decisions of an MPC take too long, but not the first ones."""
    count, act = itertools.count(), MPC.act

    def slow(mpc, *arguments):
        if next(count) > 4:
            raise fmugym.ConfigError("a decision took 130 s of at most 60 s")
        return act(mpc, *arguments)

    monkeypatch.setattr(MPC, "act", slow)


class TestTrain:
    def test_controllers_of_a_single_action_do_not_end_a_search_for_two(
        self, written, tmp_path, cli
    ):
        code, out, err = cli("train", written(TWO), "--output", tmp_path / "agent", *SHORT)
        assert code == 0, err
        assert "left out: thermostat" in err
        assert "planner" in out
        facts = json.loads((tmp_path / "agent" / "agent.json").read_text())
        assert set(facts["test"]) == {facts["agent"], "constant action", "planner"}

    def test_a_table_is_tuned_and_is_the_agent_if_nothing_beats_it(self, written, tmp_path, cli):
        """Its numbers are found before policies enter."""
        loop = "pid of=theta setpoint=0 kp=-2..-0.01 td=0..0.5"
        brake = "pid of=theta setpoint=0 kp=0.01..1"
        document = TWO | {"controllers": {"brake": brake, "pair": {"a": loop, "b": "brake"}}}
        folder = tmp_path / "agent"
        options = "--output", folder, "--rounds", "20", "--episodes", "2"
        file = written(document)
        code, out, err = cli("train", file, *options)
        assert code == 0, err
        assert "to be beaten: pair (to be tuned)" in out + err
        assert "left out" not in err  # the brake is a part of the table
        facts = json.loads((folder / "agent.json").read_text())
        entries = table_in(facts["controller"])
        assert facts["agent"] == "tuned pair"
        assert list(entries) == ["a", "b"]
        assert ".." not in facts["controller"]
        played = ("simulate", file, "--seed", 500, "--json")
        told = [
            json.loads(cli(*played, *who)[1])["episodes"][0]["total_reward"]
            for who in (("--agent", folder), ("--controller", facts["controller"]))
        ]
        assert told[0] == told[1]

    def test_one_that_fails_in_the_test_is_left_out(self, written, tmp_path, cli, monkeypatch):
        def play(agent, evaluator, seeds):
            if agent.name == "planner":
                raise fmugym.ConfigError("a decision took 130 s of at most 60 s")
            return real(agent, evaluator, seeds)

        real = ResidualAgent.play
        monkeypatch.setattr(ResidualAgent, "play", play)
        code, out, err = cli("train", written(ONE), "--output", tmp_path / "agent", *SHORT)
        assert code == 0, err
        assert "left out: planner: a decision took 130 s of at most 60 s\n" in err
        facts = json.loads((tmp_path / "agent" / "agent.json").read_text())
        assert facts["verdict"] in out
        assert "thermostat" in facts["verdict"]
        assert "planner" not in facts["test"]
        assert (tmp_path / "agent" / "policy.json").exists()

    @pytest.mark.parametrize("error", [OSError, fmugym.SimulationError])
    def test_the_folder_comes_although_the_agent_itself_fails(
        self, error, written, tmp_path, cli, monkeypatch
    ):
        def play(agent, evaluator, seeds):
            if not agent.acting:
                return real(agent, evaluator, seeds)
            raise error("it has failed")

        real, judged = ResidualAgent.play, search_training.judge

        def judge(*arguments):
            monkeypatch.setattr(ResidualAgent, "play", play)
            return judged(*arguments)

        monkeypatch.setattr(search_training, "judge", judge)
        document = {key: value for key, value in TWO.items() if key != "controllers"}
        output = "--output", tmp_path / "agent"
        task = written(document)
        code, out, err = cli("train", task, *output, "--rounds", "35", *SHORT[2:])
        facts = json.loads((tmp_path / "agent" / "agent.json").read_text())
        assert code == 0, err
        assert f"left out: {facts['agent']}: it has failed\n" in err
        assert f"no verdict: {facts['agent']}" in out
        assert facts["agent"] not in facts["test"]
        assert cli("simulate", task, "--agent", tmp_path / "agent")[0] == 0

    def test_a_scenario_that_cannot_be_opened_is_left_out(self):
        def fails():
            raise fmugym.ConfigError("there is no weather")

        make = lambda: fmugym.load(fmugym.Task.from_dict(ONE))  # noqa: E731
        agents = {name: ResidualAgent(name, f"schedule 00:00={name}") for name in ("0.05", "0")}
        told, parts = [], []
        found = judge(
            agents,
            {"frost": CandidateEvaluator(fails), "spring": CandidateEvaluator(make)},
            2,
            lambda name, error: told.append((name, str(error))),
            lambda name, part: parts.append((name, part)),
        )
        assert told == [("scenario frost", "there is no weather")]
        assert all(list(one["rewards"]) == ["spring"] for one in found.values())
        assert set(found) == set(agents)
        assert "0.05" in verdict(found, {})
        for name in agents:
            assert sum(part for one, part in parts if one == name) == pytest.approx(0.5)


class TestPlayers:
    def test_evaluate_goes_on_with_the_others(self, written, tmp_path, cli):
        players = "--controller", "thermostat", "--controller", "planner", "--action", "0,0"
        more = "--plot", tmp_path / "scores.png", "--episodes", "2"
        code, out, err = cli("evaluate", written(TWO), *players, *more)
        assert code == 1
        (line,) = [line for line in err.splitlines() if "left out" in line]
        assert line.startswith("left out: thermostat: Hysteresis gives one number")
        assert [row.split()[0] for row in out.splitlines()[1:]] == ["random", "action", "planner"]
        assert (tmp_path / "scores.png").exists()

    def test_evaluate_goes_on_after_a_failure_in_the_middle(self, written, cli, late):
        players = "--controller", "planner", "--controller", "thermostat", "--episodes", "3"
        code, out, err = cli("evaluate", written(ONE), *players, "--json")
        assert code == 1
        assert "left out: planner: a decision took" in err
        scores = json.loads(out)["scores"]
        assert [one["name"] for one in scores] == ["random", "thermostat"]
        assert all(len(one["rewards"]) == 3 for one in scores)

    def test_evaluate_tells_what_is_there_if_the_only_one_fails_late(self, written, cli, late):
        code, out, err = cli("evaluate", written(ONE), "--controller", "planner")
        assert code == 1
        assert "random" in out
        assert err.count("a decision took") == 1

    def test_simulate_writes_its_files(self, written, tmp_path, cli, late):
        players = "--controller", "planner", "--controller", "thermostat"
        output = "--output", tmp_path / "report.html"
        code, out, err = cli("simulate", written(ONE), *players, *output)
        assert code == 1
        assert "left out: planner: a decision took" in err
        assert "thermostat: seed 0" in out
        assert "thermostat" in (tmp_path / "report.html").read_text(encoding="utf-8")

    def test_simulate_writes_what_the_only_one_has_done(self, written, tmp_path, cli, late):
        output = "--output", tmp_path / "run.csv"
        code, out, err = cli("simulate", written(ONE), "--controller", "planner", *output)
        assert (code, out, err.count("\n")) == (1, "", 1)
        assert len((tmp_path / "run.csv").read_text().splitlines()) > 3


class TestProgress:
    """Where there is no terminal, a line every ten seconds; here the clock moves with each look."""

    @pytest.fixture(autouse=True)
    def clock(self, monkeypatch):
        seconds = itertools.count(0.0, 4.0)
        monkeypatch.setattr(watching, "monotonic", lambda: next(seconds))
        monkeypatch.setattr(sys.stderr, "isatty", lambda: False)

    def parts(self, err, what):
        lines = [line for line in err.splitlines() if line.startswith(f"{what}: ")]
        form = rf"{what}: (\d+) %, about [\d.]+ (s|min|h) left"
        found = [int(re.fullmatch(form, line)[1]) for line in lines]
        assert len(found) > 3
        assert found == sorted(found)
        assert found[0] < 30
        assert found[-1] > 70
        return found

    def test_of_evaluate(self, written, cli):
        two = "--scenario", "long", "--scenario", "short"
        scenarios = {
            n: {"start": d, "length": s}
            for n, d, s in (("long", "01-15", "1s"), ("short", "07-15", "0.5s"))
        }
        task = written(ONE | {"scenarios": scenarios})
        code, _, err = cli("evaluate", task, "--action", "0", *two, "--episodes", "2")
        assert code == 0
        self.parts(err, "evaluate")

    def test_of_episodes_that_end_early(self, written, cli):
        task = written(ONE | {"terminated": "abs(theta) > 1.2"})
        code, _, err = cli("evaluate", task, "--action", "0.1", "--episodes", "4")
        assert code == 0
        self.parts(err, "evaluate")

    def test_of_the_test(self, written, tmp_path, cli):
        code, _, err = cli("train", written(ONE), "--output", tmp_path / "agent", *SHORT)
        assert code == 0
        self.parts(err, "test")

    def test_of_tune(self, written, cli):
        controller = "pid of=theta setpoint=0 kp=-2..-0.01"
        options = "--rounds", "3", "--candidates", "8", "--episodes", "2"
        code, _, err = cli("tune", written(ONE), controller, *options)
        assert code == 0
        self.parts(err, "tune")

    def test_not_if_quiet(self, written, cli):
        code, _, err = cli("evaluate", written(ONE), "--action", "0", "-q")
        assert (code, err) == (0, "")


def test_groups_are_parts_of_a_whole():
    """Ten episodes of three candidates in four environments."""
    parts = []
    evaluator = CandidateEvaluator(
        lambda: fmugym.load(fmugym.Task.from_dict(ONE)), 4, advance=parts.append
    )
    numbers = np.zeros((3, 1))
    evaluator.play(
        lambda rows: ResidualAgent("0", "schedule 00:00=0")(rows[:, :0]), numbers, range(10)
    )
    evaluator.close()
    assert sum(parts) == pytest.approx(1.0)
