"""What an FMU asks for in its own words: the error names the key that gives it."""

import pytest
from fmu_tools import PlainEnv, library_name, probe_config, probe_fmu, probe_library

import fmugym
from fmugym import FMU
from fmugym.cli.class_skeleton import Skeleton
from fmugym.cli.command_line import run_command_line
from fmugym.cli.task_proposal import Proposal
from fmugym.pool.failure_texts import as_messages, asked_for, quoted

NEEDED = "!stop_defined", "a stop time is needed"


def demanding(folder, version, condition, text, experiment=""):
    """The probe, which fails in its initialization under a condition, and says why."""
    library = probe_library(version, f"-DDEMANDS={condition}", f'-DDEMANDED="{text}"')
    edits = {"<ModelVariables>": f"{experiment}<ModelVariables>"} if experiment else None
    return probe_fmu(folder, version, edits, add={library_name(version): library})


@pytest.mark.parametrize("text", [
    "a stop time is needed",
    "StopTime must be defined",
    "stopTimeDefined has to be true",
    "The end time is missing.",
    "fmi2SetupExperiment: no stop time was given",
    "initialize: stop time not specified",
    "this model requires a finalTime",
])  # fmt: skip
def test_a_stop_time(text):
    assert asked_for(text) == "stop_time"


@pytest.mark.parametrize(("text", "key"), [
    ("toleranceDefined must be fmi2True", "tolerance"),
    ("A relative tolerance is required", "tolerance"),
    ("communicationStepSize must be a multiple of 0.01", "time_step"),
    ("the step size has to be 0.5 s", "time_step"),
    ("no communication step size given", "time_step"),
])  # fmt: skip
def test_other_kinds(text, key):
    assert asked_for(text) == key


@pytest.mark.parametrize("text", [
    "the stop time is reached",
    "time 10.1 must not exceed the stop time 10",
    "the tolerance was not reached",
    "a licence is needed",
    "the start value of x must be positive",
    "the valve is stuck",
    "dormand_prince needs more than 1000000 steps in a communication step",
    "",
])  # fmt: skip
def test_nothing_of_the_kind(text):
    assert asked_for(text) == ""


def test_all_that_is_asked_for_is_named_once():
    text = quoted(as_messages(["a stop time is needed", "stopTime missing", "tolerance missing"]))
    assert text.endswith("cure: set stop_time and tolerance in the config")
    assert "cure" not in quoted(as_messages(["the valve is stuck"]))


@pytest.mark.parametrize("backend", ["native", "fmpy"])
@pytest.mark.parametrize("version", [1, 2, 3])
def test_the_error_names_the_key(tmp_path, version, backend):
    path = demanding(tmp_path, version, *NEEDED)
    cure = pytest.raises(fmugym.SimulationError, match="is needed; cure: set stop_time")
    with PlainEnv(path, probe_config(), backend=backend) as env, cure:
        env.reset()
    with PlainEnv(path, probe_config(stop_time=1.0), backend=backend) as env:
        env.reset()


def test_a_tolerance(tmp_path):
    path = demanding(tmp_path, 2, "!tolerance_defined", "toleranceDefined must be true")
    cure = pytest.raises(fmugym.SimulationError, match="cure: set tolerance in the config")
    with PlainEnv(path, probe_config()) as env, cure:
        env.reset()
    with PlainEnv(path, probe_config(tolerance=1e-4)) as env:
        env.reset()


EXPERIMENT = '<DefaultExperiment startTime="0" stopTime="5" stepSize="0.1"/>'


@pytest.mark.usefixtures("trials")
def test_a_proposed_task_has_the_end_of_the_default_experiment(tmp_path):
    path = demanding(tmp_path, 2, *NEEDED, EXPERIMENT)
    file = tmp_path / "task.toml"
    file.write_text(Proposal(FMU(path), tmp_path).text())
    with fmugym.load(file) as env:
        assert env.config.stop_time == 5
        env.reset(seed=0)
        steps = 1
        while not env.step(env.action_space.sample())[3]:
            steps += 1
        assert steps == 50
    assert '"stop_time": 5.0' in Skeleton(FMU(path)).text()


def test_of_an_fmu_without_one(tmp_path):
    path = probe_fmu(tmp_path, 2)
    assert "stop_time" not in Proposal(FMU(path), tmp_path).text()
    assert "stop_time" not in Skeleton(FMU(path)).text()


@pytest.mark.usefixtures("trials")
def test_validation_offers_the_cure(tmp_path, capsys):
    path = demanding(tmp_path, 2, *NEEDED, EXPERIMENT)
    text = Proposal(FMU(path), tmp_path).text()
    file = tmp_path / "task.toml"
    file.write_text(text.replace("stop_time =", "# stop_time ="))
    assert run_command_line(["validate", str(file)]) > 0
    said = capsys.readouterr()
    assert "cure: set stop_time in the config" in said.out + said.err
    file.write_text(text)
    run_command_line(["validate", str(file)])
    said = capsys.readouterr()
    assert "stop_time in the config" not in said.out + said.err
