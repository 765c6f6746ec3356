"""Shifts between the clocks of inputs and outputs are estimated, and told."""

import json

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from test_identification import TRUE

TASK = """
fmu = { bundled = "Pendulum" }
time_step = 0.02
reward = "-q ** 2"
parameters = { c = 0, q_0 = 0 }
[variables]
tau = { min = -1, max = 1 }
[agent]
actions = ["tau"]
observations = ["q"]
"""
G, INTERVAL = 9.81, 0.02


def write_log(path, shift, friction=0.0, noise=1e-3):
    """A pendulum that random torques drive, by SciPy; outputs are logged later by a shift."""
    rng = np.random.default_rng(0)
    time = np.arange(400) * INTERVAL
    torque = np.repeat(rng.uniform(-0.02, 0.02, 40), 10)
    m, length, b = (TRUE[name] for name in "mlb")

    def slopes(t, state):
        u = torque[min(int((t - shift) / INTERVAL + 1e-9), 399)] if t >= shift else 0.0
        q, speed = state
        moment = u - b * speed - friction * np.tanh(50 * speed) - m * G * length * np.sin(q)
        return speed, moment / (m * length**2)

    found = solve_ivp(slopes, (0, time[-1]), (0.0, 0.0), t_eval=time, max_step=0.005, rtol=1e-8)
    q = found.y[0] + rng.normal(0.0, noise, len(time))
    rows = np.stack([time, q, torque], axis=1).tolist()
    path.write_text("\n".join(["time,q,tau", *(",".join(map(repr, row)) for row in rows)]) + "\n")
    return path


def fitted(cli, folder, log):
    task = folder / "pendulum.toml"
    task.write_text(TASK)
    options = "--parameter", "l=0.05..0.2", "--parameter", "b=1e-5..0.01", "--candidates", 8
    code, out, err = cli("fit", task, "--log", log, *options, "--json")
    assert code == 0, err
    return json.loads(out)["shift"], err


@pytest.mark.parametrize("shift", [0.13, 0.06])
def test_a_shift_is_estimated(cli, tmp_path, shift):
    found, err = fitted(cli, tmp_path, write_log(tmp_path / "log.csv", shift))
    assert found["seconds"] == pytest.approx(shift, abs=0.005)
    assert found["improvement"] > 2
    assert f"the outputs are logged {found['seconds']:.3g} s later" in err
    assert "structure" not in err


def test_of_right_clocks_none_is_told(cli, tmp_path):
    found, err = fitted(cli, tmp_path, write_log(tmp_path / "log.csv", 0.0))
    assert found is None
    assert "logged" not in err
    assert "structure" not in err


def test_another_model_is_no_shift(cli, tmp_path):
    found, err = fitted(cli, tmp_path, write_log(tmp_path / "log.csv", 0.0, friction=0.01))
    assert found is None
    assert "the structure of the model is not that of the plant" in err
