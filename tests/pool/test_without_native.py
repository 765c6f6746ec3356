"""Without the C extension FMPy steps FMUs, and what needs the extension says so."""

import zipfile
from pathlib import Path

from process_tools import run_python

ROOT = Path(__file__).parents[2]
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
assert single == [envs.step(numpy.array([1, 1]))[0][0].tolist() for _ in range(5)]
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
    result = run_python("-c", PROGRAM, check=True, timeout=600)
    assert result.stdout.count("FMUs are stepped by FMPy, which is slow") == 1
    assert "Python's headers were missing. Install them" in result.stdout
    refusals = [line for line in result.stdout.splitlines() if line.startswith("refused: ")]
    assert len(refusals) == 3
    assert all("python3-dev" in line for line in refusals)


TRAINING = f"""
import sys
sys.modules["fmugym._native"] = None
sys.path.insert(0, {str(ROOT / "examples")!r})
import multiprocessing, train_cart_pole
train_cart_pole.start_worker(multiprocessing.Value("i"))
for method in train_cart_pole.AGENTS:
    task = train_cart_pole.Task(method, 0, 100, 1, train_cart_pole.ENV_ID, {{}})
    print(train_cart_pole.train_and_evaluate(task).lengths.sum())
"""


def test_the_training_of_the_readme():
    steps = run_python("-c", TRAINING, check=True, timeout=600).stdout.split()
    assert [int(number) >= 100 for number in steps] == [True, True]


def test_without_the_headers_of_python_a_wheel_is_built(tmp_path):
    copy = tmp_path / "source"
    copy.mkdir()
    for name in ("build_backend.py", "pyproject.toml", "setup.py", "README.md", "LICENSE"):
        (copy / name).write_bytes((ROOT / name).read_bytes())
    for folder in ("fmugym", "native", "resources"):
        (copy / folder).symlink_to(ROOT / folder)
    script = "import sysconfig; sysconfig.get_config_vars()['installed_base'] = '/nowhere'\n"
    script += "import build_backend\nassert build_backend.get_requires_for_build_wheel() == []\n"
    script += f"build_backend.build_wheel({str(tmp_path)!r})"
    result = run_python("-c", script, cwd=copy)
    assert result.returncode == 0, result.stderr
    (wheel,) = tmp_path.glob("*-none-any.whl")
    names = zipfile.ZipFile(wheel).namelist()
    assert "fmugym/pool/rig/fmpy_pool.py" in names
    assert not any(name.startswith("fmugym/_native.") and name[-1] != "i" for name in names)
