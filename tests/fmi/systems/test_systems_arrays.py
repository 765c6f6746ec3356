"""Arrays in systems: as a whole and by elements, between components and as the system's own."""

import numpy as np
import pytest
import ssp_tools
import values_tools
from fmu_tools import PlainEnv
from gymnasium import spaces
from scipy.linalg import expm
from system_tools import (
    by_each_master,
    closing_pools,  # noqa: F401  # the fixture "make"
    play,
)

import fmugym
from fmugym import (
    Component,
    ConfigError,
    Connection,
    FMUSystem,
    Uniform,
)
from fmugym.fmi import Status

PLANT = {
    "A": np.array([[0.0, 1.0], [-4.0, -0.4]]),
    "B": np.array([[0.0, 0.0], [1.0, 0.5]]),
    "C": np.array([[1.0, 0.0], [0.0, 1.0], [1.0, 1.0]]),
    "x_0": np.array([1.0, -0.5]),
}
CONTROL = {
    "A": np.array([[-1.0]]),
    "B": np.array([[0.5, 0.0, 0.25]]),
    "C": np.array([[-2.0], [1.0]]),
    "D": np.array([[-1.0, -0.3, 0.0], [0.2, 0.0, 0.1]]),
    "x_0": np.array([0.3]),
}
GAIN, OFFSET = 0.5, 0.25


@pytest.fixture(scope="module", name="path")
def compiled(tmp_path_factory):
    return values_tools.state_space_fmu(tmp_path_factory.mktemp("ss") / "S.fmu")


@pytest.fixture(scope="module", name="matrices")
def compiled_feedthrough(tmp_path_factory):
    return values_tools.feedthrough_fmu(tmp_path_factory.mktemp("ft") / "F.fmu", 3)


def part(path, values, **options):
    """A component with the sizes that its matrices have."""
    outputs, states = values["C"].shape
    sizes = {"n": states, "m": values["B"].shape[1], "r": outputs}
    values = {"D": np.zeros((outputs, sizes["m"])), **values}
    return Component(path, sizes | {name: v.tolist() for name, v in values.items()}, **options)


def plant_and_control(path, connections=None, feedthrough=False, **options):
    """The outputs of the plant go to the controller as a whole, its answer comes by elements.

    None for ``feedthrough`` leaves open whether the plant has one, as archives do.
    """
    links = ["plant.y -> control.u"]
    links += [
        Connection("control.y[1]", "plant.u[1]"),
        Connection("control.y[2]", "plant.u[2]", GAIN, OFFSET),
    ]
    components = {
        "plant": part(path, PLANT, feedthrough=feedthrough),
        "control": part(path, CONTROL),
    }
    return FMUSystem(components, links if connections is None else connections, **options)


def exactly(times):
    """The states of the plant and the controller, shape (times, 3)."""
    scale, shift = np.diag([1.0, GAIN]), np.array([0.0, OFFSET])
    a, b, c = PLANT["A"], PLANT["B"] @ scale, PLANT["C"]
    matrix = np.zeros((4, 4))
    matrix[:2] = np.column_stack([a + b @ CONTROL["D"] @ c, b @ CONTROL["C"], PLANT["B"] @ shift])
    matrix[2] = np.concatenate([(CONTROL["B"] @ c)[0], CONTROL["A"][0], [0.0]])
    start = np.concatenate([PLANT["x_0"], CONTROL["x_0"], [1.0]])
    return np.array([(expm(matrix * t) @ start)[:3] for t in times])


STATES = ["plant.x[1]", "plant.x[2]", "control.x[1]"]


class TestConnections:
    @by_each_master
    def test_errors_are_of_the_first_order_in_the_step_size(self, make, path, master):
        errors = []
        for count in (40, 80, 160):
            pool = make(plant_and_control(path, master=master), (), STATES, 1, 2.0 / count)
            rows = play(pool, count)
            errors.append(np.abs(rows - exactly(np.arange(count + 1) * 2.0 / count)).max())
        assert errors[2] < 0.08
        assert errors[0] / errors[1] == pytest.approx(2.0, rel=0.2)
        assert errors[1] / errors[2] == pytest.approx(2.0, rel=0.1)

    def test_algebraic_loops_of_arrays_are_solved(self, make, path):
        """y1 = D1 y2 and y2 = D2 y1 + x, where the state x falls: each step solves another loop."""
        d = np.array([[0.2, 0.4], [-0.3, 0.1]]), np.array([[0.5, 0.0], [0.2, -0.4]])
        rest = {"A": -np.eye(2), "B": np.zeros((2, 2)), "C": np.eye(2)}
        system = FMUSystem(
            {
                "a": part(path, {**rest, "D": d[0], "x_0": np.zeros(2)}),
                "b": part(path, {**rest, "D": d[1], "x_0": np.array([1.0, 2.0])}),
            },
            ["a.y -> b.u", "b.y -> a.u"],
            loop_tolerance=1e-12,
        )
        assert len(system.findings) > 0
        told = ["a.y[1]", "a.y[2]", "b.x[1]", "b.x[2]", "b.u[2]"]
        rows = play(make(system, (), told), 2)
        y, x = rows[:, :2], rows[:, 2:4]
        assert (np.diff(x, axis=0) < -0.01).all()
        assert y == pytest.approx(x @ (d[0] @ np.linalg.inv(np.eye(2) - d[1] @ d[0])).T, rel=1e-9)
        assert rows[:, 4] == pytest.approx(rows[:, 1], rel=1e-9)

    def test_elements_that_nothing_drives_stay_as_they_are(self, make, path):
        """FMI sets whole arrays: the third element has the start value of the component, and the
        second one that of the system."""
        gains = part(path, {**CONTROL, "B": np.zeros((1, 3)), "D": np.eye(2, 3) + 0.0})
        gains.start_values["D"] = [[1.0, 10.0, 100.0], [0.0, 0.0, 0.0]]
        gains.start_values["C"] = [[0.0], [0.0]]
        gains.start_values["u"] = [5.0, 6.0, 7.0]
        system = FMUSystem({"plant": part(path, PLANT), "g": gains}, ["plant.x[2] -> g.u[1]"])
        pool = make(system, (), ["g.y[1]", "g.u[1]", "g.u[2]", "g.u[3]"])
        for start, second in (((), 6.0), ((pool.variable("g.u[2]"),), -1.0)):
            pool.reset(start, np.full((len(start), 1), second))
            for _ in range(2):
                outputs, _ = pool.step()
                told, *u = outputs[:, 0]
                assert u[1:] == [second, 7.0]
                assert told == u[0] + 10.0 * u[1] + 100.0 * u[2]

    def test_integers_of_sixteen_bits_pass_as_they_are(self, make, matrices):
        system = FMUSystem(
            {"a": matrices, "b": matrices}, ["a.w -> b.v", "b.w[2,1] -> b.Float64_in"]
        )
        names = [f"a.v[{i},{j}]" for i in (1, 2) for j in (1, 2)]
        outputs = [f"b.w[{i},{j}]" for i in (1, 2) for j in (1, 2)] + ["b.Float64_out"]
        values = np.array([[1.0], [-2.0], [32767.0], [-32768.0]])
        rows = play(make(system, names, outputs), 3, [values] * 3)
        assert rows[3].tolist() == [*values[:, 0], 32767.0]

    def test_an_array_without_elements(self, make, path):
        none = {"n": 1, "m": 0, "r": 0, "A": [[-1.0]], "B": [], "C": [], "D": [], "x_0": 1.0}
        system = FMUSystem({"a": Component(path, none), "b": Component(path, none)}, ["a.y -> b.u"])
        assert play(make(system, (), ["b.x[1]"]), 1)[1, 0] == pytest.approx(np.exp(-0.1))

    def test_no_element_that_is_no_number_passes(self, make, path):
        big = {**PLANT, "A": np.diag([20.0, -1.0])}
        system = FMUSystem(
            {"big": part(path, big, feedthrough=False), "g": part(path, CONTROL)}, ["big.y -> g.u"]
        )
        pool = make(system, (), ["g.x[1]"], time_step=60.0)
        pool.reset((), np.zeros((0, 1)))
        _, statuses = pool.step()
        assert statuses[0] == Status.NOT_FINITE
        assert "component 'big'" in pool.failure(0)


# The system's own arrays, and what an environment does with them


class Plant(PlainEnv):
    """A plant whose matrix is drawn, pushed by an array."""

    def __init__(self, fmu, **changes):
        config = {
            "model_input_names": "push",
            "model_output_names": ["seen", "plant.x[2]"],
            "model_parameters": {"plant.A": [[0.0, 1.0], [Uniform(-5, -3), -0.4]], "start[2]": 2.0},
            "time_step": 0.1,
            "bounds": {"push": (-1, 1)},
            "max_episode_steps": 5,
        }
        super().__init__(fmu, config | changes)


def own_arrays(path, **options):
    connections = [
        Connection("push", "plant.u", gain=2.0, offset=1.0),
        Connection("plant.y", "seen", gain=10.0),
        Connection("start", "plant.x_0"),
    ]
    return FMUSystem({"plant": part(path, PLANT)}, connections, **options)


class TestOwnArrays:
    def test_an_environment_has_them_by_name(self, path):
        env = Plant(own_arrays(path))
        assert env.observation_names == ("seen[1]", "seen[2]", "seen[3]", "plant.x[2]")
        assert env.action_space == spaces.Box(-1, 1, (2,), np.float32)
        env.reset(seed=1)
        a = np.reshape(env.parameters["plant.A"], (2, 2))
        assert -5 <= a[1, 0] <= -3
        x = np.array([1.0, 2.0])
        assert env.out["seen"] == pytest.approx(10 * PLANT["C"] @ x)
        env.step(np.array([0.5, -0.25], np.float32))
        block = np.zeros((3, 3))
        block[:2] = np.column_stack([a, PLANT["B"] @ [2.0, 0.5]])
        x = (expm(block * 0.1) @ [*x, 1.0])[:2]
        assert env.out["seen"] == pytest.approx(10 * PLANT["C"] @ x, abs=1e-7)
        assert env.out["plant.x[2]"] == pytest.approx(x[1], abs=1e-7)
        env.close()

    def test_an_element_is_an_input_by_itself(self, path):
        """In a system, the other elements keep what they have, also a start value of the config."""
        env = Plant(
            FMUSystem({"plant": part(path, PLANT)}),
            model_input_names="plant.u[2]",
            model_output_names=["plant.x", "plant.u"],
            model_parameters={"plant.u[1]": 3.0},
            bounds={"plant.u[2]": (-1, 1)},
        )
        env.reset()
        env.step(np.array([0.5], np.float32))
        assert env.out["plant.u"].tolist() == [3.0, 0.5]
        env.close()

    def test_sizes_belong_to_components(self, path):
        with pytest.raises(ConfigError, match=r"plant\.n.*start_values") as error:
            Plant(own_arrays(path), model_parameters={"plant.n": 3})
        assert "structural" in str(error.value)


class TestMistakes:
    @pytest.mark.parametrize(
        ("connection", "facts"),
        [
            ("a.y -> b.u", ["a.y", "(3,)", "b.u", "(2,)"]),
            ("a.y -> b.u[1]", ["a.y", "(3,)", "b.u[1]", "scalar"]),
            ("a.y[1] -> b.u", ["a.y[1]", "scalar", "(2,)"]),
            ("a.y[4] -> b.u[1]", ["y[4]", "(3,)"]),
            ("a.y[0] -> b.u[1]", ["y[0]", "(3,)"]),
            ("a.A -> b.u", ["a.A", "parameter"]),
            ("a.yy -> b.u", ["yy", "'y'"]),
        ],
    )
    def test_what_does_not_fit_is_told(self, path, connection, facts):
        with pytest.raises(ConfigError) as error:
            FMUSystem({"a": part(path, PLANT), "b": part(path, PLANT)}, [connection])
        assert all(fact in str(error.value) for fact in facts), error.value

    def test_two_sources_of_one_element_are_named(self, path):
        with pytest.raises(ConfigError, match=r"b\.u\[2\].*push.*a\.y\[1\]"):
            FMUSystem(
                {"a": part(path, PLANT), "b": part(path, PLANT)},
                ["push -> b.u", "a.y[1] -> b.u[2]"],
            )

    def test_start_values_of_other_shapes(self, path):
        with pytest.raises(ConfigError, match=r"plant\.A.*\(2, 2\).*\(3,\)"):
            FMUSystem({"plant": Component(path, {"A": [1.0, 2.0, 3.0]})})
        with pytest.raises(ConfigError, match=r"A\[1,2\].*'plant'.*\(3, 3\)"):
            FMUSystem({"plant": Component(path, {"n": 3, "A[1,1]": 2.0})})

    def test_one_name_for_an_array_and_an_element(self, path):
        system = FMUSystem(
            {"a": part(path, PLANT), "b": part(path, PLANT)}, ["x -> a.u", "x[1] -> b.u[1]"]
        )
        with pytest.raises(ConfigError, match=r"x\[1\]"):
            system.as_fmu()


def test_open_inputs_are_the_elements_that_nothing_drives(path):
    system = FMUSystem({"a": part(path, PLANT), "b": part(path, PLANT)}, ["a.y[1] -> b.u[2]"])
    assert [port.name for port in system.open_inputs] == ["a.u", "b.u[1]"]
    description = system.as_fmu().description
    inputs = [v.name for v in description.scalars("b.u") if v.settable_in_step]
    assert inputs == ["b.u[1]"]


TASK = """
version = 1
time_step = "100ms"
episode_length = "1s"
reward = "-abs(y1)"

[system]
connections = [
  "control.y -> plant.u",
  {{ source = "plant.x[1]", target = "control.u[1]", gain = 0.5 }},
]

[system.components.plant]
fmu = "{path}"

[system.components.plant.start_values]
n = 2
m = 2
r = 3
A = [[0, 1], [-4, -0.4]]
B = [0, 0, 1, 0.5]
C = [[1, 0], [0, 1], [1, 1]]
D = 0
x_0 = [1, -0.5]

[system.components.control]
fmu = "{path}"
feedthrough = false
start_values = {{ n = 1, m = 2, r = 2, A = -1, B = [0.5, 0], C = [-2, 1], D = 0, x_0 = 0.3 }}

[variables]
y1 = {{ name = "plant.y[1]", min = -9, max = 9 }}
u2 = {{ name = "control.u[2]" }}

[agent]
actions = ["u2"]
observations = ["y1"]

[parameters]
"plant.C[3,1]" = 2.0
"control.A" = [[-2.0]]
"""


class TestFiles:
    def test_an_archive_has_arrays_and_sizes(self, make, path, tmp_path):
        """SSP 2.0 knows arrays; elements are connectors with names of their own."""
        system = plant_and_control(path, feedthrough=None)
        again = FMUSystem.read(ssp_tools.write(system, tmp_path / "s.ssp"))
        assert again.links == system.links
        assert again.plan.components[0].sizes == system.plan.components[0].sizes
        rows = [play(make(one, (), STATES), 5) for one in (system, again)]
        assert rows[0].tobytes() == rows[1].tobytes()

    def test_a_task_file_has_arrays(self, path, tmp_path):
        task = tmp_path / "task.toml"
        task.write_text(TASK.format(path=path))
        env = fmugym.load(task)
        env.reset()
        assert env.parameters["plant.C[3,1]"] == 2.0
        assert env.out["plant.y[1]"] == 1.0
        env.step(np.ones(1, np.float32))
        assert env.out["plant.y[1]"] != 1.0
        env.close()

    def test_info_and_new_tell_of_them(self, path, tmp_path, ran):
        file = ssp_tools.write(plant_and_control(path), tmp_path / "s.ssp")
        text = ran("info", file)
        assert "plant.y -> control.u" in text
        assert "control.y[2] -> plant.u[2] (* 0.5 + 0.25)" in text
        own = ssp_tools.write(own_arrays(path), tmp_path / "own.ssp")
        ran("new", own, "--output", tmp_path / "own.toml")
        assert "push[2]" in (tmp_path / "own.toml").read_text()
