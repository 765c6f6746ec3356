"""The tasks of the examples against scipy, FMPy's simulation and closed forms.

Other tests do so for those that come with the package: test_equal_to_gymnasium.py for the cart-pole
and the pendulum (and test_declared.py for their task files), test_house_plant.py for the house,
test_cloud_pendulum.py for the cell, test_physics.py for the cart-pole of the Modelica study.
"""

import math
from contextlib import closing

import fmpy
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from fmugym import FMUVectorEnv, bundled_fmu

STEPS = 60


def swing(q, v, torques, step, *, m=0.06, length=0.1, b=4e-4, g=9.81, rod=False):
    """Angle from hanging and velocity after each step, shape (steps, 2)."""
    inertia, weight = m * length**2, m * g * length
    if rod:
        inertia, weight = inertia / 3, weight / 2
    states = [(q, v)]
    for torque in torques:

        def derivative(_, state, torque=torque):
            return state[1], (torque - b * state[1] - weight * math.sin(state[0])) / inertia

        found = solve_ivp(derivative, (0, step), states[-1], "DOP853", rtol=1e-10, atol=1e-11)
        states.append(found.y[:, -1])
    return np.array(states[1:])


def away(q):
    """Twice the potential energy that a pendulum lacks to be upright, in units of its weight."""
    return 4 * (1 + np.cos(q))


def swing_up(drawn, torques):
    """Of mpc_pendulum.py."""
    q, v = swing(0, 0, torques, 0.05, m=1, length=1, b=0.05, g=10, rod=True).T
    rewards = -away(q) - 0.1 * v**2 - 0.001 * torques**2
    return np.stack([q - np.pi, v], axis=1), rewards, np.zeros(STEPS)


def brake(drawn, torques):
    """Of own_fmu.py."""
    states = swing(drawn["q_0"], 0, torques, 0.02, m=drawn["m"], b=1e-5)
    q, v = states.T
    rests = (abs(q) < 0.05) & (abs(v) < 0.3)
    return states, 10.0 * rests - q**2 - 0.01 * v**2, rests | (abs(q) > 3.0)


TASKS = {
    ("mpc_pendulum", "SwingUp"): (swing_up, 1e-5),
    ("own_fmu", "BrakeEnv"): (brake, 1e-9),
}
"""By file and class: what it gives, and by how much angles may be off; other values ten times."""


@pytest.mark.parametrize("task", TASKS, ids="-".join)
@pytest.mark.parametrize("seed", [1, 4])
def test_a_pendulum_with_a_motor(example, task, seed):
    """One environment and many; by the second seed, BrakeEnv is at rest after a step."""
    (file, name), (reference, tolerance) = task, TASKS[task]
    make = getattr(example(file), name)
    with closing(make()) as env, closing(FMUVectorEnv(make, 2, autoreset_mode="Disabled")) as envs:
        drawn = env.reset(seed=seed)[1].get("drawn", {})
        envs.reset(seed=[seed, seed])
        high = env.action_space.high[0]
        actions = (0.9 * high * np.sign(np.sin(0.25 * np.arange(STEPS)))).astype(np.float32)
        states, rewards, ends = reference(drawn, actions.astype(float))
        last = int(np.argmax(ends)) if any(ends) else STEPS - 1
        for step, action in enumerate(actions[: last + 1]):
            _, reward, terminated, truncated, _ = env.step(action[None])
            np.testing.assert_array_less(abs(env.state - states[step]), [tolerance, 10 * tolerance])
            assert reward == pytest.approx(rewards[step], abs=10 * tolerance)
            assert (terminated, truncated) == (ends[step], False)
            many = envs.step(np.full((2, 1), action))
            assert many[1].tolist() == [reward] * 2
            assert many[2].tolist() == [terminated] * 2


def test_a_system(example, tmp_path):
    """Of train_system.py: roof and battery in closed form, and the house as FMPy simulates it."""
    with closing(
        example("train_system").HomeEnv(example("train_system").make_system(tmp_path))
    ) as env:
        drawn = env.reset(seed=3)[1]["drawn"]["house.T_m_0"]
        actions = np.random.default_rng(0).uniform([0, -1], 1, (40, 2)).astype(np.float32)
        found = [(env.step(action)[1], *env.state) for action in actions]
    rewards, temperature, charge, power, grid = np.array(found).T
    hours = 0.25 * np.arange(1, 41)
    outside = 278 - 6 * np.cos((hours - 3) * np.pi / 12)
    solar = np.maximum(0, 700 * np.sin((hours - 6) * np.pi / 12))
    house = house_by_fmpy(drawn, outside, solar, actions[:, 0])
    np.testing.assert_allclose(power, 0.2 * 14 * solar)
    np.testing.assert_allclose(temperature, house["T_air"][1:], rtol=1e-12)
    level, lost = 0.2, 0.95
    for step, command in enumerate(actions[:, 1].astype(float)):
        flow = 4000 * command * 900 / 10 / 3.6e6  # of the capacity of 10 kWh
        flow = min(max(flow, -level), (1 - level) / lost)
        level += flow * (lost if flow > 0 else 1)
        bought = house["P"][step + 1] - power[step]
        bought += flow * 3.6e7 / 900 / (lost if flow < 0 else 1)
        assert charge[step] == pytest.approx(level)
        assert grid[step] == pytest.approx(bought)
        price = 0.06 if bought < 0 else 0.6 if 17 <= hours[step] % 24 < 22 else 0.2
        cold = max(293.15 - house["T_air"][step + 1], 0)
        assert rewards[step] == pytest.approx(-bought * price / 4000 - cold / 4)


def house_by_fmpy(start, outside, solar, heating):
    signal = np.zeros(80, [(name, float) for name in ("time", "T_out", "I_sol", "u")])
    signal["time"] = 900 * np.repeat(np.arange(41), 2)[1:-1]
    for name, values in (("T_out", outside), ("I_sol", solar), ("u", heating)):
        signal[name] = np.repeat(values, 2)
    return fmpy.simulate_fmu(
        str(bundled_fmu("House")),
        stop_time=36000,
        output_interval=900,
        start_values={"T_m_0": start},
        input=signal,
        output=["T_air", "P"],
    )
