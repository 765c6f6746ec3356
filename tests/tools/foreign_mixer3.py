"""A mixer in Python: ``pythonfmu3`` exports this file as an FMU of FMI 3.0 with arrays."""

import numpy as np
from pythonfmu3 import Dimension, Float64, Fmi3Causality, Fmi3Slave, Fmi3Variability


class Mixer3(Fmi3Slave):
    """Integrates y' = gain u, with three inputs and two outputs; the gain has two rows."""

    def __init__(self, **kwargs):
        super().__init__(**kwargs)
        self.time, self.u, self.y = 0.0, np.zeros(3), np.zeros(2)
        self.gain = np.array([[1.0, 0.0, 0.5], [0.0, 2.0, -1.0]])
        self.register_variable(
            Float64(
                "time",
                causality=Fmi3Causality.independent,
                variability=Fmi3Variability.continuous,
            )
        )
        self._register("u", Fmi3Causality.input, Fmi3Variability.continuous)
        self._register("y", Fmi3Causality.output, Fmi3Variability.continuous)
        self._register("gain", Fmi3Causality.parameter, Fmi3Variability.tunable)

    def _register(self, name, causality, variability):
        """The setter of ``pythonfmu3`` itself calls numpy as numpy 2.4 does not allow."""
        shape = getattr(self, name).shape
        self.register_variable(
            Float64(
                name,
                causality=causality,
                variability=variability,
                dimensions=[Dimension(start=str(length)) for length in shape],
                setter=lambda values: setattr(self, name, np.reshape(values, shape)),
            )
        )

    def do_step(self, current_time, step_size):
        self.y = self.y + step_size * self.gain @ self.u
        return True
