"""The bundled models against closed forms, energy and scipy."""

import math

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.special import ellipk

import fmugym
from fmugym.bundled import FMI_VERSIONS


class Plain(fmugym.FMUEnv):
    """A bundled FMU as it is."""

    def _is_done(self):
        return False


def simulate(model, outputs, parameters, inputs, time_step, fmi_version="2.0"):
    """The outputs at the start and after each step, shape (len(inputs) + 1, len(outputs))."""
    config = {
        "model_input_names": "f" if model == "CartPole" else "tau",
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
