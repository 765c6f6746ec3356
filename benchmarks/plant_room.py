"""A room in Python, which ``pythonfmu`` exports: air and walls, a heater, and what it is outside.

The air has 2 MJ/K and loses 60 W/K to outside; the walls have 20 MJ/K and exchange 300 W/K with the
air. The temperature outside and the sun follow the hours of the day.
"""

import math

from pythonfmu import Fmi2Causality, Fmi2Slave, Fmi2Variability, Real

_STEP = 300.0


class Room(Fmi2Slave):
    """Heat in W in, temperatures in degC out."""

    def __init__(self, **kwargs):
        super().__init__(**kwargs)
        self.heat, self.T, self.T_wall, self.T_mean = 0.0, 19.0, 19.0, 2.0
        self.T_out, self.sun = 2.0, 0.0
        self.register_variable(Real("heat", causality=Fmi2Causality.input))
        fixed = {"causality": Fmi2Causality.parameter, "variability": Fmi2Variability.fixed}
        self.register_variable(Real("T_mean", **fixed))
        for name in ("T", "T_wall", "T_out", "sun"):
            self.register_variable(Real(name, causality=Fmi2Causality.output))

    def do_step(self, current_time, step_size):
        """Step by explicit Euler."""
        for number in range(round(step_size / _STEP)):
            hour = (current_time + number * _STEP) / 3600 % 24
            self.T_out = self.T_mean + 6 * math.cos(math.pi * (hour - 15) / 12)
            self.sun = 1500 * max(0.0, math.sin(math.pi * (hour - 7) / 11)) if hour < 18 else 0.0
            gain = self.heat + self.sun + 60 * (self.T_out - self.T)
            self.T += _STEP * (gain + 300 * (self.T_wall - self.T)) / 2e6
            self.T_wall += _STEP * 300 * (self.T - self.T_wall) / 2e7
        return True
