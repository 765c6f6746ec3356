"""What the tests of the lab do again and again."""

import math

from fmugym.lab import Client

TOKEN = "a user's token"


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
