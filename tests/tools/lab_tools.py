"""Labs without imperfections, and the calls that tests of the lab repeat."""

import math

from fmugym.lab import Client, Lab, ManualClock

TOKEN = "a user's token"
AT_ONCE = {"get_time": (0.0, 0.0), "set_time": (0.0, 0.0)}
IDEAL = {
    "homing_time": 0.0,
    "hold_stiffness": math.inf,
    "coulomb_friction": (0.0, 0.0),
    "sample_period": 0.0,
    "early_sample_share": 0.0,
    "encoder_step": (0.0, 0.0),
    "velocity_lag": 0.0,
    "velocity_noise": (0.0, 0.0),
    "torque_noise": 0.0,
    "stall_share": 0.0,
    **AT_ONCE,
}
"""Options of cells without friction, noise and delay of their own."""


def ideal_lab(**arguments):
    """A lab of ideal cells, with a clock that the test moves."""
    return Lab(**{"clock": ManualClock(), "seed": 0, **IDEAL, **arguments})


def experiment(lab, kind="SimplePendulum", length=30.0, **arguments):
    """Start an experiment; returns a client and the session token."""
    client = Client(lab)
    return client, client.start_experiment(TOKEN, kind, length, **arguments)[0]


def track(lab, client, token, duration, period=0.02, getter="get_position"):
    """Read a cell at a fixed rate; returns the readings, the first one at once."""
    readings, begin = [], lab.clock.time()
    for tick in range(math.floor(duration / period + 1e-9) + 1):
        lab.clock.sleep(begin + tick * period - lab.clock.time())
        readings.append(getattr(client, getter)(token))
    return readings
