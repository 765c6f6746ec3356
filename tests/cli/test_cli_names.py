"""Completion of commands and options by shells."""

import os
import re
import shutil
import subprocess
import sys

import pytest
from process_tools import run_python

COMMANDS = [
    *("info", "new", "validate", "simulate", "train", "evaluate", "tune", "export", "bench"),
]


def completions(line, shell, file):
    """What a shell is told of a line that ends where the Tab key is pressed."""
    settings = {
        "_ARGCOMPLETE": "1",
        "_ARGCOMPLETE_SHELL": shell,
        "COMP_LINE": line,
        "COMP_POINT": str(len(line)),
        "COMP_TYPE": "9",
        "_ARGCOMPLETE_IFS": "\n",
        "_ARGCOMPLETE_STDOUT_FILENAME": str(file),
    }
    program = "from fmugym.cli.command_line import run_command_line; run_command_line()"
    run_python("-c", program, environment=settings, check=True)
    return [re.split(r"[:\t]", one)[0].strip() for one in file.read_text().splitlines()]


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_commands_and_options_are_completed(shell, tmp_path):
    file = tmp_path / "said"
    for line, wanted in (
        ("fmugym ", COMMANDS),
        ("fmugym sim", ["simulate"]),
        ("fmugym simulate --var", ["--variables"]),
        ("fmugym info model.fmu --master ja", ["jacobi"]),
    ):
        told = completions(line, shell, file)
        assert set(wanted) <= set(told), (line, told)


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_the_line_of_the_documents_gives_a_script_for_each_shell(shell):
    program = shutil.which("register-python-argcomplete", path=os.path.dirname(sys.executable))
    done = subprocess.run([program, "--shell", shell, "fmugym"], capture_output=True, text=True)
    assert done.returncode == 0
    assert "fmugym" in done.stdout
