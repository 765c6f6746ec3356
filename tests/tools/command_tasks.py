"""Tasks that tests of several commands take."""

TURN = {
    "fmu": {"bundled": "Pendulum"},
    "time_step": 0.02,
    "episode_length": "1s",
    "variables": {"tau": {"min": -0.01, "max": 0.01}, "q": {"min": -20, "max": 20}},
    "agent": {"actions": ["tau"], "observations": ["q"]},
    "reward": "-abs(q - 1)",
}
"""A torque turns a pendulum to an angle of 1 rad within a second, as a dict."""

PRICES = """
fmu = { bundled = "Pendulum" }
time_step = "1h"
clock = "03-01"
reward = "-p"
[data]
p = { file = "prices.csv", column = "p", interpolation = "previous", timezone = "Europe/Berlin" }
q = { file = "prices.csv", column = 3, gaps = "3h", timezone = "Europe/Berlin" }
[agent]
actions = ["tau"]
observations = ["p", "q", "q_dot"]
[variables]
tau = { min = -1, max = 1 }
"""
"""Two series of a file with prices, of Berlin's time, as TOML."""
