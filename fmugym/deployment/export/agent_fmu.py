"""Agents as FMUs for co-simulation: their model descriptions, and their compiled libraries."""

from __future__ import annotations

import math
import os
import shutil
import subprocess
import sys
import tempfile
import uuid
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any, Final, NamedTuple
from xml.etree import ElementTree

import fmpy

from fmugym.checks import check_option
from fmugym.deployment.export.c_source import c_type, constant, field_names, header, source
from fmugym.deployment.export.exported_agent import ExportedAgent
from fmugym.deployment.export.identifiers import new_file
from fmugym.errors import ConfigError
from fmugym.extras import c_compiler
from fmugym.fmi.description import BASE_UNITS, Unit
from fmugym.fmi.variable import Variable

__all__ = [
    "EXPORT_VERSIONS",
    "PLATFORMS",
    "AgentVariable",
    "Platform",
    "compiled",
    "kind_of",
    "model_description",
    "ports_of",
    "write_fmu",
]


class Platform(NamedTuple):
    """A platform to build for.

    Attributes:
        target: zig's target triple.
        extension: The file name extension of shared libraries.
        folder: Its folder in FMI 2.0; None if that version does not have one.
    """

    target: str
    extension: str
    folder: str | None


PLATFORMS: Final[Mapping[str, Platform]] = {
    "x86_64-linux": Platform("x86_64-linux-gnu.2.17", ".so", "linux64"),
    "aarch64-linux": Platform("aarch64-linux-gnu.2.17", ".so", None),
    "x86_64-windows": Platform("x86_64-windows-gnu", ".dll", "win64"),
    "x86_64-darwin": Platform("x86_64-macos.10.13", ".dylib", "darwin64"),
    "aarch64-darwin": Platform("aarch64-macos.11.0", ".dylib", None),
}
"""The platforms by their folders in FMI 3.0."""

_OPTIONS: Final = (
    *("-std=c99", "-O2", "-g0", "-ffp-contract=off", "-Wno-unused-parameter", "-shared", "-fPIC"),
    *("-fvisibility=hidden",),
)
_LONGEST_MESSAGE: Final = 800


def compiled(folder: Path, files: list[str], name: str, where: str) -> bytes:
    """Compile C sources to a shared library.

    Args:
        folder: Folder of the sources.
        files: Their names.
        name: The name of the library, without its extension.
        where: One of ``PLATFORMS``.

    Raises:
        ConfigError: If there is no compiler for this platform, or it fails.
    """
    known = PLATFORMS[where]
    with tempfile.TemporaryDirectory(prefix="fmugym-export-") as scratch:
        library = Path(scratch) / f"{name}{known.extension}"
        command = [*_compiler(where), *_OPTIONS, f"-I{folder}", *files, "-o", str(library)]
        if known.extension == ".dylib":
            command.append(f"-Wl,-install_name,@rpath/{library.name}")
        done = subprocess.run(
            [*command, "-lm"], cwd=folder, capture_output=True, text=True, check=False
        )
        if done.returncode:
            raise ConfigError(
                f"the library for {where} cannot be built: {done.stderr[-_LONGEST_MESSAGE:]}"
            )
        return library.read_bytes()


def _compiler(where: str) -> list[str]:
    """The compiler of this system for this platform; ziglang for all others, and on Windows."""
    is_own = sys.platform != "win32" and where == fmpy.platform_tuple
    return c_compiler(f"the library for {where}", PLATFORMS[where].target, is_own=is_own)


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


EXPORT_VERSIONS: Final = ("2.0", "3.0")
_HEADERS: Final = {
    "2.0": ("fmi2Functions.h", "fmi2FunctionTypes.h", "fmi2TypesPlatform.h"),
    "3.0": ("fmi3Functions.h", "fmi3FunctionTypes.h", "fmi3PlatformTypes.h"),
}
_DATE: Final = (1980, 1, 1, 0, 0, 0)


def write_fmu(
    agent: ExportedAgent,
    path: str | os.PathLike[str],
    *,
    fmi_version: str = "2.0",
    platforms: Sequence[str] | None = None,
) -> Path:
    """Write an agent as an FMU for co-simulation, sources included.

    Its inputs are the measurements, its outputs the actions, by the names and units of the plant's
    variables. The compiler of this system builds it, or ``ziglang``, which can build for all
    platforms.

    Args:
        agent: The agent. Its name is that of the model.
        path: The file, which must not exist.
        fmi_version: ``"2.0"`` or ``"3.0"``.
        platforms: Platforms of ``fmugym.deployment.export.agent_fmu.PLATFORMS``; by default of this
            machine.

    Returns:
        The path.

    Raises:
        ConfigError: If an argument is invalid, there is no compiler, or the task computes what
            cannot be written in C.
        FileExistsError: If the file exists.
    """
    file = new_file(path)
    check_option("fmi_version", fmi_version, EXPORT_VERSIONS)
    names = [str(fmpy.platform_tuple)] if platforms is None else list(platforms)
    for name in names:
        check_option("platform", name, PLATFORMS)
    with tempfile.TemporaryDirectory(prefix="fmugym-export-") as scratch:
        folder = Path(scratch)
        token = _write_sources(agent, fmi_version, folder)
        files = {f"sources/{one.name}": one.read_bytes() for one in sorted(folder.iterdir())}
        files |= _binaries(agent, fmi_version, folder, names)
    files["modelDescription.xml"] = model_description(agent, fmi_version, token)
    _write_archive(file, files)
    return file


def _write_sources(agent: ExportedAgent, fmi_version: str, folder: Path) -> str:
    """Write all sources to a folder, and return the token of the FMU."""
    ports = ports_of(agent, fmi_version)
    texts = {f"{agent.name}.h": header(agent), f"{agent.name}.c": source(agent)}
    own = resources.files("fmugym.deployment.export") / "sources"
    for name in ("fmu_instance.h", f"agent_fmi{fmi_version[0]}.c"):
        texts[name] = (own / name).read_text(encoding="ascii")
    told = "\0".join([*texts.values(), *map(repr, ports)])
    token = f"{{{uuid.uuid5(uuid.NAMESPACE_URL, told)}}}"
    texts["fmu_model.h"] = _model(agent, ports, token)
    if fmi_version == "3.0":
        texts["buildDescription.xml"] = _build_description(agent)
    for name, text in texts.items():
        (folder / name).write_text(text, encoding="ascii", newline="\n")
    for name in _HEADERS[fmi_version]:
        shutil.copy(Path(fmpy.__file__).parent / "c-code" / name, folder / name)
    return token


def _model(agent: ExportedAgent, ports: Sequence[AgentVariable], token: str) -> str:
    """Write the constants of an agent that the functions of FMI need."""
    name, logic = agent.name, agent.logic
    starts = [constant(one.start, "d") for one in ports if one.causality == "input"]
    fixed = [
        "true" if one.variability == "fixed" else "false"
        for one in ports
        if one.causality == "parameter"
    ]
    kinds = "".join(map(kind_of, ports)).replace("??", '?""?')
    return f"""/* The agent, for the functions of FMI. */

#include "{name}.h"

#define TOKEN "{token}"
#define AGENT_STATE {name}_state
#define AGENT_INIT {name}_init
#define AGENT_STEP {name}_step
#define SAMPLE_TIME {name.upper()}_SAMPLE_TIME
#define IS_PLANT {"true" if agent.is_plant else "false"}
#define MEASUREMENTS {len(logic.measurements)}u
#define ACTIONS {len(logic.inputs)}u

/* The types of the variables, the time first. */
static const char kinds[] = "d{kinds}";
static const double first_measurements[] = {{{", ".join([*starts, "0.0"])}}};
static const bool is_fixed[] = {{{", ".join([*fixed, "false"])}}};

{_parameters(agent)}"""


def _parameters(agent: ExportedAgent) -> str:
    fields, logic = field_names(agent), agent.logic
    gets = sets = ""
    for number, one in enumerate(logic.parameters):
        place, kind = f"{fields[one.field]}[{one.element}]", c_type(logic.kept[one.field].dtype)
        condition = f"    if (place == {number}) {{\n        "
        gets += f"{condition}return (double)agent->{place};\n    }}\n"
        sets += f"{condition}agent->{place} = ({kind})value;\n    }}\n"
    return f"""static double get_parameter(const AGENT_STATE *agent, unsigned place) {{
{gets}    (void)agent, (void)place;
    return 0.0;
}}

static void set_parameter(AGENT_STATE *agent, unsigned place, double value) {{
{sets}    (void)agent, (void)place, (void)value;
}}
"""


def _build_description(agent: ExportedAgent) -> str:
    return (
        '<?xml version="1.0" encoding="UTF-8"?>\n'
        '<fmiBuildDescription fmiVersion="3.0">\n'
        f'  <BuildConfiguration modelIdentifier="{agent.name}">\n'
        '    <SourceFileSet language="C99">\n'
        f'      <SourceFile name="{agent.name}.c"/>\n'
        '      <SourceFile name="agent_fmi3.c"/>\n'
        "    </SourceFileSet>\n"
        "  </BuildConfiguration>\n"
        "</fmiBuildDescription>\n"
    )


def _binaries(
    agent: ExportedAgent, fmi_version: str, folder: Path, platforms: Sequence[str]
) -> dict[str, bytes]:
    """The libraries by their paths in the archive."""
    sources, libraries = [f"{agent.name}.c", f"agent_fmi{fmi_version[0]}.c"], dict[str, bytes]()
    for name in platforms:
        place = name if fmi_version == "3.0" else PLATFORMS[name].folder
        if place is None:
            raise ConfigError(f"FMI 2.0 has no folder for {name}; FMI 3.0 has")
        library = f"{agent.name}{PLATFORMS[name].extension}"
        libraries[f"binaries/{place}/{library}"] = compiled(folder, sources, agent.name, name)
    return libraries


def _write_archive(path: Path, files: Mapping[str, bytes]) -> None:
    """Write a zip file whose bytes depend on names and contents only."""
    with zipfile.ZipFile(path, "x", zipfile.ZIP_DEFLATED) as archive:
        for name in sorted(files, key=lambda name: (name != "modelDescription.xml", name)):
            entry = zipfile.ZipInfo(name, date_time=_DATE)
            entry.compress_type, entry.create_system = zipfile.ZIP_DEFLATED, 3
            entry.external_attr = 0o100644 << 16
            archive.writestr(entry, files[name])
