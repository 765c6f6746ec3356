"""A simulated lab of pendulum cells with the client interface of the CloudPendulum lab.

To run a program for the real lab here, change its import::

    from fmugym.lab import CellType, Client

    client = Client()
    gym_token = client.start_gym("any text", 30, [CellType.SINGLE])
    token, _ = client.start_episode(gym_token, "SimplePendulum", 5, initial_position=[1.0])
    client.set_torque(0.01, token)
    print(client.get_position(token))
    client.stop_gym(gym_token)

`Lab` creates labs with other properties: ``Lab(torque_noise=0.0)`` has cells that read torques
without noise, and ``Lab(clock=ManualClock())`` has a clock that the program moves.
"""

from fmugym.lab.client import Client
from fmugym.lab.data import CellType, LabError, UserInfo
from fmugym.lab.lab import Lab, current_lab
from fmugym.lab.lab_options import Options
from fmugym.pool.rig.clocks import Clock, ManualClock, RealClock

__all__ = [
    "CellType",
    "Client",
    "Clock",
    "Lab",
    "LabError",
    "ManualClock",
    "Options",
    "RealClock",
    "UserInfo",
    "current_lab",
]
