"""Systems against one model of the same equations, and against FMPy's container."""

from contextlib import closing
from types import SimpleNamespace

import fmpy
import fmpy.model_description as md
import numpy as np
import pytest
import system_tools
from combinations import in_turn
from fmpy.container_fmu import config
from fmpy.container_fmu.cli import create_container_fmu
from pool_tools import open_pool, start, step

from fmugym import FMU, Component, Connection, FMUSystem, bundled_fmu

HOUSE, PENDULUM = bundled_fmu("House"), bundled_fmu("Pendulum")
FRICTION = 4e-4  # N m s / rad, the default of the bundled pendulum
DAY = 86400.0


@pytest.fixture(scope="module", name="linear")
def fixture_linear(tmp_path_factory):
    """An FMU of linear equations, which tells nothing of its feed-through."""
    return system_tools.linear_fmu(tmp_path_factory.mktemp("linear") / "linear.fmu")


def played(fmu, outputs, end, count, substeps=1, **parameters):
    """The outputs after 0, 1 ... count steps, shape (count + 1, k)."""
    with closing(open_pool(FMU.of(fmu), (), outputs, end / count, substeps=substeps)) as pool:
        rows = [start(pool, parameters).outputs[:, 0].copy()]
        return np.array(rows + [step(pool)[:, 0] for _ in range(count)])


def matrices(**given):
    return {
        f"{letter}{row + 1}{column + 1}": float(value)
        for letter, rows in given.items()
        for row, values in enumerate(rows)
        for column, value in enumerate(values)
    }


def pendulum_in_parts(linear, master, steps):
    """The rod has no friction of its own: a part computes the torque of the velocity."""
    friction = matrices(d=[[-FRICTION, 0], [0, 0]])
    return FMUSystem(
        {
            "rod": Component(PENDULUM, {"b": 0.0, "q_0": 2.0}, steps=steps[0]),
            "friction": Component(linear, friction, steps=steps[1]),
        },
        [("rod.q_dot", "friction.u1"), ("friction.y1", "rod.tau")],
        master=master,
    )


def constants_of_the_house():
    """Those of resources/House/model.c, by its names; a parameter stands for its default."""
    r = SimpleNamespace(**{n: v.start_number for n, v in FMU(HOUSE).description.variables.items()})
    k = SimpleNamespace(r=r)
    surface, mass = 4.5 * r.A_f, r.a_m * r.A_f
    k.ats, k.stm = 3.45 * surface, 9.1 * mass
    k.mto = 1.0 / (1.0 / r.H_op - 1.0 / k.stm)
    k.capacity, k.mass_share = r.c_m * r.A_f, mass / surface
    k.surface_share = 1.0 - k.mass_share - r.H_w / (9.1 * surface)
    return k


def house_in_parts(linear, master, loops):
    """The building knows the heat from the water, the water knows the air: an algebraic loop.

    Both are affine in their state and their input; the second input is 1.
    """
    k = constants_of_the_house()
    r = k.r
    air_sum, surface_sum = r.H_ve + k.ats, k.stm + r.H_w + k.ats
    det = air_sum * surface_sum - k.ats**2
    to_air = np.array([0.0, 1.0, r.H_ve * r.T_out + 0.5 * r.Q_int])  # of T_m, heat, 1
    gains = 0.5 * r.Q_int
    to_surface = np.array([k.stm, 0.0, r.H_w * r.T_out + k.surface_share * gains])
    air = (surface_sum * to_air + k.ats * to_surface) / det
    surface = (air_sum * to_surface + k.ats * to_air) / det
    rate = k.stm * surface - np.array([k.mto + k.stm, 0, -k.mto * r.T_out - k.mass_share * gains])
    rate /= k.capacity
    building = matrices(
        a=[[rate[0], 0], [0, 0]],
        b=[rate[1:], [0, 0]],
        c=[[air[0], 0], [1, 0]],
        d=[air[1:], [0, 0]],
    )
    water = matrices(
        a=[[-r.UA / r.C_w, 0], [0, 0]],
        b=[[r.UA / r.C_w, 0], [0, 0]],
        c=[[r.UA, 0], [1, 0]],
        d=[[-r.UA, 0], [0, 0]],
    )
    return FMUSystem(
        {
            "building": Component(linear, {**building, "x1_0": r.T_m_0, "u2": 1.0}),
            "water": Component(linear, {**water, "x1_0": r.T_w_0}),
        },
        ["building.y1 -> water.u1", "water.y1 -> building.u1"],
        master=master,
        loops=loops,
    )


class TestAgainstOneModel:
    @in_turn({"steps": [(1, 1), (4, 1), (1, 3)], "master": ["gauss_seidel", "jacobi"]})
    def test_the_pendulum(self, linear, master, steps):
        """Half the step size, half the difference: order 1 for each ratio of steps."""
        system = pendulum_in_parts(linear, master, steps)
        whole = played(PENDULUM, ["q", "q_dot"], 2.0, 40, 5, q_0=2.0, b=FRICTION)
        errors = [
            np.abs(played(system, ["rod.q", "rod.q_dot"], 2.0, 40, n) - whole).max()
            for n in (10, 20, 40)
        ]
        assert errors[-1] < 0.1  # of 20 rad/s
        assert errors[0] / errors[1] == pytest.approx(2.0, rel=0.2)
        assert errors[1] / errors[2] == pytest.approx(2.0, rel=0.1)

    @pytest.mark.parametrize("master", ["gauss_seidel", "jacobi"])
    def test_the_house(self, linear, master):
        names = ["T_air", "T_m", "T_w"]
        whole = played(HOUSE, names, DAY, 24)
        system = house_in_parts(linear, master, "newton")
        own = ["building.y1", "building.y2", "water.y2"]
        errors = [np.abs(played(system, own, DAY, 24, n) - whole).max() for n in (1, 2, 4, 8)]
        assert errors[-1] < 0.2  # kelvin; the water cools by 15
        assert errors[1] / errors[2] == pytest.approx(2.0, rel=0.25)
        assert errors[2] / errors[3] == pytest.approx(2.0, rel=0.2)

    def test_the_loop_of_the_house(self, linear):
        """Air and heat agree at the start and after each step, by both methods."""
        start = played(HOUSE, ["T_air", "Q_em"], DAY, 24)[0]
        found = []
        for loops in ("newton", "fixed_point"):
            system = house_in_parts(linear, "gauss_seidel", loops)
            assert len(system.order.loops) == 1
            rows = played(system, ["building.y1", "water.y1"], DAY, 24, 2)
            assert rows[0] == pytest.approx(start, rel=1e-7)
            found.append(rows)
        assert found[0] == pytest.approx(found[1], rel=1e-6)


def write_container(folder, step_size, connections, starts):
    """Write FMPy's container of two pendulums of FMI 3.0.

    Args:
        folder: Where to write it.
        step_size: In seconds.
        connections: ``(component, output, component, input)``, components by their numbers.
        starts: The start value of q of each.
    """
    parts = []
    for name in ("a", "b"):
        path = folder / f"{name}.fmu"
        path.write_bytes(bundled_fmu("Pendulum", "3.0").read_bytes())
        parts.append(config.Component(name, path, fmpy.read_model_description(str(path))))
    own = [{v.name: v for v in part.modelDescription.modelVariables} for part in parts]
    kind = {"type": "Float64", "causality": "output", "variability": "continuous"}
    kind["initial"] = "calculated"
    fixed = kind | {"causality": "parameter", "variability": "fixed", "initial": "exact"}
    time = kind | {"causality": "independent", "initial": None}
    variables, mappings = [md.ModelVariable(name="time", **time)], {}
    for number, part in enumerate(parts):
        for name, more in (("q_0", fixed | {"start": str(starts[number])}), ("q", kind)):
            variable = md.ModelVariable(name=f"{part.name}.{name}", **more)
            variables.append(variable)
            mappings[variable] = [(part, own[number][name])]
    outputs = [md.Unknown(variable=v) for v in variables if v.causality == "output"]
    description = md.ModelDescription(
        fmiVersion="3.0",
        modelName="container",
        instantiationToken="{container}",
        coSimulation=md.CoSimulation("container_fmu", fixedInternalStepSize=step_size),
        modelVariables=variables,
        outputs=outputs,
        initialUnknowns=outputs,
    )
    links = [
        config.Connection(parts[i], [own[i][output]], parts[k], [own[k][name]])
        for i, output, k, name in connections
    ]
    (folder / "unpacked").mkdir()
    create_container_fmu(
        config.Configuration(False, description, parts, links, mappings),
        folder / "unpacked",
        folder / "container.fmu",
    )
    return folder / "container.fmu"


def test_jacobi_steps_are_those_of_the_container_of_fmpy(tmp_path):
    """Its container exchanges all values, then steps all components."""
    starts = (0.5, -0.3)
    wires = [(0, "theta_dot", 1, "tau"), (1, "theta_dot", 0, "tau")]
    container = write_container(tmp_path, 0.01, wires, starts)
    rows = fmpy.simulate_fmu(
        str(container),
        stop_time=1.0,
        step_size=0.01,
        output_interval=0.01,
        output=["a.q", "b.q"],
        validate=False,
    )
    theirs = np.array([[row["a.q"], row["b.q"]] for row in rows])
    assert np.ptp(theirs, axis=0).min() > 0.5  # they swing
    pendulum = bundled_fmu("Pendulum", "3.0")
    system = FMUSystem(
        {n: Component(pendulum, {"q_0": q}) for n, q in zip("ab", starts, strict=True)},
        [
            Connection("a.theta_dot", "b.tau", convert_units=False),
            Connection("b.theta_dot", "a.tau", convert_units=False),
        ],
        master="jacobi",
    )
    ours = played(system, ["a.q", "b.q"], 1.0, 100)
    assert theirs == pytest.approx(ours, rel=1e-12, abs=1e-12)
