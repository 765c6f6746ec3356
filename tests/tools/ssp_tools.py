"""SSP archives for tests: the parts of a file, and archives of simple systems."""

import zipfile
from xml.sax.saxutils import quoteattr

import numpy as np

HEAD = (
    '<?xml version="1.0" encoding="UTF-8"?>\n<ssd:SystemStructureDescription version="1.0" '
    'name="test" xmlns:ssd="http://ssp-standard.org/SSP1/SystemStructureDescription" '
    'xmlns:ssc="http://ssp-standard.org/SSP1/SystemStructureCommon" '
    'xmlns:ssv="http://ssp-standard.org/SSP1/SystemStructureParameterValues" '
    'xmlns:ssm="http://ssp-standard.org/SSP1/SystemStructureParameterMapping">\n'
)
TAIL = "</ssd:SystemStructureDescription>"


def connectors(**kinds):
    """Connectors by name: the kind, and after a blank the unit."""
    parts = []
    for name, text in kinds.items():
        kind, _, unit = text.partition(" ")
        unit = f' unit="{unit}"' if unit else ""
        own = f'<ssd:Connector name="{name}" kind="{kind}"><ssc:Real{unit}/></ssd:Connector>'
        parts.append(own)
    return f"<ssd:Connectors>{''.join(parts)}</ssd:Connectors>"


def values(parameters, more="", **attributes):
    """A binding with values in place, by name: a number, and after a blank its unit."""
    own = "".join(f' {name}="{value}"' for name, value in attributes.items())
    return (
        f"<ssd:ParameterBinding{own}><ssd:ParameterValues>{parameter_set(parameters)}"
        f"</ssd:ParameterValues>{more}</ssd:ParameterBinding>"
    )


def parameter_set(parameters):
    own = "".join(
        f'<ssv:Parameter name="{name}">{value}</ssv:Parameter>'
        for name, value in parameters.items()
    )
    return (
        '<ssv:ParameterSet version="1.0" name="set" '
        'xmlns:ssv="http://ssp-standard.org/SSP1/SystemStructureParameterValues">'
        f"<ssv:Parameters>{own}</ssv:Parameters></ssv:ParameterSet>"
    )


def mapping(entries):
    return (
        '<ssm:ParameterMapping version="1.0" '
        'xmlns:ssc="http://ssp-standard.org/SSP1/SystemStructureCommon" '
        'xmlns:ssm="http://ssp-standard.org/SSP1/SystemStructureParameterMapping">'
        f"{entries}</ssm:ParameterMapping>"
    )


def bindings(*texts):
    return f"<ssd:ParameterBindings>{''.join(texts)}</ssd:ParameterBindings>"


def real(value, unit=""):
    unit = f' unit="{unit}"' if unit else ""
    return f'<ssv:Real value="{value}"{unit}/>'


def component(name, ports, source="resources/House.fmu", more="", **attributes):
    own = "".join(f' {key}="{value}"' for key, value in attributes.items())
    return (
        f'<ssd:Component name="{name}" source="{source}"{own}>{connectors(**ports)}{more}'
        "</ssd:Component>"
    )


def connection(start, end, inner="", **attributes):
    ends = []
    for kind, text in (("start", start), ("end", end)):
        element, _, connector = text.rpartition(".")
        ends.append(f' {kind}Element="{element}"' if element else "")
        ends.append(f' {kind}Connector="{connector}"')
    own = "".join(f' {key}="{value}"' for key, value in attributes.items())
    return f"<ssd:Connection{''.join(ends)}{own}>{inner}</ssd:Connection>"


def system(name, ports, elements, connections=(), more=""):
    wires = f"<ssd:Connections>{''.join(connections)}</ssd:Connections>" if connections else ""
    return (
        f'<ssd:System name="{name}">{connectors(**ports) if ports else ""}{more}'
        f"<ssd:Elements>{''.join(elements)}</ssd:Elements>{wires}</ssd:System>"
    )


def linear(factor, offset=0.0):
    return f'<ssc:LinearTransformation factor="{factor}" offset="{offset}"/>'


def write(made, path):
    """Write a system of one level, as another tool might; returns the path."""
    files = {
        one.fmu.path: f"resources/{n}-{one.fmu.path.name}"
        for n, one in enumerate(made.components.values())
    }
    parts = []
    for name, one in made.components.items():
        starts = {key: setting(value) for key, value in one.given.start_values.items()}
        parts.append(component(name, {}, files[one.fmu.path], bindings(values(starts))))
    ports = {one.name: f"{one.causality} {one.unit or ''}" for one in made.connectors}
    wires = []
    for one in made.connections:
        own = {} if one.convert_units else {"suppressUnitConversion": "true"}
        wires.append(connection(one.source, one.target, linear(one.gain, one.offset), **own))
    with zipfile.ZipFile(path, "w") as archive:
        text = HEAD.replace("test", made.name) + system(made.name, ports, parts, wires) + TAIL
        archive.writestr("SystemStructure.ssd", text)
        for file, place in files.items():
            archive.write(file, place)
    return path


def setting(value):
    """A start value: a text, a number or an array of numbers."""
    if isinstance(value, str):
        return f"<ssv:String value={quoteattr(value)}/>"
    sizes = "".join(f'<ssc:Dimension size="{length}"/>' for length in np.shape(value))
    return real(" ".join(map(str, np.ravel(value).tolist()))) + sizes
