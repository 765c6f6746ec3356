"""The comparison of foreign FMUs with FMPy tells right from wrong."""

import shutil
import subprocess
import sys
from pathlib import Path

import held_out
import pytest

import fmugym
from fmugym.fmi.bundled import FMI_VERSIONS

RIGHT = [[[[0.0], [2.0]]]]


@pytest.mark.parametrize(
    ("episodes", "verdict"),
    [
        (RIGHT, "same"),
        ([[[[0.0], [2.0001]]]], "close"),
        ([[[[0.0], [2.1]]]], "WRONG"),
        ([[[[0.0], [float("nan")]]]], "WRONG"),
        ([[[[0.0]]]], "WRONG: an episode has 0 steps, not 1"),
        ("exit status -11: ", "exit status -11"),
    ],
)
def test_verdicts(episodes, verdict):
    assert held_out.judge(episodes, RIGHT, 1e-4).startswith(verdict)


@pytest.mark.parametrize("version", FMI_VERSIONS)
def test_a_folder(tmp_path, version):
    shutil.copy(fmugym.bundled_fmu("Pendulum", version), tmp_path)
    (tmp_path / "broken.fmu").write_text("nothing")
    program = Path(held_out.__file__)
    done = subprocess.run(
        [sys.executable, program, tmp_path], capture_output=True, text=True, timeout=300, check=True
    )
    *rows, shares = done.stdout.splitlines()
    lines = dict(row.split(" | ", 1) for row in rows)
    assert lines["Pendulum.fmu"] == (
        "fmpy: steps | single: same | vector: same | threads: same | isolated: same"
    )
    assert lines["broken.fmu"].startswith("fmpy: exit status 1: ")
    assert shares == "FMPy steps 1; right in all settings: 1"
