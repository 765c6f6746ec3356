"""An integrator in Python that fails beyond a limit: ``pythonfmu`` exports this file as an FMU."""

from pythonfmu import Fmi2Causality, Fmi2Slave, Fmi2Variability, Real


class Fragile(Fmi2Slave):
    def __init__(self, **kwargs):
        super().__init__(**kwargs)
        self.u, self.y, self.limit = 0.0, 0.0, 0.55
        fixed = {"causality": Fmi2Causality.parameter, "variability": Fmi2Variability.fixed}
        self.register_variable(Real("limit", **fixed))
        self.register_variable(Real("u", causality=Fmi2Causality.input))
        self.register_variable(Real("y", causality=Fmi2Causality.output))

    def do_step(self, current_time, step_size):
        self.y += self.u * step_size
        if self.y > self.limit:
            raise ValueError("beyond the limit")
        return True
