"""The tasks that ``fmugym new`` proposes: what they guess, and that they can be learned."""

import json
import zipfile

import pytest
import ssp_tools
import test_cli_inspection
from fmu_tools import probe_fmu
from makers import MADE
from test_cli_inspection import INPUT, OUTPUT, variable

import fmugym
from fmugym.cli.task_proposal import Proposal
from fmugym.fmi.bundled import MODELS

make_fmu = test_cli_inspection.make_fmu


def proposed(ran, fmu):
    """The task and the notes."""
    told = json.loads(ran("new", fmu, "--json"))
    return told["task"], "\n".join(told["notes"])


@pytest.fixture
def new(ran):
    return lambda fmu: proposed(ran, fmu)


def trained(folder, ran, fmu):
    """The facts of the agent that a newcomer gets by two commands."""
    path, agent = folder / "task.toml", folder / "agent"
    ran("new", fmu, "--output", path)
    options = "--rounds", "30", "--episodes", "2"
    ran("train", path, "--output", agent, *options)
    return json.loads((agent / "agent.json").read_text())


@pytest.mark.parametrize("maker", MADE)
def test_foreign_fmus_train_without_editing(maker, tmp_path, ran):
    (tmp_path / "made").mkdir()
    facts = trained(tmp_path, ran, MADE[maker].build(tmp_path / "made"))
    assert facts["rounds"] == 30


@pytest.mark.parametrize("version", [1, 2, 3])
def test_types_of_every_kind_train_without_editing(version, tmp_path, ran):
    assert trained(tmp_path, ran, probe_fmu(tmp_path, version))["rounds"] == 30


@pytest.mark.parametrize("model", MODELS)
def test_bundled_fmus_train_without_editing(model, tmp_path, ran):
    assert trained(tmp_path, ran, fmugym.bundled_fmu(model))["rounds"] == 30


def test_weather_and_people_are_no_actions(new):
    task, notes = new(fmugym.bundled_fmu("House"))
    assert task["agent"]["actions"] == ["u"]
    assert all(f"input {name!r} looks like" in notes for name in ("T_out", "I_sol", "Q_int"))


def test_an_output_follows_a_set_point_that_the_agent_sees(new):
    task, notes = new(fmugym.bundled_fmu("House"))
    assert task["reward"] == "-abs(T_air - T_air_set)"
    assert "T_air_set" in task["agent"]["observations"]
    drawn = task["setpoints"]["T_air_set"]
    assert (drawn["low"], drawn["high"]) == (295.0, 305.0)  # 5 K around the nominal value
    assert "guesses: 'T_air' follows 'T_air_set'" in notes


def test_controllers_have_the_sign_of_the_plant(new):
    """More heating raises the temperature; a table has an entry for each motor of two pendulums."""
    one, _ = new(fmugym.bundled_fmu("House"))
    assert {*one["controllers"]} == {"pi", "p"}
    for text in one["controllers"].values():
        assert text.startswith("pid of=T_air setpoint=T_air_set kp=")
        assert " kp=-" not in text
    two, _ = new(fmugym.bundled_fmu("DoublePendulum"))
    assert all(set(table) == set(two["agent"]["actions"]) for table in two["controllers"].values())


@pytest.mark.parametrize(
    ("inner", "low", "high"),
    [
        ('<Real min="0" max="8"/>', 2.0, 6.0),
        ('<Real start="5"/>', 4.75, 5.25),
        ('<Real start="5" min="6"/>', 6.125, 6.375),
        ('<Real start="293.15" unit="K" min="0"/>', 288.15, 298.15),
        ('<Real nominal="300" unit="K" min="0"/>', 295.0, 305.0),
        ("<Real/>", 0.25, 0.75),
        ("<Boolean/>", 0.25, 0.75),
    ],
)
def test_a_set_point_is_near_to_what_is_known(inner, low, high, make_fmu, new):
    start = "exact" if "start" in inner else "calculated"
    output = variable("y", inner, "output", initial=start)
    task, _ = new(make_fmu(INPUT, output))
    assert (task["setpoints"]["y_set"]["low"], task["setpoints"]["y_set"]["high"]) == (low, high)


@pytest.mark.parametrize(
    ("outputs", "goal"),
    [
        ([("P", "W", "power"), ("T_room", "K", "")], "T_room"),
        ([("i", "A", "current"), ("w", "rad/s", "")], "w"),
        ([("P", "W", ""), ("motor.w", "", "")], "motor_w"),
        ([("flow", "kg/s", ""), ("h", "", "Level of the tank")], "h"),
        ([("T_amb", "K", ""), ("T_room", "K", "")], "T_room"),
        ([("a", "", ""), ("b", "", "")], "a"),
    ],
)
def test_names_and_units_tell_what_is_controlled(outputs, goal, make_fmu, new):
    made = [
        variable(name, f'<Real unit="{unit}"/>', "output", initial="calculated", description=text)
        for name, unit, text in outputs
    ]
    assert new(make_fmu(INPUT, *made))[0]["reward"] == f"-abs({goal} - {goal}_set)"


def test_a_length_that_nobody_gives_is_a_guess(make_fmu, new):
    _, notes = new(make_fmu(INPUT, OUTPUT))
    assert "'episode_length' is a guess" in notes
    assert "episode_length" not in new(fmugym.bundled_fmu("CartPole"))[1]


def test_guesses_are_marked_in_the_file(ran):
    out = ran("new", fmugym.bundled_fmu("House"))
    marked = [line for line in out.splitlines() if "TODO: a guess" in line]
    assert [line.split(" =")[0] for line in marked] == ["reward", "T_air_set"]


class TestArchives:
    """Archives without inputs: all that an agent might act on is driven within."""

    def archive(self, folder, fmu, ports, crossing, more=(), own=()):
        """Two components that drive each other; outputs by the inputs that they drive."""
        pairs = [("a", "b"), ("b", "a")]
        wires = [
            ssp_tools.connection(f"{x}.{out}", f"{y}.{into}", suppressUnitConversion="true")
            for x, y in pairs
            for into, out in crossing.items()
        ]
        parts = [ssp_tools.component(name, ports, f"resources/{fmu}.fmu") for name in "ab"]
        root = ssp_tools.system("s", dict(own), parts, [*wires, *more])
        path = folder / "closed.ssp"
        with zipfile.ZipFile(path, "w") as file:
            file.writestr("SystemStructure.ssd", ssp_tools.HEAD + root + ssp_tools.TAIL)
            file.write(fmugym.bundled_fmu(fmu), f"resources/{fmu}.fmu")
        return path

    def house(self, folder, **options):
        crossing = {"T_out": "T_m", "u": "COP", "Q_int": "P", "I_sol": "E"}
        inputs = dict.fromkeys(crossing, "input") | dict.fromkeys(crossing.values(), "output")
        return self.archive(folder, "House", inputs | {"H_ve": "parameter"}, crossing, **options)

    def test_a_tunable_parameter_is_the_action(self, tmp_path, new):
        task, notes = new(self.house(tmp_path))
        (action,) = task["agent"]["actions"]
        assert task["variables"][action]["name"] == "a.H_ve"
        assert "parameter 'a.H_ve'" in notes
        self.plays(task)

    def test_parameters_of_the_system_come_first(self, tmp_path, new):
        more = [ssp_tools.connection(name, f"{name[-1]}.H_ve") for name in ("H_a", "H_b")]
        own = {"H_a": "parameter W/K", "H_b": "parameter W/K"}
        task, _ = new(self.house(tmp_path, more=more, own=own))
        assert task["agent"]["actions"] == ["H_a", "H_b"]
        self.plays(task)

    def plays(self, task):
        with fmugym.load(task) as env:
            env.reset(seed=0)
            assert not env.step(env.action_space.low)[4].get("fault")

    def test_fixed_parameters_are_refused_with_a_reason(self, tmp_path, ran):
        ports = {"f": "input", "x": "output"}
        path = self.archive(tmp_path, "CartPole", ports, {"f": "x"})
        with pytest.raises(fmugym.ConfigError) as error:
            Proposal(fmugym.FMUSystem.read(path).as_fmu())
        assert all(word in str(error.value) for word in ("closed.ssp", "'input'", "a.m_cart"))
