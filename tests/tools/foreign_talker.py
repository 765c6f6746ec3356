"""A model for ``pythonfmu``, an exporter of others: it says a word that is a parameter."""

from pythonfmu import Fmi2Causality, Fmi2Slave, Fmi2Variability, Real, String


class Talker(Fmi2Slave):
    """Tells the word and the time of its last step."""

    def __init__(self, **kwargs):
        super().__init__(**kwargs)
        self.word, self.said, self.length = "none", "", 0.0
        fixed, discrete = Fmi2Variability.fixed, Fmi2Variability.discrete
        self.register_variable(String("word", causality=Fmi2Causality.parameter, variability=fixed))
        self.register_variable(String("said", causality=Fmi2Causality.output, variability=discrete))
        self.register_variable(Real("length", causality=Fmi2Causality.output))

    def do_step(self, current_time, step_size):
        """Say it."""
        self.said = f"{self.word} at {current_time:.1f}"
        self.length = float(len(self.word))
        return True
