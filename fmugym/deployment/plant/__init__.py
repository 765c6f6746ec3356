"""Plants: agents that follow a plant as its shadow, and FMUs served as plants.

::

    env = fmugym.deployment.plant.connect("house.toml")
    observation, info = env.reset()
    observation, reward, terminated, truncated, info = env.step(agent.act(observation))

This is no safety function. Interlocks stay in the PLC, and whoever enables writing is responsible.
Nothing in here writes to a plant.
"""

from fmugym.deployment.plant.plant_server import Server
from fmugym.deployment.plant.shadow import Shadow, connect

__all__ = ["Server", "Shadow", "connect"]
