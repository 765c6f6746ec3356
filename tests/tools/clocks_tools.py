"""The FMU of ``exchange/clocks.c``, with clocks of all kinds."""

import fmu_tools

CLOCKS = {
    "constant": 'intervalVariability="constant" intervalDecimal="0.1" shiftDecimal="0.05"',
    "fixed": 'intervalVariability="fixed" intervalCounter="1" resolution="4"',
    "calculated": 'intervalVariability="calculated"',
    "tunable": 'intervalVariability="tunable"',
    "changing": 'intervalVariability="changing"',
    "countdown": 'intervalVariability="countdown"',
    "strike": 'intervalVariability="triggered"',
    "bell": 'intervalVariability="triggered"',
}
"""By name, in the order of the value references."""

FRACTIONS = CLOCKS | {
    "constant": 'intervalVariability="constant" resolution="3" intervalCounter="1" '
    'shiftCounter="1"',
    "fixed": 'intervalVariability="fixed" intervalCounter="1" resolution="7"',
}

REALS = {
    "x": (
        30,
        'causality="output" variability="continuous" initial="exact" start="0"',
    ),
    "der(x)": (31, 'causality="local" variability="continuous" derivative="30"'),
    "period": (32, 'causality="parameter" variability="fixed" start="0.2"'),
    "pace": (33, 'causality="parameter" variability="tunable" start="0.5"'),
    "command": (34, 'causality="input" variability="discrete" clocks="0" start="0"'),
    "sample": (35, 'causality="output" variability="discrete" clocks="0"'),
    "plain": (36, 'causality="input" variability="continuous" start="0"'),
    "eager": (37, 'causality="parameter" variability="fixed" start="0"'),
    "alarms": (38, 'causality="output" variability="discrete"'),
    "bad counter": (39, 'causality="parameter" variability="fixed" start="0"'),
}
ARRAYS = {
    "commands": (40, 'causality="input" variability="discrete" clocks="0" start="0 0"'),
    "samples": (41, 'causality="output" variability="discrete" clocks="0"'),
    "plains": (42, 'causality="input" variability="continuous" start="0 0"'),
}
"""Of two elements each."""

FLAGS = 'canGetAndSetFMUState="true" canSerializeFMUState="true"'


def clocks_fmu(
    path, interface="CoSimulation", event_mode=True, flags="", clocks=None, arrays=False, scale=1
):
    """Write the FMU with one interface; if its clocks are ``FRACTIONS``, it takes no decimals.

    If asked for, it has the arrays. Counters and resolutions of two of its fractions are so many
    times as large.
    """
    clocks = CLOCKS if clocks is None else clocks
    xml = _describe(interface, event_mode, flags, clocks, arrays)
    options = () if clocks is CLOCKS else ("-DFRACTIONS", f"-DSCALE={scale}")
    library = fmu_tools.model_library(3, "Clocks", "exchange/clocks.c", flags=options)
    return fmu_tools.write_model(path, 3, "Clocks", xml, library)


def _describe(interface, event_mode, flags, kinds, arrays):
    extra = ' canHandleVariableCommunicationStepSize="true"' if interface == "CoSimulation" else ""
    extra += ' hasEventMode="true"' if event_mode and interface == "CoSimulation" else ""
    clocks = "".join(
        f'<Clock name="{name}" valueReference="{i}" variability="discrete" {kind} '
        f'causality="{"output" if name == "bell" else "input"}" '
        f'supportsFraction="{str(kinds is not CLOCKS).lower()}"/>'
        for i, (name, kind) in enumerate(kinds.items())
    )
    reals = "".join(
        f'<Float64 name="{name}" valueReference="{reference}" {kind}/>'
        for name, (reference, kind) in (REALS | _counts()).items()
    )
    if arrays:
        reals += "".join(
            f'<Float64 name="{name}" valueReference="{reference}" {kind}><Dimension start="2"/>'
            "</Float64>"
            for name, (reference, kind) in ARRAYS.items()
        )
    structure = '<ContinuousStateDerivative valueReference="31"/>'
    return (
        '<fmiModelDescription fmiVersion="3.0" modelName="Clocks" instantiationToken="{clocks}">'
        f'<{interface} modelIdentifier="Clocks" {FLAGS}{extra} {flags}/>'
        '<DefaultExperiment startTime="0" stepSize="0.1"/>'
        f"<ModelVariables>{clocks}{reals}</ModelVariables>"
        f"<ModelStructure>{structure}</ModelStructure></fmiModelDescription>"
    )


def _counts():
    kind = 'causality="output" variability="discrete"'
    counts = {f"count of {name}": (10 + i, kind) for i, name in enumerate(CLOCKS)}
    return counts | {f"last {name}": (20 + i, kind) for i, name in enumerate(CLOCKS)}
