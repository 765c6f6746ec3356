"""Systems against one model of the same equations, and against FMPy's container."""

from contextlib import closing
from types import SimpleNamespace

import numpy as np
import pytest
import system_tools
from combinations import in_turn
from pool_tools import open_pool, start, step

from fmugym import FMU, Component, FMUSystem, bundled_fmu

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
