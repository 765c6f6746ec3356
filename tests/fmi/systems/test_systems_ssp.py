"""SSP archives: what is read of them, compared with FMPy's reader."""

import copy
import random
import sys
import zipfile
from contextlib import closing
from types import MappingProxyType

import model_tools
import numpy as np
import pool_tools
import pytest
import system_tools
from fmpy.ssp.ssd import find_components, get_connections, read_ssd, read_ssm, read_ssv
from fmu_tools import PlainEnv
from lxml import etree
from ssp_tools import (
    HEAD,
    TAIL,
    bindings,
    component,
    connection,
    linear,
    mapping,
    parameter_set,
    real,
    system,
    values,
)

import fmugym
from fmugym import (
    FMU,
    ConfigError,
    FMUGymError,
    FMULoadError,
    FMUSystem,
    bundled_fmu,
)

HOUSE, PENDULUM = bundled_fmu("House"), bundled_fmu("Pendulum", "3.0")


@pytest.fixture
def pack(tmp_path):
    """Write an archive with one system, the bundled FMUs and more files."""

    def write(root, after="", **files):
        path = tmp_path / "system.ssp"
        with zipfile.ZipFile(path, "w") as archive:
            archive.writestr("SystemStructure.ssd", HEAD + root + after + TAIL)
            archive.write(HOUSE, "resources/House.fmu")
            archive.write(PENDULUM, "resources/Pendulum.fmu")
            for name, text in files.items():
                archive.writestr(f"resources/{name.replace('_', '.')}", text)
        return path

    return write


HOUSE_PORTS = {"T_out": "input K", "Q_int": "input W", "Q_em": "output W", "T_air": "output K"}
LINKED = system(
    "root",
    {"T": "input degC", "warmth": "output"},
    [component("a", HOUSE_PORTS), component("b", HOUSE_PORTS)],
    [
        connection("T", "a.T_out"),
        connection("a.Q_em", "b.Q_int", linear(0.5, 10)),
        connection("warmth", "b.T_air"),  # from its end to its start
    ],
)
EAST = {"Q_int": "input W", "Q_em": "output W", "T_air": "output K"}
NESTED = system(
    "root",
    {"power": "input kW", "T": "output degC"},
    [
        system(
            "east",
            {"heat": "input kW", "out": "output W", "T": "output K"},
            [component("house", EAST)],
            [
                connection("heat", "house.Q_int"),
                connection("house.Q_em", "out"),
                connection("house.T_air", "T"),
            ],
        ),
        system(
            "west",
            {"heat": "input W"},
            [
                system(
                    "room",
                    {"heat": "input W"},
                    [component("house", {"Q_int": "input W"})],
                    [connection("heat", "house.Q_int", linear(2.0, 1.0))],
                )
            ],
            [connection("heat", "room.heat")],
        ),
    ],
    [
        connection("power", "east.heat"),
        connection("east.out", "west.heat", linear(3.0, 5.0)),
        connection("east.T", "T"),
    ],
)


def one_house(*wires, ports=None, more="", **attributes):
    """A system of a house; the wires are pairs of ends, with a transformation after them or not."""
    house = component("h", HOUSE_PORTS, more=more, **attributes)
    return system("r", ports or {}, [house], [connection(*wire) for wire in wires])


def starts_of(system):
    return {one.name: dict(one.starts) for one in system.plan.components}


class TestReading:
    def test_of_one_level(self, pack):
        system = FMUSystem.read(pack(LINKED))
        assert system.name == "test"
        assert system_tools.links_of(system) == [("a", "Q_em", "b", "Q_int", 0.5, 10.0)]
        found = {c.name: (c.causality, c.ends[0].component) for c in system.plan.connectors}
        assert found == {"T": ("input", "a"), "warmth": ("output", "b")}
        (end,) = system.plan.connectors[0].ends
        assert end.offset == pytest.approx(273.15)  # pint knows degC, the file does not define it

    def test_nested_systems_become_flat(self, pack):
        system = FMUSystem.read(pack(NESTED))
        assert list(system.components) == ["east.house", "west.room.house"]
        ((*ends, gain, offset),) = system_tools.links_of(system)
        assert ends == ["east.house", "Q_em", "west.room.house", "Q_int"]
        assert (gain, offset) == (6.0, 11.0)  # 2 (3 x + 5) + 1
        inputs = {c.name: c.ends[0] for c in system.plan.connectors}
        assert inputs["power"].gain == pytest.approx(1000.0)  # from kW to W
        assert inputs["T"].offset == pytest.approx(-273.15)

    def test_the_same_components_and_connections_as_fmpy_finds(self, pack):
        path = pack(NESTED)
        theirs = read_ssd(str(path))
        names = {f"{c.parent.name}.{c.name}" for c in find_components(theirs.system)}
        ours = FMUSystem.read(path)
        assert names == {".".join(name.split(".")[-2:]) for name in ours.components}
        assert traced_by_fmpy(theirs) == {
            (f"{k.source}.{k.output}", f"{k.target}.{k.input}") for k in ours.links
        }

    def test_parameters_by_their_hierarchical_names(self, pack):
        """A binding of a system wins over those of its parts, a later one over an earlier one."""
        inner = bindings(values({"A_f": real(50), "H_w": real(1)}), values({"H_w": real(2)}))
        east = system(
            "east",
            {"area": "parameter m2"},
            [component("house", {"A_f": "parameter m2"}, more=inner)],
            [connection("area", "house.A_f")],
            more=bindings(values({"house.H_ve": real(3)})),
        )
        top = bindings(
            values({"east.area": real(70), "east.house.UA": real(4)}),
            values({"house.C_w": real(5), "nothing": real(1)}, prefix="east."),
            values({"T_m_0": real(20, "degC")}, prefix="east.house."),
        )
        found = FMUSystem.read(pack(system("root", {}, [east], more=top)))
        (starts,) = starts_of(found).values()
        assert starts.pop("T_m_0") == pytest.approx(293.15)
        assert starts == {"A_f": 70.0, "H_w": 2.0, "H_ve": 3.0, "UA": 4.0, "C_w": 5.0}
        assert any("east.nothing" in finding for finding in found.findings)

    def test_external_sets_and_mappings_as_fmpy_reads_them(self, pack):
        entries = (
            f'<ssm:MappingEntry source="area" target="A_f">{linear(2.0, 1.0)}</ssm:MappingEntry>'
            '<ssm:MappingEntry source="method" target="solver"><ssc:IntegerMappingTransformation>'
            '<ssc:MapEntry source="0" target="1"/><ssc:MapEntry source="7" target="2"/>'
            "</ssc:IntegerMappingTransformation></ssm:MappingEntry>"
        )
        own = {"area": real(60), "method": '<ssv:Integer value="7"/>', "UA": real(9)}
        binding = (
            '<ssd:ParameterBinding source="resources/p.ssv">'
            '<ssd:ParameterMapping source="resources/p.ssm"/></ssd:ParameterBinding>'
        )
        root = one_house(more=bindings(binding))
        path = pack(root, p_ssv=parameter_set(own), p_ssm=mapping(entries))
        assert starts_of(FMUSystem.read(path)) == {"h": {"A_f": 121.0, "solver": 2.0}}
        theirs = read_ssv(str(path), "resources/p.ssv")
        assert {one.name: one.value for one in theirs.parameters} == {
            "area": "60",
            "method": "7",
            "UA": "9",
        }
        (first, _) = read_ssm(str(path), "resources/p.ssm").mappingEntries
        assert (first.source, first.target) == ("area", "A_f")

    def test_items_of_enumerations_and_booleans(self, pack):
        item = {"solver": '<ssv:Enumeration value="rk4"/>'}
        root = one_house(more=bindings(values(item)))
        assert starts_of(FMUSystem.read(pack(root))) == {"h": {"solver": 2.0}}

    def test_what_is_ignored_is_told(self, pack):
        note = (
            '<ssd:Annotations><ssc:Annotation type="org.example"><x/></ssc:Annotation>'
            "</ssd:Annotations>"
        )
        shape = '<ssd:ElementGeometry x1="0" y1="0" x2="1" y2="1"/>'
        root = one_house(ports={"idle": "input"}, more=shape + note)
        findings = " ".join(FMUSystem.read(pack(root)).findings)
        for fact in ("org.example", "ElementGeometry", "idle"):
            assert fact in findings

    def test_the_default_experiment_and_the_interface(self, pack):
        root = one_house(implementation="CoSimulation")
        experiment = '<ssd:DefaultExperiment startTime="3" stopTime="9.5"/>'
        plan = FMUSystem.read(pack(root, experiment)).plan
        assert (plan.start_time, plan.stop_time) == (3.0, 9.5)
        assert plan.components[0].interface == "co_simulation"

    def test_units_of_the_file_are_known(self, pack):
        unit = (
            '<ssd:Units><ssc:Unit name="odd"><ssc:BaseUnit kg="1" m="2" s="-3" factor="7"/>'
            "</ssc:Unit></ssd:Units>"
        )
        root = one_house(("q", "h.Q_int"), ports={"q": "input odd"})
        (connector,) = FMUSystem.read(pack(root, unit)).plan.connectors
        assert connector.ends[0].gain == 7.0


WATT = '<ssc:BaseUnit kg="1" m="2" s="-3" factor="{}"/>'
ODD_UNITS = (
    f'<ssd:Units><ssc:Unit name="odd">{WATT.format(7)}</ssc:Unit>'
    f'<ssc:Unit name="even">{WATT.format(2)}</ssc:Unit></ssd:Units>'
)


@pytest.fixture
def odd_fmu(tmp_path):
    """The bytes of an FMU whose ``y1`` is in a unit that it does not define, and ``u1`` in none."""
    own = {"u1": 'start="0" unit=""', "u2": 'start="0" unit="even"', "y1": 'unit="odd"'}
    variables = [(n, kind, own.get(n, more)) for n, kind, more in system_tools.VARIABLES]
    path = tmp_path / "odd.fmu"
    return model_tools.model_fmu(path, "linear", 2, "{linear}", variables).read_bytes()


class TestUnits:
    """What the file says of units counts where an FMU says nothing."""

    ODD = MappingProxyType({"source": "resources/odd.fmu"})

    def read(self, pack, odd_fmu, root):
        return FMUSystem.read(pack(root, ODD_UNITS, odd_fmu=odd_fmu))

    def pair(self, ports, wires, of_first="output odd", of_second="input"):
        parts = [component("a", {"y1": of_first}, **self.ODD)]
        parts.append(component("b", {"u1": of_second, "u2": "input even"}, **self.ODD))
        return system("r", ports, parts, wires)

    def test_an_empty_unit_is_none(self, pack):
        ports = HOUSE_PORTS | {"Q_int": "input"}
        text = system("r", {"q": "input"}, [component("h", ports)], [connection("q", "h.Q_int")])
        given = text.replace("<ssc:Real/>", '<ssc:Real unit=""/>')
        more = bindings(values({"h.A_f": '<ssv:Real value="3" unit=""/>'}))
        found = FMUSystem.read(pack(given.replace("<ssd:Elements>", f"{more}<ssd:Elements>")))
        assert found.connectors == FMUSystem.read(pack(text)).connectors
        assert starts_of(found) == {"h": {"A_f": 3.0}}

    def test_an_empty_unit_of_an_fmu_is_none(self, pack, odd_fmu):
        root = self.pair({}, [connection("a.y1", "b.u1")])
        found = self.read(pack, odd_fmu, root)
        assert system_tools.links_of(found) == [("a", "y1", "b", "u1", 1.0, 0.0)]

    def test_that_the_file_defines_convert_between_fmus(self, pack, odd_fmu):
        found = self.read(pack, odd_fmu, self.pair({}, [connection("a.y1", "b.u2")]))
        assert system_tools.links_of(found) == [("a", "y1", "b", "u2", 3.5, 0.0)]

    def test_that_the_file_defines_convert_through_systems(self, pack, odd_fmu):
        inner = system(
            "inner",
            {"out": "output even"},
            [component("a", {"y1": "output odd"}, **self.ODD)],
            [connection("a.y1", "out")],
        )
        outer = component("b", {"u2": "input even"}, **self.ODD)
        wires = [connection("inner.out", "b.u2", linear(2.0))]
        found = self.read(pack, odd_fmu, system("r", {}, [inner, outer], wires))
        assert system_tools.links_of(found) == [("inner.a", "y1", "b", "u2", 7.0, 0.0)]

    def test_of_a_connector_is_that_of_a_variable_without_one(self, pack, odd_fmu):
        root = self.pair({"q": "input odd"}, [connection("q", "b.u1")], of_second="input even")
        (connector,) = self.read(pack, odd_fmu, root).connectors
        assert (connector.unit, connector.ends[0].gain) == ("odd", 3.5)
        root = self.pair({}, [connection("a.y1", "b.u1")], of_second="input W")
        assert system_tools.links_of(self.read(pack, odd_fmu, root)) == [
            ("a", "y1", "b", "u1", 7.0, 0.0)
        ]

    def test_that_the_file_defines_are_known_to_tasks(self, pack, odd_fmu, tmp_path):
        fmu = self.read(pack, odd_fmu, self.pair({"q": "input odd"}, [connection("q", "b.u2")]))
        task = {
            "fmu": str(fmu.file),
            "time_step": "1s",
            "reward": "-y",
            "variables": {
                "q": {"name": "q", "unit": "W", "min": 0, "max": 14},
                "y": {"name": "a.y1", "unit": "W"},
            },
            "agent": {"actions": ["q"], "observations": ["y"]},
        }
        with closing(fmugym.load(task)) as env:
            env.reset(seed=0)
            env.step(np.array([14.0], np.float32))
            assert env.inputs == (2.0,)


def traced_by_fmpy(ssd):
    """The connections of components that FMPy finds, followed through the connectors of systems."""
    from fmpy.ssp.ssd import Component as Part
    from fmpy.ssp.ssd import build_path

    pairs = get_connections(ssd.system)
    source = {id(end): start for start, end in pairs}
    found = set()
    for start, end in pairs:
        while id(start) in source and not isinstance(start.parent, Part):
            start = source[id(start)]
        if isinstance(start.parent, Part) and isinstance(end.parent, Part):
            names = [build_path(one).partition(".")[2] for one in (start, end)]
            found.add(tuple(names))
    return found


class TestDrafts:
    """Archives of the drafts of 2015, in which a connector has a causality and no kind."""

    @pytest.mark.parametrize("root", [NESTED, one_house(("q", "h.Q_int"), ports={"q": "input W"})])
    def test_are_read_as_version_1(self, pack, root):
        new = FMUSystem.read(pack(root))
        assert " kind=" in root
        old = FMUSystem.read(pack(root.replace(" kind=", " causality=")))
        assert old.connectors == new.connectors
        assert old.connectors
        assert old.plan.links == new.plan.links

    def test_an_agent_acts_on_a_system(self, pack):
        root = one_house(("u", "h.u"), ("h.T_op", "T"), ports={"u": "input 1", "T": "output degC"})
        task = {
            "time_step": "15min",
            "agent": {"actions": ["u"], "observations": ["T"]},
            "variables": {"u": {"min": 0, "max": 1}},
            "reward": "-abs(T - 21)",
        }
        seen = []
        for text in (root, root.replace(" kind=", " causality=")):
            with fmugym.load(task | {"fmu": str(pack(text))}) as env:
                env.reset(seed=0)
                seen.append([env.step([1.0])[:2] for _ in range(3)])
        assert seen[0] == seen[1]
        assert 15 < seen[0][-1][0] < 40

    @pytest.mark.parametrize(("unit", "known"), [("[degC]", "degC"), ("[ K ]", "K")])
    def test_units_in_brackets_are_those_within(self, pack, unit, known):
        def read(unit):
            root = one_house(("T", "h.T_out"), ports={"T": f"input {unit}"})
            return FMUSystem.read(pack(root)).connectors[0]

        assert read(unit).unit == unit
        (one,), (other,) = read(unit).ends, read(known).ends
        assert (one.gain, one.offset) == (other.gain, other.offset)

    @pytest.mark.parametrize("unit", ["[-]", "[]"])
    def test_nothing_in_brackets_is_no_dimension(self, pack, unit):
        root = one_house(("q", "h.u"), ports={"q": f"input {unit}"})
        (end,) = FMUSystem.read(pack(root)).connectors[0].ends
        assert (end.gain, end.offset) == (1.0, 0.0)

    @pytest.mark.parametrize("unit", ["[m]", "[widget]"])
    def test_units_in_brackets_of_something_else_are_refused(self, pack, unit):
        root = one_house(("T", "h.T_out"), ports={"T": f"input {unit}"})
        with pytest.raises(ConfigError) as error:
            FMUSystem.read(pack(root))
        assert unit[1:-1] in str(error.value)

    def test_a_definition_of_the_file_comes_first(self, pack):
        own = '<ssd:Unit name="[m]"><ssc:BaseUnit K="1" factor="2"/></ssd:Unit>'
        units = f"<ssd:Units>{own}</ssd:Units>"
        root = one_house(("T", "h.T_out"), ports={"T": "input [m]"})
        (end,) = FMUSystem.read(pack(root, units)).connectors[0].ends
        assert end.gain == 2.0


class TestMistakes:
    @pytest.mark.parametrize(
        ("root", "error", "facts"),
        [
            (
                one_house(source="resources/Hause.fmu"),
                FMULoadError,
                ["'h'", "resources/Hause.fmu"],
            ),
            (one_house(source="../House.fmu"), FMULoadError, ["../House.fmu"]),
            (
                one_house(type="application/x-ssp-package"),
                FMULoadError,
                ["application/x-ssp-package"],
            ),
            (one_house(("h.Q_em", "h.Q_in")), ConfigError, ["Q_in", "Q_int"]),
            (one_house(("h.Q_em", "i.Q_int")), FMULoadError, ["'i'"]),
            (one_house(("q", "h.Q_int")), FMULoadError, ["'q'"]),
            (
                one_house(("h.Q_em", "h.T_air")),
                FMULoadError,
                ["h.Q_em", "h.T_air", "both give"],
            ),
            (
                one_house(("q", "h.Q_int"), ("p", "h.Q_int"), ports={"q": "input", "p": "input"}),
                ConfigError,
                ["h.Q_int", "q, p"],
            ),
            (system("r", {}, [component("h", HOUSE_PORTS)] * 2), FMULoadError, ["'h'"]),
            (
                system("r", {}, ['<ssd:SignalDictionaryReference name="bus" dictionary="d"/>']),
                FMULoadError,
                ["signal dictionaries"],
            ),
            (
                one_house(("h.Q_em", "h.Q_int", linear("much"))),
                FMULoadError,
                ["factor", "much"],
            ),
            (
                one_house(more=bindings(values({"T_air": real(1)}))),
                ConfigError,
                ["h.T_air"],
            ),
        ],
    )
    def test_are_named(self, pack, root, error, facts):
        with pytest.raises(error) as found:
            FMUSystem.read(pack(root))
        text = str(found.value)
        assert text.startswith("system.ssp: ")
        assert all(fact in text for fact in facts), text

    def test_a_circle_of_system_connectors(self, pack):
        inner = system("s", {"u": "input", "y": "output"}, [], [connection("u", "y")])
        root = system(
            "r",
            {},
            [inner.replace("<ssd:Elements></ssd:Elements>", ""), component("h", HOUSE_PORTS)],
            [connection("s.y", "s.u"), connection("s.y", "h.Q_int")],
        )
        with pytest.raises(FMULoadError, match="circle"):
            FMUSystem.read(pack(root))

    def test_files_that_are_no_systems(self, tmp_path):
        no_zip = tmp_path / "text.ssp"
        no_zip.write_text("hello")
        bomb = tmp_path / "bomb.ssp"
        with zipfile.ZipFile(bomb, "w") as archive:
            archive.writestr("SystemStructure.ssd", '<!DOCTYPE x [<!ENTITY a "b">]><x>&a;</x>')
        cases = {tmp_path / "none.ssp": "no system", no_zip: "zip", HOUSE: "SystemStructure"}
        for path, fact in (cases | {bomb: "DOCTYPE"}).items():
            with pytest.raises(FMULoadError, match=fact):
                FMUSystem.read(path)

    @pytest.mark.parametrize("kind", ["input", "output"])
    def test_units_with_a_factor_of_0(self, pack, kind):
        ends = ("q", "h.Q_int") if kind == "input" else ("h.Q_em", "q")
        root = one_house(ends, ports={"q": f"{kind} odd"})
        unit = '<ssc:Unit name="odd"><ssc:BaseUnit kg="1" m="2" s="-3" factor="0"/></ssc:Unit>'
        with pytest.raises(FMULoadError, match=r"line 3.*'odd' is 0"):
            FMUSystem.read(pack(root, f"<ssd:Units>{unit}</ssd:Units>"))


class TestDamaged:
    """Whatever is in a file, an error of this package says so, or the system can be written."""

    WORDS = (
        "",
        "nan",
        "-1",
        "1e999",
        "x",
        "../../x",
        "input",
        "output",
        "a",
        "Q_em",
        "K",
        "\u202e",
    )

    @pytest.mark.parametrize("seed", range(3))
    def test_by_chance(self, pack, seed):
        draw = random.Random(seed)
        texts = [NESTED, LINKED, self.with_parameters()]
        read = 0
        for _ in range(40):
            root = draw.choice(texts)
            text = etree.tostring(
                self.damaged(draw, etree.fromstring((HEAD + root + TAIL).encode()))
            )
            path = pack(text.decode().partition(">")[2].rpartition("<")[0] or root)
            try:
                FMUSystem.read(path)
            except FMUGymError:
                continue
            read += 1
        assert read

    def with_parameters(self):
        own = bindings(values({"T_m_0": real(20, "degC"), "A_f": real(3)}, prefix=""))
        return one_house(more=own)

    def damaged(self, draw, root):
        for _ in range(draw.randint(1, 4)):
            elements = [one for one in root.iter() if one.getparent() is not None]
            if not elements:
                return root
            one, other = draw.choice(elements), draw.choice(elements)
            change = draw.randrange(5)
            if change <= 1 and one.attrib:
                one.set(draw.choice(list(one.attrib)), draw.choice(self.WORDS))
            elif change == 2 and one.attrib:
                del one.attrib[draw.choice(list(one.attrib))]
            elif change == 3:
                one.getparent().remove(one)
            elif other not in list(one.iter()):
                other.append(copy.deepcopy(one))
        return root


class TestNestedConnectors:
    """Connectors of nested systems that nothing outside is joined to."""

    PORTS = MappingProxyType({"warmth": "input degC", "one": "input W", "out": "output degC"})
    WIRES = (
        connection("warmth", "east.T_out"),
        connection("warmth", "west.T_out", linear(0.5, 1.0)),
        connection("one", "east.Q_int"),
        connection("west.T_air", "out"),
    )

    def archive(self, pack, ports=None, wires=(), more=()):
        houses = [component(name, HOUSE_PORTS) for name in ("east", "west")]
        pair = system("pair", self.PORTS, houses, self.WIRES)
        return pack(system("root", ports or {}, [pair, *more], wires))

    def test_one_that_fans_out_is_one_input(self, pack):
        fmu = FMUSystem.read(self.archive(pack)).as_fmu()
        variable = fmu.variable("pair.warmth")
        assert (variable.causality, variable.unit) == ("input", "degC")
        inputs = {v.name for v in fmu.description.variables.values() if v.causality == "input"}
        assert {"pair.warmth", "pair.east.Q_int"} <= inputs
        assert not inputs & {"pair.east.T_out", "pair.west.T_out"}

    def test_it_reaches_all_components(self, pack, opened):
        """As if each were set by hand, converted and scaled on the way."""
        fmu = FMUSystem.read(self.archive(pack)).as_fmu()
        names = ["pair.east.T_out", "pair.west.T_out", "pair.out", "pair.west.T_air"]
        pool = opened(pool_tools.open_pool(fmu, ["pair.warmth"], names, 900.0))
        rows = pool_tools.step(pool_tools.start(pool), 7.0)[:, 0]
        kelvin = 273.15 if FMU(HOUSE).variable("T_out").unit == "K" else 0.0
        assert rows[:2] == pytest.approx([7.0 + kelvin, 0.5 * (7.0 + kelvin) + 1.0], abs=1e-9)
        assert rows[2] == pytest.approx(rows[3] - kelvin, abs=1e-9)

    def test_an_output_has_the_name_of_the_connector(self, pack):
        fmu = FMUSystem.read(self.archive(pack)).as_fmu()
        variable = fmu.variable("pair.out")
        assert (variable.causality, variable.unit) == ("output", "degC")

    def test_what_is_driven_from_outside_is_no_input(self, pack):
        third = component("third", HOUSE_PORTS)
        wires = [connection("third.T_air", "pair.warmth"), connection("pair.out", "third.T_out")]
        made = FMUSystem.read(self.archive(pack, wires=wires, more=[third]))
        assert "pair.warmth" not in made.as_fmu().description.variables
        assert {(link.source, link.target) for link in made.links} == {
            ("third", "pair.east"),
            ("third", "pair.west"),
            ("pair.west", "third"),
        }

    def test_a_parameter_fans_out_too(self, pack):
        ports = {"area": "parameter m2"}
        houses = [component(name, {"A_f": "parameter m2"}) for name in ("east", "west")]
        wires = [connection("area", f"{name}.A_f") for name in ("east", "west")]
        made = FMUSystem.read(pack(system("root", {}, [system("pair", ports, houses, wires)])))
        variable = made.as_fmu().variable("pair.area")
        assert variable.causality == "parameter"
        assert len(made.connectors[0].ends) == 2

    def test_a_component_of_the_same_name_comes_first(self, pack):
        """Then the connector stays without a name, as its component inputs have theirs."""
        houses = [component(name, HOUSE_PORTS) for name in ("warmth", "west")]
        wires = [connection("warmth", f"{name}.T_out") for name in ("warmth", "west")]
        ports = {"warmth": "input K"}
        made = FMUSystem.read(pack(system("root", {}, [system("pair", ports, houses, wires)])))
        assert made.as_fmu().variable("pair.warmth.T_out").causality == "input"


class TestLarge:
    """Systems of many components."""

    @staticmethod
    def chain(count):
        """Components in a chain; each gets the same temperature, and a parameter from outside."""
        inner = [component(f"c{i}", HOUSE_PORTS) for i in range(count)]
        wires = [connection("T", f"c{i}.T_out") for i in range(count)]
        wires += [connection(f"c{i}.Q_em", f"c{i + 1}.Q_int") for i in range(count - 1)]
        starts = {f"c{i}.T_m_0": real(290.0) for i in range(count)}
        return system("root", {"T": "input degC"}, inner, wires, bindings(values(starts)))

    def test_opening_takes_as_many_lines_for_each_component(self, pack):
        def lines(count):
            path, counted = pack(self.chain(count)), 0

            def trace(frame, event, what):
                nonlocal counted
                counted += event == "line"
                return trace

            before = sys.gettrace()
            sys.settrace(trace)
            try:
                fmu = FMUSystem.read(path).as_fmu(probe_timeout=None)
                pool_tools.open_pool(fmu, (), ["c1.T_air"], 60.0).close()
            finally:
                sys.settrace(before)
            return counted

        lines(20)  # what is imported and kept only once
        first, second, third = map(lines, (20, 40, 80))
        assert third - second == pytest.approx(2 * (second - first), rel=0.02)

    def test_a_file_is_read_once(self, pack):
        fmu = FMUSystem.read(pack(self.chain(20))).as_fmu(probe_timeout=None)
        assert len({id(part) for part in fmu.description.parts}) == 1

    def test_three_hundred_components_play(self, pack):
        names = {"model_input_names": "T", "model_output_names": "c299.T_air"}
        config = names | {"bounds": {"T": (0, 30)}, "time_step": 60.0}
        with PlainEnv(pack(self.chain(300)), config) as env:
            env.reset(seed=0)
            assert env.step(env.action_space.sample())[0] == pytest.approx(290.0, abs=5.0)
