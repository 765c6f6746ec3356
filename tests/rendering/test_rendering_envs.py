"""The environments draw themselves, without a display too, and can be recorded."""

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.wrappers import RecordVideo

IDS = [
    "fmugym/CartPole-v0",
    "fmugym/CloudPendulum-v0",
    "fmugym/ModelicaCartPole-v0",
    "fmugym/Pendulum-v0",
]


@pytest.mark.parametrize("env_id", IDS)
def test_pictures(env_id):
    env = gym.make(env_id, render_mode="rgb_array")
    env.reset(seed=1)
    first = env.render()
    assert first.dtype == np.uint8
    assert first.shape == (*env.unwrapped.render_size[::-1], 3)
    for _ in range(5):
        env.step(env.action_space.sample())
    second = env.render()
    assert not np.array_equal(first, second)
    assert not np.shares_memory(first, second)
    env.close()


@pytest.mark.parametrize("env_id", IDS)
def test_window(env_id, monkeypatch):
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    env = gym.make(env_id, render_mode="human")
    env.reset(seed=1)
    env.step(env.action_space.sample())
    assert env.render() is None
    env.close()
    env.close()


@pytest.mark.filterwarnings("ignore:.*Overwriting existing videos")
@pytest.mark.parametrize("env_id", ["fmugym/CartPole-v0", "fmugym/Pendulum-v0"])
def test_videos(env_id, tmp_path):
    pytest.importorskip("moviepy", reason="RecordVideo needs moviepy, of the extra test")
    env = RecordVideo(gym.make(env_id, render_mode="rgb_array"), str(tmp_path))
    env.reset(seed=1)
    for _ in range(5):
        env.step(env.action_space.sample())
    env.close()
    (video,) = tmp_path.glob("*.mp4")
    assert video.stat().st_size > 1000


def test_the_picture_shows_the_torque():
    env = gym.make("fmugym/Pendulum-v0", render_mode="rgb_array").unwrapped
    pictures = []
    for torque in (-2.0, 2.0):
        env.reset(seed=1)
        env.step(np.array([torque], np.float32))
        pictures.append(env.render())
    assert not np.array_equal(*pictures)
    env.close()
