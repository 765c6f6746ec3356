"""The battery of ``classes.Home``, which ``pythonfmu`` exports; a copy from an example."""

from pythonfmu import Fmi2Causality, Fmi2Slave, Fmi2Variability, Real


class Battery(Fmi2Slave):
    """A battery between a house, its solar cells and the grid."""

    def __init__(self, **kwargs):
        super().__init__(**kwargs)
        self.P_house, self.P_pv, self.command = 0.0, 0.0, 0.0
        self.P_grid, self.charge = 0.0, 0.2
        self.capacity, self.P_max = 10.0 * 3.6e6, 4000.0
        for name in ("P_house", "P_pv", "command"):
            self.register_variable(Real(name, causality=Fmi2Causality.input))
        for name in ("P_grid", "charge"):
            self.register_variable(Real(name, causality=Fmi2Causality.output))
        for name in ("capacity", "P_max"):
            self.register_variable(
                Real(name, causality=Fmi2Causality.parameter, variability=Fmi2Variability.tunable)
            )

    def do_step(self, current_time, step_size):
        most = (1.0 - self.charge) * self.capacity / step_size / 0.95
        least = -self.charge * self.capacity / step_size
        limit = max(-self.P_max, least), min(self.P_max, most)
        power = min(max(self.command * self.P_max, limit[0]), limit[1])
        self.charge += power * (0.95 if power > 0 else 1.0) * step_size / self.capacity
        self.P_grid = self.P_house - self.P_pv + power / (0.95 if power < 0 else 1.0)
        return True
