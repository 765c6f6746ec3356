"""Where FMUs are extracted to, whatever the system's folder for temporary files is called."""

import os
import tempfile
import threading
from pathlib import Path

import fmu_tools
import model_tools
import pytest
from gymnasium import spaces

from fmugym import FMU, FMULoadError
from fmugym.fmi import temporary
from fmugym.fmi.safe_zip import SafeZip
from fmugym.fmi.temporary import folder_name, is_plain_path

each_root = pytest.mark.parametrize(
    "name", ["a b", "Müller", "a%20b", "a+b", "a#b", "x" * 200, "it's", "a(1)"]
)


class Env(fmu_tools.PlainEnv):
    """Reads a file of its resources, whose URI it does not decode."""

    def _get_action_space(self):
        return spaces.Discrete(2)

    def _get_inputs(self):
        return []


@pytest.fixture(name="use")
def fixture_use(tmp_path, monkeypatch):
    """Use another folder for temporary files."""

    def use(name):
        root = tmp_path / name
        root.mkdir()
        monkeypatch.setattr(tempfile, "tempdir", str(root))
        monkeypatch.setenv("TMPDIR", str(root))
        return root

    return use


def resource_fmu(folder, version):
    add, outputs = {"resources/y.txt": "42.5"}, [("y", "output", "")]
    path = folder / "Resource.fmu"
    return model_tools.model_fmu(path, "resource", version, "{resource}", outputs, add=add)


@each_root
@pytest.mark.parametrize("version", [1, 2])
@pytest.mark.usefixtures("engine")
def test_an_fmu_that_does_not_decode_uris(tmp_path, use, opened, version, name):
    root = use(name)
    config = {"model_input_names": [], "model_output_names": "y", "time_step": 0.5}
    for isolation in (None, "process"):
        config |= {"isolation": isolation}
        env = opened(Env(resource_fmu(tmp_path, version), config))
        assert env.reset()[0] == [42.5]
    assert list(root.iterdir()) == []


@each_root
def test_the_folder_goes(tmp_path, use, name):
    use(name)
    fmu = FMU(resource_fmu(tmp_path, 2))
    folder = fmu.extract()
    assert is_plain_path(folder)
    assert (folder.stat().st_mode & 0o077) == 0
    fmu.close()
    assert not folder.exists()


def test_nobody_removes_it_while_files_are_extracted(tmp_path, monkeypatch):
    """Several threads may use one FMU, of which one closes it."""
    fmu, alive = FMU(resource_fmu(tmp_path, 2)), []
    closing, extract = threading.Thread(target=fmu.close), SafeZip.extract

    def slow(*arguments):
        closing.start()
        closing.join(0.2)
        alive.append(closing.is_alive())
        extract(*arguments)

    monkeypatch.setattr(SafeZip, "extract", slow)
    folder = fmu.extract()
    closing.join()
    assert alive == [True]
    assert not folder.exists()


def test_a_plain_one_is_used(use):
    root = use("plain-1.x_y")
    assert folder_name().parent == root


@pytest.mark.usefixtures("engine")
def test_without_a_plain_one(tmp_path, use, monkeypatch):
    """The message names the cure."""
    monkeypatch.setattr(temporary, "_OTHER_ROOTS", (str(tmp_path / "missing"), str(tmp_path / "é")))
    (tmp_path / "é").mkdir()
    root = use("a b")
    assert folder_name().parent == root
    config = {"model_input_names": [], "model_output_names": "y", "time_step": 0.5}
    for isolation in ("none", "process"):
        with pytest.raises(FMULoadError, match=r"a b.*spaces.*: set TMPDIR to a short path"):
            Env(resource_fmu(tmp_path, 2), config | {"isolation": isolation})
    assert list(root.iterdir()) == []


@pytest.mark.skipif(not hasattr(os, "ST_NOEXEC"), reason="asks Linux how folders are mounted")
def test_a_folder_without_execution_is_not_used(use, monkeypatch):
    class Mounted:
        f_flag = getattr(os, "ST_NOEXEC", 0)

    root = use("a b")
    monkeypatch.setattr(os, "statvfs", lambda _: Mounted)
    assert folder_name().parent == Path(root)
