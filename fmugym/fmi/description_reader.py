"""Reader of ``modelDescription.xml`` in bounded memory and time, whatever the file has; its cache.

Nothing is parsed before its size, its encoding and the amount of its markup are known: a short file
can unpack to gigabytes, and each element takes a quarter of a kilobyte once it is parsed.

The cache keeps model descriptions: large ones take seconds to parse at each construction. A file of
it holds JSON behind a checksum, which takes less time to write than to compress. What is damaged,
or was written by another version of this package, is as good as missing, and so is a folder that
cannot be read or written.
"""

from __future__ import annotations

import functools
import gc
import hashlib
import io
import json
import logging
import math
import re
import zipfile
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any, Final

import fmpy
from lxml import etree

from fmugym.errors import FMULoadError, reason
from fmugym.files import cache_folder, read_file, replace_file
from fmugym.fmi.description import Capabilities, ModelDescription, ModelExchange, Unit
from fmugym.fmi.fmpy_conversion import convert
from fmugym.fmi.safe_zip import ArchiveLimits, SafeZip, check_limit
from fmugym.fmi.variable import OWN, UNKNOWN, Interval, Variable

__all__ = ["keep", "kept", "parse_xml", "read_model_description", "read_root", "read_xml"]

logger = logging.getLogger(__name__)

_FOLDER: Final = "descriptions"
_LARGEST: Final = 2**28
"""Bytes that a file may have."""

_SIMPLE: Final = tuple(
    field.name
    for field in fields(ModelDescription)
    if field.name
    not in {"capabilities", "variables", "namesakes", "units", "model_exchange", "structure"}
)


def kept(key: str) -> ModelDescription | None:
    """Read the value of a key from the cache; None if there is no sound one."""
    try:
        content = read_file(cache_folder(_FOLDER) / _name(key), _LARGEST)
        digest, text = content[:32], content[32:]
        if hashlib.sha256(text).digest() != digest:
            return None
        return _description_of(json.loads(text))
    except Exception:  # whatever a file may hold
        return None


def keep(key: str, description: ModelDescription) -> None:
    """Keep a model description under a key, as it was read."""
    try:
        text = json.dumps(_plain(description)).encode()
        path = cache_folder(_FOLDER) / _name(key)
        replace_file(path, hashlib.sha256(text).digest() + text)
    except (OSError, RecursionError) as error:
        logger.debug("the model description is not kept: %s", error)


def _name(key: str) -> str:
    return hashlib.sha256(f"{key} {_version()}".encode()).hexdigest()[:32]


@functools.cache
def _version() -> str:
    """Identify the code that reads model descriptions.

    Raises:
        OSError: If its files cannot be read.
    """
    sources = sorted(Path(__file__).parent.glob("*.py"))
    if not sources:
        raise FileNotFoundError(f"{__file__} is in no folder")
    digest = hashlib.sha256(fmpy.__version__.encode())
    for source in sources:
        digest.update(source.read_bytes())
    return digest.hexdigest()


def _plain(description: ModelDescription) -> dict[str, Any]:
    """Lists, dicts, texts and numbers from which ``_description_of`` makes it again."""
    exchange = description.model_exchange
    return {
        "simple": [getattr(description, name) for name in _SIMPLE],
        "capabilities": asdict(description.capabilities),
        "units": {name: asdict(unit) for name, unit in description.units.items()},
        "model_exchange": None if exchange is None else asdict(exchange),
        "variables": _table(description.variables.values()),
        "namesakes": [_table(several) for several in description.namesakes.values()],
    }


def _table(variables: Iterable[Variable]) -> dict[str, Any]:
    """Own values of each variable, and the number of the values that its siblings share."""
    rows = list(variables)
    each = [variable.shared for variable in rows]
    shared = {id(one): one for one in each}
    numbers = {identity: number for number, identity in enumerate(shared)}
    return {
        "own": [[getattr(variable, name) for variable in rows] for name in OWN],
        "numbers": [numbers[id(one)] for one in each],
        "shared": list(shared.values()),
    }


def _description_of(plain: dict[str, Any]) -> ModelDescription:
    exchange = plain["model_exchange"]
    variables = _variables_of(plain["variables"])
    namesakes = [tuple(_variables_of(table)) for table in plain["namesakes"]]
    simple = dict(zip(_SIMPLE, map(_frozen, plain["simple"]), strict=True))
    return ModelDescription(
        **simple,
        capabilities=Capabilities(**plain["capabilities"]),
        variables={variable.name: variable for variable in variables},
        namesakes={several[0].name: several for several in namesakes},
        units={name: _unit_of(unit) for name, unit in plain["units"].items()},
        model_exchange=None
        if exchange is None
        else ModelExchange(**{name: _frozen(value) for name, value in exchange.items()}),
    )


def _variables_of(table: dict[str, Any]) -> list[Variable]:
    templates = [_template_of(shared) for shared in table["shared"]]
    rows = zip(table["numbers"], *table["own"], strict=True)
    return [templates[number].sibling(*own) for number, *own in rows]


def _template_of(shared: dict[str, Any]) -> Variable:
    attributes = {name: _frozen(value) for name, value in shared.items()}
    times = {name: _time_of(attributes[name]) for name in ("interval", "shift")}
    return Variable(name="", value_reference=0, **(attributes | times))


def _time_of(time: Sequence[Any]) -> Interval:
    """Read a time of a clock; ``UNKNOWN`` for one that only the FMU knows."""
    made = Interval(*time)
    return UNKNOWN if math.isnan(made.seconds) else made


def _unit_of(unit: dict[str, Any]) -> Unit:
    displays = {name: tuple(pair) for name, pair in unit["display_units"].items()}
    dimension = unit["dimension"]
    return Unit(
        None if dimension is None else tuple(dimension), unit["factor"], unit["offset"], displays
    )


def _frozen(value: Any) -> Any:
    """Tuples, which JSON has made lists."""
    return tuple(map(_frozen, value)) if isinstance(value, list) else value


_XML: Final = "modelDescription.xml"
_LARGE: Final = 2**18
"""Size in bytes of XML that is kept in the cache folder once parsed: some thousand variables."""

_MARKUP_PER_VARIABLE: Final = 25
"""Elements and attributes that a file may have for each of ``max_variables``."""

_UTF_8_MARK: Final = b"\xef\xbb\xbf"
_BYTE_ORDER_MARKS: Final = {
    _UTF_8_MARK: "utf-8",
    b"\xff\xfe": "utf-16",
    b"\xfe\xff": "utf-16",
    b"<\0": "utf-16-le",
    b"\0<": "utf-16-be",
}
_OF_UTF_8: Final = b'<?xml version="1.0" encoding="UTF-8"?>'
_DECLARATION: Final = re.compile(rb"\A(<\?xml\s[^>]*\?>)?")
_ENCODING: Final = re.compile(rb"""<\?xml[^>]*?\bencoding\s*=\s*["']([^"'>]*)["']""")
_DEPENDENCIES: Final = re.compile(rb"""\sdependencies(Kind)?\s*=\s*("[^"]*"|'[^']*')""")
_VARIABLES_BEGIN: Final = b"<ModelVariables>"
_VARIABLES_END: Final = b"</ModelVariables>"
_LEFT_OUT_BY_FMPY: Final = (
    b"relativeQuantity",
    b"negatedAlias",
    b"clocks",
    b"intervalVariability",
    b"<UInt",
)
"""Marks of variables of which ``convert`` needs more than FMPy reads."""

_ENCODINGS: Final = re.compile(r"utf-?8|(us-)?ascii|iso-?8859-\d+|(windows-|cp)125\d", re.I)
"""Encodings in which neither ``<`` nor ``=`` can hide. FMI 2.0 and 3.0 ask for UTF-8."""


def read_model_description(archive: SafeZip, interface: str | None = None) -> ModelDescription:
    """Read the model description of an FMU. Nothing of the FMU is executed or extracted.

    FMUs may break rules of the standard, as many do: what FMPy's validation finds is kept in
    ``findings``.

    Args:
        archive: The FMU.
        interface: One of ``INTERFACES``; None for co-simulation, or else model exchange.

    Returns:
        The model description.

    Raises:
        FMULoadError: If the XML is missing, too large or unreadable, or lacks the interface.
    """
    content = _read_content(archive)
    if len(content) < _LARGE:
        return _read(archive, content, interface)
    with _pausing_the_collector():
        return _read_or_recall(archive, content, interface)


@contextmanager
def _pausing_the_collector() -> Iterator[None]:
    """Let Python not look for garbage: all of the many objects that are made now are kept."""
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_enabled:
            gc.enable()


def _read_or_recall(archive: SafeZip, content: bytes, interface: str | None) -> ModelDescription:
    limit = archive.limits.max_variables
    key = f"{hashlib.sha256(content).hexdigest()} {interface} {limit}"
    description = kept(key)
    if description is None:
        description = _read(archive, content, interface)
        keep(key, description)
    return description


def _read(archive: SafeZip, content: bytes, interface: str | None) -> ModelDescription:
    name, content = archive.path.name, _without_dependencies(content)
    root = _parse_content(archive, _without_plain_variables(content, archive.limits))
    try:
        return convert(_parse_with_fmpy(content), root, interface)
    except FMULoadError as error:
        raise FMULoadError(f"{name}: {error}") from None
    except Exception as error:  # FMPy leaks a dozen types for malformed files
        parse_xml(name, _XML, content)  # may be no XML where the variables are
        raise FMULoadError(
            f"{name}: {_XML} cannot be understood: {type(error).__name__}: {reason(error)}"
        ) from error


def read_root(archive: SafeZip) -> Any:
    """Read the XML of an FMU with the dependencies, which no environment of one FMU needs.

    Returns:
        The root, an element of lxml.

    Raises:
        FMULoadError: If the XML is missing, too large or unreadable.
    """
    return _parse_content(archive, _read_content(archive))


def _read_content(archive: SafeZip) -> bytes:
    name, limits = archive.path.name, archive.limits
    if _XML not in archive.files:
        raise FMULoadError(f"{name} is not an FMU: it has no {_XML}{_hint(archive)}")
    content = read_xml(archive, _XML, limits.max_xml_bytes)
    count = content.count(b"<") + content.count(b"=")
    most = _MARKUP_PER_VARIABLE * limits.max_variables + 1000
    found = f"{name}: {_XML} has some {count} elements and attributes"
    check_limit(found, count, most, "max_variables")
    return content


def _parse_content(archive: SafeZip, content: bytes) -> Any:
    name, most = archive.path.name, archive.limits.max_variables
    root = parse_xml(name, _XML, content)
    version = root.get("fmiVersion", "")
    if root.tag != "fmiModelDescription" or not re.fullmatch(r"1\.0|2\.0(\.\d+)?|3\.\d.*", version):
        raise FMULoadError(
            f"{name}: expected a model description of FMI 1.0, 2.0 or 3.0, "
            f"found <{root.tag} fmiVersion={version!r}>"
        )
    count = len(root.findall("ModelVariables/*"))
    check_limit(f"{name} has {count} variables", count, most, "max_variables")
    return root


def read_xml(archive: SafeZip, place: str, limit: int) -> bytes:
    """Read an XML file of an archive.

    Args:
        archive: The archive.
        place: The place of the file.
        limit: The most bytes that it may have.

    Returns:
        The text in UTF-8.

    Raises:
        FMULoadError: If it is too large, its encoding is unknown, or it has a DOCTYPE.
    """
    name = archive.path.name
    content = archive.read(place, limit)
    size = max(len(content), archive.files[place].file_size)
    check_limit(f"{name}: {place} has {size} bytes", len(content), limit, "max_xml_bytes")
    try:
        content = _as_utf_8(content)
    except (UnicodeError, LookupError) as error:
        raise FMULoadError(f"{name}: {place} is not valid XML: {reason(error)}") from None
    if re.search(rb"<!\s*DOCTYPE", content, re.IGNORECASE):  # its entities could grow without end
        raise FMULoadError(f"{name}: {place} has a DOCTYPE, which FMI and SSP forbid")
    return content


def _hint(archive: SafeZip) -> str:
    """Explain the mistake of packing a folder instead of its content."""
    inside = next((p for p in archive.files if p.endswith(f"/{_XML}") and p.count("/") == 1), None)
    if inside is None:
        return ""
    folder = inside.partition("/")[0]
    return f", but {inside!r}; pack the files in the folder {folder!r}, not the folder itself"


def _as_utf_8(content: bytes) -> bytes:
    """Convert the text to UTF-8, with a declaration that says so and is the only one.

    The parsers would find the encoding by themselves, but not all of them the same one.
    """
    encoding = _encoding_of(content)
    if not re.fullmatch("utf-?8", encoding, re.IGNORECASE):
        content = content.decode(encoding).encode()
    text = content.removeprefix(_UTF_8_MARK).lstrip()
    return text if text.startswith(_OF_UTF_8) else _DECLARATION.sub(_OF_UTF_8, text, count=1)


def _encoding_of(content: bytes) -> str:
    """The encoding by the byte order mark or else the declaration.

    Raises:
        LookupError: If markup could hide in it.
    """
    encoding = next((e for m, e in _BYTE_ORDER_MARKS.items() if content.startswith(m)), None)
    if encoding is None:
        declared = _ENCODING.match(content.lstrip()[:1000])
        encoding = declared[1].decode("ascii", "replace") if declared else "utf-8"
        if not _ENCODINGS.fullmatch(encoding):
            raise LookupError(f"its encoding is {encoding[:40]!r}, expected 'UTF-8'")
    return encoding


def _without_dependencies(content: bytes) -> bytes:
    """Leave out the dependencies of the unknowns.

    No environment needs it, and FMPy makes millions of objects of a few megabytes of numbers. Line
    breaks stay, since findings have the numbers of lines.
    """
    start = content.rfind(b"<ModelStructure")
    if start < 0:
        return content
    rest = _DEPENDENCIES.sub(lambda match: b"\n" * match[0].count(b"\n"), content[start:])
    return content[:start] + rest


def _without_plain_variables(content: bytes, limits: ArchiveLimits) -> bytes:
    """Leave out all variables, unless one has elements that FMPy does not read.

    FMPy parses them in any case, and twice takes much time and memory. They stay where it is not
    sure where they begin and end, and where there may be too many, which are counted before FMPy
    reads them. Line breaks stay, since errors have the numbers of lines.
    """
    start, end = content.find(_VARIABLES_BEGIN), content.find(_VARIABLES_END)
    if not 0 <= start < end or content.count(b"ModelVariables") > 2:  # some may be in comments
        return content
    start += len(_VARIABLES_BEGIN)
    special = any(content.find(text, start, end) >= 0 for text in _LEFT_OUT_BY_FMPY)
    if special or content.count(b"valueReference", start, end) > limits.max_variables:
        return content
    return content[:start] + b"\n" * content.count(b"\n", start, end) + content[end:]


def parse_xml(name: str, place: str, content: bytes) -> Any:
    """Parse the text of an XML file.

    Args:
        name: The name of the archive, for errors.
        place: The place of the file, for errors.
        content: Result of ``read_xml``.

    Returns:
        The root, an element of lxml.

    Raises:
        FMULoadError: If it is no XML.
    """
    parser = etree.XMLParser(resolve_entities=False, no_network=True)
    try:
        return etree.fromstring(content, parser)
    except etree.XMLSyntaxError as error:
        raise FMULoadError(f"{name}: {place} is not valid XML: {reason(error)}") from None


def _parse_with_fmpy(content: bytes) -> Any:
    """Let FMPy read an archive of the checked XML alone."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        archive.writestr(_XML, content)
    return fmpy.read_model_description(buffer, validate=False)
