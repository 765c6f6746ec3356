"""A simulated lab of pendulum cells with the client interface of the CloudPendulum lab.

To run a program for the real lab here, change its import::

    from fmugym.lab import CellType, Client

    client = Client()
    gym_token = client.start_gym("any text", 30, [CellType.SINGLE])
    token, _ = client.start_episode(gym_token, "SimplePendulum", 5, initial_position=[1.0])
    client.set_torque(0.01, token)
    print(client.get_position(token))
    client.stop_gym(gym_token)

`Lab` creates labs with other properties: ``Lab("ideal")`` has cells without friction, noise and
delay, and ``Lab(clock=ManualClock())`` has a clock that the program moves.
"""

from fmugym.lab.client import Client, Lab, current_lab
from fmugym.lab.data import ActuatorInfo, CellInfo, CellType, LabError, UserInfo
from fmugym.lab.presets import HARDWARE, IDEAL, Options
from fmugym.lab.users import User
from fmugym.pool.backend.clocks import Clock, ManualClock, RealClock

__all__ = [
    "HARDWARE",
    "IDEAL",
    "ActuatorInfo",
    "CellInfo",
    "CellType",
    "Client",
    "Clock",
    "Lab",
    "LabError",
    "ManualClock",
    "Options",
    "RealClock",
    "User",
    "UserInfo",
    "current_lab",
]
