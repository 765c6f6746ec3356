"""FMUs for tests: the bundled ones with edits, and ``probe.c``, which obeys its parameters."""

import re
import zipfile
from pathlib import Path
from typing import NamedTuple
from xml.sax.saxutils import quoteattr

import building
import fmpy
import pytest

import fmugym
from fmugym.environment.config import FOREIGN
from fmugym.fmi import ArchiveLimits

MAJOR_VERSIONS = (1, 2, 3)
HERE = Path(__file__).parents[1]
TYPES = (
    "Real",
    "Integer",
    "Boolean",
    "Enumeration",
    "String",
    "Float32",
    "Int8",
    "UInt16",
    "Int64",
)
FMI3_NAMES = {"Real": "Float64", "Integer": "Int32"}
ITEMS = {"slow": 1, "fast": 2, "turbo": 5}


class Row(NamedTuple):
    """A variable of the probe; the value reference is 100 times the type's number plus index."""

    name: str
    type: str
    index: int
    causality: str
    variability: str
    attributes: dict[str, str]


def _inputs():
    """The order is not that of the names or of the value references."""
    bounds = {"min": "-1", "max": "1", "start": "0"}
    yield from (Row(n, "Real", "abc".index(n), "input", "continuous", bounds) for n in "cab")
    yield Row("free", "Real", 3, "input", "continuous", {"start": "0"})
    yield Row("n", "Integer", 0, "input", "discrete", {"min": "-5", "max": "5", "start": "0"})
    yield Row("n_free", "Integer", 1, "input", "discrete", {"start": "0"})
    yield Row("on", "Boolean", 0, "input", "discrete", {"start": "false"})
    yield Row("mode", "Enumeration", 0, "input", "discrete", {"start": "1"})


def _outputs():
    for index, name in enumerate(("mix", "sum", "end", "step_size", "free_out"), start=10):
        yield Row(name, "Real", index, "output", "continuous", {})
    for index, name in enumerate(("n_out", "steps", "instances", "live", "illegal"), start=10):
        yield Row(name, "Integer", index, "output", "discrete", {"min": "-5", "max": "1000"})
    yield Row("on_out", "Boolean", 10, "output", "discrete", {})
    yield Row("mode_out", "Enumeration", 10, "output", "discrete", {})


def _parameters():
    yield Row("gain", "Real", 20, "parameter", "fixed", {"start": "1"})
    yield Row("trim", "Real", 21, "parameter", "tunable", {"start": "0", "min": "-9", "max": "9"})
    yield Row("seven", "Real", 22, "local", "constant", {"start": "7"})
    yield Row("double_gain", "Real", 23, "calculatedParameter", "fixed", {})
    yield Row("stop", "Real", 24, "local", "continuous", {})
    yield Row("tolerance", "Real", 25, "local", "continuous", {})
    statuses = ("init_status", "reset_status", "restore_status", "set_status", "log_status")
    names = ("fault", "fault_step", *statuses, "refusals", "get_status")
    for index, name in enumerate(names, start=20):
        start = "-1" if name == "log_status" else "0"
        yield Row(name, "Integer", index, "parameter", "fixed", {"start": start})
    yield Row("leaky", "Boolean", 20, "parameter", "fixed", {"start": "false"})
    yield Row("label", "String", 0, "parameter", "fixed", {"start": "probe"})


def _fmi3_types():
    for type_ in TYPES[5:]:
        variability = "continuous" if type_ == "Float32" else "discrete"
        bounds = {"min": "0", "max": "9", "start": "0"}
        yield Row(f"{type_}_in", type_, 0, "input", variability, bounds)
        yield Row(f"{type_}_out", type_, 10, "output", variability, {})
    yield Row("array", "Real", 30, "input", "continuous", {"start": "0 0"})


def _element(row, version):
    reference = str(100 * TYPES.index(row.type) + row.index)
    causality, variability, values = row.causality, row.variability, dict(row.attributes)
    if row.type == "Enumeration":
        values["declaredType"] = "Mode"
    common = {"name": row.name, "valueReference": reference}
    if version == 1:
        if causality.endswith("arameter"):
            causality, variability = "internal", "parameter"
        causality = "internal" if causality == "local" else causality
    common |= {"causality": causality, "variability": variability}
    if version < 3:
        return _tag("ScalarVariable", common, _tag(row.type, values))
    if row.type == "String":
        return _tag("String", common, _tag("Start", {"value": values["start"]}))
    inside = _tag("Dimension", {"start": "2"}) if row.name == "array" else ""
    return _tag(FMI3_NAMES.get(row.type, row.type), common | values, inside)


def _tag(name, attributes, inside=""):
    text = " ".join(f"{key}={quoteattr(value)}" for key, value in attributes.items())
    return f"<{name} {text}>{inside}</{name}>\n"


def _types(version):
    items = [{"name": n} | ({"value": str(v)} if version > 1 else {}) for n, v in ITEMS.items()]
    inside = "".join(_tag("Item", item) for item in items)
    if version == 1:
        return f'<Type name="Mode"><EnumerationType>{inside}</EnumerationType></Type>'
    if version == 2:
        return f'<SimpleType name="Mode"><Enumeration>{inside}</Enumeration></SimpleType>'
    return f'<EnumerationType name="Mode">{inside}</EnumerationType>'


def _head(version):
    attributes = {"fmiVersion": f"{version}.0", "modelName": "Probe"}
    attributes["instantiationToken" if version == 3 else "guid"] = f"{{probe-{version}}}"
    if version == 1:
        attributes["modelIdentifier"] = "Probe"
        attributes |= {"numberOfContinuousStates": "0", "numberOfEventIndicators": "0"}
    return attributes


def probe_xml(version):
    """The model description of the probe."""
    rows = [*_inputs(), *_outputs(), *_parameters(), *(_fmi3_types() if version == 3 else ())]
    variables = "".join(_element(row, version) for row in rows)
    state = {2: "canGetAndSetFMUstate", 3: "canGetAndSetFMUState"}.get(version)
    flags = {"canHandleVariableCommunicationStepSize": "true"} | ({state: "true"} if state else {})
    interface = _tag("CoSimulation", {"modelIdentifier": "Probe"} | flags)
    inside = interface if version > 1 else ""
    inside += f"<TypeDefinitions>{_types(version)}</TypeDefinitions>"
    inside += f"<ModelVariables>{variables}</ModelVariables>"
    if version == 1:
        stand_alone = _tag("CoSimulation_StandAlone", {}, _tag("Capabilities", flags))
        inside += f"<Implementation>{stand_alone}</Implementation>"
    else:
        inside += "<ModelStructure/>"
    return _tag("fmiModelDescription", _head(version), inside)


def probe_library(version, *flags):
    """The compiled probe, by more arguments of the compiler."""
    return building.library("sources/probe.c", flags=(f"-DFMI_VERSION={version}", *flags))


def stubs(version, prefix, source, made=()):
    """A line ``STUB(name)`` for each function of the standard that a C source does not have.

    The functions are those that FMPy looks up, as its headers have them. Macros of the source may
    have made some of them.
    """
    headers = (Path(fmpy.__file__).parent / "c-code").glob(f"fmi{version}*.h")
    text = "".join(path.read_text() for path in headers)
    names = set(re.findall(rf"\bfmi{version}(\w+?)TYPE\b", text))
    own = set(re.findall(rf"\b{prefix}(\w+)\(", source.read_text()))
    return "".join(f"STUB({prefix}{name})\n" for name in sorted(names - own - set(made)))


def model_library(version, identifier, *sources, flags=(), made=()):
    """The compiled library of a model; the last source has functions of the standard.

    Args:
        version: Of FMI.
        identifier: Of the model.
        sources: The C files, relative to ``tests``.
        flags: More arguments of the compiler.
        made: As in ``stubs``.
    """
    prefix = f"{identifier}_fmi" if version == 1 else f"fmi{version}"
    flags = (f"-DFMI_VERSION={version}", *flags)
    missing = stubs(version, prefix, building.HERE / sources[-1], made)
    return building.library(*sources, flags=flags, stubs=missing)


def platform_folder(version):
    """The folder under ``binaries`` of this machine."""
    return fmpy.platform_tuple if version == 3 else fmpy.platform


def library_name(version, identifier="Probe"):
    """Where an FMU has its library for this machine."""
    return f"binaries/{platform_folder(version)}/{identifier}{fmpy.sharedLibraryExtension}"


def write_model(path, version, identifier, description, library, add=None):
    """Write an FMU of a model description, a library, and more files by name."""
    files = {"modelDescription.xml": description, library_name(version, identifier): library}
    return write_fmu(Path(path), files | (add or {}))


def write_fmu(path, files, level=1):
    """Write an archive; equal files make equal archives.

    Args:
        path: Its file.
        files: Text or bytes by name.
        level: Of compression; 9 takes most time.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in files.items():
            archive.writestr(zipfile.ZipInfo(name), content, zipfile.ZIP_DEFLATED, level)
    return path


def read_fmu(path):
    """The files of an archive by name."""
    with zipfile.ZipFile(path) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def probe_fmu(folder, version=2, edits=None, **keywords):
    """Make the probe FMU in a folder; ``edits`` and keywords as in ``edited_fmu``."""
    path, xml = Path(folder) / "Probe.fmu", probe_xml(version)
    write_model(path, version, "Probe", xml, probe_library(version))
    return edited_fmu(path, folder, edits, **keywords) if edits or keywords else path


CLAIMING_DERIVATIVES = {
    'modelIdentifier="Probe"': 'modelIdentifier="Probe" providesDirectionalDerivative="true"',
    "<ModelStructure/>": '<ModelStructure><Derivatives><Unknown index="9"/></Derivatives>'
                         "</ModelStructure>",
    '<ScalarVariable name="mix" valueReference="10" causality="output" '
    'variability="continuous"><Real ': '<ScalarVariable name="mix" valueReference="10" '
    'causality="output" variability="continuous"><Real derivative="10"',
}  # fmt: skip
"""Edits of the probe by which it claims to provide derivatives."""


def edited_fmu(source, folder, edits=None, *, drop=(), add=None):
    """Copy an FMU with changes.

    Args:
        source: The FMU; or the name of a bundled one.
        folder: Where to put the copy.
        edits: Replacements in modelDescription.xml: every old text must be there.
        drop: Parts of names of files that are left out.
        add: More files by name, or others instead of those that are there.
    """
    source = Path(source) if Path(source).suffix == ".fmu" else fmugym.bundled_fmu(source)
    files = read_fmu(source)
    xml = files["modelDescription.xml"].decode()
    for old, new in (edits or {}).items():
        assert old in xml, f"{old} is not in the model description"
        xml = xml.replace(old, new)
    files["modelDescription.xml"] = xml.encode()
    files = {n: c for n, c in files.items() if not any(part in n for part in drop)}
    return write_fmu(Path(folder) / source.name, files | (add or {}))


class PlainEnv(fmugym.FMUEnv):
    """An FMU of any version without a task."""

    def _is_done(self):
        return False


def require_refused(path, match, **limits):
    """Require that opening and extracting an FMU fails, with a text that names the file."""
    with pytest.raises(fmugym.FMULoadError, match=match) as caught:
        fmugym.FMU(path, limits=ArchiveLimits(**limits)).extract()
    assert Path(path).name in str(caught.value)


def grouped(config):
    """A config whose keys for experts stand in their table."""
    foreign = {key: value for key, value in config.items() if key in FOREIGN.keys}
    own = {key: value for key, value in config.items() if key not in foreign}
    return own | ({"foreign": foreign} if foreign else {})


def probe_config(**changes):
    """A config for the probe: one input, its integral as output."""
    config = {"model_input_names": "a", "model_output_names": ["sum", "mix"], "time_step": 0.1}
    return grouped(config | changes)


def interrupted_after(count, original, error=KeyboardInterrupt):
    """A function like another one, which fails after some calls."""
    calls = iter(range(count))

    def call(*arguments, **keywords):
        if next(calls, None) is None:
            raise error
        return original(*arguments, **keywords)

    return call
