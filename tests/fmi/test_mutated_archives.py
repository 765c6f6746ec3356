"""Broken FMUs: each is opened, described and extracted, or refused with an error.

Nothing of the FMU is loaded.
"""

import contextlib
import copy
import functools
import io
import math
import operator
import re
import stat
import warnings
import zipfile
from pathlib import Path

import pytest
from fmu_tools import library_name, probe_xml, read_fmu
from hypothesis import given
from hypothesis import strategies as st
from lxml import etree
from odd_values import working_or_refused

from fmugym import FMU, FMULoadError
from fmugym.cli.class_skeleton import Skeleton
from fmugym.cli.overview import as_text, overview
from fmugym.environment.config import EnvConfig
from fmugym.environment.interface import resolve
from fmugym.environment.spaces import action_space, observation_space
from fmugym.errors import FMUGymError
from fmugym.fmi import fmu as fmu_module
from fmugym.fmi.bundled import BUNDLED_FMUS, bundled_fmu

XML = "modelDescription.xml"
TABLE = "resources/table.csv"


def sound_fmus():
    """Yield the files of FMUs, with the library of this machine only."""
    for model, version in BUNDLED_FMUS:
        files = read_fmu(bundled_fmu(model, version))
        library = library_name(int(version[0]), model)
        yield {XML: files[XML], library: files[library], TABLE: b"0,1\n" * 9}
    for version in (1, 2, 3):
        library = read_fmu(bundled_fmu("Pendulum", f"{version}.0"))
        content = library[library_name(version, "Pendulum")]
        yield {XML: probe_xml(version).encode(), library_name(version): content}


SOUND = tuple(sound_fmus())


class Content(bytes):
    """The bytes of a file, of which Hypothesis shows the number only."""

    def __repr__(self):
        return f"<{len(self)} bytes>"


# Damage to bytes

NUMBERS = st.binary(min_size=1, max_size=8) | st.builds(
    lambda number, width: (number % 2 ** (8 * width)).to_bytes(width, "little"),
    st.sampled_from((0, 1, -1, 0x7F, 0xFF, 2**7, 2**15, 2**31, 2**63)),
    st.sampled_from((1, 2, 4, 8)),
)


def damaged(draw, content):
    """Damage a piece of a file as transports, disks and bad tools do."""
    for _ in range(draw(st.integers(1, 4))):
        start = draw(st.integers(0, len(content)))
        end = start + draw(st.sampled_from((1, 2, 4, 16, 256, 4096)))
        before, piece, after = content[:start], content[start:end], content[end:]
        match draw(st.sampled_from(("flip", "overwrite", "remove", "repeat", "truncate"))):
            case "flip":
                masks = draw(st.binary(min_size=min(16, len(piece)), max_size=16))
                flipped = bytes(map(operator.xor, piece, masks))
                content = overwritten(content, start, flipped)
            case "overwrite":
                content = overwritten(content, start, draw(NUMBERS))
            case "remove":
                content = before + after
            case "repeat":
                content = before + 2 * piece + after
            case "truncate":
                content = before
    return content


def overwritten(content, start, new):
    return content[:start] + new + content[start + len(new) :]


def damaged_header(draw, content):
    """Overwrite a field of a header of the archive, where a random byte seldom lands."""
    headers = [found.start() for found in re.finditer(rb"PK(\x03\x04|\x01\x02|\x05\x06)", content)]
    if not headers:
        return damaged(draw, content)
    start = draw(st.sampled_from(headers)) + draw(st.integers(4, 45))
    return overwritten(content, start, draw(NUMBERS))


# Damage to the archive

NAMES = (
    *("../x", "/x", "..", ".", "", "a/../../x", "c:x", "a\\b", "a//b", "./" + XML, XML.upper()),
    *("resources", "resources/x", XML, XML + "/x", "binaries", "con", "x\0y", "\u00e4", "x" * 300),
    *("./", ".\\", "resources\\", "a\\..\\..\\x", "Binaries/linux64/x.so", "\x1b[2J", "\x9b"),
    *("a/" * 30 + "x", "a/" * 70 + "x", "a/" * 30_000, "resources/" + "b/" * 50 + "x"),
)
SPELLINGS = (
    lambda name: name.replace("/", "\\"),
    lambda name: f"./{name}",
    lambda name: name.replace("/", "//"),
    str.upper,
    str.title,
)
"""Names as odd tools write them."""

LINK = (stat.S_IFLNK | 0o777) << 16


def damaged_files(draw, files):
    """Rename, drop, empty or add a file."""
    name, other = draw(st.sampled_from(sorted(files))), draw(st.sampled_from(NAMES))
    content = files[name]
    rest = {one: files[one] for one in files if one != name}
    match draw(st.sampled_from(("rename", "drop", "empty", "add"))):
        case "rename":
            return rest | {other: content}
        case "drop":
            return rest
        case "empty":
            return files | {name: b""}
        case "add":
            return files | {other: draw(st.sampled_from((b"", b"x", content)))}


def untidy(draw, entries):
    """Spell names as odd tools do, and give two files one name."""
    spell = draw(st.sampled_from(SPELLINGS))
    entries = [(spell(name) if draw(st.booleans()) else name, content) for name, content in entries]
    name, content = draw(st.sampled_from(entries))
    other = draw(st.sampled_from((content, b"", b"/etc/passwd", b"a" * 5000)))
    return draw(st.permutations([*entries, (name, other)]))


METHODS = st.sampled_from((zipfile.ZIP_DEFLATED, zipfile.ZIP_STORED) * 20 + (12, 14))
MODES = st.sampled_from((0,) * 100 + (LINK, 2**31, 2**32 - 1))


def zipped(entries, method=lambda: zipfile.ZIP_DEFLATED, mode=lambda: 0):
    """An archive of files, for each of which functions give the method and the mode."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of names that come twice
        for name, content in entries:
            info = zipfile.ZipInfo(name or "/")
            info.filename = name or "/"  # with backslashes on Windows, too
            info.compress_type, info.external_attr = method(), mode()
            archive.writestr(info, content)
    return buffer.getvalue()


# Damage to the model description

VALUES = (
    *("", " ", "0", "-1", "1e999", "-inf", "NaN", "1.5", "true", "True", "None", "0x10", "1,5"),
    *(
        "99999999999999999999",
        "4294967296",
        "-2147483649",
        "1 2 3",
        "\u00e4\u200b\u4e2d",
        "a" * 5000,
    ),
    *("../../x", "/etc/passwd", "C:\\x", "%s%n", "{0}", "input", "parameter", "fixed", "constant"),
    *("discrete", "independent", "exact", "calculated", "3.0", "1.0", "2.0", "Real", "u", "[2]"),
    "\x9b2J\x85\u202e\n",
)
CHANGES = ("attribute",) * 4 + ("no attribute", "no element", "move", "rename", "nest", "fill")
PROLOGS = (
    *("<!DOCTYPE x>", '<!DOCTYPE x [<!ENTITY a "b">]>', "<?php ?>", "<!-- -->", "\ufeff", "<x/>"),
    "\0",
)
ENCODINGS = ("utf-8", "utf-8", "utf-16", "iso-8859-1", "utf-7", "utf-32")


def damaged_xml(draw, xml):
    """Change elements and attributes, so that it stays well-formed, unless there is a prolog."""
    try:
        root = etree.fromstring(xml)
    except (etree.XMLSyntaxError, ValueError):
        return damaged(draw, xml)
    for _ in range(draw(st.sampled_from((1, 1, 1, 2, 3)))):
        change(draw, root)
    text = etree.tostring(root, encoding="unicode")
    if draw(st.sampled_from((False,) * 19 + (True,))):
        return (draw(st.sampled_from(PROLOGS)) + text).encode()
    encoding = draw(st.sampled_from(ENCODINGS))
    head = f'<?xml version="1.0" encoding="{encoding}"?>'
    return (head + text).encode(encoding, "xmlcharrefreplace")


def change(draw, root):
    """Change one element."""
    elements = list(root.iter("*"))
    element, other = (elements[draw(st.integers(0, len(elements) - 1))] for _ in range(2))
    match draw(st.sampled_from(CHANGES)):
        case "attribute":
            names = sorted(element.attrib) or sorted(other.attrib) or ["name"]
            name = draw(st.sampled_from(names * 3 + sorted(other.attrib)))
            values = st.sampled_from((*VALUES, *element.attrib.values()))
            with contextlib.suppress(ValueError):  # what XML cannot carry
                element.set(name, draw(values))
        case "no attribute" if element.attrib:
            del element.attrib[draw(st.sampled_from(sorted(element.attrib)))]
        case "no element" if element is not root:
            element.getparent().remove(element)
        case "move":
            other.append(copy.deepcopy(element))
        case "rename":
            element.tag = draw(st.sampled_from((other.tag, "x", "Binary", "Clock", "UInt64")))
        case "nest":
            for _ in range(draw(st.sampled_from((3, 300)))):
                element = etree.SubElement(element, element.tag)
        case "fill":
            element.text = draw(st.sampled_from(VALUES))


# Broken FMUs

KINDS = ("xml", "xml", "xml", "bytes of xml", "library", "files", "names", "header", "bytes")


@st.composite
def broken_fmus(draw):
    """A strategy of the kinds of damage to an FMU, and its bytes."""
    files = dict(draw(st.sampled_from(SOUND)))
    kinds = draw(st.lists(st.sampled_from(KINDS), min_size=1, max_size=3))
    for name in files:
        if name == XML and "xml" in kinds:
            files[name] = damaged_xml(draw, files[name])
        if name == XML and "bytes of xml" in kinds:
            files[name] = damaged(draw, files[name])
        if name.startswith("binaries/") and "library" in kinds:
            files[name] = damaged(draw, files[name][:4096]) + files[name][4096:]
    entries = list((damaged_files(draw, files) if "files" in kinds else files).items())
    entries = untidy(draw, entries) if "names" in kinds else entries
    content = zipped(entries, lambda: draw(METHODS), lambda: draw(MODES))
    if "header" in kinds:
        content = damaged_header(draw, content)
    if "bytes" in kinds:
        content = damaged(draw, content)
    return kinds, Content(content)


def use(content):
    """Do what is done with an FMU before it is loaded."""
    Path("case.fmu").write_bytes(content)
    with contextlib.closing(FMU("case.fmu")) as fmu:
        require_plain(as_text(overview(fmu, everything=True)))
        with contextlib.suppress(FMUGymError):
            require_plain(Skeleton(fmu).text())
        configure(fmu)
        fmu.extract()


def require_plain(text):
    """Fail if a terminal could obey a text, or a log take it for several lines."""
    assert text.replace("\n", " ").isprintable(), ascii(text)


def configure(fmu):
    """Take an FMU's variables for environments, all together and one by one."""
    variables = [v for v in fmu.description.variables.values() if v.numeric]
    inputs = [v.name for v in variables if v.causality == "input"]
    outputs = [v.name for v in variables if v.causality == "output"]
    make_spaces(fmu, inputs, outputs)
    for name in [*inputs, *outputs][:20]:
        make_spaces(fmu, [name] if name in inputs else [], [name])


def make_spaces(fmu, inputs, outputs):
    config = {"model_input_names": inputs, "model_output_names": outputs}
    config["time_step"] = fmu.description.step_size or 0.1
    with contextlib.suppress(FMUGymError):
        interface = resolve(EnvConfig.from_dict(config), fmu.description)
        interface.pool_spec()
        observation_space(interface)
        action_space(interface)
        assert all(math.isfinite(variable.start_number) for variable in interface.inputs)


@pytest.fixture(name="one_answer", autouse=True)
def fixture_one_answer(monkeypatch):
    """Ask the loader once for the same libraries, which is slow."""
    remembered = functools.cache(fmu_module.ask_in_a_child)
    monkeypatch.setattr(fmu_module, "ask_in_a_child", lambda names: remembered(tuple(names)))


@pytest.fixture(name="in_folder")
def fixture_in_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


@pytest.mark.parametrize("files", SOUND, ids=lambda files: list(files)[1])
def test_a_sound_fmu_is_described(files, in_folder):
    use(zipped(files.items()))


@pytest.mark.parametrize(
    "changes",
    [{XML: b""}, {XML: b"<x/>"}, {XML: SOUND[0][XML][:-9]}, {"../x": b""}, {"/x": b""}],
)
def test_a_broken_fmu_is_refused(changes, in_folder):
    with pytest.raises(FMULoadError):
        use(zipped((SOUND[0] | changes).items()))


@pytest.mark.parametrize("length", [0, 1, 100, 1000])
def test_an_fmu_that_is_cut_off_is_refused(length, in_folder):
    with pytest.raises(FMULoadError):
        use(zipped(SOUND[0].items())[:length])


def test_a_text_that_a_terminal_obeys_is_found(monkeypatch, in_folder):
    monkeypatch.setattr("fmugym.cli.overview.plain", str)
    evil = SOUND[0][XML].replace(b'modelName="', b'modelName="&#x9b;2J')
    with pytest.raises(AssertionError):
        use(zipped((SOUND[0] | {XML: evil}).items()))


@given(broken_fmus())
def test_a_mutated_fmu_is_described_or_refused(fmu):
    _, content = fmu
    with working_or_refused():
        use(content)
