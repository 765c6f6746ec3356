"""FMUs that demand something (``zoo/demanding.c``), and environments of them."""

import model_tools

STEP = 0.05
FLAGS = 'canHandleVariableCommunicationStepSize="true" ' + model_tools.STATES[2]


class DemandingEnv(model_tools.GainEnv):
    """The gain is constant unless given."""

    def __init__(self, path, gain=1.5, backend=None, log_level=30, **config):
        super().__init__(path, gain, log_level, backend, **{"time_step": STEP} | config)


def make_fmu(folder, token, flags='canSerializeFMUstate="true"'):
    """Write the FMU that does what its token says."""
    path = folder / token.replace(" ", "_") / "Demanding.fmu"
    variables, flags = model_tools.GAIN_VARIABLES, f"{FLAGS} {flags}"
    return model_tools.model_fmu(path, "demanding", 2, token, variables, flags=flags)


def expected_outputs(gain, inputs):
    """The outputs after each step, by the same operations in the same order."""
    y, rows = 0.0, [0.0]
    for u in inputs:
        for _ in range(round(STEP * 1000)):
            y += 0.001 * (gain * u - y)
        rows.append(y)
    return rows
