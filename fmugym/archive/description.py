"""What an FMU says of itself, in one form for the three FMI versions.

FMPy reads the XML; this module turns its result into frozen, typed objects, fills in what FMPy
leaves out, and holds the rules for which variable may be set when.
"""

from __future__ import annotations

import io
import math
import re
import zipfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import fmpy
from fmpy.validation import validate_model_description
from lxml import etree

from fmugym.archive.safe_zip import ZIP_ERRORS, ArchiveLimits, over_limit
from fmugym.errors import ConfigError, FMULoadError, unknown_name

__all__ = ["Capabilities", "ModelDescription", "Variable", "read_model_description"]

_KINDS = {
    "Real": "real",
    "Float32": "real",
    "Float64": "real",
    "Boolean": "boolean",
    "Enumeration": "enumeration",
    "String": "string",
    "Binary": "binary",
    "Clock": "clock",
}
_MARKUP_PER_VARIABLE = 25
"""Elements and attributes that a variable may have for each of the most variables."""

_EXPERIMENT = ("startTime", "stopTime", "tolerance", "stepSize")
_POSITIVE = {"tolerance", "stepSize", "fixedInternalStepSize"}
_INTEGER_BITS = {"Integer": 32, "Enumeration": 64} | {f"Int{n}": n for n in (8, 16, 32, 64)}


@dataclass(frozen=True, eq=False)
class Variable:
    """One variable of the model description, in the terms of the FMI standard.

    ``type`` is the standard's own name (``Real``, ``Float64``, ``Int32``, ...); ``kind`` is one of
    real, integer, boolean, enumeration, string, binary and clock. ``start`` is the XML's text.
    ``minimum`` and ``maximum`` are infinite, and ``nominal`` is None, where neither the variable
    nor its declared type gives a value of use. ``items`` are the names and values of an
    enumeration. ``shape`` is that of an array of FMI 3.0, () for a scalar.
    """

    name: str
    type: str
    value_reference: int
    causality: str
    variability: str
    initial: str | None
    start: str | None = None
    unit: str | None = None
    minimum: float = -math.inf
    maximum: float = math.inf
    nominal: float | None = None
    description: str = ""
    items: tuple[tuple[str, int], ...] = ()
    shape: tuple[int, ...] = ()

    @property
    def kind(self) -> str:
        """The type without its width."""
        return _KINDS.get(self.type, "integer")

    @property
    def numeric(self) -> bool:
        """Whether a float64 can carry the value: a scalar real, integer, Boolean, enumeration."""
        return self.kind in {"real", "integer", "boolean", "enumeration"} and not self.shape

    @property
    def settable_at_start(self) -> bool:
        """Whether a value may be set between instantiation and initialization."""
        if self.variability == "constant":
            return False
        return self.causality == "input" or self.initial in {"exact", "approx"}

    @property
    def settable_in_step(self) -> bool:
        """Whether a value may be set between two steps."""
        tunable = self.causality == "parameter" and self.variability == "tunable"
        return self.causality == "input" or tunable

    @property
    def start_number(self) -> float:
        """The start value of a numeric variable; 0 where there is none.

        Raises:
            ConfigError: If it is not a finite number.
        """
        text = "0" if self.start is None else self.start
        try:
            number = float({"true": "1", "false": "0"}.get(text, text))
        except ValueError:
            number = math.nan
        if not math.isfinite(number):
            raise ConfigError(
                f"the start value of {self.name!r} is {text!r}, expected a finite number"
            )
        return number

    @property
    def integer_limits(self) -> tuple[int, int]:
        """The range of the C type that carries an integer or enumeration."""
        if self.type.startswith("UInt"):
            return 0, 2 ** int(self.type[4:]) - 1
        bits = _INTEGER_BITS[self.type]
        return -(2 ** (bits - 1)), 2 ** (bits - 1) - 1


@dataclass(frozen=True)
class Capabilities:
    """The capability flags of a co-simulation FMU, by their FMI 3.0 names in Python's spelling."""

    can_handle_variable_communication_step_size: bool = False
    can_get_and_set_fmu_state: bool = False
    can_serialize_fmu_state: bool = False
    provides_directional_derivatives: bool = False
    can_be_instantiated_only_once_per_process: bool = False
    needs_execution_tool: bool = False


@dataclass(frozen=True)
class ModelDescription:
    """The part of a model description that an environment needs.

    ``interfaces`` holds the names of the FMI interface types the FMU offers. ``model_identifier``
    and ``capabilities`` are those of co-simulation. ``state_derivatives`` names, for each scalar
    continuous state that the FMU declares, its derivative. Times are in seconds, None where not
    given or of no use.
    """

    fmi_version: str
    model_name: str
    model_identifier: str
    instantiation_token: str
    interfaces: tuple[str, ...]
    description: str
    generation_tool: str
    start_time: float
    stop_time: float | None
    tolerance: float | None
    step_size: float | None
    fixed_internal_step_size: float | None
    capabilities: Capabilities
    variables: Mapping[str, Variable]
    state_derivatives: Mapping[str, str]
    findings: tuple[str, ...]

    @cached_property
    def fmi_major_version(self) -> int:
        """1, 2 or 3."""
        return int(self.fmi_version.split(".")[0])

    @property
    def platform(self) -> str:
        """The folder under ``binaries/`` of this machine; FMI 3.0 names it in another way."""
        return str(fmpy.platform_tuple if self.fmi_major_version == 3 else fmpy.platform)

    def variable(self, name: str) -> Variable:
        """Look a variable up by its name.

        Raises:
            ConfigError: If there is no such variable; the text names the nearest.
        """
        try:
            return self.variables[name]
        except Exception:  # a KeyError; or something that is no key at all
            raise unknown_name(
                f"variable of {self.model_name}", name, list(self.variables)
            ) from None


def read_model_description(path: Path, limits: ArchiveLimits | None = None) -> ModelDescription:
    """Read the model description of an FMU; nothing of the FMU is executed or extracted.

    The FMU may break rules of the standard as foreign FMUs often do: what FMPy's validation finds
    is kept in ``findings``.

    Args:
        path: The FMU.
        limits: What is too large to be read; by default ``ArchiveLimits()``.

    Returns:
        The model description.

    Raises:
        FMULoadError: If the XML is missing, unreadable or not that of a co-simulation FMU.
    """
    limits = ArchiveLimits() if limits is None else limits
    xml = _read_xml(path, limits.max_xml_bytes)
    _check_markup(path, xml, limits.max_variables)
    try:
        root = etree.fromstring(xml, etree.XMLParser(resolve_entities=False, no_network=True))
    except etree.XMLSyntaxError as error:
        raise FMULoadError(f"{path.name}: modelDescription.xml is not valid XML: {error}") from None
    _check_root(path, root, limits.max_variables)
    try:
        return _convert(_parse_with_fmpy(xml), root)
    except FMULoadError:
        raise
    except Exception as error:  # FMPy leaks a dozen types of exceptions for malformed files
        raise FMULoadError(
            f"{path.name}: modelDescription.xml cannot be understood: "
            f"{type(error).__name__}: {error}"
        ) from error


def _read_xml(path: Path, limit: int) -> bytes:
    try:
        with zipfile.ZipFile(path) as archive:
            info = archive.getinfo("modelDescription.xml")
            if info.file_size > limit:
                found = f"{path.name}: modelDescription.xml has {info.file_size} bytes"
                raise over_limit(found, limit, "max_xml_bytes")
            xml = archive.read(info)
    except KeyError:
        raise FMULoadError(f"{path.name} is not an FMU: it has no modelDescription.xml") from None
    except ZIP_ERRORS as error:
        raise FMULoadError(f"{path.name}: modelDescription.xml cannot be read: {error}") from None
    if re.search(rb"<!\s*DOCTYPE", xml, re.IGNORECASE):
        raise _doctype_error(path)
    return xml


def _check_markup(path: Path, xml: bytes, max_variables: int) -> None:
    """Each element or attribute takes a quarter of a kilobyte once parsed, however short it is."""
    count, limit = xml.count(b"<") + xml.count(b"="), _MARKUP_PER_VARIABLE * max_variables + 1000
    if count > limit:
        found = f"{path.name}: modelDescription.xml has some {count} elements and attributes"
        raise over_limit(found, limit, "max_variables")


def _doctype_error(path: Path) -> FMULoadError:
    return FMULoadError(f"{path.name}: modelDescription.xml has a DOCTYPE, which FMI forbids")


def _check_root(path: Path, root: Any, limit: int) -> None:
    if root.getroottree().docinfo.doctype:  # in an encoding in which it was not seen before
        raise _doctype_error(path)
    version = root.get("fmiVersion", "")
    if root.tag != "fmiModelDescription" or not re.fullmatch(r"1\.0|2\.0(\.\d+)?|3\.\d.*", version):
        raise FMULoadError(
            f"{path.name}: expected a model description of FMI 1.0, 2.0 or 3.0, "
            f"found <{root.tag} fmiVersion={version!r}>"
        )
    count = len(root.findall("ModelVariables/*"))
    if count > limit:
        raise over_limit(f"{path.name} has {count} variables", limit, "max_variables")


def _parse_with_fmpy(xml: bytes) -> Any:
    """Hand FMPy an archive with nothing but the XML: what it read is what was checked."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        archive.writestr("modelDescription.xml", xml)
    return fmpy.read_model_description(buffer, validate=False)


def _convert(source: Any, root: Any) -> ModelDescription:
    co_simulation = source.coSimulation
    if co_simulation is None:
        raise FMULoadError(
            f"{source.modelName} has no co-simulation interface; "
            "export the model for co-simulation (model exchange is not supported)"
        )
    experiment = source.defaultExperiment
    _read_unsigned_limits(source, root)
    variables = {v.name: _convert_variable(v) for v in source.modelVariables}
    return ModelDescription(
        fmi_version=source.fmiVersion,
        model_name=source.modelName or "",
        model_identifier=_c_identifier(co_simulation.modelIdentifier),
        instantiation_token=source.guid or "",
        interfaces=_interfaces(source),
        description=source.description or "",
        generation_tool=source.generationTool or "",
        start_time=_time(experiment, "startTime") or 0.0,
        stop_time=_time(experiment, "stopTime"),
        tolerance=_time(experiment, "tolerance"),
        step_size=_time(experiment, "stepSize"),
        fixed_internal_step_size=_time(co_simulation, "fixedInternalStepSize"),
        capabilities=_capabilities(source, root),
        variables=variables,
        state_derivatives=_state_derivatives(source),
        findings=_findings(source),
    )


def _state_derivatives(source: Any) -> dict[str, str]:
    """Read ModelStructure's derivatives; one that does not say of which state is left out."""
    derivatives = [unknown.variable for unknown in source.derivatives]
    return {d.derivative.name: d.name for d in derivatives if d.derivative and not d.shape}


def _interfaces(source: Any) -> tuple[str, ...]:
    offered = {
        "co-simulation": source.coSimulation,
        "model exchange": source.modelExchange,
        "scheduled execution": source.scheduledExecution,
    }
    return tuple(name for name, interface in offered.items() if interface is not None)


def _c_identifier(name: str | None) -> str:
    """The model identifier becomes a file name: a path here would load any library."""
    if name is None or not re.fullmatch(r"[A-Za-z_]\w*", name, re.ASCII):
        raise FMULoadError(f"modelIdentifier {name!r} is not a C identifier")
    return name


def _time(source: Any, attribute: str) -> float | None:
    """A time, or the tolerance; None also for one with which nothing can be simulated."""
    text = getattr(source, attribute, None)
    if text is None:
        return None
    value = float(text)
    usable = math.isfinite(value) and (value > 0 or attribute not in _POSITIVE)
    return value if usable else None


def _capabilities(source: Any, root: Any) -> Capabilities:
    interface = source.coSimulation
    if source.fmiVersion == "1.0":
        return _fmi1_capabilities(root)
    return Capabilities(
        interface.canHandleVariableCommunicationStepSize,
        interface.canGetAndSetFMUstate,
        interface.canSerializeFMUstate,
        _provides_directional_derivatives(root),
        interface.canBeInstantiatedOnlyOncePerProcess,
        interface.needsExecutionTool,
    )


def _provides_directional_derivatives(root: Any) -> bool:
    """FMI 3.0 has the attribute in the plural, which FMPy does not read."""
    attributes = root.find("CoSimulation").attrib
    names = ("providesDirectionalDerivative", "providesDirectionalDerivatives")
    return any(attributes.get(name) in {"true", "1"} for name in names)


def _fmi1_capabilities(root: Any) -> Capabilities:
    """Read the flags of FMI 1.0, which FMPy leaves out; FMI 1.0 has no FMU state."""
    flags = root.find("Implementation/*/Capabilities")
    attributes = {} if flags is None else flags.attrib

    def flag(name: str) -> bool:
        return attributes.get(name) in {"true", "1"}

    return Capabilities(
        can_handle_variable_communication_step_size=flag("canHandleVariableCommunicationStepSize"),
        can_be_instantiated_only_once_per_process=flag("canBeInstantiatedOnlyOncePerProcess"),
        needs_execution_tool=root.find("Implementation/CoSimulation_Tool") is not None,
    )


def _read_unsigned_limits(source: Any, root: Any) -> None:
    """Read min and max of unsigned integers, which FMPy leaves out."""
    elements = {element.get("name"): element for element in root.find("ModelVariables")}
    for variable in source.modelVariables:
        if variable.type.startswith("UInt"):
            element = elements[variable.name]
            variable.min, variable.max = element.get("min"), element.get("max")


def _convert_variable(source: Any) -> Variable:
    return Variable(
        name=source.name,
        type=source.type,
        value_reference=int(source.valueReference),
        causality=source.causality,
        variability=source.variability,
        initial=_initial(source),
        start=source.start,
        unit=_inherited(source, "unit", str),
        minimum=_bound(source, "min", -math.inf),
        maximum=_bound(source, "max", math.inf),
        nominal=_nominal(source),
        description=source.description or "",
        items=_items(source),
        shape=tuple(source.shape or ()),
    )


def _initial(source: Any) -> str | None:
    """FMI 1.0 has no ``initial``: there a start attribute says that the value may be set."""
    if source.initial is None:
        return None if source.start is None else "exact"
    return str(source.initial)


def _inherited(source: Any, attribute: str, convert: Callable[[str], Any]) -> Any:
    """Take an attribute from the variable, or else from its declared type."""
    value = getattr(source, attribute)
    if value is None and source.declaredType is not None:
        value = getattr(source.declaredType, attribute)
    return None if value is None else convert(value)


def _bound(source: Any, attribute: str, default: float) -> float:
    value = _inherited(source, attribute, float)
    return default if value is None or math.isnan(value) else float(value)


def _nominal(source: Any) -> float | None:
    value = _inherited(source, "nominal", float)
    return value if value is not None and math.isfinite(value) else None


def _items(source: Any) -> tuple[tuple[str, int], ...]:
    declared = source.declaredType
    return () if declared is None else tuple((str(i.name), int(i.value)) for i in declared.items)


def _findings(source: Any) -> tuple[str, ...]:
    experiment = _unused_times(source.defaultExperiment, _EXPERIMENT)
    internal = _unused_times(source.coSimulation, ("fixedInternalStepSize",))
    return experiment + internal + _broken_rules(source)


def _unused_times(source: Any, attributes: tuple[str, ...]) -> tuple[str, ...]:
    given = {name: getattr(source, name, None) for name in attributes}
    return tuple(
        f"{name} is {text}, which cannot be used"
        for name, text in given.items()
        if text is not None and _time(source, name) is None
    )


def _broken_rules(source: Any) -> tuple[str, ...]:
    try:
        return tuple(validate_model_description(source))
    except Exception as error:  # the validation itself stumbles over some invalid files
        return (f"the model description could not be validated: {error}",)
