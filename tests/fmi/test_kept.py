"""Large model descriptions, which are kept in the cache folder once they were read."""

import hashlib
import pickle
from dataclasses import fields

import fmpy
import pytest
from clocks_tools import clocks_fmu
from exchange_tools import exchange_fmu
from fmu_tools import probe_fmu
from process_tools import run_python

from fmugym import FMU, FMULoadError, bundled_fmu
from fmugym.fmi import ArchiveLimits, description_reader
from fmugym.fmi.bundled import BUNDLED_FMUS

MANY = 2000
PLAIN = (
    '<ScalarVariable name="wall[{0}].T" valueReference="{1}" causality="local" '
    'variability="continuous" description="Node {0}"><Real unit="K" min="0"/></ScalarVariable>'
)


@pytest.fixture
def cache(tmp_path, monkeypatch):
    folder = tmp_path / "cache"
    monkeypatch.setenv("FMUGYM_CACHE_DIR", str(folder))
    return folder / "descriptions"


@pytest.fixture
def path(tmp_path):
    """The probe with many variables, one name twice, and a description that is not ASCII."""
    rows = [PLAIN.format(i, 5000 + i) for i in range(MANY)]
    rows += [PLAIN.format("0", 9).replace("Node", "Größe")]
    return probe_fmu(tmp_path, 2, {"</ModelVariables>": f"{''.join(rows)}</ModelVariables>"})


@pytest.fixture
def unread(monkeypatch):
    """Nothing is parsed from now on."""

    def forbid():
        monkeypatch.setattr(
            description_reader, "convert", lambda *_: pytest.fail("it was read again")
        )

    return forbid


def same(one, other):
    """Compare every attribute, with its type; variables are compared by identity otherwise."""
    for field in fields(one):
        if field.name not in {"variables", "namesakes"}:
            assert getattr(one, field.name) == getattr(other, field.name), field.name
    assert list(one.variables) == list(other.variables)
    assert one.namesakes.keys() == other.namesakes.keys()
    pairs = list(zip(one.everything, other.everything, strict=True))
    assert pairs
    for first, second in pairs:
        same_variable(first, second)


def same_variable(first, second):
    for field in fields(first):
        values = getattr(first, field.name), getattr(second, field.name)
        assert repr(values[0]) == repr(values[1]), (first.name, field.name)
        assert type(values[0]) is type(values[1])


def test_the_second_reading_parses_nothing(cache, path, unread):
    first = FMU(path)
    assert len(list(cache.iterdir())) == 1
    unread()
    second = FMU(path)
    same(first.description, second.description)
    assert first.findings == second.findings
    assert len(first.description.namesakes["wall[0].T"]) == 2


def test_small_ones_are_not_kept(cache, tmp_path):
    FMU(probe_fmu(tmp_path, 2))
    assert not cache.exists()


def test_another_content_is_another_description(cache, path, tmp_path):
    FMU(path)
    more = {"</ModelVariables>": f"{PLAIN.format(1, 1) * 3000}</ModelVariables>"}
    other = probe_fmu(tmp_path / "other", 2, more)
    assert "mix" in FMU(other).description.variables
    assert len(list(cache.iterdir())) == 2


def test_limits_hold_for_what_is_kept(cache, path):
    FMU(path)
    with pytest.raises(FMULoadError, match="max_variables"):
        FMU(path, limits=ArchiveLimits(max_variables=MANY))


@pytest.mark.parametrize("interface", ["co_simulation", "model_exchange"])
def test_each_interface_is_kept_by_itself(cache, tmp_path, monkeypatch, unread, interface):
    monkeypatch.setattr(description_reader, "_LARGE", 0)
    path = exchange_fmu(tmp_path / "b.fmu", "ball", 3, ("ModelExchange", "CoSimulation"))
    before = [FMU(path, interface=name).description for name in (interface, None)]
    unread()
    for name, description in zip((interface, None), before, strict=True):
        same(FMU(path, interface=name).description, description)


def every_kind(folder):
    yield from (probe_fmu(folder / f"probe {version}", version) for version in (1, 2, 3))
    yield from (bundled_fmu(model, version) for model, version in BUNDLED_FMUS)
    for version in (1, 2, 3):
        yield exchange_fmu(folder / f"{version}.fmu", "friction", version)
    yield clocks_fmu(folder / "clocks.fmu", arrays=True)


def test_every_kind_of_description_comes_back(cache, tmp_path):
    descriptions = [FMU(path).description for path in every_kind(tmp_path)]
    for number, description in enumerate(descriptions):
        description_reader.keep(str(number), description)
    for number, description in enumerate(descriptions):
        same(description, description_reader.kept(str(number)))


DIFFERENT = {
    2: [
        '<ScalarVariable name="v" valueReference="900" causality="local" variability="{}">'
        "<{}/></ScalarVariable>".format(*one)
        for one in [
            ("continuous", "Real"),
            ("discrete", "Real"),
            ("discrete", "Integer"),
            ("continuous", 'Real min="0"'),
            ("continuous", 'Real min="-0"'),
            ("continuous", 'Real max="0"'),
            ("continuous", 'Real nominal="2"'),
            ("continuous", 'Real unit="K"'),
            ("continuous", 'Real relativeQuantity="true"'),
            ("continuous", 'Real relativeQuantity="false"'),
            ("discrete", 'Enumeration declaredType="Mode"'),
        ]
    ],
    3: [
        f'<{one} name="v" valueReference="900" causality="local" variability="discrete"'
        f"{more}</{one.split()[0]}>"
        for one, more in [
            ("Float64", ">"),
            ("UInt8", ">"),
            ("UInt8", ' max="3">'),
            ("Float64", ' relativeQuantity="true">'),
            ("Float64", '><Dimension start="1"/>'),
            ("Float64", '><Dimension start="2"/>'),
        ]
    ],
}
"""Variables that differ in one thing."""


@pytest.mark.parametrize("version", DIFFERENT)
def test_variables_that_are_nearly_the_same_stay_apart(cache, tmp_path, version):
    """They are alone in a description, and then together."""

    def described(*rows):
        more = {"</ModelVariables>": f"{''.join(rows)}</ModelVariables>"}
        return FMU(probe_fmu(tmp_path, version, more)).description

    rows = DIFFERENT[version]
    alone = [described(row).variables["v"] for row in rows]
    together = described(*rows)
    description_reader.keep("together", together)
    for description in (together, description_reader.kept("together")):
        for one, other in zip(alone, description.namesakes["v"], strict=True):
            same_variable(one, other)


def damages():
    yield "cut", lambda content: content[:-10]
    yield "empty", lambda content: b""
    yield "a byte", lambda content: content[:200] + bytes([content[200] ^ 1]) + content[201:]
    yield "the checksum", lambda content: bytes([content[0] ^ 1]) + content[1:]
    yield "longer", lambda content: content + b"\0"
    yield "another thing", lambda content: pickle.dumps(Trap())


class Trap:
    def __reduce__(self):
        return pytest.fail, ("it was unpickled",)


@pytest.mark.parametrize(("name", "damage"), list(damages()))
def test_a_damaged_file_is_read_anew(cache, path, name, damage):
    expected = FMU(path).description
    (file,) = cache.iterdir()
    sound = file.read_bytes()
    file.write_bytes(damage(sound))
    same(FMU(path).description, expected)
    assert file.read_bytes() == sound  # and is replaced


@pytest.mark.parametrize("text", ["[]", "{}", "null", '{"simple": []}', "{", '"' * 99])
def test_a_sound_file_of_something_else_is_read_anew(cache, path, text):
    """The checksum may be right where the text is not that of a description."""
    expected = FMU(path).description
    (file,) = cache.iterdir()
    content = text.encode()
    file.write_bytes(hashlib.sha256(content).digest() + content)
    same(FMU(path).description, expected)


def test_another_version_reads_anew(cache, path):
    FMU(path)
    for count, version in enumerate((fmpy.__version__, "0.0.1"), 1):
        program = f"import fmpy; fmpy.__version__ = {version!r}; import fmugym; fmugym.FMU"
        run_python("-c", f"{program}({str(path)!r})", check=True)
        assert len(list(cache.iterdir())) == count


def test_without_a_folder_it_is_read_each_time(tmp_path, path, monkeypatch):
    expected = FMU(path).description
    monkeypatch.setenv("FMUGYM_CACHE_DIR", str(path / "in a file"))
    same(FMU(path).description, expected)


def test_a_folder_in_the_place_of_the_file_does_no_harm(cache, path):
    expected = FMU(path).description
    (file,) = cache.iterdir()
    file.unlink()
    file.mkdir()
    same(FMU(path).description, expected)


def test_a_link_is_not_followed(cache, path, tmp_path):
    expected = FMU(path).description
    (file,) = cache.iterdir()
    file.rename(tmp_path / "elsewhere")
    file.symlink_to(tmp_path / "elsewhere")
    same(FMU(path).description, expected)
    assert not file.is_symlink()  # it was replaced, not what it led to
