"""A water tank in Python: ``pythonfmu3`` exports this file as an FMU of FMI 3.0."""

from pythonfmu3 import Boolean, Float64, Fmi3Causality, Fmi3Slave, Fmi3Variability, Int32


class Tank3(Fmi3Slave):
    def __init__(self, **kwargs):
        super().__init__(**kwargs)
        self.time, self.inflow, self.valve_open = 0.0, 0.0, False
        self.area, self.level, self.switches = 2.0, 1.0, 0
        self._was_open = False
        continuous = {"variability": Fmi3Variability.continuous}
        discrete = {"variability": Fmi3Variability.discrete}
        self.register_variable(Float64("time", causality=Fmi3Causality.independent, **continuous))
        self.register_variable(Float64("inflow", causality=Fmi3Causality.input, **continuous))
        self.register_variable(Boolean("valve_open", causality=Fmi3Causality.input, **discrete))
        fixed = {"causality": Fmi3Causality.parameter, "variability": Fmi3Variability.fixed}
        self.register_variable(Float64("area", **fixed))
        self.register_variable(Float64("level", causality=Fmi3Causality.output, **continuous))
        self.register_variable(Int32("switches", causality=Fmi3Causality.output, **discrete))

    def do_step(self, current_time, step_size):
        self.switches += int(self.valve_open != self._was_open)
        self._was_open = self.valve_open
        outflow = 0.3 * self.valve_open * max(self.level, 0.0) ** 0.5
        self.level += step_size * (self.inflow - outflow) / self.area
        return True
