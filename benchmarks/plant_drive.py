"""A drive in Python, which ``pythonfmu`` exports: a motor turns a load through an elastic shaft.

The motor has 0.02 kg m2, the load 0.05 kg m2, the shaft between them 5 N m/rad and 0.02 N m s/rad.
The load has viscous and dry friction.
"""

import math

from pythonfmu import Fmi2Causality, Fmi2Slave, Fmi2Variability, Real

_STEP = 2e-3


class Drive(Fmi2Slave):
    """Torque in, speeds out."""

    def __init__(self, **kwargs):
        super().__init__(**kwargs)
        self.tau, self.w_motor, self.w_load, self.twist, self.dry = 0.0, 0.0, 0.0, 0.0, 0.2
        self.register_variable(Real("tau", causality=Fmi2Causality.input))
        fixed = {"causality": Fmi2Causality.parameter, "variability": Fmi2Variability.fixed}
        self.register_variable(Real("dry", **fixed))
        for name in ("w_motor", "w_load", "twist"):
            self.register_variable(Real(name, causality=Fmi2Causality.output))

    def do_step(self, current_time, step_size):
        """Step by semi-implicit Euler."""
        for _ in range(round(step_size / _STEP)):
            shaft = 5.0 * self.twist + 0.02 * (self.w_motor - self.w_load)
            friction = self.dry * math.tanh(self.w_load / 0.05) + 0.02 * self.w_load
            self.w_motor += _STEP * (self.tau - shaft) / 0.02
            self.w_load += _STEP * (shaft - friction) / 0.05
            self.twist += _STEP * (self.w_motor - self.w_load)
        return True
