"""The working directories of workers, the names of their instances, and files of the user."""

import logging
import os
from pathlib import Path

import fmu_tools
import model_tools
import numpy as np
import pytest
from process_tools import linux_only

from fmugym import FMU
from fmugym.pool import PoolSpec
from fmugym.pool.opening import PoolOptions, open_pool

LOG = logging.getLogger("fmugym.test")
VARIABLES = (
    ("u", "input", 'start="0"'),
    *((name, "output", "") for name in ("y", "gain", "lines")),
)


def files_fmu(folder, version=2):
    """Write the FMU of ``files.c``."""
    return model_tools.model_fmu(Path(folder) / "Files.fmu", "files", version, "{1}", VARIABLES)


@pytest.fixture(name="directory")
def fixture_directory(tmp_path, monkeypatch):
    """The user's working directory, which is empty."""
    directory = tmp_path / "of user"
    directory.mkdir()
    monkeypatch.chdir(directory)
    return directory


@pytest.fixture(name="make")
def fixture_make(opened):
    def make(path, num_instances=4, **options):
        fmu = FMU(path)
        spec = PoolSpec((fmu.variable("u"),), tuple(map(fmu.variable, ["y", "gain", "lines"])), 0.5)
        options = {"isolation": "process", "workers": num_instances} | options
        return opened(open_pool(fmu, spec, num_instances, LOG, PoolOptions(**options)))

    return make


@pytest.mark.parametrize("version", [1, 2, 3])
def test_each_worker_writes_files_of_its_own(make, tmp_path, directory, version):
    pool = make(files_fmu(tmp_path, version))
    for _ in range(2):
        pool.reset((), np.zeros((0, 4)))
        for number in (1, 2, 3):
            outputs, statuses = pool.step(np.ones((1, 4)))
            assert not statuses.any()
            np.testing.assert_array_equal(outputs, [[0.5 * number] * 4, [0] * 4, [number] * 4])
    assert list(directory.iterdir()) == []


@linux_only
def test_names_of_instances_are_unique(make, tmp_path):
    pools = [make(files_fmu(tmp_path), workers=2) for _ in range(2)]
    names = []
    for pool in pools:
        pool.reset((), np.zeros((0, 4)))
        pool.step(np.ones((1, 4)))
        for pid in pool.processes():
            names += [one.name for one in Path(f"/proc/{pid}/cwd/").iterdir()]
    names = [name for name in names if name.endswith(".log")]
    assert len(names) == len(set(names)) == 8


@pytest.mark.parametrize("isolation", ["process", None])
def test_a_trial_writes_nothing_there(tmp_path, directory, own_trials, opened, isolation):
    config = {"model_input_names": "u", "model_output_names": "lines", "time_step": 0.5}
    config |= {"bounds": {"u": (-1, 1)}, "isolation": isolation}
    env = opened(fmu_tools.PlainEnv(files_fmu(tmp_path), fmu_tools.grouped(config)))
    assert list(directory.iterdir()) == []
    env.reset()
    assert env.step([1.0])[0] == [1.0]
    assert bool(list(directory.iterdir())) == (isolation is None)


@linux_only
class TestTexts:
    """Files of the user that Strings name are there, also by relative paths."""

    def test_start_values(self, make, tmp_path, directory):
        path = files_fmu(tmp_path)
        (directory / "tables").mkdir()
        (directory / "tables" / "gain.txt").write_text("7")
        pool = make(path)
        pool.reset((), np.zeros((0, 4)))
        assert pool.step(np.ones((1, 4)))[0][1].tolist() == [0] * 4  # nobody has named the file
        files = fmu_tools.read_fmu(path)
        element = (
            '<ScalarVariable name="table" valueReference="9" causality="parameter" '
            'variability="fixed"><String start="tables/gain.txt"/></ScalarVariable>'
            "</ModelVariables>"
        )
        xml = files["modelDescription.xml"].replace(b"</ModelVariables>", element.encode())
        fmu_tools.write_fmu(path, files | {"modelDescription.xml": xml})
        pool = make(path)
        for _ in range(2):
            pool.reset((), np.zeros((0, 4)))
            assert pool.step(np.ones((1, 4)))[0][1].tolist() == [7] * 4
            os.kill(pool.processes()[1], 9)
            pool.step(np.ones((1, 4)))

    @pytest.mark.parametrize("text", ["a table.txt", "data/a table.txt"])
    def test_parameters(self, make_env, directory, text):
        (directory / "data").mkdir()
        for name in ("a table.txt", "data/a table.txt", "other.txt"):
            Path(name).write_text("7")
        env = make_env(isolation="process", model_parameters={"label": text})
        env.reset()
        (pid,) = env.pool.processes()
        scratch = Path(f"/proc/{pid}/cwd")
        assert (scratch / text).read_text() == "7"
        assert not (scratch / "other.txt").exists()

    @pytest.mark.parametrize(
        "text", ["", ".", "..", "../of user", "/", "no file", "a\nb", "x" * 5000]
    )
    def test_that_name_no_file(self, make_env, directory, text):
        env = make_env(isolation="process", model_parameters={"label": text})
        env.reset()
        (pid,) = env.pool.processes()
        assert os.listdir(f"/proc/{pid}/cwd") == []
