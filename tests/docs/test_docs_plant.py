"""The tutorial of plants: its commands run in their order, as written, with servers."""

import re
import shlex
import socket
import statistics
import subprocess
import sys
from contextlib import ExitStack, contextmanager
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("pymodbus", reason="needs pymodbus, of the extra plant")
pytest.importorskip("scipy", reason="needs SciPy, of the extra identification")
pytest.importorskip("matplotlib", reason="needs Matplotlib, of the extra plot")

from fmugym.cli.command_line import run_command_line
from fmugym.records.plant_log import PlantLog

TEXT = (Path(__file__).parents[2] / "docs" / "plant-tutorial.md").read_text(encoding="utf-8")
REACHED = re.compile(r"seed \d+: reward (\S+), cost \S+ in (\d+) steps")
_NUMBER = r"(\d+(?:\.\d+)?)"
PI = re.compile(rf"pid of=T setpoint={_NUMBER} kp={_NUMBER} ti={_NUMBER}")


def blocks():
    """The blocks of the shell, each a list of commands, each a list of words."""
    for block in re.findall(r"^```bash\n(.*?)^```", TEXT, re.M | re.S):
        yield [shlex.split(line) for line in block.replace("\\\n", " ").splitlines()]


def shortened(words):
    """Two days instead of two weeks, and a training of seconds."""
    words = ["192" if word == "1344" else word for word in words]
    if "train" in words:
        words += ["--rounds", "10", "--episodes", "1"]
    if "tune" in words:
        words += ["--candidates", "8", "--episodes", "2"]
    return ["8" if "mpc" in " ".join(words) and word == "192" else word for word in words]


@contextmanager
def served(words):
    """A plant in a process of its own, until it is told to end; background jobs get no Ctrl-C."""
    command = [sys.executable, "-m", "fmugym", *words[1:]]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert "serving real.toml" in process.stdout.readline()
            yield
            process.terminate()
            said, _ = process.communicate(timeout=20)
            assert REACHED.search(said)
            assert process.returncode == 143
        finally:
            process.kill()


@pytest.fixture(name="run")
def fixture_run(tmp_path, monkeypatch, capsys):
    """Run the page in an empty folder; returns what each command printed."""
    monkeypatch.chdir(tmp_path)
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = str(free.getsockname()[1])
    for block in re.findall(r"^```toml\n(.*?)^```", TEXT, re.M | re.S):
        name = block.split()[1]
        Path(name).write_text(block.replace("5020", port), encoding="utf-8")

    def run(change=lambda words: words):
        printed = []
        with ExitStack() as plant:
            for block in blocks():
                for words in map(change, block):
                    words = [port if word == "5020" else word for word in words]
                    if words[0] == "python":
                        subprocess.run([sys.executable, *words[1:]], check=True, timeout=60)
                    elif "--port" in words:
                        plant.enter_context(served(words))
                    else:
                        assert run_command_line(words[1:]) == 0, words
                        printed.append((words, capsys.readouterr().out))
                if "--port" not in block[0]:
                    plant.close()
        return printed

    return run


def require_a_fit(far):
    """The fitted values are those of the plant, as far as the slow heat pump lets them be."""
    with np.load("fitted.npz") as file:
        found = dict(zip(file["names"].tolist(), np.median(file["rows"], axis=0), strict=True))
    text = next(line for line in TEXT.splitlines() if line.startswith("parameters"))
    for name, value in re.findall(r"(UA|H_ve|cop_factor|C_w) = ([\d.e]+)", text):
        assert found[name] == pytest.approx(float(value), rel=far), name


def reached(printed):
    """What the agent and the PI controller have reached in the place of the plant."""
    return [float(REACHED.search(said)[1]) for words, said in printed if words[1] == "serve"]


def require_a_shadow(printed, steps):
    log = PlantLog.read("shadow.csv")
    assert len(log.times) >= steps
    proposed = log.columns["proposed.u"]
    assert np.mean(np.isfinite(proposed)) > 0.9
    assert np.nanmax(np.abs(proposed - log.columns["u"])) > 0.3
    assert "<html" in Path("shadow.html").read_text(encoding="utf-8")[:500].lower()
    (said,) = [said for words, said in printed if "--ahead" in words]
    assert re.search(r"error of T, .* 21600 s ahead", said)
    (table,) = [said for words, said in printed if "--log" in words and words[1] == "evaluate"]
    for row in ("plant, measured", "actions of the plant", "proposed actions", "pid of=T", "agent"):
        assert f"\n{row}" in table


def test_its_commands_run(run):
    printed = run(shortened)
    require_a_fit(far=0.5)
    require_a_shadow(printed, 192)
    assert [int(REACHED.search(s)[2]) for w, s in printed if w[1] == "serve"] == [192, 192]


def test_the_agent_beats_the_tuned_pi_controller(run, capsys):
    """As the page says, by the median of three trainings."""
    printed = run()
    require_a_fit(far=0.15)
    require_a_shadow(printed, 1344)
    (tuned,) = [said for words, said in printed if words[1] == "tune"]
    (found,), (shown, *_) = PI.findall(tuned), PI.findall(TEXT)
    found, shown = ([*map(float, one)][:2] for one in (found, shown))  # ti hardly matters
    assert found == pytest.approx(shown, rel=0.5)
    agent, pi = reached(printed)
    agents = [agent]
    (serving,) = [w for w, _ in printed if w[1] == "serve" and "--agent" in w]
    for seed in ("1", "2"):
        assert (
            run_command_line(["train", "fitted.toml", "--output", f"agent{seed}", "--seed", seed])
            == 0
        )
        capsys.readouterr()
        words = [f"agent{seed}" if word == "agent" else word for word in serving]
        assert run_command_line(words[1:]) == 0
        agents.append(float(REACHED.search(capsys.readouterr().out)[1]))
    assert statistics.median(agents) > pi
