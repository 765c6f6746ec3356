"""What there is to see: videos, and the live view of a lease."""

import importlib.util
import subprocess
from pathlib import Path
from urllib.parse import urlparse
from urllib.request import url2pathname

import numpy as np
import pytest
from lab_tools import TOKEN, experiment, track
from process_tools import run_python

from fmugym import ConfigError
from fmugym.lab import CellType, Client, Lab, LabError, ManualClock, videos
from fmugym.rendering import palette

imageio_ffmpeg = pytest.importorskip("imageio_ffmpeg", reason="writes and reads the videos")
Image = pytest.importorskip("PIL.Image", reason="writes and reads the animations")


@pytest.fixture(name="no_ffmpeg")
def fixture_no_ffmpeg(monkeypatch):
    hide(monkeypatch, "imageio_ffmpeg")


def hide(monkeypatch, *hidden):
    find = importlib.util.find_spec
    monkeypatch.setattr(
        videos.importlib.util, "find_spec", lambda name: None if name in hidden else find(name)
    )


def path_of(url):
    parts = urlparse(url)
    assert parts.scheme == "file"
    return Path(url2pathname(parts.path))


def swing(lab, duration, **arguments):
    """Record a swing and stop it; returns the path of the video."""
    client, token = experiment(lab, record=True, initial_position=[1.0], **arguments)
    track(lab, client, token, duration)
    return path_of(client.stop_experiment(token))


def frames_of(path):
    """Decode a video; returns what FFmpeg says of it and its frames."""
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-i", path, "-f", "rawvideo"]
    decoded = subprocess.run([*command, "-pix_fmt", "rgb24", "-"], capture_output=True, check=True)
    about, frames = decoded.stderr.decode(), np.frombuffer(decoded.stdout, np.uint8)
    return about, frames.reshape(-1, 320, 320, 3)


class TestVideo:
    def test_has_a_frame_every_40_ms_and_moves(self, lab):
        about, frames = frames_of(swing(lab, 2.0))
        assert len(frames) == 50
        assert "320x320" in about
        assert "25 fps" in about
        assert not np.array_equal(frames[0], frames[6])

    def test_of_a_double_pendulum(self, lab):
        client, token = experiment(lab, "DoublePendulum", record=True, initial_position=[1, 1])
        client.set_torque([0.05, -0.01], token)
        track(lab, client, token, 0.4)
        assert len(frames_of(path_of(client.stop_experiment(token)))[1]) == 10

    @pytest.mark.parametrize("duration", [0.0, 0.02, 0.04, 0.06])
    def test_of_a_moment_has_a_frame(self, lab, duration):
        assert len(frames_of(swing(lab, duration))[1]) == max(1, int(duration / 0.04 + 0.999))

    def test_of_an_episode_that_ended_by_time(self, lab):
        client = Client(lab)
        gym = client.start_gym(TOKEN, 30, [CellType.SINGLE])
        token, _ = client.start_episode(gym, "SimplePendulum", 1, record=True)
        lab.clock.advance(1.5)
        _, frames = frames_of(path_of(client.stop_episode(token)))
        assert len(frames) == 25

    def test_goes_with_the_lab(self, lab, temp_root):
        path = swing(lab, 0.1)
        assert path.exists()
        lab.close()
        assert list(temp_root.iterdir()) == []

    def test_stays_in_a_folder_of_ones_own(self, tmp_path):
        folder = tmp_path / "my videos"
        with Lab("ideal", clock=ManualClock(), video_folder=folder) as lab:
            assert not folder.exists()
            paths = {swing(lab, 0.1), swing(lab, 0.1)}
        assert set(folder.iterdir()) == paths
        assert all(len(frames_of(path)[1]) == 3 for path in paths)


class TestUnusableFolder:
    def test_is_refused_at_the_start_and_costs_nothing(self, tmp_path):
        (tmp_path / "file").touch()
        with Lab("ideal", clock=ManualClock(), video_folder=tmp_path / "file" / "x") as lab:
            with pytest.raises(LabError, match="no video can be written"):
                experiment(lab, record=True)
            assert Client(lab).get_user_info(TOKEN).number_of_attempts == 1000
            experiment(lab)

    def test_that_vanishes_does_not_keep_the_session(self, tmp_path):
        folder = tmp_path / "videos"
        with Lab("ideal", clock=ManualClock(), video_folder=folder) as lab:
            client, token = experiment(lab, record=True, cell_id=101)
            folder.rmdir()
            folder.touch()
            with pytest.raises(LabError, match="no video can be written"):
                client.stop_experiment(token)
            experiment(lab, cell_id=101)
            assert lab.clock.time() == 0.0


class TestWithoutFFmpeg:
    def test_is_a_gif(self, lab, no_ffmpeg):
        path = swing(lab, 1.0)
        assert path.suffix == ".gif"
        with Image.open(path) as animation:
            assert animation.n_frames == 25
            assert animation.info["duration"] == 40

    def test_that_fails_is_a_gif(self, lab, monkeypatch, caplog):
        def fail(*arguments, **options):
            raise RuntimeError("no FFmpeg executable")

        monkeypatch.setattr(imageio_ffmpeg, "write_frames", fail)
        assert swing(lab, 0.1).suffix == ".gif"
        assert "writing a GIF" in caplog.text

    def test_nor_pillow_is_refused_at_the_start(self, lab, monkeypatch):
        hide(monkeypatch, "imageio_ffmpeg", "PIL")
        with pytest.raises(LabError, match=r"pip install '.\[lab\]'"):
            experiment(lab, record=True)
        assert Client(lab).get_user_info(TOKEN).number_of_attempts == 1000


class TestView:
    @pytest.fixture(name="gym")
    def fixture_gym(self, lab):
        client = Client(lab)
        gym = client.start_gym(TOKEN, 60, [CellType.SINGLE] * 2 + [CellType.DOUBLE])
        token, _ = client.start_episode(gym, "SimplePendulum", 20, initial_position=[1.0])
        client.set_torque(0.1, token)
        return gym

    def test_shows_all_cells_of_a_lease_side_by_side(self, lab, gym):
        before = lab.view(gym)
        assert before.shape == (240, 720, 3)
        assert before.dtype == np.uint8
        lab.clock.advance(0.3)
        after = lab.view(gym)
        differs = np.any(before != after, axis=(0, 2))
        assert differs[:240].any()  # the one that swings
        assert not differs[240:].any()
        assert (after[:, :240] == palette.ACCENT).all(axis=-1).any()  # its torque

    def test_window(self, lab, gym, monkeypatch):
        monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
        for _ in range(2):
            assert lab.view(gym, render_mode="human") is None
        Client(lab).stop_gym(gym)
        from fmugym.rendering.window import Window

        assert not Window._shares

    def test_needs_a_lease_that_runs(self, lab, gym):
        lab.clock.advance(61.0)
        with pytest.raises(LabError, match="the gym has ended"):
            lab.view(gym)
        with pytest.raises(LabError, match="not valid"):
            lab.view("123")

    def test_unknown_mode(self, lab, gym):
        with pytest.raises(ConfigError, match="did you mean 'rgb_array'"):
            lab.view(gym, render_mode="rgbarray")

    def test_unknown_livestream(self, lab):
        with pytest.raises(LabError, match="unknown token"):
            lab.livestream_url("123")


def test_temporary_videos_go_with_the_interpreter(temp_root):
    code = """
from lab_tools import experiment
from fmugym.lab import Lab, ManualClock
client, token = experiment(Lab("ideal", clock=ManualClock()), record=True)
print(client.stop_experiment(token))
"""
    done = run_python("-W", "error", "-c", code)
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.startswith("file://")
    assert list(temp_root.iterdir()) == []
