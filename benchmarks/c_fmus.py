"""FMUs of FMI 2.0 for the benchmarks, compiled here from the C files beside this one."""

from __future__ import annotations

import zipfile
from collections.abc import Sequence
from pathlib import Path

import fmpy
from c_limit import compile_c

__all__ = ["build_building", "build_busy"]

Names = Sequence[tuple[str, str]]
"""Names and causalities of Real variables, in the order of their value references."""

_BUSY: Names = (
    *(("u", "input"), ("busy", "output")),
    *((name, "parameter") for name in ("mean", "sigma", "seed", "rare", "rare_time")),
)
_ZONES = range(1, 11)
_BUILDING: Names = (
    *((f"P{zone}", "input") for zone in _ZONES),
    *((f"{name}{zone}", "output") for name in ("T", "T_wall", "error") for zone in _ZONES),
    *((name, "parameter") for name in ("T_outside", "T_0")),
)


def build_busy(folder: Path) -> Path:
    """Build the FMU whose steps take a given time, see ``busy.c``.

    Raises:
        MissingError: See ``compile_c``.
    """
    return _build("busy", _BUSY, folder)


def build_building(folder: Path) -> Path:
    """Build the ten zones, see ``building.c``.

    Raises:
        MissingError: See ``compile_c``.
    """
    return _build("building", _BUILDING, folder)


def _build(name: str, variables: Names, folder: Path) -> Path:
    library = folder / f"{name}{fmpy.sharedLibraryExtension}"
    compile_c(Path(__file__).with_name(f"{name}.c"), library, "-shared", "-fPIC", "-lm")
    path = folder / f"{name}.fmu"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("modelDescription.xml", _model_description(name, variables))
        archive.write(library, f"binaries/{fmpy.platform}/{library.name}")
    return path


def _model_description(name: str, variables: Names) -> str:
    rows = "".join(_variable(index, *row) for index, row in enumerate(variables))
    return (
        f'<fmiModelDescription fmiVersion="2.0" modelName="{name}" guid="{{{name}}}">'
        f'<CoSimulation modelIdentifier="{name}" canHandleVariableCommunicationStepSize="true"/>'
        f"<ModelVariables>{rows}</ModelVariables><ModelStructure/></fmiModelDescription>"
    )


def _variable(index: int, name: str, causality: str) -> str:
    start = "" if causality == "output" else ' start="0"'
    variability = "fixed" if causality == "parameter" else "continuous"
    head = f'name="{name}" valueReference="{index}" causality="{causality}"'
    return f'<ScalarVariable {head} variability="{variability}"><Real{start}/></ScalarVariable>'
