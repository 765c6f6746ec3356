"""Controllers that need no training, and models for them: linear, surrogate, identified.

Each controller is made without an environment and bound to one or to many::

    controller = PID("theta", setpoint=0.0, kp=-0.4, td=0.15)
    controller.bind(env)
    observation, info = env.reset(seed=0)
    action = controller.act(observation, info)

All read the observation by the names of its elements and return actions of the action space. They
are baselines for trained agents.
"""

from typing import TYPE_CHECKING

from fmugym.extras import lazily

if TYPE_CHECKING:
    from fmugym.control.controller import Controller
    from fmugym.control.controller_parsing import controller_of
    from fmugym.control.controller_table import ControllerTable, Signal
    from fmugym.control.mpc import MPC
    from fmugym.control.standard_controllers import (
        LQR,
        PID,
        Constant,
        Hysteresis,
        Random,
        Schedule,
    )
    from fmugym.control.tuning import Tuning, tune

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

_MODULES = {
    "controller": ["Controller"],
    "controller_parsing": ["controller_of"],
    "controller_table": ["ControllerTable", "Signal"],
    "mpc": ["MPC"],
    "standard_controllers": ["LQR", "PID", "Constant", "Hysteresis", "Random", "Schedule"],
    "tuning": ["Tuning", "tune"],
}

__getattr__ = lazily(
    __name__,
    {name: f"{__name__}.{module}" for module, names in _MODULES.items() for name in names},
)
