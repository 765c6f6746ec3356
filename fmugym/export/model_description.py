"""The model descriptions of exported agents."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final
from xml.etree import ElementTree

from fmugym.archive.description import BASE_UNITS, Unit
from fmugym.archive.variable import Variable
from fmugym.export.exportable import ExportedAgent

__all__ = ["AgentVariable", "kind_of", "model_description", "ports_of"]

_KINDS: Final[Mapping[str, str]] = {
    "Float64": "d",
    "Float32": "f",
    "Int8": "b",
    "UInt8": "B",
    "Int16": "h",
    "UInt16": "H",
    "Int32": "i",
    "UInt32": "I",
    "Int64": "q",
    "UInt64": "Q",
    "Boolean": "?",
    "Real": "d",
    "Integer": "i",
}
"""Types of FMI 2.0 and 3.0, and their letters in the C sources."""

_FLOATS: Final = ("Real", "Float64", "Float32")
_OF_FMI_2: Final = {"real": "Real", "boolean": "Boolean"}
_OF_FMI_3: Final = {"Real": "Float64", "Integer": "Int32", "Enumeration": "Int64"}


@dataclass(frozen=True)
class AgentVariable:
    """A variable of an exported agent.

    Attributes:
        name: Its name, that of the plant's variable.
        causality: ``input``, ``output`` or ``parameter``.
        variability: In the words of FMI.
        type: In the words of the FMI version.
        start: The start value; None for outputs.
        variable: The plant's variable; None for a parameter that the plant does not have.
    """

    name: str
    causality: str
    variability: str
    type: str
    start: float | None
    variable: Variable | None


def kind_of(port: AgentVariable) -> str:
    """The letter of a port's type."""
    return _KINDS[port.type]


def ports_of(agent: ExportedAgent, fmi_version: str) -> list[AgentVariable]:
    """The variables of an agent, in the order of their value references from 1 on."""
    logic = agent.logic
    ports = [
        _port(one, "input", fmi_version, _finite(one.start_number)) for one in logic.measurements
    ]
    ports += [_port(one, "output", fmi_version, None) for one in logic.inputs]
    taken = {port.name for port in ports} | {"time"}
    number = "Real" if fmi_version == "2.0" else "Float64"
    for one in logic.parameters:
        name = one.name if one.name not in taken else f"{one.name}_parameter"
        variability = "fixed" if logic.kept[one.field].updates else "tunable"
        ports.append(AgentVariable(name, "parameter", variability, number, one.start, one.variable))
    return ports


def _finite(value: float) -> float:
    return value if math.isfinite(value) else 0.0


def _port(
    variable: Variable, causality: str, fmi_version: str, start: float | None
) -> AgentVariable:
    if fmi_version == "2.0":
        kind = _OF_FMI_2.get(variable.kind, "Integer")
    else:
        kind = _OF_FMI_3.get(variable.type, variable.type)
    is_continuous = kind in _FLOATS and causality == "input"
    variability = "continuous" if is_continuous else "discrete"
    return AgentVariable(variable.name, causality, variability, kind, start, variable)


def model_description(agent: ExportedAgent, fmi_version: str, token: str) -> bytes:
    """Write a model description.

    Args:
        agent: The agent.
        fmi_version: ``"2.0"`` or ``"3.0"``.
        token: The GUID or instantiation token.
    """
    ports = ports_of(agent, fmi_version)
    writer: _Writer2 | _Writer3 = _Writer2() if fmi_version == "2.0" else _Writer3()
    root = writer.root(agent, token)
    _add_units(root, ports, agent.units)
    categories = ElementTree.SubElement(root, "LogCategories")
    ElementTree.SubElement(categories, "Category", name="logStatusError")
    step = repr(agent.logic.time_step)
    ElementTree.SubElement(root, "DefaultExperiment", startTime="0", stepSize=step)
    time = AgentVariable("time", "independent", "continuous", writer.number, None, None)
    variables = ElementTree.SubElement(root, "ModelVariables")
    for reference, port in enumerate([time, *ports]):
        writer.add_variable(variables, port, _facts(port, reference))
    outputs = [number for number, port in enumerate(ports, 1) if port.causality == "output"]
    writer.add_structure(ElementTree.SubElement(root, "ModelStructure"), outputs)
    ElementTree.indent(root)
    text = ElementTree.tostring(root, "unicode")
    return f'<?xml version="1.0" encoding="UTF-8"?>\n{text}\n'.encode()


def _add_units(root: Any, ports: Sequence[AgentVariable], units: Mapping[str, Unit]) -> None:
    used = dict.fromkeys(one.variable.unit for one in ports if one.variable is not None)
    names = [name for name in used if name]
    if not names:
        return
    section = ElementTree.SubElement(root, "UnitDefinitions")
    for name in names:
        element = ElementTree.SubElement(section, "Unit", name=name)
        unit = units.get(name)
        if unit is None or unit.dimension is None:
            continue
        exponents = zip(BASE_UNITS, unit.dimension, strict=True)
        facts = {base: str(power) for base, power in exponents if power}
        facts |= {} if unit.factor == 1.0 else {"factor": repr(unit.factor)}
        facts |= {} if unit.offset == 0.0 else {"offset": repr(unit.offset)}
        ElementTree.SubElement(element, "BaseUnit", facts)


class _Writer:
    """Writer of the parts of a model description that both FMI versions share."""

    version: str
    number: str
    """The type of numbers."""
    token: str
    """What the token is called."""
    state: str
    """How the names of functions for states end."""

    def root(self, agent: ExportedAgent, token: str) -> Any:
        facts = {
            "fmiVersion": self.version,
            "modelName": agent.name,
            self.token: token,
            "description": agent.notes[0],
            "generationTool": f"fmugym {agent.version}",
            "variableNamingConvention": "flat",
        }
        root = ElementTree.Element("fmiModelDescription", facts)
        abilities = {
            "modelIdentifier": agent.name,
            "canHandleVariableCommunicationStepSize": "true",
            f"canGetAndSet{self.state}": "true",
            f"canSerialize{self.state}": "true",
        }
        ElementTree.SubElement(root, "CoSimulation", abilities)
        return root


class _Writer2(_Writer):
    """FMI 2.0."""

    version, number, token, state = "2.0", "Real", "guid", "FMUstate"

    def root(self, agent: ExportedAgent, token: str) -> Any:
        root = super().root(agent, token)
        root.set("numberOfEventIndicators", "0")
        root[0].set("canNotUseMemoryManagementFunctions", "true")
        files = ElementTree.SubElement(root[0], "SourceFiles")
        for name in (f"{agent.name}.c", "agent_fmi2.c"):
            ElementTree.SubElement(files, "File", name=name)
        return root

    def add_variable(self, section: Any, port: AgentVariable, facts: dict[str, str]) -> None:
        element = ElementTree.SubElement(section, "ScalarVariable", facts)
        ElementTree.SubElement(element, port.type, _of_type(port))

    def add_structure(self, section: Any, outputs: Sequence[int]) -> None:
        for name in ("Outputs", "InitialUnknowns"):
            group = ElementTree.SubElement(section, name)
            for number in outputs:  # the time is the first variable
                facts = {"index": str(number + 1)} | _dependencies(name)
                ElementTree.SubElement(group, "Unknown", facts)


class _Writer3(_Writer):
    """FMI 3.0."""

    version, number, token, state = "3.0", "Float64", "instantiationToken", "FMUState"

    def add_variable(self, section: Any, port: AgentVariable, facts: dict[str, str]) -> None:
        ElementTree.SubElement(section, port.type, facts | _of_type(port))

    def add_structure(self, section: Any, outputs: Sequence[int]) -> None:
        for name in ("Output", "InitialUnknown"):
            for reference in outputs:
                facts = {"valueReference": str(reference)} | _dependencies(name)
                ElementTree.SubElement(section, name, facts)


def _dependencies(section: str) -> dict[str, str]:
    """Outputs depend on all inputs in the initialization, and on none between two steps."""
    return {} if section.startswith("Initial") else {"dependencies": ""}


def _facts(port: AgentVariable, reference: int) -> dict[str, str]:
    facts = {
        "name": port.name,
        "valueReference": str(reference),
        "causality": port.causality,
        "variability": port.variability,
    }
    if port.causality == "output":
        facts["initial"] = "calculated"
    if port.variable is not None and port.variable.description:
        facts["description"] = port.variable.description
    return facts


def _of_type(port: AgentVariable) -> dict[str, str]:
    """The attributes that depend on the type."""
    facts = {} if port.start is None else {"start": _written(port.start, port.type)}
    if port.variable is None or port.type == "Boolean":
        return facts
    low, high = port.variable.minimum, port.variable.maximum
    limits = {"min": low, "max": high} if low < high else {}
    facts |= {k: _written(v, port.type) for k, v in limits.items() if math.isfinite(v)}
    if port.type in _FLOATS and port.variable.unit:
        facts["unit"] = port.variable.unit
    return facts


def _written(value: float, kind: str) -> str:
    if kind == "Boolean":
        return "true" if value else "false"
    return repr(float(value)) if kind in _FLOATS else str(int(value))
