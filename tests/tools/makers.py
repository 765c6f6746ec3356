"""FMUs that programs of other makers build without a modelling tool."""

import json
import shutil
from dataclasses import dataclass, field
from pathlib import Path

import pytest
from container_tools import container

import fmugym

HERE = Path(__file__).parents[1]
NO_PACKAGE = "{} builds it; install the extra 'test'"


@dataclass(frozen=True)
class Made:
    """An FMU and how to play it.

    Attributes:
        build: Makes it in a folder; returns its path.
        inputs: How far each input moves.
        outputs: Names.
        step: The communication step size in seconds.
        parameters: The limits between which each is drawn.
    """

    build: object
    inputs: dict[str, float]
    outputs: tuple[str, ...]
    step: float
    parameters: dict[str, tuple[float, float]] = field(default_factory=dict)


def by_python(package, script, **options):
    """An FMU with a Python interpreter in it, built with options of the package."""

    def build(folder):
        builder = pytest.importorskip(f"{package}.builder", reason=NO_PACKAGE.format(package))
        path = Path(builder.FmuBuilder.build_FMU(HERE / "tools" / script, dest=folder, **options))
        if not fmugym.FMU(path).runs_here:
            pytest.skip(f"{package} has no binary for this platform")
        return path

    return build


def by_fmpy(version):
    """Two pendulums, of which the first drives the second, in a container of FMPy."""
    path = Path(fmugym.bundled_fmu("Pendulum", "3.0"))
    names = {"tau": ("first", "tau"), "q_first": ("first", "q"), "q_second": ("second", "q")}
    link = ("first", "q", "second", "tau")
    return lambda folder: container(
        folder, path, ("first", "second"), [link], names, PENDULUMS["step"], version
    )


def by_renault(version):
    """The same two pendulums in a container of Renault's FMU manipulation toolbox."""

    def build(folder):
        assembly = pytest.importorskip(
            "fmu_manipulation_toolbox.assembly",
            reason=NO_PACKAGE.format("fmu-manipulation-toolbox"),
        )
        for name in ("First.fmu", "Second.fmu"):
            shutil.copy(fmugym.bundled_fmu("Pendulum", f"{version}.0"), folder / name)
        description = {
            "name": "Pendulums.fmu",
            "fmu": ["First.fmu", "Second.fmu"],
            "input": [["tau", "First.fmu", "tau"]],
            "output": [["First.fmu", "q", "q_first"], ["Second.fmu", "q", "q_second"]],
            "link": [["First.fmu", "q", "Second.fmu", "tau"]],
            "step_size": 0.02,
            "auto_output": False,
        }
        (folder / "pendulums.json").write_text(json.dumps(description))
        one = assembly.Assembly("pendulums.json", fmu_directory=folder)
        one.make_fmu(fmi_version=version)
        return folder / "Pendulums.fmu"

    return build


PENDULUMS = {"inputs": {"tau": 0.5}, "outputs": ("q_first", "q_second"), "step": 0.02}
TANK = {"parameters": {"area": (1.0, 3.0)}, "step": 0.5}
MADE = {
    "pythonfmu": Made(
        by_python("pythonfmu", "foreign_tank.py"),
        {"inflow": 0.5, "valve_open": 1, "pump_stage": 3},
        ("level", "overflowing", "switches"),
        **TANK,
    ),
    "pythonfmu3": Made(
        by_python("pythonfmu3", "foreign_tank3.py"),
        {"inflow": 0.5, "valve_open": 1},
        ("level", "switches"),
        **TANK,
    ),
    "FMPy's container 2": Made(by_fmpy(2), **PENDULUMS),
    "FMPy's container 3": Made(by_fmpy(3), **PENDULUMS),
    "Renault's container 2": Made(by_renault(2), **PENDULUMS),
    "Renault's container 3": Made(by_renault(3), **PENDULUMS),
}
