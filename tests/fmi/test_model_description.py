"""Model descriptions: the three versions in one form, what is filled in, and what is refused."""

import math

import fmpy
import numpy as np
import pytest
from combinations import in_turn
from fmu_tools import (
    ITEMS,
    MAJOR_VERSIONS,
    edited_fmu,
    probe_fmu,
    read_fmu,
    require_refused,
    write_fmu,
)

from fmugym import FMU, ConfigError, FMULoadError, bundled_fmu
from fmugym.fmi import ArchiveLimits
from fmugym.fmi.bundled import BUNDLED_FMUS, FMI_VERSIONS


def describe(path):
    return FMU(path).description


def with_xml(tmp_path, xml):
    return write_fmu(tmp_path / "some.fmu", {"modelDescription.xml": xml})


class TestBundledModels:
    @pytest.mark.parametrize(("model", "version"), BUNDLED_FMUS)
    def test_variables_are_those_that_fmpy_reads(self, model, version):
        path = bundled_fmu(model, version)
        ours, theirs = describe(path), fmpy.read_model_description(str(path))
        assert ours.findings == ()
        assert ours.fmi_version == version
        assert ours.model_name == model
        assert list(ours.variables) == [v.name for v in theirs.modelVariables]
        for other in theirs.modelVariables:
            variable = ours.variable(other.name)
            assert variable.value_reference == other.valueReference
            assert variable.type == other.type
            assert variable.causality == other.causality
            assert variable.unit == other.unit

    @pytest.mark.parametrize("version", FMI_VERSIONS)
    def test_limits_are_numbers_and_infinite_where_not_given(self, version):
        variables = describe(bundled_fmu("CartPole", version)).variables
        assert (variables["f"].minimum, variables["f"].maximum) == (-1000.0, 1000.0)
        assert (variables["x"].minimum, variables["x"].maximum) == (-math.inf, math.inf)
        assert variables["f"].nominal == 10.0
        assert variables["theta"].unit == "rad"

    @pytest.mark.parametrize("version", FMI_VERSIONS)
    def test_states_and_their_derivatives(self, version):
        """FMI 1.0 has no ModelStructure to declare them in."""
        declared = describe(bundled_fmu("Pendulum", version)).state_derivatives
        pairs = [("theta", "theta_dot"), ("theta_dot", "theta_ddot")]
        assert list(declared.items()) == ([] if version == "1.0" else pairs)

    @pytest.mark.parametrize("version", FMI_VERSIONS)
    def test_capabilities(self, version):
        capabilities = describe(bundled_fmu("CartPole", version)).capabilities
        assert capabilities.can_handle_variable_communication_step_size
        assert capabilities.can_get_and_set_fmu_state is (version != "1.0")
        assert capabilities.can_serialize_fmu_state is (version != "1.0")
        assert capabilities.provides_directional_derivatives is (version != "1.0")
        assert not capabilities.can_be_instantiated_only_once_per_process
        assert not capabilities.needs_execution_tool

    def test_default_experiment(self):
        description = describe(bundled_fmu("CartPole", "2.0"))
        assert (description.start_time, description.stop_time) == (0.0, 10.0)
        assert description.step_size == 0.05
        assert description.tolerance is None
        assert describe(bundled_fmu("CartPole", "1.0")).step_size is None


class TestSettability:
    """The rules of the standard by causality and variability, the same in all versions."""

    @pytest.mark.parametrize("version", MAJOR_VERSIONS)
    def test_when_a_variable_may_be_set(self, probe, version):
        """FMI 1.0 has no tunable parameters."""
        names = ("a", "gain", "trim", "label", "seven", "double_gain", "mix", "stop")
        found = {name: describe(probe(version)).variable(name) for name in names}
        at_start = [name for name in names if found[name].settable_at_start]
        assert at_start == ["a", "gain", "trim", "label"]
        in_step = [name for name in names if found[name].settable_in_step]
        assert in_step == (["a"] if version == 1 else ["a", "trim"])

    def test_an_output_with_a_start_value_may_be_set_at_the_start_in_fmi_1(self, tmp_path):
        old = 'causality="output" variability="continuous"><Real >'
        new = old.replace("<Real >", '<Real start="1">')
        path = probe_fmu(tmp_path, 1, {old: new})
        assert describe(path).variable("sum").settable_at_start

    def test_initial_approx_may_be_set_in_fmi_2(self, tmp_path):
        old = 'causality="output" variability="continuous"><Real >'
        new = 'causality="output" variability="continuous" initial="approx"><Real start="1">'
        variable = describe(probe_fmu(tmp_path, 2, {old: new})).variable("sum")
        assert variable.settable_at_start
        assert not variable.settable_in_step


class TestTypes:
    @pytest.mark.parametrize("version", MAJOR_VERSIONS)
    def test_kinds(self, probe, version):
        variables = describe(probe(version)).variables
        names = {"a": "real", "n": "integer", "on": "boolean", "mode": "enumeration"}
        assert {name: variables[name].kind for name in names} == names
        assert all(variables[name].numeric for name in names)
        assert variables["label"].kind == "string"
        assert not variables["label"].numeric

    @pytest.mark.parametrize("version", MAJOR_VERSIONS)
    def test_enumeration_items(self, probe, version):
        """FMI 1.0 counts them from 1; later versions may leave gaps."""
        values = [1, 2, 3] if version == 1 else list(ITEMS.values())
        expected = tuple(zip(ITEMS, values, strict=True))
        assert describe(probe(version)).variable("mode").items == expected

    @pytest.mark.parametrize("name", ["Int8", "UInt16", "Int64", "Float32"])
    def test_limits_of_fmi_3_types(self, probe, name):
        """FMPy does not read min and max of unsigned integers."""
        variable = describe(probe(3)).variable(f"{name}_in")
        assert (variable.minimum, variable.maximum) == (0.0, 9.0)

    @pytest.mark.parametrize("name", ["Int8", "UInt16", "Int64"])
    def test_integer_limits_are_those_of_the_c_type(self, probe, name):
        info = np.iinfo(name.lower())
        limits = describe(probe(3)).variable(f"{name}_in").integer_limits
        assert limits == (info.min, info.max)

    def test_arrays_are_not_numeric(self, probe):
        variable = describe(probe(3)).variable("array")
        assert variable.shape == (2,)
        assert not variable.numeric

    def test_limits_of_a_declared_type_are_inherited(self, tmp_path):
        simple = '<SimpleType name="Angle"><Real min="-2" max="2" unit="rad" nominal="0.5"/>'
        edits = {
            "</TypeDefinitions>": f"{simple}</SimpleType></TypeDefinitions>",
            'min="-9" max="9"': 'declaredType="Angle" min="-1"',
        }
        variable = describe(probe_fmu(tmp_path, 2, edits)).variable("trim")
        assert (variable.minimum, variable.maximum) == (-1.0, 2.0)
        assert (variable.unit, variable.nominal) == ("rad", 0.5)

    def test_limits_that_are_no_numbers_are_none(self, tmp_path):
        edits = {'min="-9" max="9"': 'min="NaN" max="9" nominal="NaN"'}
        variable = describe(probe_fmu(tmp_path, 2, edits)).variable("trim")
        assert (variable.minimum, variable.maximum) == (-math.inf, 9.0)
        assert variable.nominal is None


class TestOtherFacts:
    @pytest.mark.parametrize("value", ["0", "-0.1", "NaN", "1e999"])
    def test_step_sizes_that_no_one_can_use(self, tmp_path, value):
        experiment = f'<DefaultExperiment stepSize="{value}"/><ModelVariables>'
        fmu = FMU(probe_fmu(tmp_path, 2, {"<ModelVariables>": experiment}))
        assert fmu.description.step_size is None
        assert f"stepSize is {value}, which cannot be used" in fmu.description.findings

    @pytest.mark.parametrize("value", ["0", "-0.1", "NaN"])
    def test_internal_step_sizes_that_no_one_can_use(self, tmp_path, value):
        step = f'<CoSimulation fixedInternalStepSize="{value}"'
        description = describe(probe_fmu(tmp_path, 3, {"<CoSimulation": step}))
        assert description.fixed_internal_step_size is None
        assert any(f.startswith("fixedInternalStepSize is") for f in description.findings)

    @pytest.mark.parametrize("value", ["low", "", "NaN", "1e999"])
    def test_start_values_that_are_no_numbers(self, tmp_path, value):
        """They can be read, and matter only where they are used."""
        fmu = FMU(probe_fmu(tmp_path, 2, {'start="0"': f'start="{value}"'}))
        with pytest.raises(ConfigError, match=f"start value of 'a' is '{value}', expected"):
            _ = fmu.variable("a").start_number

    def test_default_experiment_need_not_start_at_zero(self, tmp_path):
        experiment = '<DefaultExperiment startTime="1.0" stopTime="2" tolerance="1e-4"/>'
        edits = {"<ModelVariables>": f"{experiment}<ModelVariables>"}
        description = describe(probe_fmu(tmp_path, 2, edits))
        assert (description.start_time, description.stop_time) == (1.0, 2.0)
        assert description.tolerance == 1e-4
        assert description.step_size is None

    def test_fmi_1_flags(self, tmp_path):
        flag = 'canHandleVariableCommunicationStepSize="true"'
        edits = {flag: 'canBeInstantiatedOnlyOncePerProcess="true"'}
        capabilities = describe(probe_fmu(tmp_path, 1, edits)).capabilities
        assert capabilities.can_be_instantiated_only_once_per_process
        assert not capabilities.can_handle_variable_communication_step_size

    def test_both_interfaces_are_named(self, tmp_path):
        other = '<ModelExchange modelIdentifier="Other"/><TypeDefinitions>'
        description = describe(probe_fmu(tmp_path, 2, {"<TypeDefinitions>": other}))
        assert description.interfaces == ("co-simulation", "model exchange")
        assert description.model_identifier == "Probe"

    @pytest.mark.parametrize("version", MAJOR_VERSIONS)
    def test_platform_in_the_naming_of_the_version(self, probe, version):
        expected = fmpy.platform_tuple if version == 3 else fmpy.platform
        assert describe(probe(version)).platform == expected

    def test_unknown_variable_names_the_nearest(self, probe):
        with pytest.raises(ConfigError, match=r"'gian'.*did you mean 'gain'"):
            describe(probe(2)).variable("gian")

    @pytest.mark.parametrize("name", [None, ["a"], 3])
    def test_a_name_that_is_none(self, probe, name):
        with pytest.raises(ConfigError, match="unknown variable of Probe"):
            describe(probe(2)).variable(name)

    def test_other_releases_of_fmi_2_and_3(self, tmp_path):
        path = probe_fmu(tmp_path, 2, {'fmiVersion="2.0"': 'fmiVersion="2.0.4"'})
        with pytest.raises(FMULoadError, match="Unsupported FMI version"):
            describe(path)
        path = probe_fmu(tmp_path, 3, {'fmiVersion="3.0"': 'fmiVersion="3.0.1"'})
        assert describe(path).fmi_major_version == 3


PATHS = ("../../x", "/tmp/x", "a\\b", "c:x", "", ".", "..", "a\nb", "x" * 300)


class TestRefused:
    @pytest.mark.parametrize("count", ["-1", "99999999999"])
    def test_a_number_of_equations_that_cannot_be(self, tmp_path, count):
        edits = {"CoSimulation": "ModelExchange"}
        edits["<fmiModelDescription "] = f'<fmiModelDescription numberOfEventIndicators="{count}" '
        require_refused(probe_fmu(tmp_path, 2, edits), f"numberOfEventIndicators is {count}")

    def test_no_interface_at_all(self, tmp_path):
        path = probe_fmu(tmp_path, 3, {"CoSimulation": "ScheduledExecution"})
        require_refused(path, "co-simulation or model exchange.*scheduled execution")

    @in_turn({"identifier": PATHS, "version": MAJOR_VERSIONS})
    def test_a_model_identifier_that_is_a_path(self, tmp_path, identifier, version):
        text = identifier.replace("\n", "&#10;")
        edits = {'modelIdentifier="Probe"': f'modelIdentifier="{text}"'}
        require_refused(
            probe_fmu(tmp_path, version, edits), "the modelIdentifier is .*expected the name"
        )

    @pytest.mark.parametrize("identifier", ["a b", "1x", "x.so", "x\u00e4", "a-b"])
    def test_functions_of_fmi_1_begin_with_the_model_identifier(self, tmp_path, identifier):
        edits = {'modelIdentifier="Probe"': f'modelIdentifier="{identifier}"'}
        require_refused(probe_fmu(tmp_path, 1, edits), "expected a C identifier")

    @pytest.mark.parametrize(
        "xml",
        [
            b"",
            b"no xml",
            b"<fmiModelDescription",
            b"\xff\xfe",
            b"<a>" * 10_000,
            "<a/>".encode("utf-32"),
        ],
    )
    def test_no_xml(self, tmp_path, xml):
        require_refused(
            with_xml(tmp_path, xml), "some.fmu: .*(not valid XML|expected a model description)"
        )

    @pytest.mark.parametrize("version", ["", "4.0", "1.1", "2.1", "abc", "2"])
    def test_other_versions(self, tmp_path, version):
        xml = f'<fmiModelDescription fmiVersion="{version}"/>'
        require_refused(
            with_xml(tmp_path, xml), "expected a model description of FMI 1.0, 2.0 or 3.0"
        )

    def test_another_root(self, tmp_path):
        require_refused(with_xml(tmp_path, '<svg fmiVersion="2.0"/>'), "found <svg")

    @pytest.mark.parametrize("encoding", ["utf-8", "utf-16"])
    def test_doctype(self, tmp_path, encoding):
        """An entity could read a file or grow without end."""
        xml = (
            f'<?xml version="1.0" encoding="{encoding}"?>'
            '<!DOCTYPE x [<!ENTITY secret "x">]>'
            '<fmiModelDescription fmiVersion="2.0" modelName="&secret;"/>'
        )
        require_refused(with_xml(tmp_path, xml.encode(encoding)), "DOCTYPE")

    def test_markup_that_would_fill_the_memory(self, tmp_path):
        """Four bytes of an element are a quarter of a kilobyte once they are parsed."""
        path = with_xml(tmp_path, f"<fmiModelDescription>{'<a/>' * 10_000}</fmiModelDescription>")
        with pytest.raises(FMULoadError, match=r"some 1000\d elements.* limit is 1250; .*max_v"):
            FMU(path, limits=ArchiveLimits(max_variables=10))

    @pytest.mark.parametrize(
        ("old", "new"),
        [
            ('min="-1"', 'min="low"'),
            ('valueReference="0"', 'valueReference="x"'),
            ('valueReference="0"', ""),
            ('declaredType="Mode"', 'declaredType="Absent"'),
            ("<Real ", "<Complex "),
            ('<Item name="slow" value="1">', '<Item name="slow" value="one">'),
            ('causality="parameter"', 'causality="independent"'),
        ],
    )
    def test_malformed_variables(self, tmp_path, old, new):
        """FMPy raises a different exception for each."""
        edits = {old: new}
        if old == "<Real ":
            edits["</Real>"] = "</Complex>"
        require_refused(
            probe_fmu(tmp_path, 2, edits), "Probe.fmu: modelDescription.xml cannot be underst"
        )

    @pytest.mark.parametrize("part", ["ModelVariables", "ModelStructure"])
    def test_missing_parts(self, tmp_path, part):
        path = probe_fmu(tmp_path, 2)
        xml = read_fmu(path)["modelDescription.xml"].decode()
        start, end = xml.index(f"<{part}"), xml.index(f"</{part}>") if part[5] == "V" else None
        cut = xml[:start] + (xml[end + len(part) + 3 :] if end else "</fmiModelDescription>")
        changed = edited_fmu(path, tmp_path / "cut", add={"modelDescription.xml": cut})
        if part == "ModelVariables":
            require_refused(changed, "cannot be understood")
        else:
            assert describe(changed).variable("a").causality == "input"
