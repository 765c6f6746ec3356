"""Recordings of episodes, and replays that are equal or name the first difference."""

import json
import zipfile
from dataclasses import replace

import gymnasium
import numpy as np
import pytest
from combinations import in_turn
from test_snapshots import Track

import fmugym
from fmugym import ConfigError, SimulationError
from fmugym.envs import CartPoleEnv
from fmugym.records.recording import Recorder, Recording, replay


class Named(Track):
    """Observations and actions that are dicts."""

    def _get_action_space(self):
        return gymnasium.spaces.Dict({"tau": gymnasium.spaces.Box(-0.01, 0.01, (1,), np.float32)})

    def _get_inputs(self):
        return self.action["tau"]

    def _get_observation_space(self):
        return gymnasium.spaces.Dict({"q": gymnasium.spaces.Box(-np.inf, np.inf, (), np.float64)})

    def _get_observation(self):
        return {"q": np.float64(self.out["q"])}


def record(env, steps=8, **arguments):
    recorder = Recorder(env)
    recorder.reset(**arguments)
    env.action_space.seed(0)
    for _ in range(steps):
        if any(recorder.step(env.action_space.sample())[2:4]):
            break
    return recorder


@in_turn({"make": [Track, CartPoleEnv, Named], "version": ["1.0", "2.0", "3.0"]})
def test_a_file_is_replayed_to_the_last_bit(make, version, tmp_path):
    with make(fmi_version=version) as env:
        recording = record(env, seed=5).recording
    recording.save(tmp_path / "episode.npz")
    loaded = Recording.load(tmp_path / "episode.npz")
    assert len(loaded) == len(recording) == 8
    assert loaded.seed == 5
    assert loaded.drawn == recording.drawn
    with make(fmi_version=version, isolation="process") as env:
        report = replay(loaded, env)
    assert report.is_equal
    assert str(report) == "8 steps were replayed: all is equal to the last bit"
    assert (tmp_path / "episode.npz").stat().st_size < 20_000


def test_a_later_episode_and_its_options():
    with Track() as env:
        env.reset(seed=1)
        recorder = record(env, options={"model_parameters": {"m": 0.055}})
    assert recorder.recording.seed is None
    assert recorder.recording.drawn["m"] == 0.055
    with Track() as env:
        assert replay(recorder.recording, env).is_equal


def test_a_recorded_episode_is_that_without_a_recorder():
    with Track() as env, Track() as plain:
        recording = record(env, seed=3).recording
        observation, info = plain.reset(seed=3)
        assert observation.tolist() == recording.observations[0].tolist()
        assert info["drawn"] == recording.drawn
        assert plain.step(recording.actions[0])[1] == recording.rewards[0]


def test_wrappers_are_part_of_it():
    env = gymnasium.make("fmugym/CartPole-v0", max_episode_steps=4)
    recording = record(env, seed=0).recording
    assert recording.truncated.tolist() == [False, False, False, True]
    assert replay(recording, env).is_equal
    report = replay(recording, env.unwrapped)
    assert report.difference == "step 4: the flag truncated is np.False_, recorded was np.True_"
    env.close()


@pytest.mark.parametrize(
    ("changes", "difference"),
    [
        ({"drawn": {"m": 1.0}}, "drawn m = "),
        ({"observations": 0}, "the first observation[0] is"),
        ({"observations": 3}, "step 3: the observation[0] is"),
        ({"rewards": 2}, "step 3: the reward is"),
        ({"terminated": 1}, "step 2: the flag terminated"),
    ],
)
def test_the_first_difference_is_named(changes, difference):
    with Track() as env:
        recording = record(env, seed=0).recording
        for name, change in changes.items():
            value = change
            if name != "drawn":
                value = getattr(recording, name).copy()
                value[change] = ~value[change] if value.dtype == bool else value[change] + 1e-6
            recording = replace(recording, **{name: value})
        report = replay(recording, env)
    assert difference in report.difference
    assert not report.is_equal


def test_other_surroundings_are_told():
    with Track() as env:
        recording = record(env, seed=0).recording
        others = {**recording.surroundings, "numpy": "1.0"}
        report = replay(replace(recording, surroundings=others), env)
    assert report.surroundings == {"numpy": ("1.0", np.__version__)}
    assert f"numpy was '1.0', is '{np.__version__}'" in str(report)


@pytest.fixture
def recorded(tmp_path):
    """The file of an episode of eight steps."""
    with Track() as env:
        record(env, seed=0).recording.save(tmp_path / "episode.npz")
    return tmp_path / "episode.npz"


class TestRefusals:
    def test_of_another_config(self):
        with Track() as env, Track(time_step=0.01) as other:
            recording = record(env, seed=0).recording
            with pytest.raises(ConfigError, match="time_step"):
                replay(recording, other)

    def test_of_other_environments(self):
        with pytest.raises(ConfigError, match="environment of fmugym, got CartPoleEnv"):
            Recorder(gymnasium.make("CartPole-v1"))

    def test_before_the_first_reset(self):
        with Track() as env, pytest.raises(SimulationError, match="before the first reset"):
            _ = Recorder(env).recording

    def test_of_options_that_are_no_json(self):
        with Track() as env, pytest.raises(ConfigError, match="cannot be recorded"):
            Recorder(env).reset(options={"model_parameters": {"m": fmugym.Uniform(0.1, 0.2)}})

    @pytest.mark.parametrize("content", [b"", b"text", None])
    def test_of_other_files(self, tmp_path, content):
        path = tmp_path / "episode.npz"
        if content is not None:
            path.write_bytes(content)
        with pytest.raises(ConfigError, match="no recording"):
            Recording.load(path)

    def test_of_another_format(self, tmp_path, monkeypatch):
        with Track() as env:
            recording = record(env, seed=0).recording
        monkeypatch.setattr("fmugym.records.recording._VERSION", 2)
        recording.save(tmp_path / "episode.npz")
        monkeypatch.undo()
        with pytest.raises(ConfigError, match="another version"):
            Recording.load(tmp_path / "episode.npz")

    def test_of_more_than_memory_should_hold(self, recorded):
        with zipfile.ZipFile(recorded, "a") as archive:
            archive.writestr("more.npy", b"")
            archive.getinfo("more.npy").file_size = 4 * 2**30
        with pytest.raises(ConfigError, match="4 GB"):
            Recording.load(recorded)

    @pytest.mark.parametrize(
        ("name", "value"),
        [
            ("rewards", np.zeros(7)),
            ("rewards", np.zeros((8, 1))),
            ("rewards", np.float64(1.0)),
            ("observations", np.zeros((8, 3))),
            ("actions", np.array(["a"] * 8)),
            ("terminated", np.zeros(8)),
        ],
    )
    def test_of_arrays_that_do_not_match(self, recorded, name, value):
        with np.load(recorded) as file:
            np.savez(recorded, **dict(file) | {name: value})
        with pytest.raises(ConfigError, match=r"recording.*expected \d rows"):
            Recording.load(recorded)

    @pytest.mark.parametrize(
        ("name", "value"),
        [
            ("stream", [1, 2]),
            ("stream", [-1, 2, 3, 4, 0, 0]),
            ("stream", 5),
            ("scope", "all"),
            ("drawn", {"m": "heavy"}),
            ("drawn", [1.0]),
            ("seed", "five"),
            ("options", "{"),
            ("surroundings", None),
        ],
    )
    def test_of_facts_that_are_none(self, recorded, name, value):
        with np.load(recorded) as file:
            header = json.loads(file["header"].tobytes()) | {name: value}
            text = np.frombuffer(json.dumps(header).encode(), np.uint8)
            np.savez(recorded, **dict(file) | {"header": text})
        with pytest.raises(ConfigError, match="no recording"):
            Recording.load(recorded)

    def test_of_a_header_that_is_no_dict(self, recorded):
        with np.load(recorded) as file:
            np.savez(recorded, **dict(file) | {"header": np.frombuffer(b"[1]", np.uint8)})
        with pytest.raises(ConfigError, match="no recording"):
            Recording.load(recorded)

    @in_turn({"make": [Track, CartPoleEnv, Named], "shape": [(8, 2), (8, 0)]})
    def test_of_actions_of_another_shape(self, make, shape):
        with make() as env:
            recording = replace(record(env, seed=0).recording, actions=np.zeros(shape))
            with pytest.raises(ConfigError, match=r"action|flat element"):
                replay(recording, env)
