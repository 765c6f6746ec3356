"""An FMU in Python that gets a signal while it works: ``pythonfmu`` exports this file."""

import os

from pythonfmu import Fmi2Causality, Fmi2Slave, Fmi2Variability, Integer, Real


class Signalled(Fmi2Slave):
    """``when`` says in which call: 1 initialization, 2 a step; ``number`` which signal it is."""

    def __init__(self, **kwargs):
        super().__init__(**kwargs)
        self.u, self.y, self.at, self.number, self.when = 0.0, 0.0, 0.0, 0, 0
        fixed = {"causality": Fmi2Causality.parameter, "variability": Fmi2Variability.fixed}
        self.register_variable(Integer("number", **fixed))
        self.register_variable(Integer("when", **fixed))
        self.register_variable(Real("at", **fixed))
        self.register_variable(Real("u", causality=Fmi2Causality.input))
        self.register_variable(Real("y", causality=Fmi2Causality.output))
        if "FMUGYM_TEST_SIGNAL" in os.environ:
            self.signal(int(os.environ["FMUGYM_TEST_SIGNAL"]))

    def signal(self, number):
        os.kill(os.getpid(), number)
        for _ in range(1000):  # handlers run between two instructions of Python
            pass

    def exit_initialization_mode(self):
        if self.when == 1:
            self.signal(self.number)

    def do_step(self, current_time, step_size):
        if self.when == 2 and abs(current_time - self.at) < 1e-6:
            self.signal(self.number)
        self.y += self.u * step_size
        return True
