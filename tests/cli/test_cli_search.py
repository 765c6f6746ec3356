"""The command that searches for agents: train without an algorithm."""

import csv
import io
import itertools
import json
import pickle
import re
import shutil
import sys
from contextlib import redirect_stderr, redirect_stdout
from functools import partial
from types import SimpleNamespace
from typing import ClassVar

import numpy as np
import pytest

import fmugym
from fmugym.cli.command_line import run_command_line
from fmugym.control.candidate_evaluation import CandidateEvaluator
from fmugym.records.episode_statistics import confidence
from fmugym.training.search.policy import POLICY_FILE, ResidualAgent
from fmugym.training.search.policy_search import Search
from fmugym.training.search_training import Searching, verdict

TASK = {
    "fmu": {"bundled": "Pendulum"},
    "time_step": 0.05,
    "episode_length": "2s",
    "variables": {"tau": {"min": -0.1, "max": 0.1}},
    "agent": {"actions": ["tau"], "observations": ["theta", "theta_dot"]},
    "parameters": {"q_0": "pi", "theta_0": {"distribution": "uniform", "low": 0.1, "high": 1}},
    "controllers": {"lazy": 0, "pi": "pid of=theta setpoint=0 kp=-2..-0.01 td=0.2"},
    "reward": "-theta**2 - 0.1 * theta_dot**2",
    "costs": {"effort": {"expr": "abs(tau)", "limit": 1.0}},
    "terminated": "abs(theta) > 1.45",
}
SMALL = "--episodes", "3"
ROUNDS = 45


@pytest.fixture
def searched(cli):
    return lambda task, folder, *options: cli("train", task, "--output", folder, *SMALL, *options)


@pytest.fixture
def task(tmp_path):
    return written(tmp_path)


def test_only_the_folder_of_a_training_is_replaced_and_only_by_a_new_agent(
    task, tmp_path, searched
):
    """A search that time ends before it has found anything is no agent."""
    folder = tmp_path / "agent"
    assert searched(task, folder, "--rounds", "3")[0] == 0
    before = facts_of(folder)
    few = written(tmp_path, "few", controllers={"pi": TASK["controllers"]["pi"]})
    for output in (folder, tmp_path / "none"):
        code, _, err = searched(few, output, "--minutes", "1e-9", "--force")
        assert (code, "rounds are too few" in err) == (1, True)
    assert facts_of(folder) == before
    assert not (tmp_path / "none").exists()
    precious = tmp_path / "precious"
    precious.mkdir()
    (precious / "file").touch()
    assert searched(task, precious, "--force")[0] == 1
    assert (precious / "file").exists()


def test_faults_are_told_where_they_may_decide(tmp_path, searched):
    """A reward that is NaN beyond some actions; the log tells three of many such episodes."""
    changes = {"reward": "log(0.09 - tau) - 9", "costs": None, "controllers": {"full": 0.1}}
    task = written(tmp_path, **changes)
    code, _, err = searched(task, tmp_path / "agent", "--rounds", "12")
    test = facts_of(tmp_path / "agent")["test"]
    parts = {name: one["mean_costs"]["failed episodes"] for name, one in test.items()}
    assert code == 0
    assert parts.pop("full") == 1.0
    assert [*parts.values()] == [0.0]
    assert "full 100 %" in err
    assert err.count("nan, where") == 3


def written(tmp_path, name="task", **changes):
    document = {key: value for key, value in (TASK | changes).items() if value is not None}
    path = tmp_path / f"{name}.toml"
    fmugym.Task.from_dict(document).write(path)
    return path


def facts_of(folder):
    return json.loads((folder / "agent.json").read_text())


def curve(folder):
    """The scores; the steps of a round that was interrupted count, too."""
    lines = (folder / "evaluations.csv").read_text().splitlines()
    return [line.partition(",")[2] for line in lines]


def content(folder):
    return (folder / POLICY_FILE).read_bytes()


class Interruption:
    """Ctrl-C after some rounds, or within the next one."""

    def __init__(self, monkeypatch, rounds, *, within=False):
        self.rounds, self.now, advance, play = rounds, -1, Search.advance, CandidateEvaluator.play

        def advanced(search, evaluator):
            if not within and search.rounds >= self.rounds:
                raise KeyboardInterrupt
            self.now = search.rounds
            advance(search, evaluator)

        def played(evaluator, *arguments, **options):
            outcome = play(evaluator, *arguments, **options)
            if within and self.now >= self.rounds:
                raise KeyboardInterrupt
            return outcome

        monkeypatch.setattr(Search, "advance", advanced)
        monkeypatch.setattr(CandidateEvaluator, "play", played)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """The folder of a search, and what it has printed."""
    path, out = tmp_path_factory.mktemp("search"), io.StringIO()
    options = "--output", str(path / "whole"), *SMALL, "--rounds", str(ROUNDS)
    with redirect_stdout(out), redirect_stderr(io.StringIO()):
        assert run_command_line(["train", str(written(path)), *options]) == 0
    return path / "whole", out.getvalue()


class Trap:
    """Its pickle runs code."""

    opened: ClassVar[list[str]] = []

    def __reduce__(self):
        return Trap.opened.append, ("opened",)


def npz(**arrays):
    """The content of an archive of arrays."""
    file = io.BytesIO()
    np.savez(file, **arrays)
    return file.getvalue()


def text_of(facts):
    return np.frombuffer(json.dumps(facts).encode(), np.uint8)


POSSIBLE = {"task": [{"a": 1}], "limits": [{"a": 1}], "name": ["nonsense"], "actions": ["nonsense"]}


def mistakes(facts):
    """The facts of a search, each time with something else missing or of another kind."""
    policy, controller = facts["policies"][0], facts["controllers"][0]
    for part in (facts, facts["linear"], policy, controller, policy["make"], policy["cma"]):
        for name, value in list(part.items()):
            for wrong in ({"a": 1}, "nonsense", -1.5):
                part[name] = wrong
                if wrong not in POSSIBLE.get(name, ()):
                    yield facts
            del part[name]
            yield facts
            part[name] = value


class TestCourse:
    def test_rounds_repeat_a_search_and_its_output(self, whole, task, tmp_path, searched):
        folder, told = whole
        code, out, err = searched(task, tmp_path / "b", "--rounds", ROUNDS, "--envs", "7")
        assert (code, out) == (0, told)
        assert content(tmp_path / "b") == content(folder)
        assert f"--rounds {ROUNDS}" in err

    @pytest.mark.parametrize("within", [False, True])
    @pytest.mark.parametrize("rounds", [7, 20, 33])
    def test_an_interrupted_search_goes_on_as_if_it_was_not(
        self, rounds, within, whole, task, tmp_path, cli, searched, monkeypatch
    ):
        folder, parts = whole[0], tmp_path / "parts"
        with monkeypatch.context() as patch:
            Interruption(patch, rounds, within=within)
            code, out, err = searched(task, parts, "--rounds", ROUNDS)
        assert (code, out) == (130, "")
        assert "--resume" in err
        assert ResidualAgent.load(parts).name == facts_of(parts)["agent"]  # the best until then
        options = "--output", parts, "--episodes", "3", "--rounds", ROUNDS, "--resume"
        code, out, err = cli("train", task, *options)
        assert (code, out) == (0, whole[1]), err
        assert content(parts) == content(folder)
        assert curve(parts) == curve(folder)

    def test_a_resumed_search_may_be_longer(self, whole, task, tmp_path, ran, searched):
        """And is then like one that was as long from the beginning."""
        options = "--rounds", ROUNDS + 12
        code, *_ = searched(task, tmp_path / "longer", *options)
        assert code == 0
        folder = shutil.copytree(whole[0], tmp_path / "whole")
        options = "--output", folder, "--episodes", "3", *options, "--resume"
        ran("train", task, *options)
        assert content(folder) == content(tmp_path / "longer")

    @pytest.mark.parametrize("ceiling", [30_000, 60_000, 75_000])
    def test_steps_are_a_ceiling(self, ceiling, task, tmp_path, searched):
        """The rounds that it tells repeat what was found until then."""
        code, out, err = searched(task, tmp_path / "a", "--steps", ceiling)
        assert code == 0, err
        facts = facts_of(tmp_path / "a")
        assert 0.5 * ceiling < facts["steps"] <= ceiling
        options = words_after(err, "repeat the search:")
        code, again, err = searched(task, tmp_path / "b", *options)
        assert (code, again) == (0, out), err
        assert content(tmp_path / "b") == content(tmp_path / "a")

    def test_a_search_that_time_has_ended_is_repeated(self, task, tmp_path, cli):
        arguments = "train", task, "--episodes", "3"
        options = "--minutes", "0.2", "--output", tmp_path / "a"
        code, out, err = cli(*arguments, *options)
        assert code == 0, err
        options = words_after(err, "repeat the search:")
        code, again, err = cli(*arguments, *options, "--output", tmp_path / "b")
        assert (code, again) == (0, out), err
        assert content(tmp_path / "b") == content(tmp_path / "a")

    def test_what_cannot_be_resumed(self, whole, task, tmp_path, cli):
        folder = shutil.copytree(whole[0], tmp_path / "whole")
        before = content(folder)
        other = written(tmp_path, "other", time_step=0.1)
        another = written(tmp_path, "another", agent=TASK["agent"] | {"observations": ["theta"]})
        for path, output, options, fact in (
            (task, tmp_path / "none", ["--rounds", "1"], "no search to resume"),
            (task, folder, ["--rounds", "1", "--seed", "1"], "--seed"),
            (task, folder, ["--algorithm", "PPO"], "no training to resume"),
            (other, folder, ["--rounds", "1"], "time_step"),
            (another, folder, ["--rounds", "1"], "observations"),
        ):
            code, out, err = cli("train", path, "--output", output, *options, "--resume")
            assert (code, out, err.count("\n")) == (1, "", 1), options
            assert fact in err
        assert content(folder) == before

    def test_nothing_in_its_file_could_run(self, whole, task, tmp_path, cli):
        """It is an archive of numbers; a pickle in its place is not opened."""
        assert [path.name for path in whole[0].glob("search.*")] == ["search.npz"]
        with np.load(whole[0] / "search.npz", allow_pickle=False) as file:
            assert {file[name].dtype.kind for name in file.files} == {"u", "f"}
        folder = shutil.copytree(whole[0], tmp_path / "whole")
        for content in (pickle.dumps(Trap()), npz(text=np.array([Trap()], dtype=object))):
            (folder / "search.npz").write_bytes(content)
            code, _, err = cli("train", task, "--output", folder, "--resume")
            assert (code, "no search to resume" in err) == (1, True)
        assert not Trap.opened

    def test_a_damaged_file_is_one_error(self, whole, task, tmp_path, cli):
        folder = shutil.copytree(whole[0], tmp_path / "whole")
        state = folder / "search.npz"
        good = state.read_bytes()
        with np.load(state, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
        facts = json.loads(arrays["text"].tobytes())
        damaged = [b"", b"broken", good[: len(good) // 2], npz(text=np.zeros(3)), npz()]
        damaged += [npz(**arrays | {"text": text_of(one)}) for one in mistakes(facts)]
        name = facts["policies"][0]["cma"]["mean"]
        for wrong in (arrays[name][:-1], arrays[name] * np.nan, arrays[name].astype("f4")):
            damaged.append(npz(**arrays | {name: wrong}))
        assert len(damaged) > 100
        for content in damaged:
            state.write_bytes(content)
            with pytest.raises(fmugym.ConfigError, match="no search to resume"):
                Searching(None, {}, folder).run(resume=True)
        code, _, err = cli("train", task, "--output", folder, "--resume")
        assert (code, err.count("\n")) == (1, 1)

    def test_an_interruption_before_anything_is_found(self, task, tmp_path, searched, monkeypatch):
        Interruption(monkeypatch, 0)
        code, out, err = searched(task, tmp_path / "a", "--rounds", ROUNDS)
        assert (code, out) == (130, "")
        assert "nothing" in err
        assert not (tmp_path / "a").exists()


def words_after(text, mark):
    """The options in the last line that a search prints."""
    return text.rpartition(mark)[2].split()


CRANE = {
    "fmu": {"bundled": "CartPole"},
    "time_step": 0.05,
    "episode_length": 15,
    "variables": {"f": {"min": -20, "max": 20}},
    "expressions": {"swing": {"expr": "theta + pi / 2", "min": -4, "max": 4}},
    "parameters": {"theta_0": "-pi / 2"},
    "setpoints": {"x_set": {"distribution": "uniform", "low": -3, "high": 3}},
    "agent": {
        "actions": ["f"],
        "observations": ["x", "x_dot", "swing", "theta_dot", "x_set"],
    },
    "reward": "-abs(x - x_set) - 2 * abs(swing)",
}
"""A load hangs from a cart, which constant forces drive far away."""


@pytest.mark.parametrize(
    ("task", "rounds", "target"),
    [("fmugym/CartPole-v0", 50, 475), ("fmugym/CloudPendulum-v0", 100, -95), (CRANE, 250, -75)],
    ids=["cart-pole", "cloud-pendulum", "crane"],
)
def test_targets_are_reached(task, rounds, target, tmp_path, ran):
    """By the mean of 100 episodes of the test, in the median of three seeds."""
    if task is CRANE:
        task = tmp_path / "crane.toml"
        fmugym.Task.from_dict(CRANE).write(task)
    reached = []
    for seed in range(3):
        options = "--output", tmp_path / f"{seed}", "--rounds", rounds, "--seed", seed, "--json"
        told = json.loads(ran("train", task, *options))
        test = told["test"][told["agent"]]
        assert len(test["rewards"]["unseen episodes"]) == 100
        reached.append(test["total_reward"])
    assert sorted(reached)[1] >= target


class Bar:
    """In the place of tqdm's."""

    def __init__(self, told, **options):
        self.told = told

    def __enter__(self):
        return self

    def __exit__(self, *error):
        return None

    def set_postfix_str(self, text, refresh):
        self.told.append(text)

    def update(self, steps):
        return None


class TestOutput:
    def test_it_tells_what_it_does(self, task, tmp_path, searched):
        code, out, err = searched(task, tmp_path / "a", "--rounds", "25", "--steps", 10**9)
        assert code == 0
        first, plan, *_ = err.splitlines()
        assert "lazy" in first
        assert "pi (to be tuned)" in first
        for fact in ("40 steps", "round 25", "1000000000 steps"):
            assert fact in plan
        assert out.count("\n") == 1
        for fact in ("lazy", "tuned pi", "unseen episodes", "effort", "of at most 1"):
            assert fact in out
        assert f"its controller: {facts_of(tmp_path / 'a')['controller']}" in err

    @pytest.mark.parametrize(
        ("is_terminal", "has_tqdm"), [(True, True), (False, True), (True, False)]
    )
    def test_scores_are_a_bar_or_plain_lines(
        self, is_terminal, has_tqdm, task, tmp_path, searched, monkeypatch
    ):
        """There is a line every ten seconds, and in any case at the end; a round takes a second."""
        told = []
        clock = itertools.count()
        monkeypatch.setattr("fmugym.cli.training_commands.monotonic", clock.__next__)
        module = SimpleNamespace(tqdm=partial(Bar, told)) if has_tqdm else None
        monkeypatch.setitem(sys.modules, "tqdm", module)
        monkeypatch.setattr(sys.stderr, "isatty", lambda: is_terminal)
        code, _, err = searched(task, tmp_path / "a", "--rounds", "35")
        assert code == 0
        lines = [line for line in err.splitlines() if line.startswith("round")]
        if told:
            assert len(lines) == 1
            rounds = [int(re.match(r"round (\d+)", text)[1]) for text in told]
            assert rounds == sorted({*rounds, 1, 2, 35})
        else:
            assert 3 <= len(lines) <= 5
        assert bool(told) == (is_terminal and has_tqdm)
        for text in (lines[-1], *told[-1:]):
            assert re.fullmatch(r"round 35, best -[\d.]+, lazy -[\d.]+", text)

    def test_json(self, task, tmp_path, searched):
        code, out, _ = searched(task, tmp_path / "a", "--rounds", "32", "--json")
        told = json.loads(out)
        assert code == 0
        assert told["output"] == str(tmp_path / "a")
        assert told["rounds"] == 32
        assert {"algorithm", "agent", "baseline", "seed", "steps"} < told.keys()
        assert {key: told[key] for key in facts_of(tmp_path / "a")} == facts_of(tmp_path / "a")
        test = told["test"]
        assert next(iter(test)) == told["agent"]
        for one in test.values():
            rewards = one["rewards"]["unseen episodes"]
            assert len(rewards) == 3
            assert one["total_reward"] == pytest.approx(np.mean(rewards))
            assert one["mean_costs"]["effort"] >= 0

    def test_its_curve(self, task, tmp_path, searched):
        code, *_ = searched(task, tmp_path / "a", "--rounds", "32")
        assert code == 0
        rows = list(csv.DictReader((tmp_path / "a" / "evaluations.csv").read_text().splitlines()))
        steps = [int(row["steps"]) for row in rows]
        rewards = [float(row["reward"]) for row in rows]
        assert steps == sorted(set(steps))
        assert rewards == sorted(rewards)
        assert len({row["baseline"] for row in rows}) == 1

    def test_a_reward_that_never_changes_is_told_once(self, tmp_path, searched):
        path = written(tmp_path, reward=3, terminated=None)
        code, _, err = searched(path, tmp_path / "a", "--rounds", "5")
        assert code == 0
        assert err.count("warning") == err.count("reached 120") == 1
        path = written(tmp_path, "ends", reward=3)
        _, _, err = searched(path, tmp_path / "b", "--rounds", "5")
        assert "warning" not in err

    def test_episodes_without_a_length_are_told(self, tmp_path, searched, monkeypatch):
        monkeypatch.setattr("fmugym.training.search.probe.MOST_STEPS", 50)
        path = written(tmp_path, episode_length=None, controllers={"lazy": 0})
        _, _, err = searched(path, tmp_path / "a", "--rounds", "3")
        assert "no length" in err
        assert "50 steps" in err

    def test_scenarios_are_the_test(self, tmp_path, searched):
        more = {
            "data": {"goal": {"values": [0, 1, 2], "step": "1d"}},
            "clock": {"from": "01-01", "to": "01-03", "step": "1h", "exclude": "scenarios"},
            "scenarios": {
                "early": {"start": "01-01 12:00", "length": "0.5s"},
                "late": {"start": "01-02 12:00", "length": "1.5s"},
            },
            "reward": "-1",
            "terminated": None,
        }
        path = written(tmp_path, **more)
        code, out, _ = searched(path, tmp_path / "a", "--rounds", "5", "--json")
        assert code == 0
        (one, *_) = json.loads(out)["test"].values()
        assert one["rewards"] == {"early": [-10.0] * 3, "late": [-30.0] * 3}
        assert one["total_reward"] == -40.0


class TestAgents:
    def test_all_who_play_take_them(self, whole, task, tmp_path, ran):
        folder, told = whole[0], facts_of(whole[0])
        expected = told["test"][told["agent"]]["rewards"]["unseen episodes"]
        options = "--agent", folder, "--episodes", "3", "--seed", "1000000", "--json"
        assert json.loads(ran("evaluate", task, *options))["scores"][1]["rewards"] == expected
        out = ran("simulate", task, *options)
        assert [one["total_reward"] for one in json.loads(out)["episodes"]] == expected
        table = tmp_path / "table.csv"
        out = ran("simulate", task, *options, "--output", table)
        assert [one["total_reward"] for one in json.loads(out)["runs"][str(folder)]] == expected
        assert table.exists()

    def test_beside_controllers_they_reach_what_the_verdict_tells(self, whole, task, ran):
        told = facts_of(whole[0])["test"]["lazy"]
        options = "--controller", "lazy", "--episodes", "3", "--json"
        score = json.loads(ran("evaluate", task, *options))["scores"][1]
        assert score["rewards"] == told["rewards"]["unseen episodes"]
        assert score["mean_cost"] == pytest.approx(told["mean_costs"]["effort"])


def told(limits=(), **returns):
    """The verdict on returns for each scenario, with 0.5 for each cost."""
    test = {
        name: {
            "total_reward": sum(map(np.mean, rows)),
            "rewards": dict(zip("abcd", rows, strict=False)),
            "mean_costs": dict.fromkeys(dict(limits), 0.5),
        }
        for name, rows in returns.items()
    }
    return verdict(test, dict(limits))


class TestVerdict:
    def test_its_interval_is_students(self):
        """Of paired differences, each beside its mean in the scenario."""
        stats = pytest.importorskip("scipy.stats", reason="needs SciPy: the extra test")
        rng = np.random.default_rng(0)
        for scenarios, episodes in ((1, 100), (1, 2), (3, 4), (2, 3)):
            one = rng.normal([[-100.0], [-50.0], [-10.0]][:scenarios], 5.0, (scenarios, episodes))
            two = one + rng.normal(2.0, 1.0, (scenarios, episodes)) * [[1], [3], [9]][:scenarios]
            difference = two - one
            gain, half = difference.mean(axis=1).sum(), confidence(*difference.tolist())
            size, width = (100 * x / abs(one.mean(axis=1).sum()) for x in (abs(gain), half))
            shown = f"{size:.3g} % better than old ({size - width:.3g} to {size + width:.3g})"
            assert shown in told(new=two.tolist(), old=one.tolist())
            error = np.sqrt((difference.var(axis=1, ddof=1) / episodes).sum())
            freedom = scenarios * (episodes - 1)
            low, high = stats.t.interval(0.95, freedom, loc=gain, scale=error)
            assert (gain - half, gain + half) == pytest.approx((low, high), rel=0.01)
            if scenarios == 1:
                known = stats.ttest_rel(two[0], one[0]).confidence_interval(0.95)
                assert (gain - half, gain + half) == pytest.approx(tuple(known), rel=0.01)

    @pytest.mark.parametrize(
        ("new", "old", "facts", "missing"),
        [
            ([-90] * 3, [-100] * 3, ["10 % better than old in unseen"], ["(", "chance"]),
            ([-90, -91, -89], [-100, -101, -99], ["10 % better than old"], ["chance"]),
            ([110, 111, 109], [100, 101, 99], ["10 % better than old"], ["chance"]),
            ([-110, -111, -109], [-100, -101, -99], ["10 % worse than old"], ["chance"]),
            ([5, 6, 4], [-5, -4, -6], ["10 better than old"], ["%", "chance"]),
            ([0, 0, 0], [-5, -4, -6], ["5 better than old (2.52 to 7.48)"], ["%", "chance"]),
            ([-5, 5, 0], [-1, -1, -1], ["1 better than old", "chance"], ["%"]),
            ([3], [2], ["50 % better than old"], ["(", "chance", "unseen"]),
            ([500], [9], ["491 better than old"], ["%", "unseen"]),
        ],
    )
    def test_its_line(self, new, old, facts, missing):
        text = told(new=[new], old=[old], third=[old])
        for fact in facts:
            assert fact in text
        for one in missing:
            assert one not in text
        assert text.startswith(f"new {np.mean(new):g}, old {np.mean(old):g}, third ")

    def test_totals_are_sums_over_scenarios(self):
        text = told(new=[[-1.0, -3.0], [-10.0, -10.0]], old=[[-4.0, -4.0], [-20.0, -20.0]])
        assert text.startswith("new -12, old -24: 50 % better than old (32.1 to 67.9)")

    def test_costs_stand_beside_their_limits(self):
        limits = {"cold": 2.0, "noise": 0.25}.items()
        text = told(limits, new=[[1.0, 2.0]], old=[[0.5, 0.5]])
        assert "cold new 0.5, old 0.5 of at most 2" in text
        assert "noise new 0.5, old 0.5 of at most 0.25" in text
