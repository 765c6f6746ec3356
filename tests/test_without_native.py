"""Without the C extension FMPy steps FMUs, and what needs the extension says so."""

import os
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PROGRAM = """
import logging, sys
logging.basicConfig(stream=sys.stdout, format="%(message)s")
sys.modules["fmugym._native"] = None  # as if it had not been built
import gymnasium, fmugym, numpy
env = gymnasium.make("fmugym/CartPole-v0")
env.reset(seed=1)
single = [env.step(1)[0].tolist() for _ in range(5)]
envs = gymnasium.make_vec("fmugym/CartPole-v0", num_envs=2)
envs.reset(seed=1)
vector = [envs.step(numpy.array([1, 1]))[0][0].tolist() for _ in range(5)]
assert single == vector
for refused in (
    lambda: gymnasium.make_vec("fmugym/CartPole-v0", num_envs=2, backend="native"),
    lambda: gymnasium.make("fmugym/CartPole-v0", isolation="process"),
    env.unwrapped.save_state,
):
    try:
        refused()
    except fmugym.FMUGymError as error:
        print("refused:", error)
"""


def test_the_slow_path_works_and_says_so_once():
    result = subprocess.run(
        [sys.executable, "-c", PROGRAM], capture_output=True, text=True, check=True
    )
    assert result.stdout.count("FMUs are stepped by FMPy, which is slow") == 1
    assert "Install a C compiler" in result.stdout
    refusals = [line for line in result.stdout.splitlines() if line.startswith("refused: ")]
    assert len(refusals) == 3
    assert all("C extension" in line for line in refusals)


@pytest.mark.skipif(sys.platform == "win32", reason="a compiler is hidden by CC on Unix only")
def test_a_wheel_is_built_without_a_compiler(tmp_path):
    pytest.importorskip("build", reason="needs the extra test")
    copy = tmp_path / "source"
    listed = ("pyproject.toml", "setup.py", "README.md", "LICENSE", "MANIFEST.in")
    for name in listed:
        (copy / name).parent.mkdir(parents=True, exist_ok=True)
        (copy / name).write_bytes((ROOT / name).read_bytes())
    for folder in ("fmugym", "native", "resources"):
        (copy / folder).symlink_to(ROOT / folder)
    command = [sys.executable, "-m", "build", "--wheel", "--outdir", str(tmp_path), str(copy)]
    environment = {**os.environ, "CC": str(tmp_path / "no-compiler")}
    environment.pop("PYTEST_ADDOPTS", None)
    environment.pop("FMUGYM_REQUIRE_NATIVE", None)
    result = subprocess.run(command, capture_output=True, text=True, env=environment, check=False)
    assert result.returncode == 0, result.stderr
    (wheel,) = tmp_path.glob("*.whl")
    names = zipfile.ZipFile(wheel).namelist()
    assert "fmugym/pool/backend/by_fmpy.py" in names
    assert not any(name.startswith("fmugym/_native") and name.endswith(".so") for name in names)
