"""The roof of ``classes.Home``, which ``pythonfmu`` exports; a copy from an example."""

import math

from pythonfmu import Fmi2Causality, Fmi2Slave, Fmi2Variability, Real


class Roof(Fmi2Slave):
    """Weather of a clear day in March, and solar cells under it."""

    def __init__(self, **kwargs):
        super().__init__(**kwargs)
        self.area, self.T_out, self.I_sol, self.P_pv = 14.0, 278.0, 0.0, 0.0
        self.register_variable(
            Real("area", causality=Fmi2Causality.parameter, variability=Fmi2Variability.tunable)
        )
        for name in ("T_out", "I_sol", "P_pv"):
            self.register_variable(Real(name, causality=Fmi2Causality.output))

    def do_step(self, current_time, step_size):
        hour = (current_time + step_size) / 3600 % 24
        self.T_out = 278.0 - 6.0 * math.cos((hour - 3.0) * math.pi / 12)
        self.I_sol = max(0.0, 700.0 * math.sin((hour - 6.0) * math.pi / 12))
        self.P_pv = 0.2 * self.area * self.I_sol
        return True
