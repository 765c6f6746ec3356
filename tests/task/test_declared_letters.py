"""Names whose letters only look the same: the micro sign, ligatures, umlauts of a Mac."""

import unicodedata
from contextlib import closing

import numpy as np
import pytest
from letters import GREEK, MICRO, wide, with_names

import fmugym
from fmugym import ConfigError, TaskError
from fmugym.checks import Spellings
from fmugym.records.players import policy_of

NAMES = {
    "micro": MICRO,
    "ohm": "R_\u2126",
    "kelvin": "T_\u212a",
    "ligature": "e\ufb03ciency",
    "decomposed": unicodedata.normalize("NFD", "Gr\u00f6\u00dfe"),
    "greek": GREEK,
    "composed": "Gr\u00f6\u00dfe",
}
FORMS = ("NFC", "NFD", "NFKC", "NFKD")


def task(fmu, name, **changes):
    return {
        "fmu": str(fmu),
        "time_step": 0.02,
        "variables": {"tau": {"min": -0.01, "max": 0.01}},
        "parameters": {"q_0": 0.3},
        "agent": {"actions": "tau", "observations": name},
        "reward": f"-abs({name})",
        **changes,
    }


def angle_and_reward(config):
    with closing(fmugym.load(config)) as env:
        observation, _ = env.reset(seed=0)
        _, reward, *_ = env.step(env.action_space.low * 0)
        return observation[0], reward


@pytest.mark.parametrize("name", NAMES.values(), ids=NAMES)
def test_a_variable_is_found_by_all_of_its_forms(name, tmp_path):
    fmu = with_names(tmp_path, q=name)
    found = [angle_and_reward(task(fmu, unicodedata.normalize(form, name))) for form in FORMS]
    found.append(angle_and_reward(task(fmu, name)))
    expected = pytest.approx(np.float32(0.3)), found[0][1]
    assert found == [expected] * 5
    assert expected[1] < 0


@pytest.mark.parametrize(("declared", "used"), [(MICRO, GREEK), (GREEK, MICRO)])
def test_names_of_a_task(declared, used):
    """Each section declares a name, and each place uses it in other letters."""
    config = {
        "fmu": {"bundled": "Pendulum"},
        "time_step": 0.1,
        "variables": {
            f"q{declared}": {"name": "q", "min": -4, "max": 4},
            f"t{declared}": {"name": "tau", "min": -1, "max": 1},
        },
        "memory": {f"m{declared}": {"start": 1, "update": f"m{used} + 1"}},
        "data": {f"d{declared}": {"values": [1, 2], "step": 1}},
        "setpoints": {f"s{declared}": {"value": 1, "of": f"q{used}"}},
        "expressions": {f"e{declared}": f"q{used} + m{used} + d{used} + s{used}_error"},
        "agent": {
            "actions": [f"t{used}"],
            "observations": [f"q{used}", f"e{used}", f"s{used}_error"],
            "forecast": {"of": [f"d{used}"], "horizon": "0.2s"},
            "history": {"of": [f"q{used}"], "length": "0.1s"},
        },
        "warm_up": {
            "period": "0.2s",
            "controller": {f"t{used}": f"pid of=q{used} setpoint=s{used} kp=1"},
        },
        "reward": {f"r{declared}": f"-abs(e{used}) - previous(q{used})"},
        "kpis": {f"k{declared}": {"sum": f"r{used}"}},
        "terminated": f"m{used} > 3",
    }
    with closing(fmugym.load(config)) as env:
        env.reset(seed=0)
        ends = [env.step(env.action_space.sample()) for _ in range(3)]
        assert [end[2] for end in ends] == [False, False, True]
        assert env.observation_names[0] == f"q{declared}"


def test_controllers_and_globs(tmp_path, ran):
    file = tmp_path / "task.toml"
    fmugym.Task.from_dict(
        task(fmugym.bundled_fmu("Pendulum"), MICRO)
        | {"variables": {MICRO: {"name": "q"}, "tau": {"min": -1, "max": 1}}}
    ).write(file)
    controller = f"pid of={GREEK} setpoint=1 kp=1"
    output = tmp_path / "run.csv"
    told = ran(
        *("simulate", file, "--controller", controller, "--steps", 3),
        *("--output", output, "--variables", f"{GREEK[0]}*"),
    )
    assert "3 steps" in told
    assert MICRO in output.read_text(encoding="utf-8").splitlines()[0]


class Angle(fmugym.FMUEnv):
    def _is_done(self):
        return False

    def _reward_policy(self):
        return -abs(self.out[GREEK]) + self.variables[GREEK] * self.parameters[GREEK + "0"]


def test_a_class(tmp_path):
    fmu = with_names(tmp_path, q=MICRO, q_0=MICRO + "0")
    config = {
        "model_input_names": "tau",
        "bounds": {"tau": (-1, 1)},
        "model_output_names": [GREEK],
        "samplings": {MICRO: "mean"},
        "model_parameters": {GREEK + "0": 0.3},
        "episode_variables": {MICRO: 2.0},
        "time_step": 0.02,
    }
    with closing(Angle(fmu, config)) as env:
        observation, _ = env.reset(seed=0, options={"model_parameters": {GREEK + "0": 0.25}})
        assert observation[0] == np.float32(0.25)
        _, reward, *_ = env.step(np.float32([0.0]))
        assert reward == pytest.approx(0.25, abs=0.05)
        assert env.read_variables(GREEK)[MICRO] == pytest.approx(0.25, abs=0.01)


def test_of_two_names_the_exact_one_counts(tmp_path):
    fmu = with_names(tmp_path, q=MICRO, q_dot=GREEK)
    angle, reward = angle_and_reward(task(fmu, MICRO))
    assert angle == np.float32(0.3)
    assert reward == pytest.approx(-0.3, abs=0.01)
    speed, reward = angle_and_reward(task(fmu, GREEK))
    assert speed == 0
    assert reward != pytest.approx(-0.3, abs=0.1)


def test_what_may_be_either_is_refused(tmp_path):
    names = "\u212a\u00b5", "\u212a\u03bc"
    fmu = with_names(tmp_path, q=names[0], q_dot=names[1])
    with pytest.raises(ConfigError) as caught:
        fmugym.load(task(fmu, "K\u03bc"))
    assert str(caught.value).startswith("agent.observations: ")
    for fact in (*map(ascii, names), ascii("K\u03bc"), "look the same"):
        assert fact in str(caught.value)

    config = task(fmu, "theta", reward="-K\u03bc")
    with pytest.raises(TaskError, match=r"^reward: .*look the same"):
        fmugym.load(config)


@pytest.mark.parametrize(("declared", "used"), [(MICRO, GREEK), (GREEK, MICRO)])
def test_scenarios(declared, used):
    changes = {"episode_length": "10s", "scenarios": {declared: {"start": "10d", "length": "2d"}}}
    config = task(fmugym.bundled_fmu("Pendulum"), "q", **changes)
    with closing(fmugym.load({**config, "clock": "5d"}, scenario=used)) as env:
        assert env.config.episode_variables["clock"] == 10 * 86400
    season = {"from": "01-09", "to": "01-14", "step": "1d", "exclude": [used]}
    with closing(fmugym.load({**config, "clock": season})) as env:
        drawn = {env.reset(seed=seed)[1]["drawn"]["clock"] / 86400 for seed in range(20)}
        assert drawn == {8.0, 9.0, 12.0, 13.0}


def test_columns(tmp_path):
    file = tmp_path / "data.csv"
    file.write_text(f"time,{MICRO}\n0,1\n1,2\n", encoding="utf-8")
    config = task(
        fmugym.bundled_fmu("Pendulum"),
        "q",
        clock="0s",
        data={"d": {"file": str(file), "time": "time", "column": GREEK}},
        reward="d",
    )
    assert angle_and_reward(config)[1] == pytest.approx(1, abs=0.1)
    file.write_text(f"time,{MICRO}K,{GREEK}K\n0,1,2\n1,2,3\n", encoding="utf-8")
    config["data"]["d"]["column"] = f"{MICRO}\u212a"
    with pytest.raises(TaskError, match=r"data.d.column: .*look the same"):
        fmugym.load(config)


def test_tables_of_a_file(tmp_path):
    file = tmp_path / "tables.txt"
    file.write_text("#1\ndouble winter(2,2)\n0 5\n9 5\ndouble summer(2,2)\n0 7\n9 7\n")
    config = task(
        fmugym.bundled_fmu("Pendulum"),
        "q",
        clock="0s",
        data={"d": {"file": str(file), "table": wide("summer"), "column": 2}},
        reward="d",
    )
    assert angle_and_reward(config)[1] == 7
    config["data"]["d"]["table"] = wide("sumer")
    with pytest.raises(TaskError, match=r"data.d.table: unknown table .*'summer'"):
        fmugym.load(config)


@pytest.mark.parametrize(("declared", "used"), [(MICRO, GREEK), (GREEK, MICRO)])
def test_controllers_of_a_task(declared, used):
    changes = {
        "controllers": {declared: "hysteresis of=q setpoint=2 band=0.1"},
        "variables": {"tau": {"min": -1, "max": 1}},
        "warm_up": {"period": "0.1s", "controller": {"tau": used}},
    }
    config = task(fmugym.bundled_fmu("Pendulum"), "q", **changes)
    with closing(fmugym.load(config, physical=True)) as env:
        policy = policy_of(env, used)
        policy.begin()
        assert policy.act(env.reset(seed=0)[0]) == 1.0
        with pytest.raises(ConfigError, match="unknown controller of the task"):
            policy_of(env, used + "s")


@pytest.mark.parametrize("other", [MICRO, GREEK])
def test_a_name_is_given_once(other):
    config = task(fmugym.bundled_fmu("Pendulum"), "q", memory={MICRO: 1})
    with pytest.raises(TaskError, match="given twice, also at memory"):
        fmugym.load({**config, "data": {other: {"values": [1], "step": 1}}})


def test_a_key_of_toml_needs_no_quotes(tmp_path, load):
    """TOML 1.0 asks for them; what is written has them."""
    file, other = tmp_path / "task.toml", tmp_path / "other.toml"
    file.write_bytes(
        """\
fmu = { bundled = "Pendulum" }  # \u00b5 is the angle
time_step = 0.05
reward = { R_\u03a9 = "-abs(\u03bc)", "\u00fc" = "-abs(ku\u0308hl)" }
[variables.\u00b5]
name = "theta"
[variables]
ku\u0308hl = { name = "theta_dot" }
\u0442\u043e\u043a = { name = "tau", min = -1, max = 1 }
[agent]
actions = "\u0442\u043e\u043a"
observations = ["\u00b5", "k\u00fchl"]
""".replace("\n", "\r\n").encode()
    )
    env = load(file)
    env.reset(seed=0)
    *_, info = env.step(env.action_space.high)
    assert {*info["reward_terms"]} == {"R_\u03a9", "\u00fc"}
    fmugym.Task.read(file).write(other)
    assert '"\u0442\u043e\u043a" = ' in other.read_text(encoding="utf-8")
    assert fmugym.Task.read(other) == fmugym.Task.read(file)


@pytest.mark.parametrize(
    "text", ["a = \u00b5", "a = 1\u00b5", "a = 1 \u00b5 = 2", "a \u00b5", "[a\u00b5"]
)
def test_other_mistakes_stay_mistakes(text, tmp_path):
    file = tmp_path / "task.toml"
    file.write_text(text, encoding="utf-8")
    with pytest.raises(
        ConfigError, match=r"task\.toml is no TOML file: .*(line 1|end of document)"
    ):
        fmugym.load(file)


def test_spellings():
    found = Spellings("name", dict.fromkeys(["a", MICRO, "e\ufb03ciency"]))
    assert [found.find(n) for n in ("a", GREEK, "efficiency", "b", 3)] == [
        *("a", MICRO, "e\ufb03ciency", None, None),
    ]
