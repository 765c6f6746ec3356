"""A disk that fills while something is written leaves what was there before."""

import contextlib
import json
import os
import signal
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import fmugym
from fmugym.cli import episode_commands
from fmugym.files import replaced, replaced_together, write_whole
from fmugym.records import output_files
from fmugym.records.evaluation import Score, plot_scores
from fmugym.task.task_writer import write_new
from fmugym.training import agents, checkpoints, training_records, training_report
from fmugym.training.search_training import Searching

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="limits of POSIX")

SMALL, LARGE = b"small", b"large" * 1000
ROOM = 1000
"""In bytes: no file can become longer."""


@contextlib.contextmanager
def full_disk(room=ROOM):
    """The system refuses to write more, as it does on a full disk."""
    import resource

    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (room, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        signal.signal(signal.SIGXFSZ, handler)


def contents(folder):
    """All files below a folder."""
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in Path(folder).rglob("*")
        if path.is_file()
    }


def unchanged(folder, work):
    """Do something on a full disk; nothing has changed afterwards."""
    before = contents(folder)
    assert before
    with full_disk(), pytest.raises(OSError):  # noqa: PT011 (its number is that of a limit)
        work()
    assert contents(folder) == before


class Saved:
    """In the place of a model of Stable-Baselines3."""

    num_timesteps, replay_buffer = 64, None

    def __init__(self, content):
        self.content = content

    def save(self, path):
        Path(path).write_bytes(self.content)


def test_a_file_is_there_as_a_whole_or_not_at_all(tmp_path):
    path = tmp_path / "file"
    write_whole(path, SMALL)
    unchanged(tmp_path, lambda: write_whole(path, LARGE))
    write_whole(path, LARGE)
    assert contents(tmp_path) == {"file": LARGE}


def test_several_files_are_replaced_together(tmp_path):
    paths = [tmp_path / name for name in ("a.zip", "b.json", "c.d")]

    def write(*all_contents):
        with replaced_together() as beside:
            for path, content in zip(paths, all_contents, strict=True):
                beside(path).write_bytes(content)
                assert beside(path).suffix == path.suffix

    write(b"1", b"2", b"3")
    unchanged(tmp_path, lambda: write(b"4", b"5", LARGE))
    write(b"4", b"5", b"6")
    assert contents(tmp_path) == {"a.zip": b"4", "b.json": b"5", "c.d": b"6"}


def interrupted(path):
    with replaced(path) as part:
        part.write_bytes(LARGE)
        raise KeyboardInterrupt


def test_an_interruption_leaves_the_old_file(tmp_path):
    write_whole(tmp_path / "file", SMALL)
    with pytest.raises(KeyboardInterrupt):
        interrupted(tmp_path / "file")
    assert contents(tmp_path) == {"file": SMALL}


def test_a_link_stays_one(tmp_path):
    write_whole(tmp_path / "file", SMALL)
    os.symlink("file", tmp_path / "link")
    write_whole(tmp_path / "link", LARGE)
    assert (tmp_path / "link").is_symlink()
    assert (tmp_path / "file").read_bytes() == LARGE


@pytest.mark.parametrize("large", ["model", "normalization", "facts"])
def test_an_agent_of_stable_baselines3(large, tmp_path):
    def save(**changes):
        files = {"model": SMALL, "normalization": SMALL, "facts": SMALL} | changes
        facts = {"facts": files["facts"].decode()}
        agents.save(tmp_path, Saved(files["model"]), Saved(files["normalization"]), facts)

    save()
    new = dict.fromkeys(("model", "normalization", "facts"), b"new")
    unchanged(tmp_path, lambda: save(**new | {large: LARGE}))
    save(**new)
    assert contents(tmp_path)["model.zip"] == b"new"


def test_a_checkpoint(tmp_path, monkeypatch):
    """Also one of the same step as the one before."""
    monkeypatch.setattr(checkpoints, "_random_states", lambda venv: {})
    monkeypatch.setattr(checkpoints, "_envs", lambda venv: None)
    monkeypatch.setattr(checkpoints, "_wrappers", lambda venv: [])

    def save(steps, content, **more):
        model = Saved(content)
        model.num_timesteps = steps
        checkpoints.save_checkpoint(tmp_path, model, None, more)

    save(64, SMALL)
    for steps in (64, 128):
        unchanged(tmp_path, lambda steps=steps: save(steps, LARGE))
        unchanged(tmp_path, lambda steps=steps: save(steps, SMALL, more=LARGE))
    for steps in (64, 64, 128):
        save(steps, f"{steps}".encode())
        place, found = checkpoints.latest_checkpoint(tmp_path)
        assert (found, (place / "model.zip").read_bytes()) == (steps, f"{steps}".encode())
        assert [*tmp_path.glob("checkpoint-*")] == [place]


def test_the_curve_and_its_picture(tmp_path):
    pytest.importorskip("matplotlib", reason="needs Matplotlib: the extra plot")
    for steps in (1, 2):
        training_records.append_row(tmp_path, ("steps", "reward"), (steps, 0.5))
    assert training_report.write_curve(tmp_path, "title", print) is not None
    unchanged(tmp_path, lambda: training_report.write_curve(tmp_path, "another", print))
    unchanged(tmp_path, lambda: training_records.append_row(tmp_path, (), ("x" * ROOM, 0.5)))
    training_records.append_row(tmp_path, ("steps", "reward"), (3, 0.5))
    assert (tmp_path / "evaluations.csv").read_text() == "steps,reward\n1,0.5\n2,0.5\n3,0.5\n"


def test_pictures_of_scores(tmp_path):
    pytest.importorskip("matplotlib", reason="needs Matplotlib: the extra plot")
    scores = [Score(name, (1.0, 2.0), (), (3, 3), {"truncated": 2}, 1.0) for name in "ab"]
    write_whole(tmp_path / "scores.png", SMALL)
    unchanged(tmp_path, lambda: plot_scores(scores, tmp_path / "scores.png", "title"))


def test_a_recording(tmp_path):
    write_whole(tmp_path / "episode.npz", SMALL)
    recording = SimpleNamespace(
        **dict.fromkeys(fmugym.records.recording._ARRAYS, np.random.default_rng(0).random(2000))
    )
    vars(recording).update(dict.fromkeys(fmugym.records.recording.METADATA))
    save = fmugym.records.recording.Recording.save
    unchanged(tmp_path, lambda: save(recording, tmp_path / "episode.npz"))


def test_a_new_task_file_leaves_nothing_incomplete(tmp_path):
    write_whole(tmp_path / "other", SMALL)
    unchanged(tmp_path, lambda: write_new(tmp_path / "task.toml", LARGE.decode()))
    write_new(tmp_path / "task.toml", "a = 1\n")
    with pytest.raises(FileExistsError):
        write_new(tmp_path / "task.toml", "a = 2\n")
    assert (tmp_path / "task.toml").read_text() == "a = 1\n"


TASK = {
    "fmu": {"bundled": "Pendulum"},
    "time_step": 0.05,
    "episode_length": "0.5s",
    "variables": {"tau": {"min": -0.1, "max": 0.1}},
    "agent": {"actions": ["tau"], "observations": ["q", "q_dot"]},
    "reward": "-abs(q)",
}


@pytest.fixture
def task(tmp_path):
    (tmp_path / "task").mkdir()
    fmugym.Task.from_dict(TASK).write(tmp_path / "task" / "task.toml")
    return tmp_path / "task" / "task.toml"


def full_within(patch, owner, name, room=ROOM):
    """While a function works, the disk is full; FMUs are unpacked without trouble."""
    function = getattr(owner, name)

    def work(*arguments, **options):
        with full_disk(room):
            return function(*arguments, **options)

    patch.setattr(owner, name, work)


@pytest.mark.parametrize("room", [10, 2000, 6000])
def test_a_search_keeps_its_agent(room, task, tmp_path, cli, monkeypatch):
    """Wherever it is stopped, all files of the folder stay those of one agent."""
    folder = tmp_path / "agent"
    assert cli("train", task, "--output", folder, "--rounds", "30", "--episodes", "1")[0] == 0
    before = contents(folder)
    with monkeypatch.context() as patch:
        full_within(patch, Searching, "_save", room)
        code, _, err = cli("train", task, "--output", folder, "--rounds", "45", "--resume")
    assert (code, str(folder) in err) == (1, True), err
    same = ("policy.json", "search.npz", "agent.json")
    assert {name: contents(folder)[name] for name in same} == {n: before[n] for n in same}
    assert not [*folder.glob(".*")]
    assert cli("train", task, "--output", folder, "--rounds", "45", "--resume")[0] == 0
    assert json.loads((folder / "agent.json").read_text())["rounds"] == 45


@pytest.mark.parametrize("command", ["evaluate", "simulate"])
def test_force_brings_the_old_file_back(command, task, tmp_path, cli, monkeypatch):
    pytest.importorskip("matplotlib", reason="needs Matplotlib: the extra plot")
    picture = tmp_path / "out" / "picture.png"
    picture.parent.mkdir()
    option = {"evaluate": "--plot", "simulate": "--output"}[command]
    arguments = command, task, "--episodes", "1", option, picture
    assert cli(*arguments)[0] == 0
    before = contents(picture.parent)
    owner, name = {
        "evaluate": (episode_commands, "plot_scores"),
        "simulate": (output_files, "_draw"),
    }[command]
    full_within(monkeypatch, owner, name)
    code, _, err = cli(*arguments, "--force")
    assert (code, "large" in err) == (1, True)
    assert contents(picture.parent) == before


def test_force_brings_the_old_agent_back(task, tmp_path, cli, monkeypatch):
    folder = tmp_path / "agent"
    arguments = "train", task, "--output", folder, "--rounds", "12", "--episodes", "1"
    assert cli(*arguments)[0] == 0
    before = contents(folder)
    full_within(monkeypatch, Searching, "_save", 10)
    assert cli(*arguments, "--force")[0] == 1
    assert contents(folder) == before
    assert sorted(path.name for path in tmp_path.iterdir()) == ["agent", "task"]
