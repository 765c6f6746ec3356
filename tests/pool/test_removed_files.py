"""Files of an FMU that a cleaner of temporary files removes: they are extracted anew."""

import os
import shutil
import signal
import time

import fmu_tools
import model_tools
import numpy as np
import pytest
from gymnasium import spaces
from process_tools import posix_only

from fmugym import FMU, FMULoadError, SimulationError
from fmugym.fmi import fmu as fmu_module
from fmugym.fmi.safe_zip import SafeZip
from fmugym.pool import native_pool

METHODS = ["reset", "instance", "library", "process"]


def resource_fmu(folder, value="42.5"):
    """Write an FMU that reads a number when it is instantiated."""
    add = {"resources/y.txt": value}
    outputs = [("y", "output", "")]
    return model_tools.model_fmu(
        folder / "Resource.fmu", "resource", 2, "{resource}", outputs, add=add
    )


def remove(folder, places):
    """Remove files and folders, of which some may be removed already."""
    for place in places.split():
        shutil.rmtree(folder / place, ignore_errors=True)
        (folder / place).unlink(missing_ok=True)
    time.sleep(2 * native_pool._BETWEEN_LOOKS)


each_removal = pytest.mark.parametrize(
    "places", [".", "binaries", "resources", "resources/y.txt", "private of-workers"]
)


class Env(fmu_tools.PlainEnv):
    def __init__(self, path, **config):
        own = {"model_input_names": [], "model_output_names": "y", "time_step": 0.5}
        super().__init__(path, fmu_tools.grouped(own | config))

    def _get_action_space(self):
        return spaces.Discrete(2)

    def _get_inputs(self):
        return []


@pytest.fixture(name="path")
def fixture_path(tmp_path):
    return resource_fmu(tmp_path)


def folder_in(temp_root):
    """The only one."""
    (folder,) = temp_root.iterdir()
    return folder


def is_isolated(env):
    return hasattr(env.pool, "processes")


@posix_only
@each_removal
@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("isolation", ["none", "process"])
def test_resets_go_on(path, opened, temp_root, places, method, isolation):
    if (method, isolation) == ("process", "none"):
        return
    env = opened(Env(path, reset_method=method, isolation=isolation))
    folder = folder_in(temp_root)
    for _ in range(3):
        assert env.reset()[0] == [42.5]
        assert env.step(0)[0] == [42.5]
        remove(folder, places)
    if is_isolated(env):
        os.kill(env.pool.processes()[0], signal.SIGKILL)
        assert env.step(0)[3]
        assert env.reset()[0] == [42.5]
    env.close()
    assert list(temp_root.iterdir()) == []


@pytest.mark.parametrize("places", [".", "resources/y.txt", "private of-workers"])
@pytest.mark.parametrize(
    ("method", "autoreset"),
    [("instance", "NextStep"), ("library", "NextStep"), ("library", "SameStep")],
)
def test_episodes_of_vector_environments_go_on(
    path, make_envs, temp_root, places, method, autoreset
):
    envs = make_envs(
        lambda: Env(path, reset_method=method, max_episode_steps=2),
        2,
        autoreset_mode=autoreset,
    )
    envs.reset()
    folder = folder_in(temp_root)
    for number in range(7):
        if number % 2:
            remove(folder, places)
        observations, _, _, _, infos = envs.step(np.zeros(2, np.int64))
        assert observations.tolist() == [[42.5]] * 2
        assert "fault" not in infos


@pytest.mark.parametrize("method", ["instance", "process"])
def test_an_archive_that_is_gone_as_well(path, opened, temp_root, method):
    env = opened(Env(path, reset_method=method))
    env.reset()
    remove(folder_in(temp_root), ".")
    path.unlink()
    for _ in range(2):
        with pytest.raises((SimulationError, FMULoadError), match=r"Resource.fmu .*unpacked"):
            env.reset()
    resource_fmu(path.parent)


def test_a_failed_extraction_leaves_no_part_of_a_file(path, temp_root, monkeypatch):
    fmu = FMU(path)
    folder = fmu.extract()
    remove(folder, "resources")
    extract = SafeZip.extract

    def interrupted(archive, to, files, folders=()):
        extract(archive, to, files, folders)
        raise KeyboardInterrupt

    monkeypatch.setattr(SafeZip, "extract", interrupted)
    with pytest.raises(KeyboardInterrupt):
        fmu.extract()
    monkeypatch.undo()
    assert not (folder / "resources" / "y.txt").exists()
    assert (fmu.extract() / "resources" / "y.txt").read_text() == "42.5"
    fmu.close()
    assert not folder.exists()


def test_the_log_says_so(path, temp_root, caplog):
    fmu = FMU(path)
    remove(fmu.extract(), "resources/y.txt")
    fmu.extract()
    fmu.extract()
    assert caplog.text.count("extracted anew") == 1
    fmu.close()


def test_a_folder_of_another_user_is_not_used(path, temp_root, monkeypatch):
    fmu = FMU(path)
    fmu.extract()
    monkeypatch.setattr(fmu_module, "is_own", lambda _: False)
    with pytest.raises(FMULoadError, match="belongs to another user"):
        fmu.extract()
    fmu.close()
