"""Command ``validate``: defects of tasks, and controllers that cannot act."""

from contextlib import closing

import numpy as np
import pytest
from command_tasks import TURN

import fmugym
from fmugym.cli import validation
from fmugym.cli.validation import validate
from fmugym.control import controller_of
from fmugym.records.players import policy_of, simulate

DEFECTS = {
    "useless action": (
        {
            "variables": {"idle": {"min": 0, "max": 1}} | TURN["variables"],
            "agent": {"actions": ["tau", "idle"], "observations": ["q"]},
        },
        ("warning", "actions", "element 1"),
    ),
    "an action that only the reward knows": (
        {
            "variables": {"fee": {"min": 0, "max": 1}} | TURN["variables"],
            "agent": {"actions": ["tau", "fee"], "observations": ["q"]},
            "reward": "-abs(q - 1) - fee",
        },
        ("warning", "actions", "no effect on observations: element 1"),
    ),
    "a reward that no action changes": (
        {"reward": "-abs(time - 1)"},
        ("warning", "reward", "the same in 50 steps, whatever the actions"),
    ),
    "a tiny reward": (
        {"reward": "-1e-7 * abs(q - 1)"},
        ("warning", "reward", "from -3"),
    ),
    "a reward that hardly differs": (
        {"reward": "-1 - 1e-11 * abs(q - 1)"},
        ("warning", "reward", "from -1 to -1 with random actions, a difference of"),
    ),
    "an end that pays": (
        {"terminated": "step == 20"},
        ("warning", "reward", "until the task ends: never positive"),
    ),
    "constant reward": ({"reward": 1}, ("warning", "reward", "always 1")),
    "no limit": ({"episode_length": None}, ("warning", "length", "no limit")),
    "outside": (
        {"variables": {"tau": {}, "q": {"min": 0, "max": 1e-3}}},
        ("warning", "observations", "q "),
    ),
    "sizes": (
        {
            "agent": {"actions": "tau", "observations": ["q", "big"]},
            "expressions": {"big": "1e5 * q"},
        },
        ("warning", "observations", "big reaches"),
    ),
    "useless parameter": (
        {"parameters": {"v_c": {"distribution": "uniform", "low": 0.1, "high": 0.2}, "c": 0}},
        ("warning", "parameters", "v_c"),
    ),
    "useless constant": (
        {"parameters": {"v_c": 0.1, "c": 0}},
        ("warning", "parameters", "v_c"),
    ),
    "idle inputs": (
        {
            "fmu": {"bundled": "DoublePendulum"},
            "variables": {"tau1": {"min": -0.01, "max": 0.01}},
            "agent": {"actions": ["tau1"], "observations": ["q1"]},
            "reward": "-abs(q1 - 1)",
        },
        ("warning", "inputs", "tau2"),
    ),
    "fault": ({"reward": "1 / (step - 3)"}, ("error", "run", "step 3")),
    "unknown to a controller": (
        {"agent": {"actions": ["tau"], "observations": ["q", "l"]}},
        ("warning", "export", "'l', which is no output"),
    ),
}


class TestValidate:
    @pytest.mark.parametrize(("change", "expected"), DEFECTS.values(), ids=DEFECTS)
    def test_defects_are_found_and_cured(self, change, expected):
        task = {key: value for key, value in (TURN | change).items() if value is not None}
        report = validate(lambda: fmugym.load(task))
        verdict, check, text = expected
        (finding,) = [one for one in report.findings if one.verdict != "ok"]
        assert (finding.verdict, finding.check) == (verdict, check)
        assert text in finding.text
        assert finding.cure
        assert report.verdict == verdict
        assert report.recommended.get("normalize", False) == ("big reaches" in text)

    @pytest.mark.parametrize("normalize", [False, True])
    def test_figures_are_in_the_units_of_the_task(self, normalize):
        variables = {"tau": {"min": -0.01, "max": 0.01}, "q": {"unit": "deg", "min": 1, "max": 5}}
        task = TURN | {"variables": variables, "agent": TURN["agent"] | {"normalize": normalize}}
        (finding,) = [one for one in validate(lambda: fmugym.load(task)).findings if one.cure]
        assert "limits: q (-" in finding.text
        assert "to 180.1 deg)" in finding.text

    def test_a_sound_task(self):
        report = validate(lambda: fmugym.load(TURN))
        assert report.verdict == "ok"
        assert report.hooks == "expressions"
        (export,) = [one.text for one in report.findings if one.check == "export"]
        assert "can be exported; it measures q" in export
        assert 0 < report.costs["step"] < 1
        assert 0 < report.costs["reset"] < 1
        assert 0 < report.costs["restore"] < 1
        assert report.recommended["envs"] in (8, 16, 64)
        assert report.recommended["reset_method"] == report.reset_method

    def test_an_error_gives_the_exit_code(self, tmp_path, cli):
        fmugym.Task.from_dict(TURN | {"reward": "1 / (step - 3)"}).write(tmp_path / "a.toml")
        code, out, _ = cli("validate", tmp_path / "a.toml")
        assert code == 1
        assert "error    run: step 3" in out

    def test_an_fmu_an_id_and_a_class(self, ran):
        targets = fmugym.bundled_fmu("CartPole"), "fmugym/CartPole-v0", "fmugym.envs:CartPoleEnv"
        for target in targets:
            out = ran("validate", target)
            assert "hooks in a vector environment: " in out
            assert "vector environment: one by one" not in out
            assert ("length: an episode takes at most 500 steps" in out) is (target == targets[1])


TEXT = """
fmu = {{ bundled = "Pendulum" }}
time_step = "0.1s"
episode_length = "1s"
reward = "-abs(q)"
[variables]
tau = {{ min = -1, max = 1 }}
q = {{ min = -9, max = 9 }}
[setpoints]
goal = 0.5
[controllers]
one = {one}
two = "pid of=q setpoint=goal kp=0.1"
[agent]
actions = {actions}
observations = ["q", "q_dot", "goal"]
"""


def write(folder, one, actions='["tau"]', end=""):
    file = folder / "task.toml"
    file.write_text(TEXT.format(one=one, actions=actions) + end)
    return file


RIGHT = {
    "a name": '"pid of=q setpoint=goal kp=0.1"',
    "a number": "0.25",
    "an expression": """"pid of='q - goal' setpoint=0 kp=0.1\"""",
    "an expression as a set point": '"pid of=q setpoint=goal+0.1*q_dot kp=0.1"',
    "a constant": '"hysteresis of=q setpoint=pi/2 band=0.1"',
    "a range": '"pid of=q setpoint=goal kp=0.1..1"',
    "a plan": '''"mpc horizon=0.5s warm='pid of=q setpoint=goal kp=1'"''',
}
WRONG = {
    "a name": ('"pid of=T setpoint=goal kp=0.1"', ("'T'", "'q'")),
    "a set point": ('"pid of=q setpoint=gaol kp=0.1"', ("'gaol'", "'goal'")),
    "an expression": (""""pid of='q - T' setpoint=0 kp=0.1\"""", ("'T'", "column 5")),
    "a number": ("3.5", ("3.5", "Box")),
    "a range": ('"pid of=T setpoint=goal kp=0.1..1"', ("'T'",)),
    "a plan": ('''"mpc horizon=0.5s warm='pid of=T setpoint=goal kp=1'"''', ("'T'",)),
}


def findings_of(file):
    report = validate(lambda: fmugym.load(file))
    return [one for one in report.findings if one.check == "controllers"]


@pytest.mark.parametrize("one", RIGHT.values(), ids=RIGHT)
def test_right_ones(one, tmp_path):
    (finding,) = findings_of(write(tmp_path, one))
    assert finding.verdict == "ok"
    assert "one, two" in finding.text


@pytest.mark.parametrize(("one", "facts"), WRONG.values(), ids=WRONG)
def test_wrong_ones(one, facts, tmp_path):
    (finding,) = findings_of(write(tmp_path, one))
    assert finding.verdict == "error"
    assert finding.text.startswith("task.toml, line 12, controllers.one: ")
    for fact in facts:
        assert fact in finding.text


def test_the_command_line_fails(tmp_path, cli):
    code, out, _ = cli("validate", write(tmp_path, WRONG["a name"][0]))
    assert code == 1
    assert "task.toml, line 12, controllers.one" in out


def test_of_two_actions(tmp_path):
    """Each gives one action; one that acts in the warm-up only acts on one of them."""
    more = '\n[inputs]\ntau = "tau_1 + tau_2"\n'
    text = TEXT.replace(
        "tau = {{ min = -1, max = 1 }}",
        "tau_1 = {{ min = -1, max = 1 }}\ntau_2 = {{ min = -1, max = 1 }}",
    )
    file = tmp_path / "task.toml"
    one, actions = '"pid of=q_ddot setpoint=0 kp=1"', '["tau_1", "tau_2"]'
    warm = 'warm_up = { period = "0.2s", controller = { tau_1 = "one" } }\n'
    file.write_text(warm + text.format(one=one.replace("q_ddot", "theta"), actions=actions) + more)
    wrong, rest = findings_of(file)
    assert (wrong.verdict, rest.verdict) == ("error", "warning")
    for fact in ("controllers.two", "one number", "Box"):
        assert fact in wrong.text
    assert "tau_1, tau_2" in rest.text


TABLES = {
    "both": ('{ tau_1 = "two", tau_2 = "pid of=q setpoint=0 kp=0.1..1" }', ""),
    "one": ('{ tau_1 = "two", tau_2 = 0.5 }', "tau_2"),
    "a cascade": (
        '{ tau_1 = "pid of=q_dot setpoint=rate kp=1", tau_2 = "two", rate = { controller = '
        '"pid of=q setpoint=0 kp=1..2", min = -1, max = 1 } }',
        "",
    ),
    "none": ("{ tau_1 = 0.5, tau_2 = 0 }", "tau_1, tau_2"),
}


@pytest.mark.parametrize(("one", "rest"), TABLES.values(), ids=TABLES)
def test_the_actions_that_none_moves(one, rest, tmp_path):
    """A controller that is part of a table need not give all actions; any other one must."""
    more = '\n[inputs]\ntau = "tau_1 + tau_2"\n'
    text = TEXT.replace(
        "tau = {{ min = -1, max = 1 }}",
        "tau_1 = {{ min = -1, max = 1 }}\ntau_2 = {{ min = -1, max = 1 }}",
    )
    file = tmp_path / "task.toml"
    file.write_text(text.format(one=one, actions='["tau_1", "tau_2"]') + more)
    first, *others = findings_of(file)
    assert first.verdict == ("ok" if '"two"' in one else "error")
    assert ("tunes one with" in first.text) == (".." in one)
    assert [other.text.partition(";")[0].endswith(f"moves {rest}") for other in others] == [True][
        : bool(rest)
    ]


def test_an_expression_measures_what_its_names_do(tmp_path):
    file = write(tmp_path, "0")
    texts = "pid of='q - goal' setpoint=0 kp=0.3", "pid of=q setpoint=goal kp=0.3"
    with closing(fmugym.load(file, physical=True)) as env:
        found = [simulate(env, policy_of(env, text), 0, 10) for text in texts]
        assert found[0] == found[1]
        assert found[0].total_reward != simulate(env, policy_of(env, "one"), 0, 10).total_reward
    with closing(fmugym.FMUVectorEnv(lambda: fmugym.load(file, physical=True), 3)) as envs:
        observations, _ = envs.reset(seed=0)
        actions = [controller_of(text).bind(envs).act(observations) for text in texts]
        np.testing.assert_array_equal(*actions)
        assert np.unique(actions[0]).size


def test_in_a_warm_up(tmp_path):
    texts = "pid of='q - goal' setpoint=0 kp=0.3", "pid of=q setpoint=goal kp=0.3"
    seen = []
    for text in texts:
        end = f'[warm_up]\nperiod = "0.5s"\ncontroller = "{text}"\n'
        with closing(fmugym.load(write(tmp_path, "0", end=end))) as env:
            seen.append(env.reset(seed=0)[0].tolist())
    assert seen[0] == seen[1]
    assert seen[0][0] != 0
    end = "[warm_up]\nperiod = 1\ncontroller = \"pid of='q - T' setpoint=0 kp=1\"\n"
    with pytest.raises(fmugym.TaskError, match=r"line 19, warm_up.controller: unknown name 'T'"):
        fmugym.load(write(tmp_path, "0", end=end))


def test_an_error_of_a_forecast_is_not_outside_of_its_limits(tmp_path):
    end = """
[agent.forecast]
of = ["price"]
horizon = "0.5s"
error = 2.0
[data]
price = { values = [0.0, 1.0], step = "1s", period = "2s", min = 0, max = 1 }
"""
    report = validate(lambda: fmugym.load(write(tmp_path, "0", end=end)))
    assert not [one for one in report.findings if "price" in one.text and "outside" in one.text]
    end = end.replace("max = 1", "max = 0.5").replace("error = 2.0", "")
    report = validate(lambda: fmugym.load(write(tmp_path, "0", end=end)))
    (finding,) = [one for one in report.findings if "outside" in one.text]
    assert "price[+" in finding.text


def test_a_reward_that_is_no_number_is_told_by_the_exit_status(tmp_path, cli):
    file = write(tmp_path, "0")
    assert cli("simulate", file, "--action", "0")[0] == 0
    file.write_text(file.read_text().replace('"-abs(q)"', '"sqrt(0.3 - elapsed)"'))
    code, out, _ = cli("simulate", file, "--action", "0")
    assert code == 1
    assert "the reward" in out
    code, out, _ = cli("simulate", file, "--action", "0", "--steps", 2)
    assert code == 0


SYSTEM = """
time_step = "0.1s"
episode_length = "1s"
reward = "-abs(q)"
variables.tau = { name = "swing.tau", min = -1, max = 1 }
variables.q = { name = "swing.q", min = -9, max = 9 }
controllers.one = "pid of=q setpoint=0 kp=0.1"
agent = { actions = ["tau"], observations = ["q"] }
"""


@pytest.mark.parametrize("master", [None, "jacobi"])
def test_a_system_is_stepped_by_the_master_of_the_command_line(tmp_path, cli, monkeypatch, master):
    """Also where the controllers are checked."""
    fmu, file, masters = fmugym.bundled_fmu("Pendulum"), tmp_path / "task.toml", []
    file.write_text(f"system.components.swing = {str(fmu)!r}\n{SYSTEM}")

    def loaded(*arguments, **options):
        env = fmugym.load(*arguments, **options)
        masters.append(env.fmu.plan.master)
        return env

    monkeypatch.setattr(validation, "load", loaded)
    code, out, _ = cli("validate", file, *(("--master", master) if master else ()))
    assert code == 0, out
    assert masters == [master or "gauss_seidel"]
