"""FMUs for model exchange of the models in ``exchange``, each with its variables."""

import fmu_tools

STATES = {
    "dahlquist": ["x"],
    "ball": ["h", "v"],
    "van_der_pol": ["x1", "x2"],
    "stair": [],
    "robertson": ["y1", "y2", "y3"],
    "friction": ["x", "v"],
    "circuit": ["voltage"],
    "tank": ["x"],
    "prothero": ["x"],
    "relay": ["x"],
    "sun": ["x"],
    "season": ["x"],
    "wild": ["x"],
}
"""By model; their value references begin with 0, and those of their derivatives follow."""

OTHERS = {
    "dahlquist": ["u", "k"],
    "ball": ["g", "e", "v_min", "bounces"],
    "van_der_pol": ["mu"],
    "stair": ["count", "period", "last"],
    "robertson": [],
    "friction": ["belt", "static", "kinetic", "mode"],
    "circuit": ["duty", "limit", "source", "discharges", "period", "tau"],
    "tank": ["u", "discards"],
    "prothero": ["k"],
    "relay": ["turns", "last", "speed", "steps"],
    "sun": ["now", "sine", "seconds", "u"],
    "season": ["u"],
    "wild": ["kind", "calls", "delay"],
}
"""The other variables in the order of their value references."""

INDICATORS = {"ball": 1, "friction": 2, "circuit": 1, "wild": 1}
INPUTS = {"u", "duty", "e"}
OUTPUTS = {"bounces", "count", "mode", "source", "discharges", "discards", "turns", "steps"}
OUTPUTS |= {"y", "calls", "now", "sine", "seconds"}
START = {
    "dahlquist": {"x": 1, "u": 0, "k": 1},
    "ball": {"h": 1, "v": 0, "g": -9.81, "e": 0.7, "v_min": 0.1},
    "van_der_pol": {"x1": 2, "x2": 0, "mu": 1},
    "stair": {"period": 1, "last": 10},
    "robertson": {"y1": 1, "y2": 0, "y3": 0},
    "friction": {"x": 0, "v": 0.1, "belt": 0.1, "static": 1, "kinetic": 0.6},
    "tank": {"x": 0.01, "u": 0},
    "prothero": {"x": 1, "k": 1},
    "relay": {"x": 0, "last": 1e9, "speed": 1},
    "sun": {"x": 0, "u": 0},
    "season": {"x": 1, "u": 0},
    "wild": {"x": 0.01, "kind": 0, "delay": 0},
    "circuit": {"voltage": 0, "duty": 0.5, "limit": 0.8, "period": 0.1, "tau": 0.3},
}
FLAGS = {1: "", 2: 'canGetAndSetFMUstate="true" canSerializeFMUstate="true"'}
FLAGS[3] = 'canGetAndSetFMUState="true" canSerializeFMUState="true"'


def names(model):
    """The names of all variables in the order of their value references."""
    states = STATES[model]
    return [*states, *(f"der({name})" for name in states), *OTHERS[model]]


def exchange_fmu(path, model, version=2, interfaces=("ModelExchange",), flags="", options=()):
    """Write an FMU.

    Args:
        path: Its file.
        model: The C file in ``exchange`` without its ending.
        version: Of FMI.
        interfaces: The elements of those that it offers.
        flags: More attributes of each.
        options: More arguments of the compiler.
    """
    sources = [f"exchange/{name}.c" for name in ("core", "usual", model, f"fmi{version}")]
    library = fmu_tools.model_library(version, "Model", *sources, flags=options)
    xml = describe(model, version, interfaces, flags)
    return fmu_tools.write_model(path, version, "Model", xml, library)


def describe(model, version, interfaces=("ModelExchange",), flags=""):
    """The model description."""
    variables = names(model)
    if version == 3:  # event indicators are variables there
        variables += [f"indicator {i}" for i in range(INDICATORS.get(model, 0))]
    elements = "".join(_variable(version, model, i, name) for i, name in enumerate(variables))
    inside = "".join(
        f'<{name} modelIdentifier="Model" {FLAGS[version]} {flags}{_extra(version, name)}/>'
        for name in (() if version == 1 else interfaces)
    )
    inside = f'{inside}<DefaultExperiment startTime="0" stepSize="0.01"/>'
    inside += f"<ModelVariables>{elements}</ModelVariables>{_structure(version, model)}"
    return f"<fmiModelDescription {_head(version, model)}>{inside}</fmiModelDescription>"


def _head(version, model):
    token = f'{"instantiationToken" if version == 3 else "guid"}="{{{model}}}"'
    head = f'fmiVersion="{version}.0" modelName="{model}" {token}'
    indicators = f' numberOfEventIndicators="{INDICATORS.get(model, 0)}"'
    if version == 1:
        states = len(STATES[model])
        return f'{head} modelIdentifier="Model" numberOfContinuousStates="{states}"{indicators}'
    return head + (indicators if version == 2 else "")


def _extra(version, interface):
    if interface == "CoSimulation":
        return ' canHandleVariableCommunicationStepSize="true"'
    return ' needsCompletedIntegratorStep="true"' if version == 3 else ""


def _variable(version, model, reference, name):
    states = STATES[model]
    causality, variability, start = _kind(model, name)
    kind = f'causality="{causality}" variability="{variability}"'
    start = "" if start is None else f'start="{start}"'
    exact = 'initial="exact" ' if start and causality != "input" else ""
    derivative = ""
    if len(states) <= reference < 2 * len(states):
        state = reference - len(states)
        derivative = f'derivative="{state + 1 if version == 2 else state}" '
    if version == 3:
        return (
            f'<Float64 name="{name}" valueReference="{reference}" {kind} {exact}{derivative}'
            f"{start}/>"
        )
    if version == 1:
        exact = derivative = ""
        if causality == "parameter":
            kind = 'causality="internal" variability="parameter"'
        kind = kind.replace('"local"', '"internal"')
    return (
        f'<ScalarVariable name="{name}" valueReference="{reference}" {kind} {exact}>'
        f"<Real {derivative}{start}/></ScalarVariable>"
    )


def _kind(model, name):
    start = START[model].get(name)
    if name in STATES[model]:
        return "output", "continuous", start
    if name in INPUTS:
        return "input", "continuous", start
    if start is not None:
        return "parameter", "tunable", start
    return ("output", "discrete", None) if name in OUTPUTS else ("local", "continuous", None)


def _structure(version, model):
    count = len(STATES[model])
    if version == 1:
        return ""
    if version == 2:
        unknowns = "".join(f'<Unknown index="{count + i + 1}"/>' for i in range(count))
        return f"<ModelStructure><Derivatives>{unknowns}</Derivatives></ModelStructure>"
    unknowns = "".join(
        f'<ContinuousStateDerivative valueReference="{count + i}"/>' for i in range(count)
    )
    first = len(names(model))
    unknowns += "".join(
        f'<EventIndicator valueReference="{first + i}"/>' for i in range(INDICATORS.get(model, 0))
    )
    return f"<ModelStructure>{unknowns}</ModelStructure>"
