"""FMPy alone parses the variables of a model description, unless they have what it leaves out."""

import pytest
from fmu_tools import MAJOR_VERSIONS, probe_fmu, require_refused

from fmugym import FMU, FMULoadError, bundled_fmu
from fmugym.fmi import description_reader
from fmugym.fmi.bundled import BUNDLED_FMUS

FLAG = {"<Real ": '<Real relativeQuantity="true" '}
BEGIN, END = "<ModelVariables>", "</ModelVariables>"


@pytest.fixture
def parsed(monkeypatch):
    """What is handed to the parser that is not FMPy's."""
    texts, original = [], description_reader.parse_xml

    def parse_xml(name, place, content):
        texts.append(content.decode())
        return original(name, place, content)

    monkeypatch.setattr(description_reader, "parse_xml", parse_xml)
    return texts


def told(path):
    """All that is read of a file, or why nothing is."""
    try:
        return repr(FMU(path).description)
    except FMULoadError as error:
        return str(error)


def require_the_same(path, monkeypatch):
    """Require that it makes no difference that variables are left out."""
    before = told(path)
    with monkeypatch.context() as patch:
        patch.setattr(description_reader, "_without_plain_variables", lambda content, _: content)
        assert told(path) == before


@pytest.mark.parametrize("version", [1, 2])
def test_plain_variables_are_left_to_fmpy(parsed, tmp_path, version):
    assert "mix" in FMU(probe_fmu(tmp_path, version)).description.variables
    assert len(parsed) == 1
    assert '"mix"' not in parsed[0]


@pytest.mark.parametrize(("version", "edits"), [(1, FLAG), (2, FLAG), (3, {})])
def test_those_with_more_are_parsed(parsed, tmp_path, version, edits):
    """FMPy leaves out this flag of variables, and the limits of unsigned integers."""
    FMU(probe_fmu(tmp_path, version, edits))
    assert '"mix"' in parsed[0]


@pytest.mark.parametrize(("model", "version"), BUNDLED_FMUS)
def test_bundled_models_are_read_alike(model, version, monkeypatch):
    require_the_same(bundled_fmu(model, version), monkeypatch)


@pytest.mark.parametrize("version", MAJOR_VERSIONS)
@pytest.mark.parametrize(
    "edits",
    [
        {},
        FLAG,
        {'name="mix"': 'name="sum"'},
        {BEGIN: f"<!-- {BEGIN} -->{BEGIN}"},
        {BEGIN: f"{BEGIN}<!-- {END} -->"},
        {END: f"{END}<!-- {END} -->"},
        {BEGIN: "<ModelVariables >", END: f"</ModelVariables ><!-- {BEGIN}{END} -->"},
        {END: ""},
        {END: f"<x>{END}"},
        {END: f"{END}<x>"},
        {'valueReference="0"': ""},
        {'valueReference="0"': 'valueReference="0'},
        {'name="a"': 'name="&a;"'},
    ],
    ids=str,
)
def test_files_are_read_or_refused_alike(tmp_path, version, edits, monkeypatch):
    if edits == FLAG and version == 3:
        edits = {"<Float64 ": '<Float64 relativeQuantity="true" '}
    require_the_same(probe_fmu(tmp_path, version, edits), monkeypatch)


@pytest.mark.parametrize("version", MAJOR_VERSIONS)
def test_too_many_are_counted_before_fmpy_reads_them(tmp_path, version, monkeypatch):
    monkeypatch.setattr(
        description_reader, "_parse_with_fmpy", lambda _: pytest.fail("FMPy read them")
    )
    require_refused(probe_fmu(tmp_path, version), r"has \d+ variables", max_variables=5)
