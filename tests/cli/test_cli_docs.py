"""The commands that the documents show do what they say."""

import re
import shlex
import shutil
from importlib.util import find_spec
from pathlib import Path

import pytest
import ssp_tools
from source_tools import write_source_fmu

import fmugym
from fmugym.cli.command_line import run_command_line

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "command-line.md").read_text()
PAGES = ("command-line.md", "training.md", "baselines.md", "foreign-fmus.md", "fit.md")
BLOCKS = [
    block
    for page in PAGES
    for block in re.findall(
        r"^```bash\n(fmugym .*?)^```", (ROOT / "docs" / page).read_text(), re.M | re.S
    )
    if "stand-in" not in block  # takes an old FMU; tests/fmi/test_fortran_libraries.py has one
]
NEEDS = {
    "--algorithm": "stable_baselines3",
    ".html": "matplotlib",
}


def lines_of(block):
    return [line for line in block.replace("\\\n", " ").splitlines() if line.strip()]


@pytest.mark.parametrize("block", BLOCKS, ids=lambda block: block.split()[1])
def test_examples_of_commands_run(block, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    if "fmugym info --repair" in block:
        write_source_fmu(tmp_path / "model.fmu")
    else:
        shutil.copy(fmugym.bundled_fmu("Pendulum"), "model.fmu")
    (tmp_path / "examples").symlink_to(ROOT / "examples")
    if "system.ssp" in block:
        write_system("system.ssp")
    if "fmugym new" not in block:
        assert run_command_line(["new", "model.fmu", "--output", "task.toml"]) == 0
    for command in lines_of(block):
        for text, module in NEEDS.items():
            if text in command and not find_spec(module):
                pytest.skip(f"needs {module}, which an extra of the package brings")
        program, *arguments = shlex.split(command)
        assert program == "fmugym"
        assert run_command_line(shortened(arguments)) == 0, capsys.readouterr().err
    capsys.readouterr()


def shortened(arguments):
    """A search of a few rounds instead of a minute, and one episode of a planner, not ten."""
    if arguments[0] == "evaluate" and any("mpc" in one for one in arguments):
        return [*arguments, "--episodes", "1"]
    is_search = arguments[0] == "train" and "trained" not in arguments
    is_search = is_search and "--algorithm" not in arguments
    return [*arguments, "--rounds", "23", "--episodes", "1"] if is_search else arguments


def write_system(path):
    house = fmugym.bundled_fmu("House")
    wires = ["first.T_air -> second.T_out"]
    ssp_tools.write(fmugym.FMUSystem({"first": house, "second": house}, wires), path)
