"""Heat two zones of a house: a heat pump with a tank, two radiator valves, and walls unseen.

The plant is a Python class that pythonfmu exports as an FMU, the task is a TOML file. Three
proportional controllers, written by hand in five minutes, are what an agent has to beat.

    pip install '.[examples]' pythonfmu
    python examples/two_zones.py --folder results
    fmugym train results/two_zones.toml --minutes 4 --output results/agent

writes the FMU and the task, plays the controllers by hand in days that no training sees, and
trains an agent.
"""

import argparse
from pathlib import Path

import numpy as np
from pythonfmu.builder import FmuBuilder

import fmugym
from fmugym.control import Controller
from fmugym.envs.house import HOUSE_TASK

PLANT = '''
from pythonfmu import Fmi2Causality, Fmi2Slave, Fmi2Variability, Real


class TwoZones(Fmi2Slave):
    """Two zones of 70 m2 with radiators, which a heat pump feeds from a tank.

    Temperatures are in degC, powers and heat flows in W, times in s. The house loses 200 W/K: 60
    W/K by windows and air and 40 W/K through the walls in each zone.
    """

    def __init__(self, **kwargs):
        super().__init__(**kwargs)
        self.u_hp, self.v1, self.v2 = 0.0, 0.0, 0.0
        self.T_out, self.sun, self.people = 5.0, 0.0, 300.0
        self.T1, self.T2, self.T_tank, self.P = 20.0, 19.0, 42.0, 0.0
        self.T1_0, self.T2_0, self.T_tank_0, self.T_wall_0 = 20.0, 19.0, 42.0, 18.0
        self._internal_step = 30.0
        for name in ("u_hp", "v1", "v2", "T_out", "sun", "people"):
            self.register_variable(Real(name, causality=Fmi2Causality.input))
        for name in ("T1", "T2", "T_tank", "P"):
            self.register_variable(Real(name, causality=Fmi2Causality.output))
        parameter = {"causality": Fmi2Causality.parameter, "variability": Fmi2Variability.fixed}
        for name in ("T1_0", "T2_0", "T_tank_0", "T_wall_0"):
            self.register_variable(Real(name, **parameter))

    def exit_initialization_mode(self):
        self.T1, self.T2 = self.T1_0, self.T2_0
        self.T_tank, self._T_wall = self.T_tank_0, self.T_wall_0

    def do_step(self, current_time, step_size):
        count = max(1, round(step_size / self._internal_step))
        for _ in range(count):
            self._move(step_size / count)
        return True

    def _move(self, seconds):
        """An explicit Euler step."""
        heat, self.P = self._heat_pump()
        into_1 = self._radiator(self.v1, self.T1)
        into_2 = self._radiator(self.v2, self.T2)
        # 400 l of water in a cellar of 15 degC; 2 W/K is class C of Regulation (EU) 812/2013.
        tank = (heat - into_1 - into_2 - 2.0 * (self.T_tank - 15.0)) / 1.67e6
        # Effective windows: 2.5 m2 to the south, 0.5 m2 to the north. A door of 30 W/K between.
        door = 30.0 * (self.T1 - self.T2)
        rate_1 = into_1 + self._gains(self.T1, 2.5) - door
        rate_2 = into_2 + self._gains(self.T2, 0.5) + door
        wall = 450.0 * (self.T1 + self.T2 - 2.0 * self._T_wall)
        wall += 80.0 * (self.T_out - self._T_wall)
        # Air and furniture: 10 kJ/K for a m2 of floor (ISO 52016-1); 1 cm of plaster: 32 kJ/K.
        self.T1 += seconds * rate_1 / 2.9e6
        self.T2 += seconds * rate_2 / 2.9e6
        # Walls and floors: 165 kJ/K for a m2 of floor, class "medium" (ISO 13790, table 12).
        self._T_wall += seconds * wall / 23e6
        self.T_tank += seconds * tank

    def _gains(self, T, window):
        """What a zone gets from people, sun, air and walls."""
        gains = 0.5 * self.people + window * self.sun
        return gains + 60.0 * (self.T_out - T) + 450.0 * (self._T_wall - T)

    def _radiator(self, valve, T):
        """Heat of radiators of 9 kW at 50 K above the room, with the exponent of EN 442, 1.3."""
        opening = min(max(valve, 0.0), 1.0)
        return opening * 9000.0 * (max(self.T_tank - T, 0.0) / 50.0) ** 1.3

    def _heat_pump(self):
        """Heat and electric power at a part load, which is off below 0.2.

        The COP is that of Ruhnau et al., Scientific Data 6:189 (2019), with their correction of
        0.85. Over the last 3 K below 60 degC, the heat pump reduces its power.
        """
        load = min(self.u_hp, 1.0, max((60.0 - self.T_tank) / 3.0, 0.0))
        if load < 0.2:
            return 0.0, 0.0
        lift = min(max(self.T_tank - self.T_out, 15.0), 90.0)
        cop = 0.85 * (6.08 - 0.09 * lift + 0.0005 * lift**2)
        return cop * 3000.0 * load, 3000.0 * load
'''

TASK = """
description = "Heat two zones cheaply: a heat pump with a tank, two valves, and walls unseen."
fmu = "TwoZones.fmu"
time_step = "15min"
episode_length = "2d"
clock = { from = "10-01", to = "04-15" }
expressions = { hour = { expr = "clock / 3600 % 24", min = 0, max = 24 } }

[variables]
u_hp = { min = 0, max = 1 }
v1 = { min = 0, max = 1 }
v2 = { min = 0, max = 1 }
T1 = { fmu_unit = "degC", min = 5, max = 35 }
T2 = { fmu_unit = "degC", min = 5, max = 35 }
T_tank = { fmu_unit = "degC", min = 10, max = 60 }
power = { name = "P", fmu_unit = "W", unit = "kW", sample = "mean" }

[parameters]
T1_0 = { distribution = "uniform", low = 18, high = 21 }
T2_0 = { distribution = "uniform", low = 17, high = 20 }
T_wall_0 = { distribution = "uniform", low = 16, high = 19 }
T_tank_0 = { distribution = "uniform", low = 35, high = 48 }

[data]
T_out = { file = 'YEAR', column = "T_out_degC", time = "time_s", input = "T_out" }
sun = { file = 'YEAR', column = "I_sol_W_m2", time = "time_s", input = "sun" }
price = { file = 'YEAR', column = "price_EUR_kWh", time = "time_s", interpolation = "previous" }

[data.people]
file = 'YEAR'
column = "Q_int_W"
time = "time_s"
interpolation = "previous"
input = "people"

[setpoints]
T1_set = { schedule = { "06:00" = 21, "22:00" = 18 } }
T2_set = { schedule = { "06:00" = 20, "09:00" = 17, "18:00" = 20, "23:00" = 17 } }

[agent]
actions = ["u_hp", "v1", "v2"]
observations = ["T1", "T2", "T_tank", "T1_set", "T2_set", "T_out", "sun", "price", "hour"]
forecast = { of = ["T1_set", "T2_set", "T_out", "price"], horizon = "6h", step = "2h" }

[reward]
energy = "-price * power * dt_h"
cold = "-0.5 * (max(T1_set - T1, 0) + max(T2_set - T2, 0)) * dt_h"
warm = "-0.5 * (max(T1 - 24, 0) + max(T2 - 24, 0)) * dt_h"
"""


class ByHand(Controller):
    """Three proportional controllers: the tank at 48 degC, both zones at their set points."""

    def _decide(self, rows):
        value = dict(zip(self.names, rows.T, strict=True))
        u_hp = 0.2 * (48 - value["T_tank"])
        v1, v2 = (0.5 + (value[f"{T}_set"] + 0.5 - value[T]) for T in ("T1", "T2"))
        return np.stack([u_hp, v1, v2], axis=1)


def make_task(folder):
    """Write the FMU and the task; returns the path of the task."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "zones.py").write_text(PLANT)
    FmuBuilder.build_FMU(folder / "zones.py", dest=folder)
    path = folder / "two_zones.toml"
    path.write_text(TASK.lstrip().replace("YEAR", str(HOUSE_TASK.with_name("house_year.csv"))))
    return path


def rewards_of(controller, path, seeds):
    """The total reward of an episode for each seed, in euro."""
    env = fmugym.load(path, physical=True)
    controller.bind(env)
    totals = []
    for seed in seeds:
        observation, info = env.reset(seed=seed)
        controller.reset()
        total, has_ended = 0.0, False
        while not has_ended:
            action = controller.act(observation, info)
            observation, reward, terminated, truncated, info = env.step(action)
            total, has_ended = total + reward, terminated or truncated
        totals.append(total)
    env.close()
    return totals


def main(argv=None):
    """Make the task, and play the controllers by hand."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--folder", type=Path, default=Path("results"))
    parser.add_argument("--episodes", type=int, default=20)
    options = parser.parse_args(argv)
    path = make_task(options.folder)
    rewards = rewards_of(ByHand(), path, range(1_000_000, 1_000_000 + options.episodes))
    print(f"{path}: by hand {np.mean(rewards):.2f} euro in two days")
    return rewards


if __name__ == "__main__":
    main()
