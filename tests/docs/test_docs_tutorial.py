"""The tutorial: its commands run in their order, as written."""

import importlib
import re
import shlex
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

from PIL import Image

import fmugym
from fmugym.cli.command_line import run_command_line
from fmugym.envs.house import HOUSE_TASK

DOCUMENT = Path(__file__).parents[2] / "docs" / "tutorial.md"
TEXT = DOCUMENT.read_text(encoding="utf-8")
TASK = re.search(r"^```toml\n(.*?)^```", TEXT, re.M | re.S)[1]


def commands():
    """The lines of the shell, each a list of words."""
    for block in re.findall(r"^```bash\n(.*?)^```", TEXT, re.M | re.S):
        for line in block.replace("\\\n", " ").splitlines():
            yield shlex.split(line)


def shortened(words):
    """A training of seconds instead of a minute."""
    if words[1] != "train":
        return words
    return [*words, "--rounds", "23", "--episodes", "1"]


def test_its_task_is_that_of_the_house():
    own, bundled = tomllib.loads(TASK), tomllib.loads(HOUSE_TASK.read_text(encoding="utf-8"))
    del own["fmu"], bundled["fmu"], bundled["description"]
    assert own == bundled
    assert len(TASK.splitlines()) <= 44


def test_its_commands_run(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Path("house.toml").write_text(TASK, encoding="ascii")
    printed = {}
    for words in commands():
        if words[0] == "python":
            subprocess.run([sys.executable, *words[1:]], check=True, timeout=60)
        elif words[0] == "fmugym":
            assert run_command_line(shortened(words)[1:]) == 0, words
            printed[words[1]] = capsys.readouterr().out
    told = {"info", "new", "validate", "simulate", "train", "evaluate"}
    assert told == set(printed)
    assert "tuned pi" in printed["train"]
    assert "T_op" in printed["info"]
    assert "agent" in printed["evaluate"]
    for name in re.findall(r"--output (\S+\.png)|--plot (\S+\.png)", TEXT):
        with Image.open("".join(name)) as image:
            assert min(image.size) > 200
    assert "<html" in Path("frost.html").read_text(encoding="utf-8")[:500].lower()


MEASURED = re.compile(r"takes|first meeting|this machine|episodes begin|recommended for a training")
"""Lines with times of this machine, or what earlier runs have shown on it."""


def test_its_pictures_show_what_is_printed_today(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(DOCUMENT.parent / "_site")
    tutorial = importlib.import_module("tutorial")
    monkeypatch.chdir(tmp_path)
    shutil.copy(fmugym.bundled_fmu("House"), "House.fmu")
    shutil.copy(HOUSE_TASK.with_name("house_year.csv"), ".")
    Path("house.toml").write_text(TASK, encoding="ascii")
    for name, commands in tutorial.PRINTED.items():
        assert all(command in TEXT for command in commands) or name == "new"
        picture = (tutorial.IMAGES / f"tutorial_{name}.svg").read_text(encoding="utf-8")
        drawn = tutorial.terminal(tutorial.printed(commands))
        assert kept(picture) == kept(drawn), name


def kept(picture):
    """The texts of a picture that are the same everywhere."""
    texts = re.findall(r">([^<]*)</text>", picture.replace("\u00a0", " "))
    return [text for text in texts if not MEASURED.search(text)]


def test_each_step_has_a_small_picture():
    for heading in TEXT.split("\n## ")[1:]:
        names = re.findall(r"!\[[^]]{20,}\]\((\S+)\)", heading)
        assert names, heading.splitlines()[0]
        assert all((DOCUMENT.parent / name).stat().st_size < 100_000 for name in names)
