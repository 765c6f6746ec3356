"""Initial states on disk: a slow model is initialized once, and only where that changes nothing."""

import os
import sys
from pathlib import Path

import numpy as np
import pytest
from demanding_tools import DemandingEnv, expected_outputs, make_fmu
from fmu_tools import edited_fmu

import fmugym
from fmugym.pool import states
from fmugym.pool.attendant import InitialState
from fmugym.pool.states import StateFiles
from fmugym.tools.overview import as_text, overview
from fmugym.trial.known import known_verdict
from fmugym.trial.verdict import Grade

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="its library is made for Linux")

WAYS = [{}, {"isolation": "process"}]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("states")


@pytest.fixture(autouse=True)
def trials(monkeypatch, tmp_path):
    """Trials as users have them, with a cache for each test, and seats for all."""
    monkeypatch.delenv("FMUGYM_PROBE", raising=False)
    monkeypatch.setenv("FMUGYM_CACHE_DIR", str(tmp_path / "cache"))
    monkeypatch.setenv("SEATS", str(tmp_path / "seats"))
    monkeypatch.setenv("SEATS_LIMIT", "64")


@pytest.fixture
def initializations(tmp_path):
    """Count the initializations since the last call; each follows an instantiation."""
    seen = [0]

    def count(instances):
        path = tmp_path / "seats.calls"
        calls = len(path.read_text().split()) if path.exists() else 0
        new, seen[0] = calls - seen[0], calls
        return new - instances

    return count


def state_files():
    return sorted((Path(os.environ["FMUGYM_CACHE_DIR"]) / "states").glob("*"))


def play(env, steps=3):
    """Play two episodes; return the outputs of both."""
    rows = []
    for _ in range(2):
        env.reset(seed=0)
        rows.append([float(env.state[0])])
        for _ in range(steps):
            env.step(np.array([0.5], np.float32))
            rows[-1].append(float(env.state[0]))
    return rows


def play_and_close(env):
    try:
        return play(env)
    finally:
        env.close()


EXPECTED = [expected_outputs(1.5, [0.5] * 3)] * 2


class TestSingle:
    @pytest.mark.parametrize("config", WAYS)
    def test_is_initialized_once_for_all_processes(self, folder, config, initializations):
        path = make_fmu(folder, "slow")
        env = DemandingEnv(path, keep_initial_states=True, **config)
        text = as_text(overview(fmugym.FMU(path)))
        assert "an initial state in another process is right to the last bit" in text
        initializations(0)
        assert play_and_close(env) == EXPECTED
        assert initializations(0) == 1
        assert len(state_files()) == 1
        for _ in range(2):
            env = DemandingEnv(path, keep_initial_states=True, **config)
            assert play_and_close(env) == EXPECTED
            assert initializations(1) == 0

    def test_native_and_python_share_them(self, folder, initializations):
        path = make_fmu(folder, "slow")
        for backend in ("native", "native"):
            env = DemandingEnv(path, keep_initial_states=True, backend=backend)
            assert play_and_close(env) == EXPECTED
        assert len(state_files()) == 1

    @pytest.mark.parametrize(
        "change", [{"gain": 1.25}, {"start_time": 1.0}, {"warm_up": 0.1}, {"tolerance": 1e-3}]
    )
    def test_other_starts_have_other_states(self, folder, change):
        path = make_fmu(folder, "slow")
        for config in ({}, change, {}, change):
            kept = play_and_close(DemandingEnv(path, keep_initial_states=True, **config))
            assert kept == play_and_close(DemandingEnv(path, **config))
        assert len(state_files()) == 2

    def test_drawn_values_have_states_of_their_own(self, folder):
        path = make_fmu(folder, "slow")
        gain = fmugym.Uniform(1.0, 2.0)
        rows = [
            play_and_close(DemandingEnv(path, gain=gain, keep_initial_states=kept))
            for kept in (True, True, False)
        ]
        assert rows[0] == rows[1] == rows[2]
        assert len(state_files()) == 1  # both episodes have the same seed

    def test_by_default_nothing_is_kept(self, folder):
        env = DemandingEnv(make_fmu(folder, "slow"))
        assert play_and_close(env) == EXPECTED
        assert state_files() == []


def make_vector(path, autoreset_mode="Disabled", max_episode_steps=None, **options):
    config = {"keep_initial_states": True, "max_episode_steps": max_episode_steps}
    return fmugym.FMUVectorEnv(
        lambda: DemandingEnv(path, **config),
        4,
        autoreset_mode=autoreset_mode,
        **options,
    )


class TestVector:
    @pytest.mark.parametrize("options", [{}, {"isolation": "process", "workers": 1}])
    def test_is_initialized_once_for_each_start(self, folder, options, initializations):
        path = make_fmu(folder, "slow")
        make_vector(path, **options).close()  # so that there is a verdict
        for file in state_files():
            file.unlink()
        for expected in (1, 0):
            initializations(0)
            envs = make_vector(path, **options)
            for _ in range(2):
                envs.reset(seed=0)
                for _ in range(3):
                    envs.step(np.full((4, 1), 0.5, np.float32))
                rows = [float(state[0]) for state in envs.get_attr("state")]
                assert rows == [EXPECTED[0][-1]] * 4
            envs.close()
            assert initializations(4) == expected
        assert len(state_files()) == 1

    def test_autoresets_restore_them(self, folder, initializations):
        path = make_fmu(folder, "slow")
        make_vector(path).close()
        initializations(0)
        envs = make_vector(path, max_episode_steps=2, autoreset_mode="NextStep")
        envs.reset(seed=0)
        for _ in range(7):
            envs.step(np.full((4, 1), 0.5, np.float32))
        envs.close()
        assert initializations(4) == 0


class TestTrial:
    @pytest.mark.parametrize(
        ("token", "grade", "reason"),
        [
            ("slow, serializes nothing", Grade.FAILS, "fails"),
            ("slow, crashes elsewhere", Grade.FAILS, "fails"),
            ("slow, refuses elsewhere", Grade.FAILS, "fails"),
            ("slow, differs elsewhere", Grade.TOLERANCE, "other results in the last digits"),
        ],
    )
    def test_finds_states_that_do_not_work(self, folder, caplog, token, grade, reason):
        path = make_fmu(folder, token)
        for _ in range(2):
            env = DemandingEnv(path, keep_initial_states=True)
            assert play_and_close(env) == EXPECTED
        assert state_files() == []
        assert known_verdict(fmugym.FMU(path)).states is grade
        assert overview(fmugym.FMU(path))["trial"]["initial_state"] == str(grade)
        assert "no initial state is kept" in caplog.text
        assert reason in caplog.text

    @pytest.mark.parametrize(
        ("config", "reason"),
        [
            ({"probe_timeout": None}, "no trial has shown"),
            ({"reset_method": "reset"}, "begin by the method 'reset'"),
        ],
    )
    def test_is_needed(self, folder, caplog, config, reason):
        env = DemandingEnv(make_fmu(folder, "slow"), keep_initial_states=True, **config)
        assert play_and_close(env) == EXPECTED
        assert state_files() == []
        assert reason in caplog.text

    def test_says_if_the_fmu_offers_no_serialization(self, tmp_path, caplog):
        path = make_fmu(tmp_path, "fine", flags="")
        play_and_close(DemandingEnv(path, keep_initial_states=True))
        assert "does not offer to serialize its state" in caplog.text

    @pytest.mark.parametrize("version", ["2.0", "3.0"])
    def test_of_sound_fmus(self, tmp_path, version):
        """The bundled ones, as if somebody else had made them."""
        path = edited_fmu(fmugym.bundled_fmu("CartPole", version), tmp_path, add={"extra": ""})
        outputs = ["x", "x_dot", "theta", "theta_dot"]

        class CartPole(fmugym.FMUEnv):
            def __init__(self, **config):
                names = {"model_input_names": "f", "model_output_names": outputs}
                super().__init__(path, names | {"bounds": {"f": (-1, 1)}} | config)

            def _is_done(self):
                return abs(self.out["x"]) > 1e9

        rows = [
            play_and_close(CartPole(keep_initial_states=kept, time_step=0.02))
            for kept in (True, True, False)
        ]
        assert rows[0] == rows[1] == rows[2]
        assert len(state_files()) == 1


class TestFiles:
    STATE = InitialState(np.array([1.0, 2.0]).tobytes(), b"state")

    @pytest.fixture
    def files(self, tmp_path):
        return StateFiles(str(tmp_path / "kept" / "fmu"), 2)

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
        files = StateFiles(str(tmp_path / "file" / "fmu"), 2)
        files.keep("a", self.STATE)
        assert files.find("a") is None

    def test_of_an_environment_that_are_damaged(self, folder):
        path = make_fmu(folder, "slow")
        play_and_close(DemandingEnv(path, keep_initial_states=True))
        (file,) = state_files()
        file.write_bytes(file.read_bytes()[:-3])
        assert play_and_close(DemandingEnv(path, keep_initial_states=True)) == EXPECTED
        (file,) = state_files()
        file.unlink()
        os.mkfifo(file)
        assert play_and_close(DemandingEnv(path, keep_initial_states=True)) == EXPECTED


def test_odd_values_are_refused():
    for value in (1, "yes", None):
        with pytest.raises(fmugym.ConfigError, match="keep_initial_states must be True or False"):
            fmugym.EnvConfig(("u",), ("y",), keep_initial_states=value)
