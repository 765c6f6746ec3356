"""Controllers that need no training, as baselines for trained agents.

Each is made without an environment and bound to one or to many::

    controller = PID("theta", setpoint=0.0, kp=-0.4, td=0.15)
    controller.bind(env)
    observation, info = env.reset(seed=0)
    action = controller.act(observation, info)

All read the observation by the names of its elements and return actions of the action space.
"""

from fmugym.baselines.controller import Controller
from fmugym.baselines.feedback import LQR, PID, Hysteresis
from fmugym.baselines.feedforward import Constant, Random, Schedule
from fmugym.baselines.mpc import MPC
from fmugym.baselines.parsing import controller_of
from fmugym.baselines.table import ControllerTable, Signal
from fmugym.baselines.tuning import Tuning, tune

__all__ = [
    "LQR",
    "MPC",
    "PID",
    "Constant",
    "Controller",
    "ControllerTable",
    "Hysteresis",
    "Random",
    "Schedule",
    "Signal",
    "Tuning",
    "controller_of",
    "tune",
]
