"""FMPy's container: an FMU that holds others, as a reference for systems."""

import copy

import fmpy
from fmpy.container_fmu import config
from fmpy.container_fmu.cli import create_container_fmu


def container(folder, path, components, links, names, step, version=3):
    """Build a container of several components with one FMU. All of its steps are Jacobi steps.

    Args:
        folder: Where to.
        path: The FMU, of FMI 3.0: FMPy cannot connect the types of FMI 2.0.
        components: The names of the components.
        links: Tuples of component and output, component and input.
        names: Component and variable of each variable of the container, by its name.
        step: Its communication step size, in seconds.
        version: Its version of FMI.

    Returns:
        The file.
    """
    read = {name: fmpy.read_model_description(str(path)) for name in components}
    parts = {name: config.Component(name, path, read[name]) for name in components}
    own = {(n, v.name): v for n in components for v in read[n].modelVariables}
    variables = []
    for name, pair in {"time": (components[0], "time"), **names}.items():
        variable = copy.copy(own[pair])
        variable.name = name
        if variable.type == "Enumeration":  # whose functions are those of Int64
            variable.type = "Int64"
        if version == 2:
            variable.type = "Real"
        variables.append(variable)
    whole = fmpy.read_model_description(str(path))
    # the value reference 0 is that of time, whatever the description says
    _simplify(whole, variables, step)
    whole.fmiVersion = f"{version}.0"
    connections = [
        config.Connection(parts[a], [own[a, x]], parts[b], [own[b, y]]) for a, x, b, y in links
    ]
    pairs = zip(variables[1:], names.values(), strict=True)
    mappings = {v: [(parts[pair[0]], own[pair])] for v, pair in pairs}
    configuration = config.Configuration(False, whole, list(parts.values()), connections, mappings)
    (folder / "container").mkdir()
    create_container_fmu(configuration, folder / "container", folder / "Container.fmu")
    return folder / "Container.fmu"


def _simplify(whole, variables, step):
    """Leave in the description of an FMU what the container can do."""
    whole.modelName = "Container"
    whole.defaultExperiment.stepSize = None
    whole.coSimulation.fixedInternalStepSize = step
    whole.coSimulation.canGetAndSetFMUstate = False
    whole.coSimulation.canSerializeFMUstate = False
    whole.coSimulation.providesDirectionalDerivative = False
    whole.modelVariables = variables
    whole.outputs, whole.derivatives, whole.initialUnknowns = [], [], []
