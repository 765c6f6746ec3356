"""FMUs that are useful but break a promise: every episode equals that of a fresh instance.

The reference is FMPy, making the same calls on a new instance of a new copy of the library. The
table is in quirk_table.py and in tests/zoo/README.md.
"""

import contextlib
import functools
import logging
import os
import shutil
import sys
from dataclasses import replace
from pathlib import Path

import fresh
import gymnasium as gym
import numpy as np
import pytest
import quirk_table
from combinations import in_turn
from fmu_tools import grouped
from quirk_table import OUTPUTS, QUIRKS
from ways import in_way

import fmugym
from fmugym.environment.env_checker import check_fmu_env
from fmugym.errors import ContractError
from fmugym.pool.native_pool import NativePool
from fmugym.pool.pool_spec import PoolSpec, ResetMethod
from fmugym.pool.trial.trial import examine
from fmugym.pool.trial.trial_episodes import Inputs
from fmugym.pool.trial.verdict import Grade, Neighbours, Verdict, known_verdict

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="its library is made for Linux")

DOCUMENT = Path(__file__).parents[2] / "zoo" / "README.md"
STEP = 0.05
LENGTHS = (3, 12, 12, 5)
NUM_ENVS = 3
WAYS = {"default": {}, "one": {"threads": 1}, "two": {"threads": 2}}
WAYS["process"] = {"isolation": "process"}
CASES = [(version, quirk) for quirk in QUIRKS for version in quirk.versions]
ONCE = [(quirk.versions[i % len(quirk.versions)], quirk) for i, quirk in enumerate(QUIRKS)]
cases = pytest.mark.parametrize(("version", "quirk"), CASES, ids=str)


class QuirkEnv(fmugym.FMUEnv):
    """Reads all outputs; the gain differs from episode to episode."""

    def __init__(self, path, gain=None, **config):
        gain = fmugym.Uniform(0.5, 2.0) if gain is None else gain
        config = {
            "model_input_names": "u",
            "model_output_names": OUTPUTS,
            "model_parameters": {"gain": gain, "tau": 0.3},
            "time_step": STEP,
        } | config
        super().__init__(path, grouped(config))

    def _is_done(self):
        return self.out["y"] > 1e9


@pytest.fixture(scope="module")
def make_fmu(tmp_path_factory):
    return quirk_table.making_quirks(tmp_path_factory.mktemp("quirks"))


@pytest.fixture(autouse=True)
def elsewhere(trials, monkeypatch, tmp_path):
    """One of the FMUs changes the working directory."""
    monkeypatch.chdir(tmp_path)


def inputs_of(length, index=0):
    """Inputs of one episode of one environment, within [-1, 1]."""
    return np.sin(0.9 * np.arange(length) + index).astype(np.float32)


@functools.cache
def reference(path, gain, length, index=0):
    """The outputs of an episode as FMPy plays it."""
    rows = [{"u": value} for value in inputs_of(length, index)]
    return fresh.play(path, OUTPUTS, rows, STEP, {"gain": gain, "tau": 0.3})


def assert_right(env, path):
    """Play episodes, each of which must equal that of a fresh instance; then close."""
    for length in LENGTHS:
        env.reset()
        rows = fresh.episode(env, inputs_of(length)[:, None])
        assert rows == reference(path, env.parameters["gain"], length)
    env.close()


def make_vector(path, quirk, gain=None, **options):
    return fmugym.FMUVectorEnv(
        in_way("arrays", lambda: QuirkEnv(path, gain, **config_of(quirk))),
        NUM_ENVS,
        autoreset_mode="Disabled",
        **options,
    )


def assert_vector_right(envs, path, gains=None):
    """The same for a vector environment, by default with the gains that are drawn."""
    for length in LENGTHS:
        _, infos = envs.reset()
        now = infos["drawn"]["gain"] if gains is None else gains
        expected = [reference(path, now[i], length, i) for i in range(NUM_ENVS)]
        actions = np.stack([inputs_of(length, i) for i in range(NUM_ENVS)], axis=1)
        assert fresh.episodes(envs, actions[:, :, None]) == expected
    envs.close()


def config_of(quirk):
    return {"probe_timeout": quirk.probe_timeout, "max_episode_steps": quirk.length}


class TestEpisodes:
    @cases
    def test_single(self, make_fmu, version, quirk):
        path = make_fmu(quirk.token, version)
        env = QuirkEnv(path, **config_of(quirk))
        assert env.reset_method in quirk.methods_of(version)
        env.reset(seed=5)
        assert_right(env, make_fmu(quirk.equal or quirk.token, version))

    @in_turn({"version,quirk": ONCE})
    def test_with_the_same_start_values(self, make_fmu, version, quirk):
        """So that states are restored."""
        path = make_fmu(quirk.token, version)
        env = QuirkEnv(path, gain=1.5, **config_of(quirk))
        assert_right(env, make_fmu(quirk.equal or quirk.token, version))

    @in_turn({"version,quirk": ONCE, "way": ["one", "two"]})
    def test_vector(self, make_fmu, version, quirk, way):
        path = make_fmu(quirk.token, version)
        envs = make_vector(path, quirk, **WAYS[way])
        envs.reset(seed=3)
        assert_vector_right(envs, make_fmu(quirk.equal or quirk.token, version))

    @in_turn({"version,quirk": ONCE, "way": ["default", "process"]})
    def test_vector_with_the_same_start_values(self, make_fmu, version, quirk, way):
        """Each environment has its own, in all episodes."""
        path, gains = make_fmu(quirk.token, version), [0.5, 1.0, 2.0]
        envs = make_vector(path, quirk, gain=1.0, **WAYS[way])
        envs.set_attr("gain", gains)
        assert_vector_right(envs, make_fmu(quirk.equal or quirk.token, version), gains)


@pytest.fixture
def make_new(make_fmu, tmp_path):
    """Make FMUs in a folder of their own, of which the log has not told yet."""
    return lambda *quirk: Path(shutil.copy(make_fmu(*quirk), tmp_path))


@cases
def test_verdict(make_new, version, quirk, caplog):
    """What several instances need, and what the log tells."""
    path = make_new(quirk.token, version)
    envs = make_vector(path, quirk)
    env = envs.prototype
    spec, starts = env.pool_spec, env.episode_start.starts()
    envs.close()
    fmu = fmugym.FMU(path, probe_timeout=quirk.probe_timeout)
    verdict = examine(
        fmu, spec, starts, num_instances=NUM_ENVS, length=quirk.length, must_survive=False
    )
    assert verdict.neighbours == quirk.neighbours
    warnings = [r.getMessage() for r in caplog.records if r.levelname == "WARNING"]
    assert quirk.log in " ".join(warnings)
    assert bool(warnings) == bool(quirk.log)


def test_outputs_before_the_first_step_are_start_values(make_fmu):
    """In each episode, restored ones included; the model description may give other ones than 0."""
    fmu = fmugym.FMU(make_fmu("no reading before a step"))
    outputs = [replace(fmu.variable(name), start=start) for name, start in START_OUTPUTS.items()]
    spec = PoolSpec((fmu.variable("u"),), tuple(outputs), STEP, blind_start=True)
    spec = replace(spec, reset_method=ResetMethod.RESTORE)
    pool = NativePool(fmu, spec, 2, logging.getLogger())
    for _ in range(4):
        outputs, statuses = pool.reset((), np.zeros((0, 2)))
        assert outputs.tolist() == [[0.75, 0.75], [0.0, 0.0]]
        outputs, statuses = pool.step(np.ones((1, 2)))
        assert outputs[1].tolist() == [1.0, 1.0]
        assert not statuses.any()
    pool.close()


START_OUTPUTS = {"y": "0.75", "calls": None}


def test_without_a_trial_a_reset_says_what_cannot_be_read(make_fmu):
    env = QuirkEnv(make_fmu("no reading before a step"), probe_timeout=None)
    with pytest.raises(fmugym.SimulationError, match="reading the outputs returned Error"):
        env.reset()
    env.close()


@pytest.mark.parametrize("isolation", ["none", "process"])
def test_reading_what_can_only_be_written(make_fmu, isolation):
    """The message names it; the FMU then needs a reset, as the standard says."""
    env = QuirkEnv(make_fmu("no reading of inputs"), gain=1.5, isolation=isolation)
    env.reset()
    env.step(np.array([0.5], np.float32))
    first = env.read_variables("gain", "y")
    with pytest.raises(fmugym.SimulationError, match=r"reading u, gain returned Error"):
        env.read_variables("u", "gain")
    assert env.step(np.array([0.5], np.float32))[3]
    env.reset()
    env.step(np.array([0.5], np.float32))
    assert env.read_variables("gain", "y") == first
    env.close()


@pytest.mark.parametrize("version", [1, 2, 3])
def test_the_trial_names_outputs_that_cannot_be_read(make_fmu, version, caplog):
    path = make_fmu("no reading of calls", version)
    for _ in range(2):  # the second time from the cache
        caplog.clear()
        env = QuirkEnv(path)
        assert "Quirks.fmu: its trial could not read the output(s) calls" in caplog.text
        with pytest.raises(fmugym.SimulationError, match="reading the outputs returned Error"):
            env.reset()
        env.close()
    caplog.clear()
    env = QuirkEnv(path, model_output_names=["y", "clock"])
    env.reset()
    env.step(np.array([0.5], np.float32))
    env.close()
    assert "could not read" not in caplog.text


class HiddenEnv(QuirkEnv):
    """Observes the output only, rounded."""

    def _get_observation(self):
        return np.array([self.out["y"] + 20.0], np.float32)

    def _get_observation_space(self):
        return gym.spaces.Box(-100.0, 100.0, (1,), np.float32)


BAD_RESETS = [
    (version, quirk)
    for version, quirk in CASES
    if quirk.method == "instance"
    and quirk.token not in ("second episode hangs", "reset frees twice", "long memory")
]


@in_turn({"version,quirk": BAD_RESETS, "gain": [1.5, fmugym.Uniform(0.5, 2.0)]})
def test_the_check_finds_bad_resets(make_fmu, version, quirk, gain):
    """Also where the observation hides them, or where the parameters never change."""
    path = make_fmu(quirk.token, version)
    env = HiddenEnv(path, gain, reset_method="reset", probe_timeout=None, max_episode_steps=30)
    with contextlib.closing(env), pytest.raises(ContractError, match="reset does not restore"):
        check_fmu_env(env)


@pytest.mark.parametrize("version", [1, 2, 3])
def test_the_check_accepts_good_resets(make_fmu, version):
    env = HiddenEnv(make_fmu("well behaved", version), max_episode_steps=30)
    with contextlib.closing(env):
        check_fmu_env(env)


def test_the_document_has_this_table():
    assert quirk_table.markdown() in DOCUMENT.read_text(), "quirk_table.py prints it"


def test_inputs_stay_within_their_limits(make_fmu):
    """An FMU may fail beyond them, and such a failure is no sign of shared globals."""
    fmu = fmugym.FMU(make_fmu("well behaved"))
    spec = PoolSpec((replace(fmu.variable("u"), bounds=(-0.5, 0.25)),), (), STEP)
    rows = Inputs(spec, 1.0).until(50)
    assert np.min(rows) < -0.4
    assert 0.24 < np.max(rows) <= 0.25
    assert np.all((np.array(rows) >= -0.5) & (np.array(rows) <= 0.25))


def test_an_fmu_that_is_not_deterministic_is_told_apart(make_new, caplog):
    env = QuirkEnv(make_new("noise"))
    assert "gives other values of y each time, even if it begins afresh" in caplog.text
    env.close()


def test_an_output_that_tells_the_processors_time_is_no_reason_for_processes(make_new, caplog):
    path = make_new("tells its time")
    make_vector(path, quirk_table.Quirk("tells its time", "")).close()
    assert "gives other values of calls each time" in caplog.text
    assert "disturb each other" not in caplog.text
    verdict = known_verdict(fmugym.FMU(path))
    assert verdict.noisy == ("calls",)
    assert verdict.neighbours is Neighbours.INDEPENDENT
    assert verdict.reset_method is ResetMethod.RESTORE


def test_many_environments_warn_once(make_new, caplog):
    """A training makes environments again and again, for its evaluations."""
    path = make_new("reset does nothing")
    for _ in range(3):
        QuirkEnv(path).close()
    warnings = [record for record in caplog.records if record.levelname == "WARNING"]
    assert len(warnings) == 1
    assert quirk_table.BAD_RESET in warnings[0].getMessage()


class TestConfig:
    def test_demands_a_method(self, make_fmu):
        path = make_fmu("well behaved")
        env = QuirkEnv(path, reset_method="library")
        assert env.reset_method == "library"
        assert_right(env, path)

    def test_refuses_others(self, make_fmu):
        with pytest.raises(fmugym.ConfigError, match="did you mean 'restore'"):
            QuirkEnv(make_fmu("well behaved"), reset_method="restoer")


class TestPromiseAboutStates:
    """FMI 2.0 tells an FMU in each step whether a state of an earlier time may be restored."""

    def returns(self, env):
        env.step(np.zeros(1, np.float32))
        return env.read_variables("returns")["returns"]

    def test_follows_the_reset_method(self, make_fmu):
        for method, expected in (("reset", 0.0), ("restore", 1.0)):
            env = QuirkEnv(make_fmu("well behaved"), gain=1.0, reset_method=method)
            for _ in range(3):
                env.reset()
                told = self.returns(env)
            assert told == expected
            env.close()

    def test_holds_from_the_first_snapshot_on(self, make_fmu):
        env = QuirkEnv(make_fmu("well behaved"), reset_method="reset")
        env.reset()
        assert self.returns(env) == 0.0
        snapshot = env.pool.save()
        assert self.returns(env) == 1.0
        env.pool.restore(snapshot)
        env.close()


class TestVerdict:
    def test_survives_its_text(self):
        verdict = Verdict(
            complete=True,
            noisy=("y",),
            resets={ResetMethod.RESTORE: Grade.WRONG, ResetMethod.RESET: Grade.TOLERANCE},
            neighbours=Neighbours.ONE_THREAD,
            harm="in the first step it hung",
            findings=("in the first step it hung",),
        )
        assert Verdict.from_text(verdict.to_text()) == verdict
        assert verdict.reset_method is ResetMethod.RESET

    @pytest.mark.parametrize(
        "text",
        [
            *("", "true", "[]", "{}", "null", '{"format": 1}', "[" * 100_000, "\0", "NaN"),
            Verdict().to_text().replace('"format": ', '"format": 1'),
            Verdict().to_text().replace("false", '"no"'),
        ],
    )
    def test_anything_else_is_none(self, text):
        assert Verdict.from_text(text) is None

    def test_a_damaged_cache_is_no_verdict(self, make_fmu, monkeypatch, tmp_path):
        monkeypatch.setenv("FMUGYM_CACHE_DIR", str(tmp_path))
        path = make_fmu("reset does nothing")
        QuirkEnv(path).close()
        verdicts = [file for file in tmp_path.iterdir() if file.is_file()]
        assert len(verdicts) == 2
        for damage in (
            lambda file: file.write_text("yes"),
            lambda file: file.write_bytes(b"\xff" * 5_000_000),
            lambda file: (file.unlink(), os.mkfifo(file)),
            lambda file: (file.unlink(), file.symlink_to("/dev/zero")),
            lambda file: (file.unlink(), file.mkdir()),
        ):
            for file in verdicts:
                damage(file)
            env = QuirkEnv(path)
            assert env.reset_method == "instance"
            env.close()


def test_info_tells_what_the_trial_has_shown(make_fmu, cli):
    path = make_fmu("reset does nothing")
    QuirkEnv(path).close()
    code, shown, _ = cli("info", path)
    assert code in (0, None)
    assert "reset is wrong, instance is right to the last bit" in shown
    assert "episodes begin by 'instance'" in shown


def test_the_working_directory_comes_back(make_fmu, tmp_path):
    """The folder that the FMU has made the working directory is removed with the environment."""
    env = QuirkEnv(make_fmu("changes directory"))
    env.reset()
    assert os.getcwd() != str(tmp_path)
    env.close()
    assert os.getcwd() == str(tmp_path)
