"""Linear models of systems: the derivatives of components, joined by the chain rule."""

from contextlib import closing

import numpy as np
import pytest
from pool_tools import open_pool, start
from system_tools import linear_fmu

from fmugym import Component, ConfigError, Connection, FMUSystem, bundled_fmu
from fmugym.control.linearization import linearize

MASS, LENGTH, GRAVITY, FRICTION = 0.5, 0.4, 9.81, 0.03
ANGLES = (0.3, -0.8)
GAINS = (0.7, -0.4)
HOUSE = bundled_fmu("House")


def coupled(versions):
    """Two point masses on rods: the angle of each is a torque on the other."""
    same = {"m": MASS, "l": LENGTH, "g": GRAVITY, "b": FRICTION, "c": 0.0, "tau_max": 100.0}
    components = {
        name: Component(bundled_fmu("Pendulum", version), same | {"q_0": angle + np.pi})
        for name, version, angle in zip("ab", versions, ANGLES, strict=True)
    }
    links = [
        Connection("a.theta", "b.tau", gain=GAINS[0], convert_units=False),
        Connection("b.theta", "a.tau", gain=GAINS[1], offset=0.1, convert_units=False),
    ]
    return FMUSystem(components, links)


@pytest.mark.parametrize("versions", [("2.0", "3.0"), ("3.0", "3.0")])
def test_it_is_the_closed_form_of_coupled_masses(versions):
    """m l^2 theta'' = tau - b theta' + m g l sin theta, where theta is 0 upright."""
    model = linearize(coupled(versions))
    assert model.states == ("a.theta", "a.theta_dot", "b.theta", "b.theta_dot")
    inertia, weight = MASS * LENGTH**2, MASS * GRAVITY * LENGTH
    expected = np.zeros((4, 4))
    for row, angle, gain in ((0, ANGLES[0], GAINS[1]), (2, ANGLES[1], GAINS[0])):
        expected[row, row + 1] = 1.0
        expected[row + 1, row] = weight * np.cos(angle) / inertia
        expected[row + 1, row + 1] = -FRICTION / inertia
        expected[row + 1, 2 - row] = gain / inertia
    assert pytest.approx(expected, rel=1e-9) == model.A
    assert model.x0 == pytest.approx([ANGLES[0], 0.0, ANGLES[1], 0.0])
    torque = GAINS[1] * ANGLES[1] + 0.1
    assert model.f[1] == pytest.approx((torque + weight * np.sin(ANGLES[0])) / inertia)


def houses():
    """Outputs depend on inputs at once here, in a circle, and one input acts on both houses."""
    return FMUSystem(
        {"a": HOUSE, "b": Component(HOUSE, {"T_m_0": 290.0})},
        [
            Connection("a.Q_em", "b.Q_int", gain=0.3),
            Connection("b.Q_em", "a.Q_int", gain=-0.2),
            "outside -> a.T_out",
            "outside -> b.T_out",
        ],
        units={"outside": "degC"},
    )


def rates(system, names, values):
    """What the derivatives are after an initialization with these start values."""
    with closing(open_pool(system.as_fmu(), (), names)) as pool:
        return start(pool, values).outputs[:, 0].copy()


def test_it_is_the_difference_quotient_of_houses_in_a_loop():
    system = houses()
    start = {"a.u": 0.5, "b.u": 0.6, "outside": 4.0, "a.T_w_0": 303.0, "a.T_m_0": 293.0}
    model = linearize(system, at=start)
    assert set(model.inputs) == {"a.u", "a.I_sol", "b.u", "b.I_sol", "outside"}
    moved = {"a.T_m": "a.T_m_0", "a.T_w": "a.T_w_0", "outside": "outside", "b.u": "b.u"}
    for name, parameter in moved.items():
        if name in model.states:
            column = model.A[:, model.states.index(name)]
        else:
            column = model.B[:, model.inputs.index(name)]
        size = 1e-3 if parameter == "b.u" else 0.05
        high, low = (
            rates(system, model.derivatives, start | {parameter: start[parameter] + change})
            for change in (size, -size)
        )
        assert column == pytest.approx((high - low) / (2 * size), rel=1e-4, abs=1e-9)
        assert np.abs(column).max() > 0


def test_an_isolated_system_gives_the_same(monkeypatch):
    one = linearize(FMUSystem({"a": HOUSE}))
    # That would load it into this process.
    monkeypatch.setattr("fmugym.pool.native_pool.NativePool", None)
    other = linearize(FMUSystem({"a": Component(HOUSE, isolate=True)}))
    for name in ("A", "B", "f", "x0", "u0"):
        assert getattr(one, name).tobytes() == getattr(other, name).tobytes()


class TestRefusals:
    def test_a_component_without_derivatives_is_named(self, tmp_path):
        path = linear_fmu(tmp_path / "linear.fmu")
        with pytest.raises(ConfigError, match=r"component 'plain'.*none"):
            linearize(FMUSystem({"house": HOUSE, "plain": path}))

    def test_states_of_other_names(self):
        with pytest.raises(ConfigError, match=r"a\.T_air"):
            linearize(houses(), states="a.T_air")
