"""The tutorial "From FMU to agent": its commands run in their order, as written."""

import re
import shlex
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from PIL import Image

from fmugym.envs.house import HOUSE_TASK
from fmugym.tools.cli import main

DOCUMENT = Path(__file__).parent.parent / "docs" / "from-fmu-to-agent.md"
TEXT = DOCUMENT.read_text(encoding="utf-8")
TASK = re.search(r"^```toml\n(.*?)^```", TEXT, re.M | re.S)[1]


def commands():
    """The lines of the shell, each a list of words."""
    for block in re.findall(r"^```bash\n(.*?)^```", TEXT, re.M | re.S):
        for line in block.replace("\\\n", " ").splitlines():
            yield shlex.split(line)


def shortened(words):
    """A training of seconds instead of minutes."""
    if words[1] != "train":
        return words
    short = {
        "400000": "256",
        "64": "4",
        "n_steps=128": "n_steps=64",
        "batch_size=1024": "n_epochs=1",
    }
    assert set(short) <= set(words)
    return [short.get(word, word) for word in words]


def test_its_task_is_that_of_the_house():
    own, bundled = tomllib.loads(TASK), tomllib.loads(HOUSE_TASK.read_text(encoding="utf-8"))
    del own["fmu"], bundled["fmu"], bundled["description"]
    assert own == bundled
    assert len(TASK.splitlines()) <= 40


def test_its_commands_run(tmp_path, monkeypatch, capsys):
    pytest.importorskip("stable_baselines3", reason="needs Stable-Baselines3: the extra sb3")
    monkeypatch.setattr("fmugym.tools.training._EVALUATIONS", 1)
    monkeypatch.chdir(tmp_path)
    Path("house.toml").write_text(TASK, encoding="ascii")
    printed = {}
    for words in commands():
        if words[0] == "python":
            subprocess.run([sys.executable, *words[1:]], check=True, timeout=60)
        elif words[0] == "fmugym":
            assert main(shortened(words)[1:]) == 0, words
            printed[words[1]] = capsys.readouterr().out
    assert {"info", "new", "validate", "simulate", "record", "train", "evaluate"} == set(printed)
    assert "T_op" in printed["info"]
    assert "agent" in printed["evaluate"]
    for name in re.findall(r"--output (\S+\.png)|--plot (\S+\.png)", TEXT):
        with Image.open("".join(name)) as image:
            assert min(image.size) > 200
    assert "<html" in Path("frost.html").read_text(encoding="utf-8")[:500].lower()
