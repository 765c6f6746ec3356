"""FMUs of the models in ``zoo``, each with its variables, and an environment of two of them."""

import fmu_tools

import fmugym

STATES = {1: "", 2: 'canGetAndSetFMUstate="true"', 3: 'canGetAndSetFMUState="true"'}
"""By version of FMI, what an FMU declares that can save and restore its state."""

GAIN_VARIABLES = (
    ("u", "input", 'start="0" min="-1" max="1"'),
    ("y", "output", ""),
    ("gain", "parameter", 'start="1"'),
)
"""Those of ``demanding.c``."""


def model_fmu(path, model, version, token, variables, definitions=(), add=None, **description):
    """Write an FMU.

    Args:
        path: Its file.
        model: The C file in ``zoo`` without its ending.
        version: Of FMI.
        token: The instantiation token.
        variables: As in ``describe``.
        definitions: For the compiler.
        add: More files by name.
        description: As in ``describe``.
    """
    xml = describe(version, token, variables, **description)
    own = library(version, model, *definitions)
    return fmu_tools.write_model(path, version, description.get("name", "Zoo"), xml, own, add)


def library(version, model, *definitions):
    """The compiled library of a model for a version of FMI."""
    sources = (f"zoo/{name}.c" for name in (model, "usual", f"fmi{version}"))
    flags = tuple(f"-D{name}" for name in definitions)
    return fmu_tools.model_library(version, "Zoo", *sources, flags=flags)


def describe(version, token, variables, flags=None, categories=(), name="Zoo"):
    """A model description.

    Args:
        version: Of FMI.
        token: The instantiation token.
        variables: Names, causalities and further attributes, in the order of value references.
        flags: Attributes of the interface; by default it can save and restore its state.
        categories: The names of those in which the FMU logs.
        name: Of the model, and of its library.
    """
    flags = STATES[version] if flags is None else flags
    elements = (_element(version, index, *row) for index, row in enumerate(variables))
    before = "" if version == 1 else _categories(categories)
    return document(version, token, "".join(elements), flags, name, before)


def document(version, token, variables, flags, name, before=""):
    """A model description of elements for variables, and of others before them."""
    head = f'fmiVersion="{version}.0" modelName="{name}"'
    head += f' {"instantiationToken" if version == 3 else "guid"}="{token}"'
    inside = f"{before}<ModelVariables>{variables}</ModelVariables>"
    if version == 1:
        head += f' modelIdentifier="{name}"'
        head += ' numberOfContinuousStates="0" numberOfEventIndicators="0"'
        inside += f"<Implementation><CoSimulation_StandAlone><Capabilities {flags}/>"
        inside += "</CoSimulation_StandAlone></Implementation>"
    else:
        inside = f'<CoSimulation modelIdentifier="{name}" {flags}/>{inside}<ModelStructure/>'
    return f"<fmiModelDescription {head}>{inside}</fmiModelDescription>"


def _categories(names):
    listed = "".join(f'<Category name="{name}"/>' for name in names)
    return f"<LogCategories>{listed}</LogCategories>" if names else ""


def _element(version, index, name, causality, attributes):
    kind = f'causality="{causality}"'
    if causality == "parameter":
        kind = 'causality="internal" variability="parameter"' if version == 1 else kind
        kind += "" if version == 1 else ' variability="fixed"'
    common = f'name="{name}" valueReference="{index}" {kind}'
    if version == 3:
        return f"<Float64 {common} {attributes}/>"
    return f"<ScalarVariable {common}><Real {attributes}/></ScalarVariable>"


class GainEnv(fmugym.FMI2CSEnv):
    """Reads the output of an FMU with ``GAIN_VARIABLES``."""

    def __init__(self, path, gain, log_level, backend=None, isolation=None, **config):
        config = {
            "model_input_names": "u",
            "model_output_names": "y",
            "model_parameters": {"gain": gain},
        } | config
        super().__init__(
            path, fmu_tools.grouped(config), log_level, backend=backend, isolation=isolation
        )

    def _is_done(self):
        return self.out["y"] > 1e9
