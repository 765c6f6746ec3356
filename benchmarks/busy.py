"""An environment over an FMU with long steps, which is compiled here from ``busy.c``."""

from __future__ import annotations

import zipfile
from pathlib import Path
from typing import Any

import fmpy
from c_limit import compile_c
from gymnasium import spaces

import fmugym

__all__ = ["BusyEnv", "build"]

NAMES = ("u:input", "busy:output", "mean:parameter", "sigma:parameter", "seed:parameter")
"""Variables in the order of their value references."""


def build(folder: Path) -> Path:
    """Compile and pack the FMU.

    Raises:
        MissingError: See ``compile_c``.
    """
    library = folder / f"Busy{fmpy.sharedLibraryExtension}"
    compile_c(Path(__file__).with_suffix(".c"), library, "-shared", "-fPIC", "-lm")
    path = folder / "Busy.fmu"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("modelDescription.xml", _model_description())
        archive.write(library, f"binaries/{fmpy.platform}/{library.name}")
    return path


def _model_description() -> str:
    variables = "".join(_variable(index, *row.split(":")) for index, row in enumerate(NAMES))
    return (
        '<fmiModelDescription fmiVersion="2.0" modelName="Busy" guid="{busy}">'
        '<CoSimulation modelIdentifier="Busy" canHandleVariableCommunicationStepSize="true"/>'
        f"<ModelVariables>{variables}</ModelVariables><ModelStructure/></fmiModelDescription>"
    )


def _variable(index: int, name: str, causality: str) -> str:
    start = "" if causality == "output" else ' start="0"'
    variability = "fixed" if causality == "parameter" else "continuous"
    head = f'name="{name}" valueReference="{index}" causality="{causality}"'
    return f'<ScalarVariable {head} variability="{variability}"><Real{start}/></ScalarVariable>'


class BusyEnv(fmugym.FMI2CSEnv):
    """Waits. The observation is the time in us that it has waited in this episode.

    Args:
        path: The FMU.
        mean: Mean time of a step in us.
        sigma: Standard deviation of the logarithm of this time; 0 for a constant time.
    """

    def __init__(self, path: Path, mean: float, sigma: float) -> None:
        seed = fmugym.Uniform(0.0, 1.0)
        config = {
            "model_input_names": "u",
            "model_output_names": "busy",
            "model_parameters": {"mean": mean, "sigma": sigma, "seed": seed},
            "time_step": 1.0,
        }
        super().__init__(path, config)

    def _get_action_space(self) -> spaces.Space[Any]:
        return spaces.Discrete(2)

    def _is_done(self) -> Any:
        return self.state[0] < 0.0
