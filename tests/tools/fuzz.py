"""Broken FMUs by the thousand: opening them raises nothing but the package's own errors.

    python tests/tools/fuzz.py --count 20000 --seed 0

Each case is a sound FMU with one to four mutations of its bytes, its archive, its model description
or its library. The program opens and describes it as ``fmugym info`` and ``fmugym new`` do,
makes a config of it, and extracts it. Nothing of the FMU is loaded. A case also fails with control
characters in a text for people. If the program ends with a crash or a hang, ``case.fmu`` stays in a
temporary folder. The bundled FMUs must stay the same for a case to be repeated. See
``fuzz_driver.py``.
"""

import contextlib
import copy
import functools
import io
import math
import stat
import sys
import warnings
import zipfile

from fmu_tools import library_name, probe_xml, read_fmu
from fuzz_driver import Case, main, require
from lxml import etree

from fmugym import FMU, FMUGymError
from fmugym.cli.class_skeleton import Skeleton
from fmugym.cli.overview import as_text, overview
from fmugym.environment.config import EnvConfig
from fmugym.environment.interface import resolve
from fmugym.environment.spaces import action_space, observation_space
from fmugym.fmi import fmu as fmu_module
from fmugym.fmi.bundled import BUNDLED_FMUS, bundled_fmu

XML = "modelDescription.xml"

VALUES = (
    *(
        "",
        " ",
        "0",
        "-1",
        "1e999",
        "-inf",
        "NaN",
        "1.5",
        "true",
        "True",
        "None",
        "\u00e4\u200b\u4e2d",
        "\x9b2J\x85\u202e\n",
    ),
    *("99999999999999999999", "4294967296", "-2147483649", "0x10", "1,5", "1 2 3", "a" * 5000),
    *("../../x", "/etc/passwd", "C:\\x", "%s%n", "{0}", "input", "parameter", "fixed", "constant"),
    *("discrete", "independent", "exact", "calculated", "3.0", "1.0", "2.0", "Real", "u", "[2]"),
)
NAMES = (
    *("../x", "/x", "..", ".", "", "a/../../x", "c:x", "a\\b", "a//b", "./" + XML, XML.upper()),
    *("resources", "resources/x", XML, XML + "/x", "binaries", "con", "x\0y", "\u00e4", "x" * 300),
    *("./", ".\\", "resources\\", "a\\..\\..\\x", "Binaries/linux64/x.so", "\x1b[2J", "\x9b"),
    *("a/" * 30 + "x", "a/" * 70 + "x", "a/" * 30_000, "resources/" + "b/" * 50 + "x"),
)
PROLOGS = (
    "<!DOCTYPE x>",
    '<!DOCTYPE x [<!ENTITY a "b">]>',
    "<?php ?>",
    "<!-- -->",
    "\ufeff",
    "<x/>",
    "\0",
)


# Mutations of bytes


def mutate_bytes(rng, content):
    """Damage a piece of a file as transports, disks and bad tools do."""
    content = bytearray(content)
    for _ in range(rng.randint(1, 8)):
        start = rng.randrange(len(content) + 1)
        end = min(len(content), start + rng.choice((1, 1, 2, 4, 16, 256, 4096)))
        rng.choice(BYTE_MUTATIONS)(rng, content, start, end)
    return bytes(content)


def flip(rng, content, start, end):
    for place in range(start, min(end, start + 16)):
        content[place] ^= 1 << rng.randrange(8)


def overwrite(rng, content, start, end):
    width = rng.choice((1, 2, 4, 8))
    span = 2 ** (8 * width)
    number = rng.choice((0, 1, 0x7F, 0xFF, span // 2, span - 1, rng.randrange(span)))
    content[start : start + width] = number.to_bytes(width, "little")


def remove(rng, content, start, end):
    del content[start:end]


def repeat(rng, content, start, end):
    content[start:start] = content[start:end]


def truncate(rng, content, start, end):
    del content[start:]


BYTE_MUTATIONS = (flip, flip, overwrite, overwrite, remove, repeat, truncate)


# Mutations of the archive


def mutate_zip(rng, content):
    """Overwrite a field of a header of the archive, where a random byte seldom lands."""
    signatures = (b"PK\x03\x04", b"PK\x01\x02", b"PK\x05\x06")
    places = [i for s in signatures for i in find_all(content, s)]
    if not places:
        return mutate_bytes(rng, content)
    content = bytearray(content)
    start = rng.choice(places) + rng.randrange(4, 46)
    overwrite(rng, content, start, start)
    return bytes(content)


def find_all(content, part):
    place = content.find(part)
    while place >= 0:
        yield place
        place = content.find(part, place + 1)


def mutate_files(rng, files):
    """Rename, drop, add or empty a file."""
    name = rng.choice(sorted(files))
    other = rng.choice(NAMES)
    kind = rng.randrange(4)
    content = files[name] if kind == 3 else files.pop(name)
    if kind == 1:
        files[other] = content
    elif kind == 2:
        files[name] = b""
    elif kind == 3:
        files[other] = rng.choice((b"", b"x", content))
    return files


def pack(rng, files):
    buffer = io.BytesIO()
    entries = list(files.items())
    if rng.random() < 0.05:
        untidy(rng, entries)
    with zipfile.ZipFile(buffer, "w") as archive, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of names that come twice
        for name, content in entries:
            info = zipfile.ZipInfo(name or "/")
            info.filename = name or "/"  # with backslashes on Windows, too
            info.compress_type = rng.choice((8, 8, 0, 0) * 10 + (12, 14))
            if rng.random() < 0.01:
                info.external_attr = rng.choice((rng.getrandbits(32), LINK))
            archive.writestr(info, content)
    return buffer.getvalue()


LINK = (stat.S_IFLNK | 0o777) << 16


def untidy(rng, entries):
    """Write names as odd tools do, or give two files one name."""
    change = rng.choice(
        (
            lambda name: name.replace("/", "\\"),
            lambda name: f"./{name}",
            lambda name: name.replace("/", "//"),
            str.upper,
            str.title,
        )
    )
    for index, (name, content) in enumerate(entries):
        if rng.random() < 0.7:
            entries[index] = change(name), content
    name, content = rng.choice(entries)
    where = rng.randrange(len(entries) + 1)
    entries.insert(where, (name, rng.choice((content, b"", b"/etc/passwd", b"a" * 5000))))


# Mutations of the model description


def mutate_xml(rng, xml):
    """Change elements and attributes, so that it stays well-formed."""
    try:
        root = etree.fromstring(xml)
    except (etree.XMLSyntaxError, ValueError):
        return mutate_bytes(rng, xml)
    for _ in range(rng.choice((1, 1, 1, 2, 3))):
        rng.choice(XML_MUTATIONS)(rng, root, rng.choice(list(root.iter("*"))))
    if rng.random() < 0.05:
        return (rng.choice(PROLOGS) + etree.tostring(root, encoding="unicode")).encode()
    encoding = rng.choice(("utf-8", "utf-8", "utf-8", "utf-16", "iso-8859-1", "utf-7", "utf-32"))
    if encoding in {"utf-7", "utf-32"}:
        text = etree.tostring(root, encoding="unicode")
        return f'<?xml version="1.0" encoding="{encoding}"?>{text}'.encode(encoding)
    return etree.tostring(root, encoding=encoding, xml_declaration=True)


def set_attribute(rng, root, element):
    others = [name for e in root.iter("*") for name in e.attrib]
    names = list(element.attrib) * 3 or others
    values = [*VALUES, *element.attrib.values()]
    value = rng.choice(values)
    with contextlib.suppress(ValueError):  # what XML cannot carry
        element.set(rng.choice(rng.choice((names, others))), value)


def drop_attribute(rng, root, element):
    if element.attrib:
        del element.attrib[rng.choice(list(element.attrib))]


def drop_element(rng, root, element):
    if element is not root:
        element.getparent().remove(element)


def move_element(rng, root, element):
    rng.choice(list(root.iter("*"))).append(copy.deepcopy(element))


def rename_element(rng, root, element):
    element.tag = rng.choice([e.tag for e in root.iter("*")] + ["x", "Binary", "Clock", "UInt64"])


def nest(rng, root, element):
    for _ in range(rng.choice((3, 300))):
        element = etree.SubElement(element, element.tag)


def fill(rng, root, element):
    element.text = rng.choice(VALUES)


XML_MUTATIONS = (set_attribute,) * 8 + (
    *(drop_attribute, drop_attribute, drop_element, drop_element, move_element, move_element),
    *(rename_element, rename_element, nest, fill),
)


# Cases

KINDS = ("xml", "bytes of xml", "library", "files", "zip", "bytes")


def sound_fmus():
    """The files of the FMUs that are mutated, with this machine's library only."""
    for model, version in BUNDLED_FMUS:
        files = read_fmu(bundled_fmu(model, version))
        yield slim(files, library_name(int(version[0]), model))
    for version in (1, 2, 3):
        library = read_fmu(bundled_fmu("Pendulum", f"{version}.0"))
        content = library[library_name(version, "Pendulum")]
        yield {XML: probe_xml(version).encode(), library_name(version): content}


def slim(files, library):
    return {name: files[name] for name in (XML, library)} | {"resources/table.csv": b"0,1\n" * 9}


def broken_fmu(bases, rng):
    """The bytes of a broken FMU, and what was done to it."""
    files = dict(rng.choice(bases))
    library = next(name for name in files if name.startswith("binaries/"))
    kinds = rng.choices(KINDS, (8, 2, 3, 2, 4, 2), k=rng.choice((1, 1, 1, 1, 2, 4)))
    for kind in kinds:
        if kind == "xml" and XML in files:
            files[XML] = mutate_xml(rng, files[XML])
        elif kind == "bytes of xml" and XML in files:
            files[XML] = mutate_bytes(rng, files[XML])
        elif kind == "library" and library in files:
            head, tail = files[library][:4096], files[library][4096:]
            files[library] = mutate_bytes(rng, head) + tail
        elif kind == "files" and len(files) > 1:
            files = mutate_files(rng, files)
    content = pack(rng, files)
    for kind in kinds:
        if kind in {"zip", "bytes"}:
            content = {"zip": mutate_zip, "bytes": mutate_bytes}[kind](rng, content)
    return content, kinds


def use(path):
    """Do what is done with an FMU before it is loaded."""
    with contextlib.closing(FMU(path)) as fmu:
        check_text(as_text(overview(fmu, everything=True)).replace("\n", " "))
        with contextlib.suppress(FMUGymError):
            check_text(Skeleton(fmu).text().replace("\n", " "))
        configure(fmu)
        fmu.extract()


def check_text(text):
    """Fail if a terminal could obey a text, or a log take it for several lines."""
    require(text.isprintable(), ascii(text[:200]))


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
        default_inputs = [variable.start_number for variable in interface.inputs]
        require(all(map(math.isfinite, default_inputs)), "an input that is not finite")


@contextlib.contextmanager
def program():
    """See ``fuzz_driver.run``; asks the loader once for the same libraries, which is slow."""
    bases = list(sound_fmus())
    before = fmu_module.ask_in_a_child
    remembered = functools.cache(before)

    def make(rng, folder):
        path = folder / "case.fmu"
        content, kinds = broken_fmu(bases, rng)
        path.write_bytes(content)
        return Case(lambda: use(path), kinds[0], kinds)

    fmu_module.ask_in_a_child = lambda names: remembered(tuple(names))
    try:
        yield make
    finally:
        fmu_module.ask_in_a_child = before


if __name__ == "__main__":
    sys.exit(main(program, __doc__, 20_000))
