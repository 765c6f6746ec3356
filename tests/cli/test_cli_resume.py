"""Trainings that are resumed, tuned, tracked and shown; agents that are damaged."""

import csv
import json
import signal
import subprocess
import sys
import time
import zipfile
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
from fmu_tools import interrupted_after
from PIL import Image

import fmugym

pytest.importorskip("stable_baselines3", reason="needs the extra test-sb3")

CART_POLE = str(Path(__file__).parents[2] / "examples" / "cart_pole.toml")
LEVELS = {
    "fmu": {"bundled": "Pendulum"},
    "time_step": 0.05,
    "episode_length": "0.5s",
    "variables": {"tau": {"levels": [-0.1, 0, 0.1], "min_on": 0.1}},
    "agent": {"actions": ["tau"], "observations": ["q", "q_dot"]},
    "parameters": {"q_0": {"distribution": "uniform", "low": -1, "high": 1}},
    "reward": "-abs(q)",
}
PENDULUM = LEVELS | {"variables": {"tau": {"min": -0.1, "max": 0.1}}}
ON_POLICY = "--algorithm", "PPO", "n_steps=32", "batch_size=32", "n_epochs=2"
OFF_POLICY = "--algorithm", "SAC", "learning_starts=20", "batch_size=16", "buffer_size=1000"


@pytest.fixture
def task(tmp_path):
    fmugym.Task.from_dict(PENDULUM).write(tmp_path / "task.toml")
    return tmp_path / "task.toml"


def parameters(folder):
    """All numbers of the networks and optimizers of the latest checkpoint."""
    import torch

    (place,) = folder.glob("checkpoint-*")
    found = []
    with zipfile.ZipFile(place / "model.zip") as archive:
        for name in sorted(archive.namelist()):
            if name.endswith(".pth"):
                with archive.open(name) as file:
                    found.append(torch.load(file, weights_only=False))
    return str([leaves(one) for one in found])


def leaves(value):
    if isinstance(value, dict):
        return {key: leaves(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [leaves(one) for one in value]
    return value.detach().numpy().tobytes() if hasattr(value, "detach") else value


@contextmanager
def interrupted(algorithm, updates):
    """Ctrl-C arrives in a training after some updates."""
    import stable_baselines3

    cls = getattr(stable_baselines3, algorithm)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(cls, "train", interrupted_after(updates, cls.train))
        yield


class TestResume:
    @pytest.mark.parametrize(
        ("options", "algorithm"),
        [(ON_POLICY, "PPO"), (OFF_POLICY, "SAC")],
        ids=["PPO", "SAC"],
    )
    def test_takes_the_same_course_to_the_last_bit(
        self, options, algorithm, task, tmp_path, cli, ran
    ):
        common = "--envs", "2", "--steps", "320", "--episodes", "2", *options
        whole, parts = tmp_path / "whole", tmp_path / "parts"
        ran("train", task, "--output", whole, *common)

        with interrupted(algorithm, 3 if options is ON_POLICY else 100):
            assert cli("train", task, "--output", parts, *common)[0] == 130
        before = json.loads((parts / "checkpoint.json").read_text())["steps"]
        assert 0 < before < 320
        code, _, err = cli("train", task, "--output", parts, "--resume")
        assert code == 0
        assert f"goes on after {before} steps\n" in err
        assert parameters(parts) == parameters(whole)
        for file in ("evaluations.csv", "agent.json", "training.json"):
            assert (parts / file).read_text() == (whole / file).read_text()

    def test_may_be_longer(self, task, tmp_path, cli):
        folder = tmp_path / "agent"
        options = "--envs", "2", "--episodes", "1", *ON_POLICY
        cli("train", task, "--output", folder, "--steps", "64", *options)
        code, *_ = cli("train", task, "--output", folder, "--resume", "--steps", "192")
        assert code == 0
        rows = list(csv.DictReader((folder / "evaluations.csv").read_text().splitlines()))
        steps = [int(row["steps"]) for row in rows]
        assert steps == sorted(set(steps))
        assert steps[-1] == 192
        assert (folder / "progress.csv").exists()
        assert (folder / "progress_from_64.csv").exists()

    def test_what_cannot_be_resumed(self, task, tmp_path, cli, refused):
        folder = tmp_path / "agent"
        algorithm = "--algorithm", "PPO"
        code, _, err = cli("train", task, "--output", folder, "--resume", *algorithm)
        assert (code, "no training to resume" in err) == (1, True)
        options = "--envs", "2", "--steps", "64", "--episodes", "1", *ON_POLICY
        cli("train", task, "--output", folder, *options)
        for change, fact in (
            (("--envs", "3"), "envs = 2"),
            (("--algorithm", "A2C"), "algorithm"),
            (("gamma=0.5",), "arguments"),
        ):
            err = refused("train", task, "--output", folder, "--resume", *change)
            assert fact in err
            assert err.count("\n") == 1
        other = tmp_path / "other.toml"
        fmugym.Task.from_dict(PENDULUM | {"time_step": 0.1}).write(other)
        code, _, err = cli("train", other, "--output", folder, "--resume", "--steps", "128")
        assert (code, err.count("\n")) == (1, 1)
        (place,) = folder.glob("checkpoint-*")
        (place / "state.pkl").write_bytes(b"broken")
        code, _, err = cli("train", task, "--output", folder, "--resume")
        assert code == 1
        assert "cannot be resumed" in err
        for facts in ({"folder": 3, "steps": 64}, {"folder": place.name, "steps": None}):
            (folder / "checkpoint.json").write_text(json.dumps(facts))
            code, _, err = cli("train", task, "--output", folder, "--resume")
            assert (code, "no training to resume" in err) == (1, True)


def steps_of(folder):
    """The steps at the latest checkpoint."""
    path = folder / "checkpoint.json"
    return json.loads(path.read_text())["steps"] if path.exists() else 0


@pytest.mark.skipif(sys.platform == "win32", reason="signals of POSIX")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_signals_keep_the_agent_and_a_checkpoint(number, task, tmp_path, temp_root, ran):
    folder = tmp_path / "agent"
    options = "--envs", "2", "--steps", "100000", "--episodes", "1", *ON_POLICY
    program = (
        "import sys; from fmugym.training import sb3_training as training\n"
        "training._SECONDS_BETWEEN_CHECKPOINTS = 0.0\n"
        "from fmugym.__main__ import main; sys.exit(main())"
    )
    command = [sys.executable, "-c", program, "train", str(task), "--output", str(folder), *options]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
        deadline = time.monotonic() + 60
        while steps_of(folder) == 0 and time.monotonic() < deadline:
            time.sleep(0.05)
        process.send_signal(number)
        process.wait(60)
    assert process.returncode == 128 + number
    assert not list(temp_root.glob("fmugym-*"))
    assert (folder / "model.zip").exists()
    assert steps_of(folder) > 0
    out = ran("simulate", task, "--agent", folder, "--episodes", "2", "--json")
    assert len(json.loads(out)["episodes"]) == 2


def test_json_of_a_training(task, tmp_path, cli):
    folder = tmp_path / "agent"
    options = "--envs", "2", "--steps", "64", "--episodes", "1", *ON_POLICY
    code, out, _ = cli("train", task, "--output", folder, *options, "--json")
    facts = json.loads(out)
    assert code == 0
    assert facts["algorithm"] == "PPO"
    assert facts["arguments"] == {"n_steps": 32, "batch_size": 32, "n_epochs": 2}
    assert facts["best"]["reward"] == json.loads((folder / "agent.json").read_text())["reward"]
    assert facts["scores"][0]["name"] == "held-out seeds"
    if find_spec("tensorboard"):
        assert list(folder.glob("events.out.tfevents.*"))


class TestAlgorithms:
    @pytest.mark.parametrize(
        ("name", "document"),
        [
            *((name, PENDULUM) for name in ("A2C", "TD3", "DDPG", "TQC", "ARS", "TRPO")),
            *((name, LEVELS) for name in ("DQN", "QRDQN", "MaskablePPO", "RecurrentPPO")),
        ],
    )
    def test_train_and_play(self, name, document, tmp_path, ran):
        if name not in ("A2C", "TD3", "DDPG", "DQN"):
            pytest.importorskip("sb3_contrib", reason="needs sb3-contrib: the extra test-sb3")
        folder, task = tmp_path / "agent", tmp_path / "task.toml"
        fmugym.Task.from_dict(document).write(task)
        options = "--envs", "2", "--steps", "40", "--episodes", "1", "--algorithm", name
        small = ("n_steps=8", "batch_size=8") if "PPO" in name or name == "TRPO" else ()
        ran("train", task, "--output", folder, *options, *small)
        out = ran("evaluate", task, "--agent", folder, "--episodes", "1", "--json")
        assert np.isfinite(json.loads(out)["scores"][1]["mean_reward"])


class TestTune:
    def test_finds_arguments_and_trains_with_them(self, task, tmp_path, ran):
        pytest.importorskip("optuna", reason="needs Optuna: the extra tune")
        folder = tmp_path / "agent"
        options = "--envs", "2", "--steps", "256", "--episodes", "1", "--tune", "3"
        options = "--algorithm", "PPO", *options
        out = ran("train", task, "--output", folder, *options, "gamma=0.9", "--json")
        rows = list(csv.DictReader((folder / "trials.csv").read_text().splitlines()))
        assert len(rows) == 3
        best = max((row for row in rows if row["reward"]), key=lambda row: float(row["reward"]))
        facts = json.loads(out)
        assert facts["arguments"] == json.loads(best["arguments"])
        assert all(json.loads(row["arguments"])["gamma"] == 0.9 for row in rows)
        assert len({row["arguments"] for row in rows}) == 3
        assert (folder / "trials" / "002" / "training.json").exists()
        assert json.loads((folder / "training.json").read_text())["arguments"] == facts["arguments"]


class TestTrack:
    def options(self, tmp_path):
        folder = "--output", tmp_path / "agent"
        return "--envs", "2", "--steps", "192", "--episodes", "1", *ON_POLICY, *folder

    def test_mlflow(self, task, tmp_path, ran, monkeypatch):
        mlflow = pytest.importorskip("mlflow", reason="needs MLflow: the extra mlflow")
        monkeypatch.setenv("MLFLOW_TRACKING_URI", (tmp_path / "runs").as_uri())
        monkeypatch.setenv("MLFLOW_ALLOW_FILE_STORE", "true")
        mlflow.set_tracking_uri((tmp_path / "runs").as_uri())
        ran("train", task, *self.options(tmp_path), "--track", "mlflow")
        (found,) = mlflow.search_runs(search_all_experiments=True, output_format="list")
        assert found.data.params["algorithm"] == "PPO"
        (*_, row) = csv.DictReader(
            (tmp_path / "agent" / "evaluations.csv").read_text().splitlines()
        )
        assert found.data.metrics["evaluation.reward"] == float(row["reward"])
        assert any(name.startswith("train.") for name in found.data.metrics)

    def test_wandb(self, task, tmp_path, ran, monkeypatch):
        pytest.importorskip("wandb", reason="needs W&B: the extra wandb")
        monkeypatch.setenv("WANDB_MODE", "offline")
        monkeypatch.setenv("WANDB_SILENT", "true")
        ran("train", task, *self.options(tmp_path), "--track", "wandb")
        assert list((tmp_path / "agent").rglob("offline-run-*/*.wandb"))


class TestDamagedAgents:
    @pytest.fixture
    def agent(self, task, tmp_path, ran):
        folder = tmp_path / "agent"
        options = "--envs", "2", "--steps", "64", "--episodes", "1", *ON_POLICY
        ran("train", task, "--output", folder, *options)
        return folder

    @pytest.mark.parametrize(
        ("file", "text"),
        [
            ("model.zip", b"no zip"),
            ("model.zip", None),
            ("normalization.pkl", b"no pickle"),
            ("agent.json", b"{}"),
            ("agent.json", b'{"algorithm": "PPOO"}'),
        ],
    )
    def test_are_one_line(self, file, text, agent, task, cli):
        if text is None:
            (agent / file).write_bytes((agent / file).read_bytes()[:2000])
        else:
            (agent / file).write_bytes(text)
        code, out, err = cli("evaluate", task, "--agent", agent, "--episodes", "1")
        assert (code, out) == (1, "")
        assert str(agent) in err or "PPOO" in err
        assert err.count("\n") == 1

    def test_for_another_task(self, agent, cli):
        code, out, err = cli("simulate", CART_POLE, "--agent", agent)
        assert (code, out) == (1, "")
        assert "another task" in err
        for fact in ("observes q, q_dot", "also gives phi, phi_dot, x", "actions are tau, here"):
            assert fact in err
        assert err.count("\n") == 1

    def test_for_a_task_of_the_same_shape(self, agent, tmp_path, cli):
        names = PENDULUM["agent"]["observations"][::-1]
        other = PENDULUM | {"agent": PENDULUM["agent"] | {"observations": names}}
        fmugym.Task.from_dict(other).write(tmp_path / "other.toml")
        code, _, err = cli("simulate", tmp_path / "other.toml", "--agent", agent)
        assert (code, "another task: the order of the observations" in err) == (1, True)


def recorded(path):
    """The rows of a recording without the numbers of episodes."""
    rows = csv.DictReader(path.read_text().splitlines())
    return [{k: v for k, v in row.items() if k != "episode"} for row in rows]


class TestRecord:
    COMMON = ("--envs", "3", "--steps", "288", "--episodes", "2", *ON_POLICY)
    RECORD = ("--record", "q*", "--record", "tau", "--record-env", "0", "--record-env", "2")

    def test_recordings_are_of_the_training_and_change_nothing(self, task, tmp_path, cli, ran):
        pytest.importorskip("matplotlib", reason="needs Matplotlib: the extra plot")
        plain, folder = tmp_path / "plain", tmp_path / "agent"
        ran("train", task, "--output", plain, *self.COMMON)
        code, *_ = cli("train", task, "--output", folder, *self.COMMON, *self.RECORD)
        assert code == 0
        assert parameters(folder) == parameters(plain)
        assert (folder / "evaluations.csv").read_text() == (plain / "evaluations.csv").read_text()
        rows = recorded(folder / "records" / "training.csv")
        assert list(rows[0])[:5] == ["environment", "step", "time [s]", "tau [N.m]", "q [rad]"]
        steps = [row for row in rows if row["step"] != "0"]
        assert [row["environment"] for row in steps[:4]] == ["0", "2", "0", "2"]
        assert len(steps) == 288 / 3 * 2
        assert all(abs(float(row["reward"])) == abs(float(row["q [rad]"])) for row in steps)
        for row in csv.DictReader((folder / "evaluations.csv").read_text().splitlines()):
            path = folder / "records" / f"evaluation-{row['steps']}-held-out_seeds.csv"
            rewards = [float(one["reward"]) for one in recorded(path)]
            assert float(row["reward"]) == pytest.approx(sum(rewards) / 2, rel=1e-12)
        with Image.open(folder / "evaluations.png") as image:
            assert min(image.size) > 200
        page = (folder / "report.html").read_text(encoding="utf-8")
        best = json.loads((folder / "agent.json").read_text())
        assert f"<dd>{best['steps']}</dd>" in page
        assert page.count("<figure>") == 2
        assert "task.toml" in page
        assert not (plain / "report.html").exists()

    def test_a_training_that_is_resumed_goes_on_with_its_recordings(self, task, tmp_path, cli, ran):
        whole, parts = tmp_path / "whole", tmp_path / "parts"
        rate = "--record-every", "0.1"
        arguments = *self.COMMON, *self.RECORD, *rate
        ran("train", task, "--output", whole, *arguments)
        with interrupted("PPO", 2):
            assert cli("train", task, "--output", parts, *arguments)[0] == 130
        begin = json.loads((parts / "checkpoint.json").read_text())["steps"]
        ran("train", task, "--output", parts, "--resume")
        again = recorded(parts / "records" / f"training_from_{begin}.csv")
        assert len(again) > 30
        assert again == recorded(whole / "records" / "training.csv")[-len(again) :]
        for path in (whole / "records").glob("evaluation-*"):
            assert (parts / "records" / path.name).read_text() == path.read_text()
