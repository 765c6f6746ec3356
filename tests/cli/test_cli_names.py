"""The names of commands: what earlier versions called them, and what shells complete."""

import os
import re
import shutil
import subprocess
import sys

import pytest
from process_tools import run_python
from source_tools import write_source_fmu

import fmugym

COMMANDS = [
    *("info", "new", "validate", "simulate", "train", "evaluate", "tune", "export", "bench"),
    "demo",
]


class TestOldNames:
    """They work for one release, and tell the present name."""

    def test_skeleton(self, cli):
        fmu = fmugym.bundled_fmu("Pendulum")
        code, out, err = cli("skeleton", fmu)
        assert code == 0
        assert out == cli("new", "--class", fmu)[1]
        assert f"'skeleton' is going away; it is now: fmugym new --class {fmu}" in err

    def test_record(self, cli, ran, tmp_path):
        arguments = ["fmugym/CartPole-v0", "--action", "0"]
        code, _, err = cli("record", *arguments, "--output", tmp_path / "old.csv")
        assert code == 0
        assert "fmugym simulate fmugym/CartPole-v0" in err
        ran("simulate", *arguments, "--output", tmp_path / "new.csv")
        assert (tmp_path / "old.csv").read_text() == (tmp_path / "new.csv").read_text()

    def test_compile(self, cli, tmp_path):
        write_source_fmu(tmp_path / "model.fmu")
        code, out, err = cli("compile", tmp_path / "model.fmu")
        assert code == 0
        assert "compiled for" in out
        assert f"fmugym info --repair {tmp_path / 'model.fmu'}" in err

    def test_stand_in(self, refused, tmp_path):
        fmu = fmugym.bundled_fmu("Pendulum")  # which lacks no library and has no source code
        err = refused("stand-in", fmu, "--folder", tmp_path)
        assert f"fmugym info --repair {fmu} --output {tmp_path}" in err


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
    program = "from fmugym.tools.cli import main; main()"
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
        if line == "fmugym ":
            assert not {"record", "skeleton", "dataset", "stand-in", "compile"} & set(told)


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_the_line_of_the_documents_gives_a_script_for_each_shell(shell):
    program = shutil.which("register-python-argcomplete", path=os.path.dirname(sys.executable))
    done = subprocess.run([program, "--shell", shell, "fmugym"], capture_output=True, text=True)
    assert done.returncode == 0
    assert "fmugym" in done.stdout
