"""FMUs that demand something (``demanding.c``), and environments of them."""

import functools
import subprocess
import sys

from fmu_tools import HERE, library_name, write_fmu

import fmugym

XML = """<fmiModelDescription fmiVersion="2.0" modelName="Demanding" guid="{token}">
<CoSimulation modelIdentifier="Demanding" canHandleVariableCommunicationStepSize="true"
  canGetAndSetFMUstate="true" {flags}/>
<ModelVariables>
<ScalarVariable name="u" valueReference="0" causality="input">
<Real start="0" min="-1" max="1"/></ScalarVariable>
<ScalarVariable name="y" valueReference="1" causality="output"><Real/></ScalarVariable>
<ScalarVariable name="gain" valueReference="2" causality="parameter" variability="fixed">
<Real start="1"/></ScalarVariable>
</ModelVariables><ModelStructure/></fmiModelDescription>"""
STEP = 0.05


class DemandingEnv(fmugym.FMI2CSEnv):
    """Reads the output; the gain is constant unless given."""

    def __init__(self, path, gain=1.5, backend=None, log_level=30, **config):
        config = {
            "model_input_names": "u",
            "model_output_names": "y",
            "model_parameters": {"gain": gain},
            "time_step": STEP,
        } | config
        super().__init__(path, config, log_level, backend=backend)

    def _is_done(self):
        return self.out["y"] > 1e9


@functools.cache
def library(folder):
    """Compile the FMU's library; return its bytes."""
    path = folder / "Demanding.so"
    command = [sys.executable, "-m", "ziglang", "cc", "-shared", "-fPIC", "-O1", "-g0"]
    command.append("-ffp-contract=off")
    subprocess.run([*command, str(HERE / "demanding.c"), "-o", str(path)], check=True)
    return path.read_bytes()


def make_fmu(folder, token, flags='canSerializeFMUstate="true"'):
    """Write the FMU that does what its token says."""
    files = {
        "modelDescription.xml": XML.format(token=token, flags=flags),
        library_name(2, "Demanding"): library(folder),
    }
    return write_fmu(folder / token.replace(" ", "_") / "Demanding.fmu", files)


def expected_outputs(gain, inputs):
    """The outputs after each step, by the same operations in the same order."""
    y, rows = 0.0, [0.0]
    for u in inputs:
        for _ in range(round(STEP * 1000)):
            y += 0.001 * (gain * u - y)
        rows.append(y)
    return rows
