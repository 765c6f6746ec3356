"""A distillation column in Python, which ``pythonfmu`` exports: Wood and Berry (1973).

A 2x2 plant of first-order lags with dead times, in minutes, as deviations. Other parameters make
other plants of it; with ``feedback`` 0 it integrates, with -1 it is unstable.
"""

import math

from pythonfmu import Fmi2Causality, Fmi2Slave, Fmi2Variability, Real

GAINS = {"11": 12.8, "12": -18.9, "21": 6.6, "22": -19.4}
TIMES = {"11": 16.7, "12": 21.0, "21": 10.9, "22": 14.4}
DELAYS = {"11": 1, "12": 3, "21": 7, "22": 3}
MINUTE = 60.0


class Column(Fmi2Slave):
    def __init__(self, **kwargs):
        super().__init__(**kwargs)
        self.reflux, self.steam, self.top, self.bottom = 0.0, 0.0, 0.0, 0.0
        self.feedback = 1.0
        for pair, gain in GAINS.items():
            setattr(self, f"gain_{pair}", gain)
        self._states = dict.fromkeys(GAINS, 0.0)
        self._past = [(0.0, 0.0)] * max(DELAYS.values())
        for name in ("reflux", "steam"):
            self.register_variable(Real(name, causality=Fmi2Causality.input))
        for name in ("top", "bottom"):
            self.register_variable(Real(name, causality=Fmi2Causality.output))
        parameter = {"causality": Fmi2Causality.parameter, "variability": Fmi2Variability.fixed}
        for name in ("feedback", *(f"gain_{pair}" for pair in GAINS)):
            self.register_variable(Real(name, **parameter))

    def do_step(self, current_time, step_size):
        """Steps of a minute, for which inputs are held: the exact solution."""
        assert step_size == MINUTE
        self._past.append((self.reflux, self.steam))
        for pair, state in self._states.items():
            value = self._past[-1 - DELAYS[pair]][int(pair[1]) - 1] * getattr(self, f"gain_{pair}")
            pole = -self.feedback / TIMES[pair]
            grown = math.exp(pole)
            share = (grown - 1.0) / pole if pole else 1.0
            self._states[pair] = grown * state + share * value / TIMES[pair]
        self.top = self._states["11"] + self._states["12"]
        self.bottom = self._states["21"] + self._states["22"]
        return True
