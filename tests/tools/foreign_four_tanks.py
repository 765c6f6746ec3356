"""The quadruple tank of Johansson (2000), which ``pythonfmu`` exports.

K. H. Johansson, "The quadruple-tank process: a multivariable laboratory process with an adjustable
zero", IEEE Transactions on Control Systems Technology 8(3). Levels are in cm, pumps and sensors in
V, times in s. The valves of the parameters decide whether it is of minimum phase.
"""

import math

from pythonfmu import Fmi2Causality, Fmi2Slave, Fmi2Variability, Real

AREAS = (28.0, 32.0, 28.0, 32.0)
HOLES = (0.071, 0.057, 0.071, 0.057)
GRAVITY, SENSOR = 981.0, 0.5


class FourTanks(Fmi2Slave):
    def __init__(self, **kwargs):
        super().__init__(**kwargs)
        self.v1, self.v2, self.y1, self.y2 = 3.0, 3.0, 0.0, 0.0
        self.k1, self.k2, self.valve_1, self.valve_2 = 3.33, 3.35, 0.70, 0.60
        self.level_1, self.level_2, self.level_3, self.level_4 = 12.4, 12.7, 1.8, 1.4
        for name in ("v1", "v2"):
            self.register_variable(Real(name, causality=Fmi2Causality.input))
        for name in ("y1", "y2"):
            self.register_variable(Real(name, causality=Fmi2Causality.output))
        parameter = {"causality": Fmi2Causality.parameter, "variability": Fmi2Variability.fixed}
        levels = (f"level_{number}" for number in range(1, 5))
        for name in ("k1", "k2", "valve_1", "valve_2", *levels):
            self.register_variable(Real(name, **parameter))

    def exit_initialization_mode(self):
        self._levels = [self.level_1, self.level_2, self.level_3, self.level_4]
        self._measure()

    def do_step(self, current_time, step_size):
        count = max(1, round(step_size))
        for _ in range(count):
            self._move(step_size / count)
        self._measure()
        return True

    def _measure(self):
        self.y1, self.y2 = (SENSOR * level for level in self._levels[:2])

    def _move(self, seconds):
        one, two, three, four = (
            hole * math.sqrt(2 * GRAVITY * level)
            for hole, level in zip(HOLES, self._levels, strict=True)
        )
        pump_1, pump_2 = self.k1 * self.v1, self.k2 * self.v2
        flows = (
            three - one + self.valve_1 * pump_1,
            four - two + self.valve_2 * pump_2,
            (1 - self.valve_2) * pump_2 - three,
            (1 - self.valve_1) * pump_1 - four,
        )
        self._levels = [
            max(level + seconds * flow / area, 0.0)
            for level, flow, area in zip(self._levels, flows, AREAS, strict=True)
        ]
