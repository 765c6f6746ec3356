"""The bundled models against closed forms, energy and scipy."""

import math

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.special import ellipk

import fmugym
from fmugym.fmi.bundled import FMI_VERSIONS


class Plain(fmugym.FMUEnv):
    """A bundled FMU as it is."""

    def _is_done(self):
        return False


def simulate(model, outputs, parameters, inputs, time_step, fmi_version="2.0"):
    """The outputs at the start and after each step, shape (len(inputs) + 1, len(outputs))."""
    names = {"CartPole": "f", "Pendulum": "tau", "DoublePendulum": ["tau1", "tau2"]}
    config = {
        "model_input_names": names[model],
        "model_output_names": outputs,
        "model_parameters": parameters,
        "time_step": time_step,
        "bounds": {},
    }
    env = Plain(fmugym.bundled_fmu(model, fmi_version), config)
    env.reset()
    trajectory = [env.state]
    for value in inputs:
        env.step(value)
        trajectory.append(env.state)
    env.close()
    return np.array(trajectory)


FREE = {"b": 0.0, "c": 0.0, "theta_dot_max": 1e3, "solver": "rk4", "max_step": 1e-3}


@pytest.mark.parametrize("fmi_version", FMI_VERSIONS)
def test_frictionless_pendulum_keeps_its_energy(fmi_version):
    m, length, g = 0.06, 0.1, 9.81
    parameters = {**FREE, "m": m, "l": length, "g": g, "q_0": 2.8, "q_dot_0": 0.5}
    q, q_dot = simulate("Pendulum", ["q", "q_dot"], parameters, [0.0] * 500, 0.02, fmi_version).T
    energy = 0.5 * m * length**2 * q_dot**2 - m * g * length * np.cos(q)
    assert np.ptp(q) > 5  # it does swing
    assert np.ptp(energy) < 1e-9 * m * g * length


def test_period_of_a_large_swing():
    """T = 4 sqrt(l / g) K(sin^2(q_0 / 2)), the complete elliptic integral of the first kind."""
    q_0, length, g = 2.0, 0.1, 9.81
    period = 4 * math.sqrt(length / g) * ellipk(math.sin(q_0 / 2) ** 2)
    parameters = {**FREE, "l": length, "g": g, "q_0": q_0}
    q, _ = simulate("Pendulum", ["q", "q_dot"], parameters, [0.0] * 10, period)[-1]
    assert q == pytest.approx(q_0, abs=1e-7)


@pytest.mark.parametrize("fmi_version", FMI_VERSIONS)
def test_pendulum_with_friction_agrees_with_scipy(fmi_version):
    m, length, b, c, v_c, g = 0.06, 0.1, 4e-4, 2e-3, 0.05, 9.81
    torque = 0.02

    def derivative(_, state):
        q, v = state
        moment = torque - b * v - c * math.tanh(v / v_c) - m * g * length * math.sin(q)
        return v, moment / (m * length**2)

    parameters = {"m": m, "l": length, "b": b, "c": c, "v_c": v_c, "g": g, "q_0": 2.5}
    parameters |= {"solver": "rk4", "max_step": 1e-4}  # the friction turns within 2 ms
    ours = simulate("Pendulum", ["q", "q_dot"], parameters, [torque] * 100, 0.02, fmi_version)
    times = np.linspace(0, 2, 101)
    theirs = solve_ivp(derivative, (0, 2), [2.5, 0], "DOP853", times, rtol=1e-11, atol=1e-12).y.T
    assert np.abs(ours - theirs).max() < 1e-6


@pytest.mark.parametrize("fmi_version", FMI_VERSIONS)
def test_tutorial_cart_pole_agrees_with_scipy(fmi_version):
    """Against Lagrange's equations in mass-matrix form, solved numerically at each point."""
    m_cart, m_pole, g, force = 10.0, 1.0, 9.81, 12.0
    rod = 900 * math.pi * 0.025**2
    mass = rod + m_pole
    lever = (0.5 * rod + m_pole) / mass
    inertia = rod * (1 / 3 + 0.025**2 / 4) + m_pole + 0.001

    def derivative(_, state):
        _, v, phi, w = state
        coupling = mass * lever * math.cos(phi)
        matrix = [[m_cart + mass, coupling], [coupling, inertia]]
        forces = [force + mass * lever * w**2 * math.sin(phi), mass * g * lever * math.sin(phi)]
        acceleration = np.linalg.solve(matrix, forces)
        return v, acceleration[0], w, acceleration[1]

    parameters = {"theta_0": math.radians(85), "solver": "rk4", "max_step": 1e-3}
    outputs = ["x", "x_dot", "phi", "phi_dot"]
    ours = simulate("CartPole", outputs, parameters, [force] * 20, 0.05, fmi_version)
    start = [0, 0, math.radians(5), 0]
    times = np.linspace(0, 1, 21)
    theirs = solve_ivp(derivative, (0, 1), start, "DOP853", times, rtol=1e-11, atol=1e-12).y.T
    assert np.abs(ours - theirs).max() < 1e-6


def test_solver_orders():
    """Halving the internal step halves Euler's error and takes that of RK4 by 16."""
    errors = {}
    start = {"q_0": 1.0, "theta_dot_max": 1e3, "b": 0.0}
    exact = simulate("Pendulum", ["q"], {**start, "solver": "rk4", "max_step": 1e-5}, [0.0], 0.4)
    for solver, step in (("explicit_euler", 1e-3), ("semi_implicit_euler", 1e-3), ("rk4", 1e-2)):
        for max_step in (step, step / 2):
            parameters = {**start, "solver": solver, "max_step": max_step}
            q = simulate("Pendulum", ["q"], parameters, [0.0], 0.4)
            errors[solver, max_step == step] = abs(q[-1, 0] - exact[-1, 0])
    for solver, order in (("explicit_euler", 1), ("semi_implicit_euler", 1), ("rk4", 4)):
        ratio = errors[solver, True] / errors[solver, False]
        assert ratio == pytest.approx(2**order, rel=0.15)


def test_angles_are_one_thing_by_several_names():
    outputs = ["theta", "theta_dot", "phi", "phi_dot"]
    rows = simulate("CartPole", outputs, {"phi_dot_0": 0.3}, [5.0] * 20, 0.02)
    assert rows[:, 0] == pytest.approx(math.pi / 2 - rows[:, 2], abs=1e-15)
    assert rows[:, 1] == pytest.approx(-rows[:, 3], abs=0)
    rows = simulate(
        "Pendulum", ["theta", "theta_dot", "q", "q_dot"], {"q_0": 1.0}, [0.0] * 20, 0.02
    )
    assert rows[:, 2] == pytest.approx(rows[:, 0] + math.pi, abs=1e-15)
    assert rows[:, 3].tolist() == rows[:, 1].tolist()


def test_torque_and_velocity_limits():
    parameters = {"tau_max": 0.1, "theta_dot_max": 3.0, "g": 0.0, "b": 0.0, "q_0": 0.0}
    limited = simulate("Pendulum", ["q", "q_dot"], parameters, [5.0] * 50, 0.001)
    at_limit = simulate("Pendulum", ["q", "q_dot"], parameters, [0.1] * 50, 0.001)
    assert limited.tolist() == at_limit.tolist()
    assert limited[:, 1].max() == 3.0


BASE = {"P1": 7.466e-4, "P2": 1.489e-4, "P3": 2.160e-4, "P6": 2.122e-4, "P4": 0.09642, "P5": 0.034}
DOUBLE = ["q1", "q1_dot", "q2", "q2_dot"]
SWING = {"q1_0": 1.5, "q1_dot_0": 2.0, "q2_0": -2.2, "q2_dot_0": 4.0}
NO_FRICTION = {"b1": 0.0, "b2": 0.0, "cf1": 0.0, "cf2": 0.0, "q_dot_max": 1e3}
without_fmi_1 = pytest.mark.parametrize("fmi_version", ["2.0", "3.0"])


def double_inertia(q2, p):
    """The inertia matrix, shape (2, 2) or (2, 2, n)."""
    coupling = p["P3"] + p["P2"] * np.cos(q2)
    return np.array([[p["P1"] + 2 * p["P2"] * np.cos(q2), coupling], [coupling, p["P6"] + 0 * q2]])


@without_fmi_1
@pytest.mark.parametrize("changed", [{}, {"P3": 1.6e-4, "P6": 2.6e-4}])
def test_frictionless_double_pendulum_keeps_its_energy(fmi_version, changed):
    """Also where P3 and P6 are not the same."""
    p = BASE | changed
    parameters = {**p, **NO_FRICTION, **SWING, "max_step": 2e-4}
    rest = [np.zeros(2)] * 200
    rows = simulate("DoublePendulum", DOUBLE, parameters, rest, 0.02, fmi_version)
    q1, v1, q2, v2 = rows.T
    v = np.array([v1, v2])
    energy = 0.5 * np.einsum("in,ijn,jn->n", v, double_inertia(q2, p), v)
    energy -= p["P4"] * np.cos(q1) + p["P5"] * np.cos(q1 + q2)
    assert np.ptp(q1) > 2  # it does swing
    assert np.ptp(q2) > 4
    assert np.ptp(energy) < 1e-7 * (p["P4"] + p["P5"])


@without_fmi_1
def test_double_pendulum_with_friction_agrees_with_scipy(fmi_version):
    """Against Lagrange's equations in mass-matrix form, solved numerically at each point."""
    p, torque = BASE, np.array([0.05, -0.03])
    b, cf = np.array([3.2e-4, 1.31e-4]), np.array([2.29e-3, 3.15e-3])

    def derivative(_, state):
        q1, v1, q2, v2 = state
        v = np.array([v1, v2])
        slope = -p["P2"] * np.sin(q2) * np.array([[2.0, 1.0], [1.0, 0.0]])  # of M over q2
        centrifugal = slope @ v * v2 - [0.0, 0.5 * v @ slope @ v]
        gravity = p["P5"] * np.sin(q1 + q2) + np.array([p["P4"] * np.sin(q1), 0.0])
        forces = torque - b * v - cf * np.tanh(v / 0.05) - gravity - centrifugal
        a1, a2 = np.linalg.solve(double_inertia(q2, p), forces)
        return v1, a1, v2, a2

    parameters = {**SWING, "max_step": 1e-5}  # the friction turns within 1 ms
    ours = simulate("DoublePendulum", DOUBLE, parameters, [torque] * 50, 0.02, fmi_version)
    times = np.linspace(0, 1, 51)
    start = [SWING[f"{name}_0"] for name in DOUBLE]
    theirs = solve_ivp(derivative, (0, 1), start, "DOP853", times, rtol=1e-11, atol=1e-12).y.T
    assert np.abs(ours - theirs).max() < 1e-6


def test_acrobot_and_pendubot_have_one_motor():
    for limit, idle in (("tau_max1", [0.1, 0.05]), ("tau_max2", [0.05, 0.1])):
        torques = np.array(idle) * (np.array(["tau_max1", "tau_max2"]) != limit)
        limited = simulate("DoublePendulum", DOUBLE, {limit: 0.0}, [idle] * 20, 0.02)
        driven = simulate("DoublePendulum", DOUBLE, {}, [torques] * 20, 0.02)
        assert limited.tolist() == driven.tolist()
        assert np.ptp(limited[:, 0]) > 0.01


def test_double_pendulum_velocity_limit():
    parameters = {**NO_FRICTION, "P4": 0.0, "P5": 0.0, "q_dot_max": 3.0}
    rows = simulate("DoublePendulum", DOUBLE, parameters, [[0.15, 0.15]] * 50, 0.01)
    assert np.abs(rows[:, [1, 3]]).max() == 3.0


@pytest.mark.parametrize(("name", "value"), [("P6", 1e-12), ("P3", 6e-4)])
def test_an_indefinite_inertia_is_refused(name, value):
    with pytest.raises(fmugym.SimulationError, match="positive definite inertia matrix"):
        simulate("DoublePendulum", DOUBLE, {name: value}, [], 0.02)
