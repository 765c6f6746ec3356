"""A water tank in Python: ``pythonfmu`` exports this file as an FMU, the test also steps it."""

from pythonfmu import Boolean, Fmi2Causality, Fmi2Slave, Fmi2Variability, Integer, Real


class Tank(Fmi2Slave):
    def __init__(self, **kwargs):
        super().__init__(**kwargs)
        self.inflow, self.valve_open, self.pump_stage = 0.0, False, 0
        self.area, self.leaks = 2.0, False
        self.level, self.overflowing, self.switches = 1.0, False, 0
        self._was_open = False
        into = Fmi2Causality.input
        self.register_variable(Integer("pump_stage", causality=into))
        self.register_variable(Boolean("valve_open", causality=into))
        self.register_variable(Real("inflow", causality=into))
        parameter = {"causality": Fmi2Causality.parameter, "variability": Fmi2Variability.fixed}
        self.register_variable(Real("area", **parameter))
        self.register_variable(Boolean("leaks", **parameter))
        out = Fmi2Causality.output
        self.register_variable(Integer("switches", causality=out))
        self.register_variable(Real("level", causality=out))
        self.register_variable(Boolean("overflowing", causality=out))

    def do_step(self, current_time, step_size):
        self.switches += int(self.valve_open != self._was_open)
        self._was_open = self.valve_open
        drains = self.valve_open + 0.1 * self.leaks
        outflow = 0.3 * drains * max(self.level, 0.0) ** 0.5
        self.level += step_size * (self.inflow + 0.1 * self.pump_stage - outflow) / self.area
        self.overflowing = self.level > 1.5
        return True
