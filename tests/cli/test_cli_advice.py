"""The settings that ``fmugym validate`` recommends, for models whose needs are known."""

import math
import re
import sys
import tomllib
from dataclasses import replace
from functools import partial
from pathlib import Path

import exchange_tools
import foreign_lag
import numpy as np
import pytest
import zoo_tools
from gymnasium import spaces
from process_tools import run_python
from pythonfmu.builder import FmuBuilder

import fmugym
from fmugym.cli import advice as advice_tools
from fmugym.cli.accuracy import Replay, substeps_of
from fmugym.cli.advice import lines_of
from fmugym.cli.validation import validate
from fmugym.task import Task, load

LAG = {
    "time_step": 0.05,
    "episode_length": 5.0,
    "variables": {"u": {"min": -1, "max": 1}},
    "agent": {"actions": ["u"], "observations": ["x", "fast"]},
    "reward": "-abs(x)",
}


@pytest.fixture(scope="module")
def lag(tmp_path_factory):
    """The FMU of ``foreign_lag.py``: explicit Euler in communication steps."""
    return FmuBuilder.build_FMU(foreign_lag.__file__, tmp_path_factory.mktemp("lag"))


def advised(task):
    report = validate(partial(load, task))
    return {one.key: one.value for one in report.advices}, report


def lag_task(lag, rate, **more):
    return Task.from_dict(LAG | {"fmu": str(lag), "parameters": {"rate": rate}} | more)


def error_of_lag(task):
    """That of x in 50 steps, against the exponential, as a fraction of its variation."""
    env = load(task)
    env.action_space.seed(1)
    env.reset(seed=0)
    decay, x, found, exact = math.exp(-0.05), 0.0, [], []
    for _ in range(50):
        action = env.action_space.sample()
        found.append(float(env.step(action)[0][0]))
        x = decay * x + (1 - decay) * float(action[0])
        exact.append(x)
    env.close()
    return np.sqrt(np.mean(np.subtract(found, exact) ** 2)) / np.std(exact)


def test_substeps_of_a_lag_make_it_exact(lag):
    advice, report = advised(lag_task(lag, 1.0))
    assert 2 <= advice["substeps"] <= 16
    better = lag_task(lag, 1.0, substeps=advice["substeps"])
    assert error_of_lag(better) < 0.02 < error_of_lag(lag_task(lag, 1.0))
    again, _ = advised(better)
    assert "substeps" not in again
    assert report.recommended["substeps"] == advice["substeps"]


def test_a_stiff_one_gets_smaller_steps(lag):
    """Euler's method is stable from 0.05 s * 1000 / 2 substeps on."""
    advice, report = advised(lag_task(lag, 1000.0))
    assert 25 < advice["substeps"] <= 128
    assert not any(finding.check == "accuracy" for finding in report.findings)


def test_needless_substeps_are_told(lag, monkeypatch):
    """The clock counts substeps: a busy machine takes any time for a step."""

    def timed(replay):
        found = substeps_of(replay)
        return replace(found, seconds={count: 1e-5 * count for count in found.seconds})

    monkeypatch.setattr(advice_tools, "substeps_of", timed)
    advice, _ = advised(lag_task(lag, 1.0, substeps=512))
    assert 2 <= advice["substeps"] <= 16


def test_lines_can_be_written_into_the_file(lag, tmp_path, cli):
    path = tmp_path / "a.toml"
    lag_task(lag, 1000.0).write(path)
    code, out, _ = cli("validate", path)
    assert code in (0, 1)
    _, _, lines = out.partition("for the task file:\n")
    document = tomllib.loads(path.read_text())
    pasted = tomllib.loads(lines)
    assert pasted["substeps"] > 25
    Task.from_dict(document | pasted)
    (tmp_path / "b.toml").write_text(lines + path.read_text(), encoding="utf-8")
    load(tmp_path / "b.toml").close()


RESTING = {
    "fmu": {"bundled": "Pendulum"},
    "time_step": 0.05,
    "episode_length": "2s",
    "variables": {"tau": {"min": -0.1, "max": 0.1}},
    "agent": {"actions": ["tau"], "observations": ["theta"]},
    "parameters": {"m": {"distribution": "uniform", "low": 0.05, "high": 0.1}},
    "reward": "-(theta**2)",
}


def findings_of(task, check):
    _, report = advised(Task.from_dict(task))
    return [one for one in report.findings if one.check == check]


def test_a_parameter_has_an_effect_where_an_action_moves_the_process():
    """Upright, the pendulum stays without a torque, whatever its mass."""
    (found,) = findings_of(RESTING, "parameters")
    assert found.verdict == "ok"
    (found,) = findings_of(RESTING | {"parameters": {"v_c": 0.05}}, "parameters")
    assert "without an effect: v_c" in found.text


@pytest.mark.parametrize("reward", ["log(-1 - theta**2)", {"a": "1", "b": "0.5 / (tau - tau)"}])
def test_a_reward_that_is_no_number_is_to_be_changed(reward):
    """Nothing is told of what only follows from a first step that fails."""
    _, report = advised(Task.from_dict(RESTING | {"reward": reward}))
    (found,) = report.findings
    assert (found.check, found.verdict) == ("run", "error")
    assert ("time step" in found.cure, "division by 0" in found.cure) == (False, True)


class TestEpisodeLength:
    """The lag follows as 1 - exp(-t), so with a time constant of 1 s."""

    def length_of(self, task):
        advice, report = advised(task)
        reasons = [one.why for one in report.advices if one.key == "episode_length"]
        return advice.get("episode_length"), "".join(reasons)

    @pytest.mark.parametrize("length", [0.05, 0.5])
    def test_one_shorter_than_the_time_constant_becomes_longer(self, lag, length):
        agent = {"actions": ["u"], "observations": ["x"]}
        found, why = self.length_of(lag_task(lag, 1.0, episode_length=length, agent=agent))
        assert 2.4 <= found <= 3.6
        assert "x follows with a time constant of" in why
        assert found == pytest.approx(0.05 * round(found / 0.05))
        load(lag_task(lag, 1.0, episode_length=found, agent=agent)).close()

    def test_an_episode_that_ends_by_itself_stays(self, lag):
        """As a batch does, which is not longer for more time."""
        agent = {"actions": ["u"], "observations": ["x"]}
        end = {"terminated": "abs(x) > 0.01", "episode_length": 0.5}
        assert self.length_of(lag_task(lag, 1.0, agent=agent, **end)) == (None, "")

    def test_one_that_is_long_enough_stays(self, lag):
        assert self.length_of(lag_task(lag, 1.0)) == (None, "")

    def test_a_second_of_a_house_gets_longer_steps_too(self):
        """T_m follows by c_m A_f and the conductances of its walls and air, in a day or two."""
        house = Task.from_dict(
            {
                "fmu": {"bundled": "House"},
                "time_step": 0.002,
                "episode_length": 1.0,
                "agent": {"actions": ["u"], "observations": ["T_m"]},
                "reward": "-abs(T_m - 293)",
            }
        )
        advice, _ = advised(house)
        assert 1 <= advice["episode_length"] / 3 / 86400 <= 2
        assert 800 <= advice["episode_length"] / advice["time_step"] <= 2000
        top = {key: advice[key] for key in ("time_step", "episode_length")}
        load({**house.document, **top}).close()

    def test_what_does_not_settle_gives_none(self):
        cart = {
            "fmu": {"bundled": "CartPole"},
            "time_step": 0.05,
            "episode_length": 0.5,
            "variables": {"f": {"min": -10, "max": 10}},
            "agent": {"actions": ["f"], "observations": ["x"]},
            "reward": "-abs(x)",
        }
        assert self.length_of(Task.from_dict(cart)) == (None, "")

    def test_what_swings_for_long_gives_none(self):
        """It passes where it will rest in a quarter of its period of 0.63 s."""
        swinging = pendulum(time_step=0.05, episode_length=2.0, parameters={**HANGING, "b": 2e-5})
        assert self.length_of(swinging) == (None, "")

    def test_it_is_told_beside_another_time_step(self):
        """And among the findings, in which nothing says that the length is fine."""
        house = {
            "fmu": {"bundled": "House"},
            "time_step": 60000.0,
            "episode_length": 60000.0,
            "agent": {"actions": ["u"], "observations": ["T_m"]},
            "reward": "-abs(T_m - 293)",
        }
        advice, report = advised(Task.from_dict(house))
        assert advice["time_step"] < 60000 < advice["episode_length"]
        (found,) = [one for one in report.findings if one.check == "length"]
        assert found.verdict == "warning"
        assert f"episode_length = {advice['episode_length']}" in found.cure


@pytest.mark.parametrize("reward", ["-1e-6 * q**2", "-1 - 1e-11 * q**2", "2 + 1e-11 * q"])
def test_a_tiny_reward_beside_large_actions_gets_lines(reward, tmp_path, cli):
    """With them, rewards have the size of 1, and begin near 0."""
    variables = {"tau": {"min": -200, "max": 200}}
    task = pendulum(variables=variables, reward=reward, time_step=0.001, episode_length=0.05)
    task.write(tmp_path / "a.toml")
    code, out, _ = cli("validate", tmp_path / "a.toml")
    assert code in (0, 1)
    _, _, lines = out.partition("for the task file:\n")
    pasted = tomllib.loads(lines)
    assert pasted["agent"]["rescale"] is True
    env = load(Task.from_dict({**task.document, "reward": pasted["reward"]}))
    env.action_space.seed(0)
    env.reset(seed=0)
    rewards = [env.step(env.action_space.sample())[1] for _ in range(50)]
    env.close()
    assert 0.1 <= np.ptp(rewards) <= 10


def test_outputs_that_never_change_are_told(lag):
    _, report = advised(lag_task(lag, 0.0))
    (told,) = [one for one in report.findings if "never change" in one.text]
    assert (told.verdict, told.check) == ("warning", "observations")
    assert told.text.endswith(": fast")


@pytest.mark.parametrize(
    ("rate", "observed"),
    [
        (0.0, ["x"]),  # the reward alone reads fast
        (1.0, ["x", "change"]),  # 0 before the first step, and while an action is held
        ({"distribution": "uniform", "low": 0.5, "high": 1.0}, ["x", "rated"]),
    ],
)
def test_what_an_agent_needs_or_does_not_observe_is_not_told_to_be_left_out(lag, rate, observed):
    """What stays the same in an episode, and is drawn for each, tells which plant this is."""
    seen = {"agent": {"actions": ["u"], "observations": observed}, "reward": "-abs(x - fast)"}
    _, report = advised(lag_task(lag, rate, **seen))
    assert not [one.text for one in report.findings if "never change" in one.text]


@pytest.mark.parametrize(("limit", "expected"), [(200.0, True), (5.0, None), (0.001, True)])
def test_actions_of_another_size_than_algorithms_explore_are_rescaled(limit, expected):
    variables = {"tau": {"min": -limit, "max": limit}}
    assert advised(pendulum(variables=variables))[0].get("rescale") is expected


class Exchanged(fmugym.FMI2MEEnv):
    """A model of ``exchange`` without inputs."""

    def __init__(self, path, config):
        super().__init__(path, {"model_input_names": [], **config})

    def _get_action_space(self):
        return spaces.Discrete(2)

    def _get_inputs(self):
        return []

    def _is_done(self):
        return False


def of_model(folder, model, outputs, time_step, **config):
    path = folder / f"{model}.fmu"
    exchange_tools.exchange_fmu(path, model, 2)
    config = {"model_output_names": outputs, "time_step": time_step, **config}
    report = validate(lambda: Exchanged(path, config))
    return {one.key: one.value for one in report.advices}, report


class TestSolvers:
    @pytest.mark.parametrize(
        ("model", "outputs", "time_step", "parameters"),
        [
            ("prothero", ["x"], 0.1, {"k": 1e6}),
            ("van_der_pol", ["x1", "x2"], 10.0, {"mu": 1000.0}),
            ("robertson", ["y1", "y3"], 10.0, {}),
        ],
    )
    def test_stiff_models_get_one_for_stiff_models(
        self, model, outputs, time_step, parameters, tmp_path
    ):
        advice, report = of_model(tmp_path, model, outputs, time_step, model_parameters=parameters)
        assert advice["solver"] == "rosenbrock"
        tables = tomllib.loads("\n".join(lines_of(report.advices)))
        assert tables["config"]["solver"] == "rosenbrock"

    def test_a_method_whose_steps_are_too_long_is_replaced(self, tmp_path):
        config = {"solver": "euler", "max_step": 0.05}
        advice, report = of_model(tmp_path, "van_der_pol", ["x1", "x2"], 0.1, **config)
        assert advice["solver"] in ("dormand_prince", "rosenbrock")
        assert advice["tolerance"] <= 1e-3
        assert "%" in next(one.why for one in report.advices if one.key == "solver")

    def test_one_that_fails_is_replaced(self, tmp_path):
        config = {"solver": "rk4", "max_step": 0.1}
        advice, _ = of_model(tmp_path, "robertson", ["y1", "y3"], 10.0, **config)
        assert advice["solver"] == "rosenbrock"

    def test_one_that_is_fine_stays(self, tmp_path):
        advice, _ = of_model(tmp_path, "van_der_pol", ["x1", "x2"], 0.1, tolerance=1e-3)
        assert "solver" not in advice


HANGING = {"q_0": 0.0}


def pendulum(**more):
    variables = {"tau": {"min": -0.01, "max": 0.01}}
    agent = {"actions": ["tau"], "observations": ["q", "q_dot"]}
    fmu, reward = {"bundled": "Pendulum"}, "-abs(q)"
    given = {"fmu": fmu, "variables": variables, "agent": agent, "reward": reward}
    return Task.from_dict({"episode_length": 20.0, **given, **more})


class TestTimeStep:
    def test_an_oscillation_gets_ten_steps(self):
        """A pendulum of 0.1 m swings with 2 pi sqrt(l / g) = 0.634 s."""
        advice, report = advised(pendulum(time_step=0.5, parameters=HANGING))
        assert advice["time_step"] == 0.05
        why = next(one.why for one in report.advices if one.key == "time_step")
        assert "0.63" in why
        assert "time_step" not in advised(pendulum(time_step=0.05, parameters=HANGING))[0]

    def test_what_falls_needs_shorter_ones(self):
        """Upright, it leaves with the time constant sqrt(l / g) = 0.1 s, of which friction adds."""
        upright = {"q_0": math.pi}
        advice, _ = advised(pendulum(time_step=0.2, parameters=upright))
        assert advice["time_step"] == 0.02


@pytest.mark.skipif(sys.platform != "linux", reason="its library is made for Linux")
def test_failures_with_other_settings_are_not_told(tmp_path, caplog):
    """They are part of the search."""
    path = zoo_tools.zoo_fmu(tmp_path, 2)
    env = zoo_tools.ZooEnv(
        path, model_parameters=zoo_tools.parameters("status", "step", at=60, status=3)
    )
    replay = Replay.of(env)
    assert np.isnan(replay.run(substeps=4).outputs).any()
    assert caplog.text == ""
    env.close()


@pytest.mark.skipif(sys.platform != "linux", reason="its library is made for Linux")
@pytest.mark.parametrize("options", [[], ["--json"], ["-v"]])
def test_what_an_fmu_prints_is_not_in_the_output(tmp_path, options):
    """It prints whenever an instance is made, also while the process ends."""
    calls = zoo_tools.FAULTS.index("print"), zoo_tools.CALLS.index("instantiate")
    path = zoo_tools.zoo_fmu(tmp_path, 2, "{{zoo {} {} 0}}".format(*calls))
    done = run_python("-m", "fmugym", "validate", path, *options, cwd=tmp_path)
    assert done.returncode == 0
    printed = "a line of the zoo"
    assert printed not in done.stdout
    assert ("--json" in options) == done.stdout.startswith("{")
    assert (printed in done.stderr) == ("-v" in options)
    if "-v" in options:
        return
    told = re.fullmatch(r"fmugym: note: what FMUs .* is in (\S+); -v shows it\n", done.stderr)
    assert Path(told[1]).read_text().startswith(printed)
    Path(told[1]).unlink()


def test_nothing_is_told_and_no_file_stays_if_an_fmu_prints_nothing(tmp_path):
    command = "bench", "fmugym/CartPole-v0", "--seconds", "0.01"
    done = run_python("-m", "fmugym", *command, environment={"TMPDIR": str(tmp_path)})
    assert (done.returncode, done.stderr) == (0, "")
    assert list(tmp_path.iterdir()) == []
