"""A lag with a stiff companion, by one step of explicit Euler in each communication step."""

from pythonfmu import Fmi2Causality, Fmi2Slave, Fmi2Variability, Real


class StiffLag(Fmi2Slave):
    def __init__(self, **kwargs):
        super().__init__(**kwargs)
        self.u, self.x, self.fast, self.rate = 0.0, 0.0, 0.0, 1.0
        self.change = 0.0
        self.register_variable(Real("u", causality=Fmi2Causality.input))
        self.register_variable(
            Real("rate", causality=Fmi2Causality.parameter, variability=Fmi2Variability.fixed)
        )
        self.register_variable(Real("x", causality=Fmi2Causality.output))
        self.register_variable(Real("fast", causality=Fmi2Causality.output))
        self.register_variable(Real("change", causality=Fmi2Causality.output))
        self.register_variable(Real("rated", causality=Fmi2Causality.output))
        self._last = 0.0

    @property
    def rated(self):
        return self.rate

    def do_step(self, current_time, step_size):
        self.x += step_size * (self.u - self.x)
        self.fast += step_size * self.rate * (self.x - self.fast)
        self.change, self._last = self.u - self._last, self.u
        return True
