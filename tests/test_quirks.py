"""FMUs that are useful but break a promise: every episode equals that of a fresh instance.

The reference is FMPy, making the same calls on a new instance of a new copy of the library.
"""

import functools
import os
import shutil
import subprocess
import sys

import fmpy
import numpy as np
import pytest
from fmpy.fmi2 import FMU2Slave
from fmu_tools import HERE, library_name, write_fmu

import fmugym
from fmugym.pool.spec import PoolSpec, ResetMethod
from fmugym.tools.cli import main
from fmugym.trial.inputs import moving_inputs, neighbour_inputs, start_inputs
from fmugym.trial.trial import Candidate, examine
from fmugym.trial.verdict import Grade, Neighbours, Verdict

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="its library is made for Linux")

OUTPUTS = {"y": 1, "clock": 4, "calls": 5}
XML = """<fmiModelDescription fmiVersion="2.0" modelName="Quirks" guid="{token}">
<CoSimulation modelIdentifier="Quirks" canGetAndSetFMUstate="true"
  canHandleVariableCommunicationStepSize="true"/>
<ModelVariables>
<ScalarVariable name="u" valueReference="0" causality="input">
<Real start="0" min="-1" max="1"/></ScalarVariable>
<ScalarVariable name="y" valueReference="1" causality="output"><Real/></ScalarVariable>
<ScalarVariable name="gain" valueReference="2" causality="parameter" variability="fixed">
<Real start="1"/></ScalarVariable>
<ScalarVariable name="tau" valueReference="3" causality="parameter" variability="fixed">
<Real start="0.5"/></ScalarVariable>
<ScalarVariable name="clock" valueReference="4" causality="output"><Real/></ScalarVariable>
<ScalarVariable name="calls" valueReference="5" causality="output"><Real/></ScalarVariable>
<ScalarVariable name="returns" valueReference="6" causality="output"><Real/></ScalarVariable>
</ModelVariables><ModelStructure/></fmiModelDescription>"""
STEP = 0.05
LENGTHS = (3, 12, 12, 5)

METHODS = {
    "well behaved": "restore",
    "restore forgets": "restore",  # found at the first restore, and given up
    "restore keeps the time": "restore",  # likewise
    "reset does nothing": "instance",
    "reset keeps the state": "instance",
    "reset keeps inputs": "restore",
    "reset keeps parameters": "restore",
    "reset keeps the time": "instance",
    "stops, reset keeps that": "instance",
    "second reset fails": "restore",
    "reset frees twice": "instance",
    "reset is not exact": "instance",
    "library keeps": "library",
}
"""The reset method that the trial finds."""


class QuirkEnv(fmugym.FMI2CSEnv):
    """Reads all outputs; the gain differs from episode to episode."""

    def __init__(self, path, gain=None, way=None, **config):
        gain = fmugym.Uniform(0.5, 2.0) if gain is None else gain
        config = {
            "model_input_names": "u",
            "model_output_names": list(OUTPUTS),
            "model_parameters": {"gain": gain, "tau": 0.3},
            "time_step": STEP,
        } | config
        super().__init__(path, config, backend=way)

    def _is_done(self):
        return self.out["y"] > 1e9


@functools.cache
def library(folder):
    path = folder / "Quirks.so"
    command = [sys.executable, "-m", "ziglang", "cc", "-shared", "-fPIC", "-O1", "-g0"]
    subprocess.run([*command, str(HERE / "quirks.c"), "-o", str(path)], check=True)
    return path.read_bytes()


@pytest.fixture(scope="module")
def make_fmu(tmp_path_factory):
    folder = tmp_path_factory.mktemp("quirks")

    @functools.cache
    def make(token):
        files = {
            "modelDescription.xml": XML.format(token=token),
            library_name(2, "Quirks"): library(folder),
        }
        return write_fmu(folder / token.replace(" ", "_") / "Quirks.fmu", files)

    return make


@pytest.fixture(autouse=True)
def trials(monkeypatch, tmp_path_factory):
    """Trials as users have them; the cache serves all tests of a session."""
    monkeypatch.delenv("FMUGYM_PROBE", raising=False)
    cache = os.path.join(tmp_path_factory.getbasetemp(), "quirk verdicts")
    monkeypatch.setenv("FMUGYM_CACHE_DIR", cache)


def inputs_of(length, index):
    """Inputs of one episode of one environment, within [-1, 1]."""
    return np.sin(0.9 * np.arange(length) + index).astype(np.float32)


def reference(path, gain, inputs):
    """Play an episode with FMPy on a fresh instance of a fresh copy of the library."""
    folder = fmpy.extract(str(path))
    description = fmpy.read_model_description(str(path))
    try:
        fmu = FMU2Slave(
            guid=description.guid,
            unzipDirectory=folder,
            modelIdentifier="Quirks",
            instanceName="reference",
        )
        fmu.instantiate()
        fmu.setupExperiment(startTime=0.0)
        fmu.setReal([2, 3], [gain, 0.3])
        fmu.enterInitializationMode()
        fmu.exitInitializationMode()
        rows = [fmu.getReal(list(OUTPUTS.values()))]
        for step, value in enumerate(inputs):
            fmu.setReal([0], [float(value)])
            try:
                fmu.doStep(step * STEP, STEP)
            except fmpy.fmi1.FMICallException:  # it asks to stop; its outputs are valid
                rows.append(fmu.getReal(list(OUTPUTS.values())))
                break
            rows.append(fmu.getReal(list(OUTPUTS.values())))
        fmu.terminate()
        fmu.freeInstance()
        return rows
    finally:
        shutil.rmtree(folder)


def play_single(env, length):
    """Play an episode; returns the gain and the outputs."""
    env.reset()
    rows = [list(env.state)]
    for value in inputs_of(length, 0):
        _, _, terminated, truncated, _ = env.step(np.array([value]))
        rows.append(list(env.state))
        if terminated or truncated:
            break
    return env.parameters["gain"], rows


@pytest.mark.parametrize("token", METHODS)
class TestEpisodes:
    def test_single(self, make_fmu, token):
        env = QuirkEnv(make_fmu(token))
        env.reset(seed=5)
        for length in LENGTHS:
            gain, rows = play_single(env, length)
            assert rows == reference(make_fmu(token), gain, inputs_of(length, 0))
        env.close()

    def test_single_with_the_same_start_values(self, make_fmu, token):
        env = QuirkEnv(make_fmu(token), gain=1.5)
        for length in LENGTHS:
            _, rows = play_single(env, length)
            assert rows == reference(make_fmu(token), 1.5, inputs_of(length, 0))
        env.close()

    @pytest.mark.parametrize("options", [{"threads": 1}, {"threads": 2}, {"isolation": "process"}])
    def test_vector(self, make_fmu, token, options):
        path = make_fmu(token)
        envs = fmugym.FMUVectorEnv(
            lambda: QuirkEnv(path), 3, autoreset_mode="Disabled", hooks="array", **options
        )
        envs.reset(seed=3)
        for length in LENGTHS:
            _, infos = envs.reset()
            gains = infos["drawn"]["gain"]
            actions = np.stack([inputs_of(length, index) for index in range(3)], axis=1)[..., None]
            expected = [reference(path, gains[i], actions[:, i, 0]) for i in range(3)]
            states = [np.array(envs.get_attr("state"))]
            for action in actions[: len(expected[0]) - 1]:
                envs.step(action)
                states.append(np.array(envs.get_attr("state")))
            for index in range(3):
                assert [list(state[index]) for state in states] == expected[index]
        envs.close()


@pytest.mark.parametrize(("token", "method"), METHODS.items())
def test_reset_method(make_fmu, token, method):
    env = QuirkEnv(make_fmu(token))
    assert env.reset_method == method
    env.close()


class TestNeighbours:
    """Several instances: right by default, whatever that takes."""

    @pytest.mark.parametrize(
        ("token", "need"),
        [
            ("well behaved", Neighbours.INDEPENDENT),
            ("globals", Neighbours.LIBRARIES),
            ("one in a process", Neighbours.LIBRARIES),
            ("strtok", Neighbours.ONE_INITIALIZATION),
        ],
    )
    def test_in_a_vector_environment(self, make_fmu, token, need):
        path = make_fmu(token)
        envs = fmugym.FMUVectorEnv(
            lambda: QuirkEnv(path), 4, autoreset_mode="Disabled", hooks="array", threads=None
        )
        for length in LENGTHS:
            _, infos = envs.reset(seed=length)
            actions = np.stack([inputs_of(length, i) for i in range(4)], axis=1)[..., None]
            for action in actions:
                envs.step(action)
            for index, state in enumerate(envs.get_attr("state")):
                gain = infos["drawn"]["gain"][index]
                assert list(state) == reference(path, gain, actions[:, index, 0])[-1]
        spec, starts = envs.get_attr("_spec")[0], envs.get_attr("_plan")[0].starts()
        envs.close()
        fmu = fmugym.FMU(path)
        verdict = examine(Candidate.of(fmu), spec, starts, several=True)
        assert verdict.neighbours is need

    def test_inputs_stay_within_their_limits(self, make_fmu):
        """An FMU may not bear others, and what follows is no sign of shared globals."""
        fmu = fmugym.FMU(make_fmu("well behaved"))
        u = fmu.variable("u")
        spec = PoolSpec((u,), (), STEP, input_limits=((-0.5, 0.25),))
        rows = [start_inputs(spec), neighbour_inputs(spec), *moving_inputs(spec, 50, 1.0)]
        assert np.min(rows) < -0.4
        assert np.max(rows) == 0.25
        assert np.all((np.array(rows) >= -0.5) & (np.array(rows) <= 0.25))


def test_an_fmu_that_overruns_its_memory_is_isolated(make_fmu, caplog):
    env = QuirkEnv(make_fmu("overruns"))
    assert "Quirks.fmu harms its process" in caplog.text
    for length in LENGTHS:
        gain, rows = play_single(env, length)
        assert rows == reference_of(make_fmu("well behaved"), gain, length)
    env.close()


def reference_of(path, gain, length):
    return reference(path, gain, inputs_of(length, 0))


def test_an_fmu_that_is_not_deterministic_is_told_apart(make_fmu, caplog):
    env = QuirkEnv(make_fmu("noise"))
    assert "gives other outputs each time, even if it begins afresh" in caplog.text
    env.close()


class TestConfig:
    def test_demands_a_method(self, make_fmu):
        env = QuirkEnv(make_fmu("well behaved"), reset_method="library")
        assert env.reset_method == "library"
        for length in LENGTHS:
            gain, rows = play_single(env, length)
            assert rows == reference_of(make_fmu("well behaved"), gain, length)
        env.close()

    def test_refuses_others(self, make_fmu):
        with pytest.raises(fmugym.ConfigError, match="did you mean 'restore'"):
            QuirkEnv(make_fmu("well behaved"), reset_method="restoer")


@pytest.mark.parametrize("backend", ["python", "native"])
class TestPromiseAboutStates:
    """FMI 2.0 tells an FMU in each step whether a state of an earlier time may be restored."""

    def returns(self, env):
        env.step(np.zeros(1, np.float32))
        return env.read_variables("returns")["returns"]

    def test_follows_the_reset_method(self, make_fmu, backend):
        for method, expected in (("reset", 0.0), ("restore", 1.0)):
            env = QuirkEnv(make_fmu("well behaved"), gain=1.0, reset_method=method, way=backend)
            for _ in range(3):
                env.reset()
                told = self.returns(env)
            assert told == expected
            env.close()

    def test_holds_from_the_first_snapshot_on(self, make_fmu, backend):
        env = QuirkEnv(make_fmu("well behaved"), reset_method="reset", way=backend)
        env.reset()
        assert self.returns(env) == 0.0
        snapshot = env._pool.save()
        assert self.returns(env) == 1.0
        env._pool.restore(snapshot)
        env.close()


class TestVerdict:
    def test_survives_its_text(self):
        verdict = Verdict(
            complete=True,
            deterministic=False,
            resets={ResetMethod.RESTORE: Grade.WRONG, ResetMethod.RESET: Grade.TOLERANCE},
            neighbours=Neighbours.ONE_THREAD,
            isolate=True,
            reasons=("in the first step it hung",),
        )
        assert Verdict.from_text(verdict.to_text()) == verdict
        assert verdict.reset_method is ResetMethod.RESET

    @pytest.mark.parametrize(
        "text",
        [
            *("", "true", "[]", "{}", "null", '{"format": 1}', "[" * 100_000, "\0", "NaN"),
            Verdict().to_text().replace("1", "2"),
            Verdict().to_text().replace("false", '"no"'),
        ],
    )
    def test_anything_else_is_none(self, text):
        assert Verdict.from_text(text) is None

    def test_a_damaged_cache_is_no_verdict(self, make_fmu, monkeypatch, tmp_path):
        monkeypatch.setenv("FMUGYM_CACHE_DIR", str(tmp_path))
        path = make_fmu("reset does nothing")
        QuirkEnv(path).close()
        verdicts = list(tmp_path.iterdir())
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


def test_info_tells_what_the_trial_has_shown(make_fmu, capsys):
    path = make_fmu("reset does nothing")
    QuirkEnv(path).close()
    assert main(["info", str(path)]) in (0, None)
    shown = capsys.readouterr().out
    assert "reset is wrong, instance is right to the last bit" in shown
    assert "episodes begin by 'instance'" in shown
