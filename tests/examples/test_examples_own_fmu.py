"""The example own_fmu.py, run as a reader would run it."""

import shutil

from example_tools import EXAMPLES, run_example


class TestOwnFMU:
    def test_a_copy_in_another_folder_runs_one_episode(self, tmp_path):
        """The check finds nothing, not even a parameter without effect."""
        copy = shutil.copy(EXAMPLES / "own_fmu.py", tmp_path / "copied.py")
        assert "at rest: True" in run_example(copy, folder=tmp_path)
        assert [path.name for path in tmp_path.iterdir()] == ["copied.py"]
