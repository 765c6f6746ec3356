"""Exported agents of a search, beside the originals: controllers and networks with a memory."""

import shutil
import sys
from dataclasses import replace

import gymnasium
import numpy as np
import pytest
from combinations import in_turn
from export_tools import compiled, drawn_in, exported
from fmpy.validation import validate_fmu
from system_tools import linear_fmu
from test_export import HEATING, PRESENT, TASKS, Shifted
from test_export_fmu import controller_of, sampling

import fmugym
from fmugym import ConfigError, bundled_fmu
from fmugym.control import LQR, PID, Hysteresis, Random
from fmugym.control import controller_of as controller_from
from fmugym.control.controller_table import table_in
from fmugym.control.linearization import linearize
from fmugym.deployment.export import agent_of, write_c, write_fmu
from fmugym.training.search.policy import ResidualAgent, ResidualPolicy

UNSCALED = np.array([[0.0], [1.0]])
LINEAR = ResidualAgent("by hand", None, 1, 1)  # each task replaces the sizes
HISTORY = ResidualAgent("by hand", None, 1, 1, history=True)
PAIR = {
    "variables": HEATING["variables"] | {"gains": {"name": "Q_int", "min": 0, "max": 500}},
    "agent": PRESENT | {"actions": ["u", "gains"]},
}
HEAT = "pid of=T setpoint=21 kp=0.1 ti=7200 td=300"
CASCADE = (
    '{ gains = "pid of=T setpoint=wish kp=-30 ti=200000", u = "schedule 02:00=0.3 03:00=0.9", '
    'wish = { controller = "pid of=T setpoint=21 kp=0.5 ti=20000 offset=15", min = 5, max = 24 } }'
)
SWITCH = "hysteresis of=T setpoint=21 band=0.3 below=0.8 above=0.2"
HEATERS = {
    "a controller": (TASKS["set point"], "pid of=T setpoint=T_set kp=0.3 ti=20000 td=60", None),
    "a controller and a history": (TASKS["history"], HEAT, HISTORY),
    "forecasts": (TASKS["forecast"], HEAT, LINEAR),
    "a switch": ({"agent": PRESENT}, SWITCH, LINEAR),
    "a change": (TASKS["change"], HEAT, HISTORY),
    "a rate": (TASKS["rate"], None, HISTORY),
    "levels": (TASKS["levels"], HEAT, LINEAR),
    "memory": (TASKS["memory"], None, ResidualAgent("by hand", None, 1, 1, hidden=8)),
    "a schedule": ({"agent": PRESENT}, "schedule 00:30=0.7 05:00=0.2 07:00=1", HISTORY),
    "a table": (PAIR, CASCADE, None),
    "a table and a history": (PAIR, CASCADE, HISTORY),
    "two actions": (PAIR, None, ResidualAgent("by hand", None, 1, 1, hidden=16, history=True)),
}  # fmt: skip


def heater(task):
    variables = HEATING["variables"] | task.get("variables", {})
    return fmugym.load(HEATING | task | {"variables": variables}, physical=True)


def agent_for(env, text, form, seed=0):
    """An agent with random weights, which sees values around those at the beginning."""
    known, rng = ResidualPolicy(None).bind(env), np.random.default_rng(seed)
    if form is None:
        return ResidualAgent("by hand", text)
    form = replace(form, observed=form.observed and len(known.names), acting=known.acting)
    values = gymnasium.spaces.flatten(env.observation_space, env.reset(seed=seed)[0])
    count = form.features
    mean = np.concatenate([values, 0 * values, values, np.zeros(form.acting)])[:count]
    scale = (
        np.stack([mean + rng.normal(size=count), rng.uniform(0.5, 2, count)]) if count else UNSCALED
    )
    weights = rng.normal(size=form.size) / 2
    return replace(
        form,
        text=text,
        weights=weights,
        scale=scale,
        names=known.names,
        actions=str(env.action_space),
    )


def played(env, agent, step, steps=300, seed=1):
    """Play an episode, and ask the exported agent beside the original.

    Args:
        env, agent: The originals.
        step: Takes the measurements, and gives the actions of the exported agent.

    Returns:
        The inputs of the plant that both want, shape (2, steps, m).
    """
    logic, policy = agent_of(env, agent).logic, agent.policy().bind(env)
    written = [env.interface.inputs.index(one) for one in logic.inputs]
    observation, _ = env.reset(seed=seed)
    rows, is_over = [], False
    while not is_over and len(rows) < steps:
        actions = step([env.out[one.name] for one in logic.measurements])
        observation, _, terminated, truncated, _ = env.step(policy.act(observation))
        rows.append([actions, np.array(env.inputs)[written]])
        is_over = terminated or truncated
    return np.moveaxis(np.array(rows), 1, 0)


def require_same(both, different=8):
    own, wanted = both
    assert len(np.unique(wanted.round(6))) >= different
    np.testing.assert_allclose(own, wanted, rtol=1e-9, atol=1e-12)


BALANCED = {
    "fmu": {"bundled": "Pendulum"},
    "time_step": "20ms",
    "episode_length": "5s",
    "parameters": {"q_0": "pi", "theta_0": 0.05},
    "variables": {"tau": {"min": -0.05, "max": 0.05}},
    "agent": {"actions": ["tau"], "observations": ["theta", "theta_dot"]},
    "reward": 1,
}
CONTROLLERS = {
    "PID": lambda: PID("theta", 0.0, kp=np.array([-0.02]), ti=3.0, td=0.1, offset=0.001),
    "PID of expressions": lambda: PID(
        "sin(theta)", "theta_dot / 9 if theta > 0 else max(0, theta)", -0.03, ti=1.0
    ),
    "hysteresis": lambda: Hysteresis("theta", 0.0, 0.5, below=0.04, above=-0.02),
    "hysteresis of expressions": lambda: Hysteresis("theta", "theta_dot / 3", 0.5, 0.04, -0.02),
    "LQR": lambda: LQR(linearize(bundled_fmu("Pendulum"), at={"q_0": np.pi}), [1, 0.1], [90]),
}


TABLES = {
    "loops": {"u1": "pid of=y1 setpoint=0.3 kp=2 ti=1", "u2": "hysteresis of=y2 setpoint=0 band=1"},
    "constants": {"u1": 0.25, "u2": -1},
    "a schedule": {"u1": "schedule 00:00=0.1 00:01=0.3", "u2": "pid of=y2 setpoint=y1 kp=-3"},
    "a cascade": {
        "u2": "pid of=y2 setpoint=b kp=-0.6 ti=5 td=0.1",
        "b": {"controller": "pid of=y1 setpoint=a+y2/9 kp=1 ti=1 offset=0.1", "min": -2, "max": 2},
        "a": {"controller": "pid of=y2 setpoint=0.5 kp=1 ti=3", "min": -1, "max": 1.5},
        "u1": "pid of=a+b setpoint=y1 kp=0.4 ti=2",
    },
}


class Agents:
    """The exported agent, beside its Python policy in an episode."""

    tolerance = 0.0

    @pytest.mark.parametrize("name", CONTROLLERS)
    def test_of_controllers(self, name, tmp_path, load):
        if name == "LQR":
            pytest.importorskip("scipy", reason="needs the extra 'identification'")
        env = load(BALANCED, physical=True)
        controller = CONTROLLERS[name]()
        agent = agent_of(env, controller)
        made = exported(agent, tmp_path, self.language)
        made.begin()
        controller.bind(env)
        places = [env.observation_names.index(one.name) for one in agent.logic.measurements]
        wanted, found = [], []
        for row in np.random.default_rng(0).normal(size=(200, 2)):
            wanted.append(controller.act(row.astype(np.float32)).tolist())
            found.append([*made.step(row[places])])
        assert len(np.unique(wanted)) >= (2 if "hysteresis" in name else 50)
        assert found == pytest.approx(np.array(wanted), abs=self.tolerance)

    @pytest.mark.parametrize("name", TABLES)
    def test_of_tables(self, name, tmp_path, load):
        """Long enough for signals and actions to be at their limits, and not to be there."""
        document = BALANCED | {
            "fmu": str(linear_fmu(tmp_path / "linear.fmu")),
            "parameters": {},
            "variables": {n: {"min": -1, "max": 1} for n in ("u1", "u2")},
            "agent": {"actions": ["u1", "u2"], "observations": ["y1", "y2"]},
        }
        env = load(document, physical=True)
        agent = agent_of(env, controller_from(TABLES[name]))
        made, controller = exported(agent, tmp_path, self.language), controller_from(TABLES[name])
        places = [env.observation_names.index(one.name) for one in agent.logic.measurements]
        waves = np.sin(np.arange(400)[:, None] / [17.0, 31.0])
        rows = 0.4 * waves + np.random.default_rng(0).normal(size=(400, 2)) / 10
        for _ in range(2):
            made.begin()
            controller.bind(env)
            wanted = [controller.act(row).tolist() for row in rows.astype(np.float32)]
            found = [[*made.step(row[places])] for row in rows.astype(np.float32).astype(float)]
            assert np.array(found) == pytest.approx(np.array(wanted), abs=self.tolerance)
        assert len(np.unique(wanted)) >= (2 if name == "constants" else 50)
        if name == "a cascade":
            assert 20 < np.count_nonzero(np.abs(wanted) == 1) < 700

    @pytest.mark.parametrize("task", HEATERS)
    def test_of_task_files(self, task, tmp_path):
        document, text, form = HEATERS[task]
        env = heater(document)
        agent = agent_for(env, text, form)
        made = agent_of(env, agent)
        controller = exported(made, tmp_path, self.language)
        env.reset(seed=1)
        controller.begin(**drawn_in(env, made.logic))
        both = played(env, agent, controller.step)
        assert both.shape[1] == 192
        require_same(both, different=2 if task == "levels" else 8)
        env.close()

    @pytest.mark.parametrize(
        ("text", "form"),
        [
            (None, HISTORY),
            (None, ResidualAgent("by hand", None, 1, 1, hidden=8)),
            ("pid of=phi setpoint=0 kp=-8 td=0.1 offset=0.5", None),
            ("pid of=phi setpoint=0 kp=-8 td=0.1 offset=0.5", HISTORY),
        ],
    )
    def test_of_choices(self, text, form, tmp_path):
        env = gymnasium.make("fmugym/CartPole-v0").unwrapped
        agent = agent_for(env, text, form)
        made = agent_of(env, agent)
        controller = exported(made, tmp_path, self.language)
        controller.begin()
        policy, rows = agent.policy().bind(env), np.random.default_rng(0).normal(size=(200, 4))
        chosen = [policy.act(row) for row in rows.astype(np.float32)]
        seen = rows[:, [env.interface.outputs.index(v) for v in made.logic.measurements]]
        assert 5 < np.sum(chosen) < 195
        assert [controller.step(row) for row in seen] == [[-10.0 + 20.0 * one] for one in chosen]
        env.close()

    @pytest.mark.parametrize(
        ("text", "form"),
        [
            (None, None),
            (None, ResidualAgent("by hand", None, 0, 1)),
            ("pid of=T setpoint=21 kp=0.001", ResidualAgent("by hand", None, 0, 1)),
        ],
    )
    def test_of_a_constant(self, text, form, tmp_path):
        env = heater({"agent": PRESENT})
        agent = agent_for(env, text, form)
        made = agent_of(env, agent)
        assert made.network is None
        assert [one.name for one in made.logic.measurements] == ["T_op"] * (text is not None)
        controller = exported(made, tmp_path, self.language)
        controller.begin()
        require_same(played(env, agent, controller.step), different=1)
        env.close()

    def test_a_second_episode_begins_as_the_first_one(self, tmp_path):
        env = heater(TASKS["history"])
        agent = agent_for(env, HEAT, HISTORY)
        controller = exported(agent_of(env, agent), tmp_path, self.language)
        runs = []
        for _ in range(2):
            controller.begin()
            runs.append(played(env, agent, controller.step))
        assert np.array_equal(*runs)
        require_same(runs[1])
        env.close()


class TestInC(Agents):
    language = "C99"

    def test_of_several_choices(self, tmp_path):
        env = Shifted()
        agent = agent_for(env, None, HISTORY)
        env.reset(seed=1)
        controller = compiled(agent_of(env, agent), tmp_path, "C++")
        controller.begin(goal=env.variables["goal"])
        require_same(played(env, agent, controller.step), different=3)
        env.close()

    def test_of_a_controller_in_python(self, tmp_path):
        env, texts = heater({"agent": PRESENT}), []
        policy, other = (ResidualAgent("by hand", HEAT).policy().bind(env) for _ in range(2))
        for one in (policy, other):
            one.act(np.array([20.0, 1.0]))
        for model in (policy, controller_from(HEAT), ResidualAgent("by hand", HEAT)):
            folder = tmp_path / str(len(texts))
            folder.mkdir()
            texts.append(write_c(agent_of(env, model), folder)[1].read_text())
        assert texts[0] == texts[1] == texts[2]
        for measured in (20.5, 20.2):  # it goes on as if nothing had been written
            seen = np.array([measured, 1.0])
            assert policy.act(seen).tolist() == other.act(seen).tolist()
        env.close()


@pytest.mark.skipif(sys.platform == "win32" or not shutil.which("cc"), reason="needs a C compiler")
@in_turn({"version": ["2.0", "3.0"], "task": ["a controller", "a controller and a history"]})
def test_as_an_fmu(version, task, tmp_path):
    document, text, form = HEATERS[task]
    env = heater(document)
    agent = agent_for(env, text, form)
    exported = agent_of(env, agent)
    path = write_fmu(exported, tmp_path / "heater.fmu", fmi_version=version)
    assert validate_fmu(str(path)) == []
    env.reset(seed=1)
    with controller_of(path, tmp_path) as controller:
        controller.begin(**drawn_in(env, exported.logic))
        require_same(played(env, agent, sampling(controller, exported.logic)))
    env.close()


class TestRefused:
    def test_what_has_no_formulas(self):
        env = heater({"agent": PRESENT})
        with pytest.raises(ConfigError, match=r"Random.*PID"):
            agent_of(env, Random())
        env.close()

    def test_a_task_in_the_form_for_agents(self, load):
        env = load(HEATING | {"agent": PRESENT})
        with pytest.raises(ConfigError, match=r"physical"):
            agent_of(env, ResidualAgent("by hand", HEAT))

    def test_another_task(self):
        env, other = heater({"agent": PRESENT}), heater(TASKS["forecast"])
        agent = agent_for(other, HEAT, HISTORY)
        with pytest.raises(ConfigError, match=r"another task.*price\[\+"):
            agent_of(env, agent)
        env.close()
        other.close()


def test_a_controller_by_the_command_line(tmp_path, ran, refused):
    """By its name in the task file, in which another one has ranges."""
    task = tmp_path / "task.toml"
    controllers = {
        "half": 0.5,
        "wide": "pid of=T setpoint=21 kp=0.1..1",
        "cascade": table_in(CASCADE),
    }
    fmugym.Task.from_dict(HEATING | PAIR | {"controllers": controllers}).write(task)
    given = "export", "--task", task, "--controller"
    said = ran(*given, "cascade", "--output", tmp_path / "cascade.c")
    assert "measurement T_op K" in said
    assert "action Q_int" in said
    assert "range" in refused(*given, "wide", "--output", tmp_path / "wide.c")
    assert "AGENT" in refused("export", "--task", task, "--output", tmp_path / "none.c")


def test_by_the_command_line(tmp_path, ran, load):
    task = "examples/cart_pole.toml"
    env = load(task, physical=True)
    agent_for(env, "pid of=phi setpoint=0 kp=-100 td=0.1", HISTORY).save(tmp_path)
    said = ran("export", tmp_path, "--task", task, "--output", tmp_path / "agent.c")
    assert "measurement phi rad" in said
    assert "agent_controller[2]" in (tmp_path / "agent.h").read_text()
