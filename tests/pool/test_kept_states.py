"""States on disk, which warm-ups of later programs need not reach again."""

import os
import sys

import numpy as np
import pytest

from fmugym.pool import states
from fmugym.pool.states import StateFiles

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="it has no pipes among files")


class TestFiles:
    STATE = np.array([1.0, 2.0]).tobytes() + b"state"

    @pytest.fixture
    def files(self, tmp_path):
        return StateFiles(str(tmp_path / "kept" / "fmu"))

    def test_come_back(self, files):
        assert files.find("a") is None
        files.keep("a", self.STATE)
        assert files.find("a") == self.STATE
        assert files.find("b") is None

    @pytest.mark.parametrize("damage", ["cut", "flip", "empty", "fifo", "link", "folder", "other"])
    def test_that_are_damaged_are_no_states(self, files, damage, tmp_path):
        files.keep("a", self.STATE)
        path = files.path("a")
        content = path.read_bytes()
        path.unlink()
        if damage == "fifo":
            os.mkfifo(path)
        elif damage == "link":
            (tmp_path / "target").write_bytes(content)
            path.symlink_to(tmp_path / "target")
        elif damage == "folder":
            path.mkdir()
        else:
            flipped = content[:-1] + bytes([content[-1] ^ 1])
            changed = {"cut": content[:-1], "flip": flipped, "empty": b"", "other": b"x" * 500}
            path.write_bytes(changed[damage])
        assert files.find("a") is None

    def test_are_bounded(self, files, monkeypatch):
        monkeypatch.setattr(states, "MOST_BYTES", 250)
        for number, key in enumerate("abc"):
            files.keep(key, self.STATE)
            if number < 2:
                os.utime(files.path(key), (number, number))
        assert files.find("a") is not None  # used, and so newer than b
        files.keep("d", self.STATE)
        assert files.find("b") is None
        sizes = [path.stat().st_size for path in files.path("a").parent.iterdir()]
        assert sum(sizes) <= 250

    def test_where_nothing_can_be_written(self, tmp_path):
        (tmp_path / "file").write_text("")
        files = StateFiles(str(tmp_path / "file" / "fmu"))
        files.keep("a", self.STATE)
        assert files.find("a") is None
