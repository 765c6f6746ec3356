"""Vector environments in Gymnasium's wrappers, pictures, videos and specs."""

import warnings

import gymnasium as gym
import numpy as np
import pytest
from vector_tools import Drawing, each_way, sampled_actions
from ways import make_vec

from fmugym import SimulationError, Uniform


def test_statistics_of_partial_resets():
    vector = gym.make_vec("fmugym/CartPole-v0", num_envs=2, autoreset_mode="disabled")
    wrapped = gym.wrappers.vector.RecordEpisodeStatistics(vector)
    wrapped.reset(seed=0)
    for _ in range(5):
        wrapped.step(np.array([0, 1]))
    wrapped.reset(options={"reset_mask": np.array([True, False])})
    assert wrapped.episode_lengths.tolist() == list(vector.get_attr("step_count")) == [0, 5]
    wrapped.close()


@each_way
def test_pictures_of_all(hooks):
    vector = make_vec(
        hooks,
        "fmugym/ModelicaCartPole-v0",
        num_envs=3,
        render_mode="rgb_array",
        theta_0=Uniform(1.4, 1.7),
    )
    with pytest.raises(SimulationError, match="before the first reset"):
        vector.render()
    vector.reset(seed=0)
    pictures = vector.render()
    assert [picture.shape for picture in pictures] == [(400, 600, 3)] * 3
    assert not np.array_equal(pictures[0], pictures[1])
    kept = pictures[0].copy()
    vector.step(np.array([0, 1, 1]))
    assert not np.array_equal(vector.render()[0], kept)
    assert np.array_equal(pictures[0], kept)
    vector.close()
    with pytest.raises(SimulationError, match="closed"):
        vector.render()


def test_no_pictures_without_a_render_mode(make_envs):
    vector = make_envs(Drawing, 2)
    assert vector.render() is None
    assert vector.render_mode is None


def test_videos(tmp_path):
    vector = gym.make_vec("fmugym/CartPole-v0", num_envs=2, render_mode="rgb_array")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # moviepy's own
        recorder = gym.wrappers.vector.RecordVideo(
            vector, str(tmp_path), video_length=5, step_trigger=lambda step: step == 0
        )
        recorder.reset(seed=0)
        for actions in sampled_actions(vector, 7):
            recorder.step(actions)
        recorder.close()
    (video,) = tmp_path.glob("*.mp4")
    assert video.stat().st_size > 1000
