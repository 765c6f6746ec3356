"""Linear models: against closed forms, central differences, and what FMUs do in a step."""

from contextlib import closing

import exchange_tools
import foreign_tank
import numpy as np
import pytest
from combinations import in_turn
from fmu_tools import CLAIMING_DERIVATIVES, edited_fmu, probe_fmu
from pool_tools import open_pool, start, step
from pythonfmu.builder import FmuBuilder
from scipy.linalg import expm

import fmugym
from fmugym.control.linearization import linearize
from fmugym.fmi.bundled import BUNDLED_FMUS

M, L, B, G, V_C = 0.06, 0.1, 4e-4, 9.81, 0.05  # of the bundled pendulum
with_derivatives = pytest.mark.parametrize(
    ("model", "version"), [pair for pair in BUNDLED_FMUS if pair[1] != "1.0"], ids="-".join
)
each_version = pytest.mark.parametrize("version", ["2.0", "3.0"])

POINTS = {
    "CartPole": {"x_0": 0.1, "x_dot_0": -0.3, "phi_0": 0.4, "phi_dot_0": 0.7, "f": 3.0},
    "Pendulum": {"theta_0": 1.2, "theta_dot_0": -0.08, "tau": 0.02},
    "DoublePendulum": {"q1_0": 0.9, "q1_dot_0": -0.06, "q2_0": 1.3, "q2_dot_0": 0.04,
                       "tau1": 0.05, "tau2": -0.02},
    "House": {"T_m_0": 291.0, "T_w_0": 309.0, "T_out": 270.0, "I_sol": 150.0,
              "Q_int": 400.0, "u": 0.6},
}  # fmt: skip


def linearize_bundled(model, version, **arguments):
    return linearize(fmugym.bundled_fmu(model, version), **arguments)


def test_an_fmu_with_arguments_of_its_own():
    path = fmugym.bundled_fmu("Pendulum")
    with closing(fmugym.FMU(path)) as fmu:
        folder = fmu.extract()
        assert linearize(fmu).A.tolist() == linearize(path).A.tolist()
        assert folder.exists()  # it is still the caller's
    preloading = fmugym.FMU(path, preload=["/nowhere/libgave.so"])
    with pytest.raises(fmugym.FMULoadError, match="libgave"):
        linearize(preloading)


@in_turn(
    {
        "angle": [0.0, 1.0, np.pi, -2.5],
        "velocity,coulomb": [(0.0, 0.0), (0.03, 2e-3), (-4.0, 3e-3)],
        "version": ["2.0", "3.0"],
    }
)
def test_the_pendulum_against_the_closed_form(version, angle, velocity, coulomb):
    at = {"theta_0": angle, "theta_dot_0": velocity, "c": coulomb, "tau": 0.01}
    model = linearize_bundled("Pendulum", version, at=at)
    damping = B + coulomb / V_C / np.cosh(velocity / V_C) ** 2
    moment = 0.01 - B * velocity - coulomb * np.tanh(velocity / V_C)
    inertia = M * L**2
    expected = [[0.0, 1.0, 0.0], [G / L * np.cos(angle), -damping / inertia, 1 / inertia]]
    assert np.hstack([model.A, model.B]) == pytest.approx(np.array(expected), rel=1e-12)
    assert model.f == pytest.approx([velocity, G / L * np.sin(angle) + moment / inertia], rel=1e-12)
    assert model.x0.tolist() == [angle, velocity]
    assert model.u0.tolist() == [0.01]


@with_derivatives
def test_against_central_differences_of_the_fmu(model, version):
    """At a point that is no equilibrium, by other start values and inputs."""
    point = POINTS[model]
    linear = linearize_bundled(model, version, at=point)
    eps = 1e-6
    values = np.array(list(point.values()))
    ways = np.array([values + s * eps * row for row in np.eye(len(values)) for s in (1, -1)])
    found = derivatives(model, version, list(point), ways.T, linear)
    slopes = (found[:, ::2] - found[:, 1::2]) / (2 * eps)
    varied = [name.removesuffix("_0") for name in point]
    known = [*linear.states, *linear.inputs]
    jacobian = np.hstack([linear.A, linear.B])[:, [known.index(name) for name in varied]]
    assert jacobian == pytest.approx(slopes, rel=1e-6, abs=1e-10 if model == "House" else 1e-5)
    rest = [name for name in known if name not in varied]
    assert rest == (["E"] if model == "House" else [])  # it has no start value
    assert not linear.A[:, [known.index(name) for name in rest]].any()


def derivatives(model, version, names, columns, linear):
    """The FMU's own derivatives of the states, for columns of start values and inputs."""
    fmu = fmugym.FMU(fmugym.bundled_fmu(model, version))
    with closing(open_pool(fmu, n=columns.shape[1])) as pool:
        start(pool, dict(zip(names, columns, strict=True)))
        return pool.read(tuple(map(fmu.variable, linear.derivatives)))


@each_version
def test_each_instance_is_differentiated_at_its_own_point(version):
    fmu = fmugym.FMU(fmugym.bundled_fmu("Pendulum", version))
    torque, theta, speed = map(fmu.variable, ["tau", "theta", "theta_dot"])
    angles = np.array([0.0, 1.0, -2.5])
    with closing(open_pool(fmu, ["tau"], n=3)) as pool:
        with pytest.raises(fmugym.SimulationError, match="needs a reset"):
            pool.differentiate((theta,), (theta,))
        start(pool, {"theta_0": angles})
        found = pool.differentiate((speed, fmu.variable("theta_ddot")), (theta, torque))
    by_angle, by_torque = G / L * np.cos(angles), np.full(3, 1 / (M * L**2))
    expected = np.array([np.zeros((2, 3)), [by_angle, by_torque]])
    assert found == pytest.approx(expected, rel=1e-12)


@each_version
def test_a_step_from_near_upright_is_that_of_the_linear_model(version):
    linear = linearize_bundled("Pendulum", version)
    system = np.zeros((3, 3))
    system[:2] = np.hstack([linear.A, linear.B])
    fmu = fmugym.FMU(fmugym.bundled_fmu("Pendulum", version))
    assert linear.states == ("theta", "theta_dot")
    deviations = np.diag([1e-4, 1e-3, 1e-5])
    with closing(open_pool(fmu, ["tau"], linear.states, 0.02, 3)) as pool:
        start(pool, {"theta_0": deviations[0], "theta_dot_0": deviations[1]})
        stepped = step(pool, deviations[2])
    assert stepped == pytest.approx((expm(0.02 * system) @ deviations)[:2], rel=1e-5)


@each_version
def test_the_states_may_be_chosen_and_ordered(version):
    point = POINTS["DoublePendulum"]
    all_ = linearize_bundled("DoublePendulum", version, at=point)
    assert all_.states == ("q1", "q2", "q1_dot", "q2_dot")
    assert all_.derivatives == ("q1_dot", "q2_dot", "q1_ddot", "q2_ddot")
    elbow = linearize_bundled(
        "DoublePendulum", version, states=["q2_dot", "q2"], inputs="tau2", at=point
    )
    assert elbow.derivatives == ("q2_ddot", "q2_dot")
    assert elbow.A.tolist() == all_.A[np.ix_([3, 1], [3, 1])].tolist()
    assert elbow.B.tolist() == all_.B[np.ix_([3, 1], [1])].tolist()
    assert linearize_bundled("DoublePendulum", version, inputs=[]).B.shape == (4, 0)


@each_version
def test_units(version):
    units = {"theta": "rad", "theta_dot": "rad/s", "theta_ddot": "rad/s2", "tau": "N.m"}
    assert linearize_bundled("Pendulum", version).units == units


@each_version
def test_an_item_of_an_enumeration_may_be_named(version):
    """A rod that turns about its end has 3/2 of the point mass's g / l."""
    rod = linearize_bundled("Pendulum", version, at={"body": "uniform_rod"})
    assert rod.A[1, 0] == pytest.approx(1.5 * G / L, rel=1e-12)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"states": ["thet"]}, "unknown variable of Pendulum 'thet'; did you mean 'theta'?"),
        ({"states": ["q"]}, "'q' is no continuous state of Pendulum but a continuous output; "
                            "expected some of: 'theta', 'theta_dot'"),
        ({"inputs": ["b"]}, "'b' is no continuous input of Pendulum but a tunable parameter; "
                            "expected some of: 'tau'"),
        ({"at": {"q_O": 1.0}}, "did you mean 'q_0'?"),
        ({"at": {"theta": 1.0}}, "'theta' cannot be set: it is a continuous output"),
        ({"at": {"m": "heavy"}}, "'m' must be a number, got 'heavy'"),
        ({"at": {"m": np.nan}}, "'m' must be finite"),
        ({"at": {"body": "rod"}}, "unknown item of 'body' 'rod'"),
    ],
)  # fmt: skip
def test_a_mistake_is_named(arguments, message):
    with pytest.raises(fmugym.ConfigError) as error:
        linearize_bundled("Pendulum", "2.0", **arguments)
    assert message in str(error.value)


def test_fmi_1_has_no_derivatives():
    with pytest.raises(fmugym.ConfigError, match=r"Pendulum \(FMI 1\.0\) cannot be linearized: it"):
        linearize_bundled("Pendulum", "1.0")


def test_an_fmu_of_another_exporter_without_derivatives(tmp_path):
    path = FmuBuilder.build_FMU(foreign_tank.__file__, dest=tmp_path)
    with pytest.raises(fmugym.ConfigError, match="it provides neither directional derivatives"):
        linearize(path)


def test_an_fmu_that_declares_no_states(tmp_path):
    claim = {'modelIdentifier="Probe"': 'modelIdentifier="Probe" providesDirectionalDerivative="1"'}
    with pytest.raises(fmugym.ConfigError, match=r"Probe.*no derivatives of"):
        linearize(probe_fmu(tmp_path, edits=claim))


def test_a_derivative_of_no_named_state_is_left_out(tmp_path):
    path = edited_fmu("Pendulum", tmp_path, {' nominal="1" derivative="3"': ' nominal="1"'})
    assert linearize(path).states == ("theta_dot",)


def test_an_fmu_that_fails(tmp_path, temp_root):
    """The probe claims to provide derivatives; its String is set before it fails."""
    path = probe_fmu(tmp_path, edits=CLAIMING_DERIVATIVES)
    with pytest.raises(fmugym.SimulationError, match="the derivative by 'sum' returned Error"):
        linearize(path, at={"label": "derived", "gain": 2.0})
    with pytest.raises(fmugym.SimulationError, match="initialization returned Error"):
        linearize(path, at={"init_status": 3})
    assert list(temp_root.iterdir()) == []


@pytest.mark.parametrize("interface", ["ModelExchange", "CoSimulation"])
def test_adjoint_derivatives_where_there_are_no_others(tmp_path, interface):
    flags = 'providesAdjointDerivatives="true"'
    path = exchange_tools.exchange_fmu(
        tmp_path / "model.fmu", "van_der_pol", 3, (interface,), flags
    )
    assert not fmugym.FMU(path).description.capabilities.provides_directional_derivatives
    model = linearize(path, at={"x1": 1.5, "x2": -0.5, "mu": 3.0})
    assert model.A.tolist() == [[0.0, 1.0], [2 * 3.0 * 1.5 * 0.5 - 1.0, 3.0 * (1.0 - 1.5**2)]]
    assert model.f.tolist() == [-0.5, 3.0 * (1.0 - 1.5**2) * -0.5 - 1.5]
    assert linearize(path, states="x2").A.shape == (1, 1)
