"""Datasets of Minari hold what recordings hold, and give it back."""

import json

import gymnasium as gym
import numpy as np
import pytest
from combinations import in_turn

import fmugym
from fmugym import ConfigError
from fmugym.records import RecordSeries
from fmugym.records.recording import Recorder, Recording, replay

minari = pytest.importorskip("minari", reason="needs Minari: the extra minari")

from fmugym.records.minari import read_dataset, write_dataset  # noqa: E402

IDS = ["fmugym/CartPole-v0", "fmugym/Pendulum-v0", "fmugym/House-v0"]
GOALS = {
    "fmu": {"bundled": "Pendulum"},
    "time_step": 0.02,
    "episode_length": "0.2s",
    "variables": {"tau": {"min": -0.1, "max": 0.1}},
    "agent": {"actions": ["tau"], "observations": ["q", "q_dot"]},
    "reward": "-abs(q)",
}


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "datasets"))
    return tmp_path


def played(env, episodes=3, steps=30):
    recorder, found = Recorder(env), []
    for number in range(episodes):
        recorder.reset(seed=None if number == 1 else number)
        over = False
        while not over and len(recorder.recording) < steps:
            _, _, terminated, truncated, _ = recorder.step(env.action_space.sample())
            over = terminated or truncated
        found.append(recorder.recording)
    return found


@in_turn({"env_id": IDS, "data_format": ["hdf5", "parquet"]})
def test_recordings_come_back_to_the_last_bit(env_id, data_format):
    if data_format == "parquet":
        pytest.importorskip("pyarrow", reason="needs pyarrow: the extra parquet")
    env = gym.make(env_id)
    recordings = played(env)
    made = write_dataset("test/all-v0", recordings, env.unwrapped, data_format=data_format)
    assert made.total_episodes == 3
    assert made.total_steps == sum(map(len, recordings))
    for one, expected in zip(read_dataset("test/all-v0"), recordings, strict=True):
        for name, value in vars(expected).items():
            np.testing.assert_array_equal(getattr(one, name), value, err_msg=name)
        assert replay(one, env).is_equal
    env.close()


def test_minari_itself_sees_the_same_steps():
    env = gym.make("fmugym/Pendulum-v0")
    recordings = played(env)
    write_dataset("test/seen-v0", recordings, env.unwrapped, author="Ada")
    dataset = minari.load_dataset("test/seen-v0")
    assert dataset.storage.metadata["author"] in ("Ada", {"Ada"}, ["Ada"])
    for episode, expected in zip(dataset.iterate_episodes(), recordings, strict=True):
        np.testing.assert_array_equal(episode.observations, expected.observations)
        np.testing.assert_array_equal(episode.actions, expected.actions)
        np.testing.assert_array_equal(episode.rewards, expected.rewards)
    again = dataset.recover_environment()
    assert isinstance(again.unwrapped, type(env.unwrapped))
    again.close()
    env.close()


class Goal(fmugym.FMI2CSEnv):
    """An observation of several parts, and one of several actions."""

    def __init__(self):
        config = {
            "model_input_names": "tau",
            "model_output_names": ["q", "q_dot"],
            "time_step": 0.02,
        }
        super().__init__(fmugym.bundled_fmu("Pendulum"), config)

    def _get_observation_space(self):
        box = gym.spaces.Box(-np.inf, np.inf, (2,), np.float64)
        return gym.spaces.Dict({"now": box, "side": gym.spaces.Discrete(2)})

    def _get_action_space(self):
        return gym.spaces.Discrete(3, start=-1)

    def _get_observation(self):
        return {"now": np.array(self.state), "side": np.int64(self.out["q"] > 0)}

    def _get_inputs(self):
        return 0.01 * self.action

    def _is_done(self):
        return False


def test_observations_of_several_parts():
    env = Goal()
    recordings = played(env, 2, 10)
    write_dataset("test/parts-v0", recordings, env)
    for one, expected in zip(read_dataset("test/parts-v0"), recordings, strict=True):
        np.testing.assert_array_equal(one.observations, expected.observations)
        np.testing.assert_array_equal(one.actions, expected.actions)
    env.close()


class TestMistakes:
    def test_no_recordings(self, load):
        env = load(GOALS)
        with pytest.raises(ConfigError, match="at least one"):
            write_dataset("test/none-v0", [], env)

    def test_another_task(self, load):
        env, other = gym.make("fmugym/CartPole-v0"), load(GOALS)
        with pytest.raises(ConfigError, match="recording"):
            write_dataset("test/other-v0", played(env, 1, 5), other)
        env.close()

    def test_a_name_that_exists(self, load):
        env = load(GOALS)
        recordings = played(env, 1)
        write_dataset("test/twice-v0", recordings, env)
        with pytest.raises(ConfigError, match="test/twice-v0"):
            write_dataset("test/twice-v0", recordings, env)

    def test_a_dataset_that_is_missing(self):
        with pytest.raises(ConfigError, match=r"nothing-v0.*there are: none"):
            read_dataset("test/nothing-v0")

    @pytest.mark.filterwarnings("ignore")
    def test_a_dataset_of_another_program(self):
        episode = minari.data_collector.EpisodeBuffer(
            observations=[np.zeros(4, np.float32)] * 2,
            actions=[0],
            rewards=[1.0],
            terminations=[True],
            truncations=[False],
        )
        dataset = minari.create_dataset_from_buffers(
            "test/foreign-v0", [episode], env="CartPole-v1"
        )
        with pytest.raises(ConfigError, match="not made by fmugym"):
            read_dataset(dataset)


class TestCommand:
    def test_episodes_of_a_controller(self, ran):
        command = ["simulate", "fmugym/Pendulum-v0", "--output", "minari:test/random-v0"]
        told = json.loads(ran(*command, "--episodes", "2", "--json"))
        assert (told["episodes"], told["steps"]) == (2, 400)
        recordings = read_dataset("test/random-v0")
        assert [bool(one.truncated[-1]) for one in recordings] == [True, True]

    def test_back_to_recordings(self, folder, ran):
        command = ["simulate", "fmugym/CartPole-v0", "--output", "minari:test/two-v0"]
        ran(*command, "--episodes", "2")
        ran("info", "minari:test/two-v0", "--output", folder / "out")
        files = sorted((folder / "out").iterdir())
        assert len(files) == 2
        texts = [argument for file in files for argument in ("--log", str(file))]
        again = ["simulate", "fmugym/CartPole-v0", "--output", "minari:test/again-v0", *texts]
        ran(*again)
        assert len(Recording.load(files[0])) == len(read_dataset("test/again-v0")[0])

    def test_logs(self, folder, ran):
        with RecordSeries(gym.make("fmugym/House-v0"), path=folder / "week.csv") as env:
            env.reset(seed=0)
            for _ in range(20):
                env.step(env.action_space.sample())
        command = ["simulate", "fmugym/House-v0", "--output", "minari:test/log-v0", "--log"]
        assert "1 episodes, 20 steps" in ran(*command, folder / "week.csv")

    @pytest.mark.parametrize(
        ("arguments", "fact"),
        [
            (["--log", "none.csv"], "none.csv"),
            (["--log", "none.csv", "--column", "x"], "COLUMN="),
            (["--output", "more.csv"], "alone"),
        ],
    )
    def test_mistakes(self, arguments, fact, refused):
        name = "minari:test/wrong-v0"
        assert fact in refused("simulate", "fmugym/CartPole-v0", "--output", name, *arguments)

    def test_a_dataset_is_replaced_only_by_force(self, refused, ran):
        command = ["simulate", "fmugym/CartPole-v0", "--output", "minari:test/once-v0"]
        ran(*command, "--episodes", "1")
        assert "test/once-v0" in refused(*command, "--episodes", "2")
        assert len(read_dataset("test/once-v0")) == 1
        ran(*command, "--episodes", "2", "--force")
        assert len(read_dataset("test/once-v0")) == 2


def test_the_record_of_a_shadow(folder, monkeypatch, ran, refused):
    """With a gap, on the plant's time, and with the data that the record has."""
    pytest.importorskip("pymodbus", reason="needs pymodbus: the extra plant")
    from plant_tools import LockStep, changed, house, nothing_left, watched

    from fmugym.deployment.plant import Server

    gone, clock = [], LockStep()
    changed(monkeypatch, lambda values: {"T": (np.nan,)} if gone else {})
    data = {"T_out": {"register": 200}}
    seen = {"observations": ["T", "T_floor", "T_out"]}
    task = house(stale_after="1min", agent=seen, data=data)
    task.write(folder / "house.toml")
    with (
        nothing_left(),
        Server(task, "thermostat", clock=clock) as server,
        watched(clock, server.address, task) as shadow,
    ):
        env = RecordSeries(shadow, path=folder / "shadow.csv")
        env.reset(seed=0)
        for step in range(9):
            gone[:] = [True] * (step in (4, 5))
            env.step(np.float32([0.5]))
        env.complete()
    command = ["simulate", folder / "house.toml", "--output", "minari:test/shadow-v0"]
    assert "2 episodes, 6 steps" in ran(*command, "--log", folder / "shadow.csv")
    names = list(env.unwrapped.observation_names)
    for begin, episode in zip((0, 7), minari.load_dataset("test/shadow-v0"), strict=True):
        rows = range(begin, begin + len(episode) + 1)
        expected = np.transpose([env.series[name][rows] for name in names])
        np.testing.assert_allclose(episode.observations, expected, rtol=1e-5)
        np.testing.assert_allclose(episode.rewards, env.series["reward"][rows[1:]], atol=1e-6)
        np.testing.assert_allclose(episode.actions.ravel(), env.series["u"][rows[1:]], atol=1e-6)
    assert [bool(one.truncated[-1]) for one in read_dataset("test/shadow-v0")] == [True, True]
    err = refused(*command, "--log", folder / "shadow.csv", "--scenario", "frost")
    assert "shadow.csv' has its own periods" in err
