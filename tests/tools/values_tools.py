"""FMUs of the models in ``values``, with variables of all types and arrays, and environments."""

import fmu_tools
import model_tools
import pytest
from gymnasium import spaces

import fmugym

SIZES = {"m": 1, "n": 2, "r": 3}
MATRICES = {
    "A": ("nn", "-1 0.5 0 -2"),
    "B": ("nm", "1 0.5"),
    "C": ("rn", "1 0 0 1 1 1"),
    "D": ("rm", "0 0 0.25"),
    "x_0": ("n", "1 0"),
}
"""By name of a parameter of ``state_space.c``: its dimensions, and start values."""

_OLD = ("Real", "Integer", "Boolean")
_NEW = (
    *("Float64", "Float32", "Int8", "UInt8", "Int16", "UInt16", "Int32", "UInt32", "Int64"),
    *("UInt64", "Boolean"),
)
TYPES = {1: _OLD, 2: _OLD, 3: _NEW}
"""Those of ``feedthrough.c`` by version of FMI, in the order of their numbers."""

FLAGS = 'canGetAndSetFMUState="true" canSerializeFMUState="true"'


def state_space_fmu(
    path, interfaces=("ModelExchange", "CoSimulation"), fixed=False, derivatives=""
):
    """Write an FMU of ``state_space.c``.

    Args:
        path: Its file.
        interfaces: The elements of those that it offers.
        fixed: Whether the sizes of its arrays are numbers instead of structural parameters.
        derivatives: The kind that it says to provide: ``"Directional"`` or ``"Adjoint"``.
    """
    xml = _describe_state_space(interfaces, fixed, derivatives)
    library = fmu_tools.model_library(3, "Model", "values/state_space.c")
    return fmu_tools.write_model(path, 3, "Model", xml, library)


def _describe_state_space(interfaces, fixed, derivatives):
    flags = f'{FLAGS} provides{derivatives}Derivatives="true"' if derivatives else FLAGS
    offers = "".join(f'<{name} modelIdentifier="Model" {flags}/>' for name in interfaces)
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
        kind = "fixed" if name == "x_0" else "tunable"
        attributes = f'causality="parameter" variability="{kind}" start="{start}"'
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


@pytest.fixture(name="feedthrough", scope="module")
def fixture_feedthrough(tmp_path_factory):
    """The FMU of each version of FMI whose outputs are its inputs."""
    folder = tmp_path_factory.mktemp("feedthrough")
    return {v: feedthrough_fmu(folder / f"F{v}.fmu", v) for v in VERSIONS}


def feedthrough_fmu(path, version):
    """Write an FMU of ``feedthrough.c``.

    Of each type it has ``TYPE_in``, ``TYPE_out``, ``TYPE_parameter`` and ``TYPE_told``. FMI 1.0 and
    2.0 have ``v[1]`` and ``v[2]``, which come out as ``w[1]`` and ``w[2]``; FMI 3.0 has a matrix
    ``v``, which comes out as ``w``.
    """
    made = [verb + type_ for verb in ("Get", "Set") for type_ in (*TYPES[version], "String")]
    library = fmu_tools.model_library(version, "Model", "values/feedthrough.c", made=made)
    return fmu_tools.write_model(path, version, "Model", _describe_feedthrough(version), library)


_CAUSALITIES = ("input", "output", "parameter", "output")
_NAMES = ("in", "out", "parameter", "told")


def _describe_feedthrough(version):
    variables = ""
    for number, type_ in enumerate((*TYPES[version], "String")):
        for place, (name, causality) in enumerate(zip(_NAMES, _CAUSALITIES, strict=True)):
            reference = 10 * number + place
            variables += _variable(version, f"{type_}_{name}", type_, reference, causality)
    integer = 10 * TYPES[version].index("Int64" if version == 3 else "Integer")
    for place in (0, 1):
        name = f"Enumeration_{_NAMES[place]}"
        reference = integer + 4 + 2 * place
        variables += _variable(version, name, "Enumeration", reference, _CAUSALITIES[place])
    variables += _variable(version, "length", TYPES[version][0], 301, "output")
    if version == 3:
        inside = '<Dimension start="2"/><Dimension start="2"/>'
        variables += (
            '<Int16 name="v" valueReference="204" causality="input" variability="discrete" '
            f'start="0 0 0 0">{inside}</Int16><Int16 name="w" valueReference="205" '
            f'causality="output" variability="discrete">{inside}</Int16>'
            '<Binary name="Binary_in" valueReference="300" causality="input"/>'
        )
    else:
        for i in (1, 2):
            variables += _variable(version, f"v[{i}]", "Real", 3 + i, "input")
            variables += _variable(version, f"w[{i}]", "Real", 5 + i, "output")
    types = f"<TypeDefinitions>{_GEARS[version]}</TypeDefinitions>"
    flags = f'{model_tools.STATES[version]} canHandleVariableCommunicationStepSize="true"'
    return model_tools.document(version, "{feedthrough}", variables, flags, "Model", types)


def _variable(version, name, type_, reference, causality):
    continuous = type_ in {"Real", "Float32", "Float64"}
    variability = "continuous" if continuous else "discrete"
    if causality == "parameter":
        variability = "fixed"
        if version == 1:
            causality, variability = "internal", "parameter"
    start = {"String": "start", "Boolean": "false", "Enumeration": "1"}.get(type_, "0")
    start = f'start="{start}"' if causality in {"input", "parameter", "internal"} else ""
    declared = 'declaredType="Gear"' if type_ == "Enumeration" else ""
    common = f'name="{name}" valueReference="{reference}" causality="{causality}"'
    common += f' variability="{variability}"'
    if version < 3:
        return f"<ScalarVariable {common}><{type_} {declared} {start}/></ScalarVariable>"
    if type_ == "String":
        inside = start.replace("start=", "value=", 1)
        return f"<String {common}>{f'<Start {inside}/>' if inside else ''}</String>"
    return f"<{type_} {common} {declared} {start}/>"


_GEARS = {
    1: '<Type name="Gear"><EnumerationType><Item name="low"/><Item name="high"/></EnumerationType>'
    "</Type>",
    2: '<SimpleType name="Gear"><Enumeration><Item name="low" value="1"/>'
    '<Item name="high" value="2"/></Enumeration></SimpleType>',
    3: '<EnumerationType name="Gear"><Item name="low" value="1"/><Item name="high" value="2"/>'
    "</EnumerationType>",
}


STEP = 0.1

POOLS = {
    "native": {},
    "isolated": {"isolation": "process"},
}

pools = pytest.mark.parametrize("options", POOLS.values(), ids=POOLS)

VERSIONS = (1, 2, 3)

versions = pytest.mark.parametrize("version", VERSIONS)

WAYS = [
    options | {"interface": interface, "tolerance": 1e-9}
    for options in POOLS.values()
    for interface in ("co_simulation", "model_exchange")
]

ways = pytest.mark.parametrize(
    "options", WAYS, ids=lambda options: " ".join(map(str, options.values()))
)

LARGER = {
    "n": 3,
    "m": 2,
    "r": 1,
    "A": [[-1, 0.5, 0], [0, -2, 1], [0.1, 0, -3]],
    "B": [[1, 0], [0, 1], [1, 1]],
    "C": [[1, 1, 1]],
    "D": [[0.5, 0]],
    "x_0": [1, 2, 3],
}


class Env(fmugym.FMUEnv):
    """An FMU without a task."""

    def __init__(self, path, isolation=None, **config):
        defaults = {"time_step": STEP, "probe_timeout": None}
        super().__init__(path, fmu_tools.grouped(defaults | config), isolation=isolation)

    def _is_done(self):
        return self.out["y"][0] > 1e9 if "y" in self.out else False


class Writing(Env):
    """Writes the same inputs in each step, whatever the action."""

    def __init__(self, path, given, **config):
        self.given = given
        super().__init__(path, **config)

    def _get_action_space(self):
        return spaces.Discrete(2)

    def _get_inputs(self):
        return self.given


def state_space_env(path, **changes):
    config = {"model_input_names": "u", "model_output_names": ["y", "x"]}
    return Env(path, **(config | changes))
