"""FMUs of the models in ``values``, with variables of all types and arrays."""

from pathlib import Path

import building
import fmu_tools

SIZES = {"m": 1, "n": 2, "r": 3}
MATRICES = {
    "A": ("nn", "-1 0.5 0 -2"),
    "B": ("nm", "1 0.5"),
    "C": ("rn", "1 0 0 1 1 1"),
    "D": ("rm", "0 0 0.25"),
    "x_0": ("n", "1 0"),
}
"""By name of a parameter of ``state_space.c``: its dimensions, and start values."""

FLAGS = 'canGetAndSetFMUState="true" canSerializeFMUState="true"'


def state_space_fmu(path, interfaces=("CoSimulation", "ModelExchange"), fixed=False):
    """Write an FMU of ``state_space.c``.

    Args:
        path: Its file.
        interfaces: The elements of those that it offers.
        fixed: Whether the sizes of its arrays are numbers instead of structural parameters.
    """
    files = {
        "modelDescription.xml": _describe_state_space(interfaces, fixed),
        fmu_tools.library_name(3, "Model"): _library("state_space", 3),
    }
    return fmu_tools.write_fmu(Path(path), files)


def _library(model, version):
    source = f"values/{model}.c"
    prefix = "Model_fmi" if version == 1 else f"fmi{version}"
    stubs = fmu_tools.stubs(version, prefix, building.HERE / source)
    return building.library(source, flags=(f"-DFMI_VERSION={version}",), stubs=stubs)


def _describe_state_space(interfaces, fixed):
    offers = "".join(f'<{name} modelIdentifier="Model" {FLAGS}/>' for name in interfaces)
    variables = '<Float64 name="time" valueReference="0" causality="independent"/>'
    references = {}
    for reference, (name, size) in enumerate(SIZES.items(), start=1):
        references[name] = reference
        if not fixed:
            variables += (
                f'<UInt64 name="{name}" valueReference="{reference}" start="{size}" min="0" '
                'max="8" causality="structuralParameter" variability="tunable"/>'
            )

    def array(reference, name, dimensions, attributes):
        inside = "".join(
            f'<Dimension start="{SIZES[d]}"/>'
            if fixed
            else f'<Dimension valueReference="{references[d]}"/>'
            for d in dimensions
        )
        return (
            f'<Float64 name="{name}" valueReference="{reference}" {attributes}>{inside}</Float64>'
        )

    for reference, (name, (dimensions, start)) in enumerate(MATRICES.items(), start=4):
        attributes = f'causality="parameter" variability="fixed" start="{start}"'
        variables += array(reference, name, dimensions, attributes)
    variables += array(9, "u", "m", 'causality="input" start="0" min="-5" max="5"')
    variables += array(10, "y", "r", 'causality="output"')
    variables += array(11, "x", "n", 'causality="output"')
    variables += array(12, "der(x)", "n", 'causality="local" derivative="11"')
    return (
        '<fmiModelDescription fmiVersion="3.0" modelName="StateSpace" instantiationToken="{ss}">'
        f'{offers}<DefaultExperiment startTime="0" stepSize="0.1"/>'
        f"<ModelVariables>{variables}</ModelVariables><ModelStructure>"
        '<Output valueReference="10"/><Output valueReference="11"/>'
        '<ContinuousStateDerivative valueReference="12"/></ModelStructure></fmiModelDescription>'
    )
