"""Files that last, and temporary ones: what others have made is not used."""

import logging
import os
import signal
import tempfile
from pathlib import Path

import pytest
from process_tools import run_python

import fmugym
from fmugym.envs import CartPoleEnv
from fmugym.files import cache_folder, lasting_folder, own_prefix, sweep
from fmugym.fmi.wine import wine_folder
from fmugym.pool.trial.verdict import recall, remember

pytestmark = pytest.mark.skipif(os.name != "posix", reason="Windows has no such owners and modes")


@pytest.fixture
def cache(tmp_path, monkeypatch):
    """The folder that is to be the cache; it is not there yet."""
    monkeypatch.setenv("FMUGYM_CACHE_DIR", str(tmp_path / "cache"))
    return tmp_path / "cache"


@pytest.fixture
def temp(tmp_path, monkeypatch):
    """The folder for temporary files."""
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "temp"))
    (tmp_path / "temp").mkdir()
    return tmp_path / "temp"


OF_A_DEAD_PROCESS = own_prefix().replace(f"-{os.getpid()}-", "-99999999999-") + "ab"


def pretend_another_user(monkeypatch):
    other = os.geteuid() + 1
    monkeypatch.setattr(os, "geteuid", lambda: other)


class TestCache:
    def test_it_is_made_for_the_user_alone(self, cache):
        for folder in (cache_folder("wine"), cache):
            assert folder.stat().st_mode & 0o777 == 0o700

    @pytest.mark.parametrize("mode", [0o775, 0o707])
    @pytest.mark.parametrize("place", ["", "wine"])
    def test_it_is_not_used_where_others_may_write(self, cache, mode, place):
        folder = cache_folder("wine")
        (folder / "worker.exe").touch()
        (cache / place).chmod(mode)
        with pytest.raises(fmugym.FMULoadError, match=str(cache / place)):
            wine_folder()

    def test_nor_are_its_verdicts(self, cache, caplog):
        remember("key", "text")
        assert recall("key") == "text"
        cache.chmod(0o777)
        with caplog.at_level(logging.WARNING):
            assert recall("key") is None
            remember("key", "another")
        assert len([record for record in caplog.records if str(cache) in record.message]) == 1
        cache.chmod(0o700)
        assert recall("key") == "text"

    def test_nor_is_that_of_another_user(self, cache, monkeypatch):
        remember("key", "text")
        pretend_another_user(monkeypatch)
        assert recall("key") is None
        with pytest.raises(OSError, match="cache"):
            cache_folder()

    def test_nor_is_one_in_the_folder_for_temporary_files(self, cache, temp, monkeypatch):
        cache.write_text("no folder")
        folder = lasting_folder("ray")
        assert folder == temp / f"fmugym-{os.geteuid()}" / "ray"
        folder.parent.chmod(0o777)
        with pytest.raises(OSError, match="fmugym-"):
            lasting_folder("ray")


KILLED = """
import os, signal
from fmugym.pool.trial.verdict import remember
os.replace = lambda *_: os.kill(os.getpid(), signal.SIGKILL)
remember("key", "text")
"""


def test_what_a_killed_process_has_not_kept_goes(cache):
    """It was killed after it had written a file, and before it had given it its name."""
    assert run_python("-c", KILLED).returncode == -signal.SIGKILL
    assert len(list(cache.iterdir())) == 1
    remember("other", "text")
    assert [path.name for path in cache.iterdir()] == ["other"]


class TestFoldersOfDeadProcesses:
    @pytest.fixture
    def planted(self, temp):
        folder = temp / OF_A_DEAD_PROCESS
        folder.mkdir()
        sweep.cache_clear()
        return folder

    def test_a_number_that_no_process_has_stops_nobody(self, planted):
        CartPoleEnv().close()
        assert not planted.exists()

    def test_those_of_others_stay(self, planted, monkeypatch):
        pretend_another_user(monkeypatch)
        sweep(planted.parent)
        assert planted.exists()

    def test_a_file_or_a_link_of_such_a_name_stops_nobody(self, planted, temp):
        planted.rmdir()
        planted.symlink_to(temp / "nowhere")
        Path(f"{planted}c").touch()
        CartPoleEnv().close()
