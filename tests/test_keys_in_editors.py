"""What a TOML language server says of task files that name the schema."""

import re
import shutil
import subprocess
from pathlib import Path

import pytest

pytestmark = pytest.mark.skipif(shutil.which("npm") is None, reason="needs npm")
ROOT = Path(__file__).parent.parent
TAPLO = "@taplo/cli@0.7.0"

WRONG = """\
fmu = { bundled = "Pendulum" }
time_stepp = "20ms"
reward = "-abs(q)"

[variables]
tau = { min = 0.01, max = -0.01, sample = "median" }

[agent]
actions = ["tau"]
observations = ["q"]
rescale = "yes"

[setpoints]
goal = { steps = { low = 0, high = 1 } }

[config]
on_fault = "rais"

[foreign]
probe_timeout = -1
"""


@pytest.fixture(scope="module")
def taplo(tmp_path_factory):
    """The program of the language server."""
    folder = tmp_path_factory.mktemp("taplo")
    subprocess.run(["npm", "install", "--silent", "--prefix", folder, TAPLO], check=True)
    return folder / "node_modules" / ".bin" / "taplo"


def check(taplo, folder, *texts):
    """Check files with these texts: the exit code, and all that is said."""
    shutil.copy(ROOT / "fmugym/task/task.schema.json", folder / "fmugym.schema.json")
    for number, text in enumerate(texts):
        (folder / f"{number}.toml").write_text(f"#:schema ./fmugym.schema.json\n{text}")
    command = [taplo, "check", "--colors", "never", *(f"{n}.toml" for n in range(len(texts)))]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True)
    return done.returncode, done.stdout + done.stderr


def test_mistakes_are_marked(taplo, tmp_path):
    code, said = check(taplo, tmp_path, WRONG)
    assert code != 0
    for fact in ("time_stepp", "median", '"mean"', '"yes"', "boolean", "rais", '"raise"'):
        assert fact in said
    assert re.search(r'"low": ?0', said)
    assert "-1 is less than or equal to" in said


def test_tasks_that_are_right_are_not_marked(taplo, tmp_path):
    folders = (ROOT / "examples", ROOT / "fmugym" / "envs")
    texts = [path.read_text("utf-8") for one in folders for path in one.glob("*.toml")]
    page = (ROOT / "docs" / "task-file.md").read_text("utf-8")
    texts += re.findall(r"^```toml\n(.*?)^```", page, re.M | re.S)
    assert len(texts) > 10
    code, said = check(taplo, tmp_path, *texts)
    assert code == 0, said
