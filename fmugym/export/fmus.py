"""Agents as FMUs for co-simulation."""

from __future__ import annotations

import os
import shutil
import tempfile
import uuid
import zipfile
from collections.abc import Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import Final

import fmpy

from fmugym.checks import check_option
from fmugym.errors import ConfigError
from fmugym.export.building import PLATFORMS, compiled
from fmugym.export.c99 import field_names, header, source
from fmugym.export.exportable import ExportedAgent
from fmugym.export.layers import c_type
from fmugym.export.model_description import AgentVariable, kind_of, model_description, ports_of
from fmugym.export.names import new_file
from fmugym.export.operations import constant

__all__ = ["EXPORT_VERSIONS", "write_fmu"]

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
        platforms: Platforms of ``fmugym.export.building.PLATFORMS``; by default of this machine.

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
    own = resources.files("fmugym.export") / "sources"
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
