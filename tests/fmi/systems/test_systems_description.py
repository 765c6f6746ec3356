"""Systems as users describe them: names, units, types, order, loops."""

import pickle
from itertools import pairwise

import pytest
from fmu_tools import PlainEnv
from letters import wide
from system_tools import links_of

from fmugym import Component, Connection, FMUSystem, bundled_fmu
from fmugym.errors import ArgumentError, ConfigError, FMULoadError
from fmugym.fmi.description import Feedthrough
from fmugym.fmi.systems.system_plan import Link, Loop, order_of, strong_components
from fmugym.fmi.units import conversion_of_link

HOUSE, PENDULUM = bundled_fmu("House"), bundled_fmu("Pendulum")
CART = {version: bundled_fmu("CartPole", version) for version in ("1.0", "2.0", "3.0")}


def houses(*connections, **options):
    return FMUSystem({"a": HOUSE, "b": HOUSE}, list(connections), **options)


class TestConnections:
    def test_as_text_as_pair_and_as_object_are_the_same(self):
        expected = [("a", "Q_em", "b", "Q_int", 1.0, 0.0)]
        for given in ("a.Q_em -> b.Q_int", ("a.Q_em", "b.Q_int"), Connection("a.Q_em", "b.Q_int")):
            assert links_of(houses(given)) == expected

    def test_units_are_converted_before_gain_and_offset(self):
        """By SSP 1.0, the linear transformation applies to the converted value."""
        system = FMUSystem(
            {"house": HOUSE, "cart": CART["2.0"]},
            [Connection("T_cellar", "house.T_out", gain=2.0, offset=3.0)],
            units={"T_cellar": "degF"},
        )
        (end,) = system.plan.connectors[0].ends
        fahrenheit = 50.0  # is 283.15 K
        assert end.gain * fahrenheit + end.offset == pytest.approx(2 * 283.15 + 3, rel=1e-12)

    def test_outputs_of_the_system_are_converted_to_its_units(self):
        system = houses("a.T_air -> T", units={"T": "degC"})
        (end,) = system.plan.connectors[0].ends
        assert (end.gain * 293.15 + end.offset) == pytest.approx(20.0, abs=1e-12)

    def test_the_definitions_of_fmus_win_over_pint(self):
        from fmugym.fmi.description import Unit

        length = (0, 1, 0, 0, 0, 0, 0, 0)
        own, other = {"x": Unit(length, 1000.0)}, {"x": Unit(length, 0.001)}
        assert conversion_of_link("x", own, "x", other)(2.0) == pytest.approx(2e6)
        assert conversion_of_link("m", own, "km", other)(2.0) == pytest.approx(0.002)
        assert conversion_of_link(None, own, "km", other)(2.0) == 2.0

    @pytest.mark.parametrize(
        ("connection", "facts"),
        [
            ("aa.Q_em -> b.Q_int", ["aa", "'a'"]),
            ("a.Q_en -> b.Q_int", ["Q_en", "Q_em", "'a'"]),
            ("a.Q_em -> b.T_out", ["a.Q_em", "b.T_out", "'W'", "'K'"]),
            ("a.Q_em -> b.P", ["b.P", "output"]),
            ("a.T_out -> b.T_out", ["a.T_out", "input"]),
            ("a.Q_em -> b.A_f", ["b.A_f", "parameter"]),
            ("x -> y", ["x -> y", "a, b"]),
            ("a -> b.T_out", ["'a'", "component"]),
            ("a.Q_em", ["'a.Q_em'"]),
            (" -> b.T_out", ["source"]),
        ],
    )
    def test_what_does_not_fit_is_told(self, connection, facts):
        with pytest.raises(ConfigError) as error:
            houses(connection)
        assert all(fact in str(error.value) for fact in facts), error.value

    def test_two_sources_of_one_input_are_named(self):
        with pytest.raises(ConfigError, match=r"b\.Q_int.*a\.Q_em.*heat"):
            houses("a.Q_em -> b.Q_int", "heat -> b.Q_int")
        with pytest.raises(ConfigError, match=r"'T'.*a\.T_air.*b\.T_air"):
            houses("a.T_air -> T", "b.T_air -> T")

    def test_a_real_cannot_become_an_enumeration(self, logic):
        with pytest.raises(ConfigError, match=r"Real.*Integer"):
            FMUSystem({"l": logic, "h": HOUSE}, ["h.T_air -> l.level"])
        with pytest.raises(ConfigError, match=r"Boolean.*Real"):
            FMUSystem({"l": logic, "h": HOUSE}, ["l.on -> h.u"])
        with pytest.raises(ConfigError, match="String"):
            FMUSystem({"l": logic, "h": HOUSE}, ["l.text -> h.u"])
        whole = FMUSystem({"l": logic, "h": HOUSE}, [Connection("l.count", "h.u", 0.1, 0.5)])
        assert links_of(whole) == [("l", "count", "h", "u", 0.1, 0.5)]
        with pytest.raises(ConfigError, match="gain and offset"):
            FMUSystem({"l": logic, "m": logic}, [Connection("l.count", "m.level", 2.0)])

    def test_inputs_without_a_source_are_open(self):
        names = [port.name for port in houses("a.Q_em -> b.Q_int", "u -> a.u").open_inputs]
        assert names == ["a.T_out", "a.I_sol", "a.Q_int", "b.T_out", "b.I_sol", "b.u"]

    def test_one_input_of_the_system_may_drive_many(self):
        system = houses("T -> a.T_out", "T -> b.T_out", "A -> a.A_f", "A -> b.A_f")
        found = {c.name: (c.causality, len(c.ends)) for c in system.plan.connectors}
        assert found == {"T": ("input", 2), "A": ("parameter", 2)}


@pytest.fixture(scope="module")
def logic(tmp_path_factory):
    """An FMU of pythonfmu with variables of all types, which tells nothing of its structure."""
    from pythonfmu.builder import FmuBuilder

    folder = tmp_path_factory.mktemp("logic")
    (folder / "logic.py").write_text(
        "from pythonfmu import *\n"
        "class Logic(Fmi2Slave):\n"
        "    def __init__(self, **kwargs):\n"
        "        super().__init__(**kwargs)\n"
        "        self.level, self.count, self.on, self.text = 0, 0, False, ''\n"
        "        kinds = [(Integer, 'level', 'input'), (Integer, 'count', 'output'),\n"
        "                 (Boolean, 'on', 'output'), (String, 'text', 'output')]\n"
        "        for kind, name, causality in kinds:\n"
        "            self.register_variable(kind(name, causality=Fmi2Causality[causality],\n"
        "                                        variability=Fmi2Variability.discrete))\n"
        "    def do_step(self, time, step):\n"
        "        self.count = self.level\n"
        "        return True\n"
    )
    return FmuBuilder.build_FMU(folder / "logic.py", dest=folder)


class TestLetters:
    """Names are also found by letters that only look other: components, and the system's own."""

    def test_of_components(self):
        ohm, other = "R_\u03a9", "R_\u2126"  # a Greek letter, and the sign of the unit
        system = FMUSystem({ohm: HOUSE, "b": HOUSE}, [f"{other}.Q_em -> {wide('b')}.Q_int"])
        assert links_of(system) == [(ohm, "Q_em", "b", "Q_int", 1.0, 0.0)]
        with pytest.raises(ConfigError, match="is a component; which of its variables"):
            houses(f"{wide('a')} -> b.Q_int")
        with pytest.raises(ConfigError, match="unknown component 'c'"):
            houses("c.Q_em -> b.Q_int")

    def test_of_the_system(self):
        system = houses(
            "\u00b5 -> a.T_out",
            "\u03bc -> b.T_out",
            "a.T_air -> k\u00fchl",
            units={"ku\u0308hl": "degC"},
        )
        source, target = system.plan.connectors
        assert (source.name, len(source.ends)) == ("\u00b5", 2)
        assert (target.name, target.unit) == ("ku\u0308hl", "degC")
        with pytest.raises(ConfigError, match=r"two sources: a\.T_air, b\.T_air"):
            houses("a.T_air -> k\u00fchl", "b.T_air -> ku\u0308hl")


class Env(PlainEnv):
    def __init__(self, system, **changes):
        config = {"model_input_names": "a.u", "model_output_names": "b.T_air", "time_step": 60.0}
        super().__init__(system, config | changes)


class TestDrivenVariables:
    """What a connection drives cannot be set otherwise; the message says what drives it."""

    @pytest.mark.parametrize(
        ("config", "facts"),
        [
            ({"model_input_names": "b.Q_int"}, ("'b.Q_int'", "'a.Q_em'")),
            ({"model_parameters": {"b.Q_int": 1.0}}, ("'b.Q_int'", "'a.Q_em'")),
            ({"model_parameters": {"a.A_f": 120.0}}, ("'a.A_f'", "'area'")),
        ],
    )
    def test_their_source_is_named(self, config, facts):
        system = houses("a.Q_em -> b.Q_int", "area -> a.A_f", "area -> b.A_f")
        with pytest.raises(ConfigError) as caught:
            Env(system, **config)
        assert all(fact in str(caught.value) for fact in facts)


class TestComponents:
    def test_start_values_are_checked_against_the_fmu(self):
        system = FMUSystem({"h": Component(HOUSE, {"A_f": 100, "solver": "rk4"}, steps=3)})
        assert system.plan.components[0].starts == (("A_f", 100.0), ("solver", 2.0))
        assert system.plan.components[0].steps == 3
        for values, fact in (
            ({"A_ff": 1}, "A_f"),
            ({"T_air": 1}, "T_air"),
            ({"A_f": "big"}, "A_f"),
            ({"solver": "rk5"}, "rk4"),
            ({"solver": 1.5}, "Enumeration"),
        ):
            with pytest.raises(ConfigError, match=fact):
                FMUSystem({"h": Component(HOUSE, values)})

    @pytest.mark.parametrize("name", ["", "a/b", " a", "a\n"])
    def test_names_that_make_no_file_or_variable_are_refused(self, name):
        with pytest.raises(ConfigError, match="named"):
            FMUSystem({name: HOUSE})

    def test_an_fmu_that_does_not_exist_is_that_of_a_component(self, tmp_path):
        with pytest.raises(FMULoadError, match=r"'h'.*none\.fmu"):
            FMUSystem({"h": tmp_path / "none.fmu"})

    def test_the_smallest_step_of_a_component_is_the_default(self):
        system = FMUSystem({"h": HOUSE, "p": Component(PENDULUM, steps=10)})
        assert system.plan.step_size == 0.1
        assert FMUSystem({"h": HOUSE}, step_size=60).plan.step_size == 60.0

    def test_mistakes_in_arguments(self):
        for arguments in (
            {"components": {}},
            {"components": {"h": HOUSE}, "master": "gauss"},
            {"components": {"h": HOUSE}, "loops": "picard"},
            {"components": {"h": HOUSE}, "units": {"T": "K"}},
            {"components": {"h": HOUSE}, "connections": "a -> b"},
            {"components": {"h": 3}},
            {"components": {"h": HOUSE}, "step_size": 0},
        ):
            with pytest.raises(ConfigError):
                FMUSystem(**arguments)
        with pytest.raises(ConfigError):
            Component(HOUSE, steps=0)
        with pytest.raises(ConfigError):
            Component(HOUSE, interface="cosimulation")

    def test_unknown_arguments_are_refused_with_the_nearest_name(self):
        with pytest.raises(ArgumentError, match=r"FMUSystem.*'loop_tolerence'.*'loop_tolerance'"):
            FMUSystem({"h": HOUSE}, loop_tolerence=1e-3)

    def test_a_pickled_system_is_the_same(self):
        system = houses("a.Q_em -> b.Q_int", "T -> a.T_out", units={"T": "degC"}, step_size=60)
        assert pickle.loads(pickle.dumps(system)).plan == system.plan


class TestFeedthrough:
    @pytest.mark.parametrize("fmu", [HOUSE, bundled_fmu("House", "3.0")])
    def test_of_fmi_2_and_3(self, fmu):
        from fmugym import FMU

        told = FMU(fmu).feedthrough
        assert told.in_step["T_air"] == {"T_out", "I_sol", "Q_int"}
        assert told.in_step["P"] == {"u"}
        assert told.in_step["E"] == frozenset()
        assert told.at_start["E"] == {"T_out", "I_sol", "Q_int", "u"}  # the XML tells nothing
        assert told.known

    def test_of_fmi_1(self):
        from fmugym import FMU

        told = FMU(CART["1.0"]).feedthrough
        assert told.in_step["x"] == frozenset()

    def test_an_fmu_that_tells_nothing_depends_on_all_inputs(self, logic):
        system = FMUSystem({"l": logic}, ["l.count -> l.level"])
        assert system.order.loops
        assert any("does not tell" in finding for finding in system.findings)
        told = FMUSystem({"l": Component(logic, feedthrough=False)}, ["l.count -> l.level"])
        assert not told.order.loops


class TestOrder:
    def test_a_loop_is_named_and_can_be_refused(self):
        loop = ["a.Q_em -> b.Q_int", "b.Q_em -> a.Q_int"]
        system = houses(*loop)
        (group,) = system.plan.groups
        assert group.components == ("a", "b")
        assert group.loop == Loop()
        assert any(all(one in finding for one in loop) for finding in system.findings)
        with pytest.raises(ConfigError, match=r"a\.Q_em -> b\.Q_int, b\.Q_em -> a\.Q_int"):
            houses(*loop, loops="refuse")

    def test_states_break_a_loop(self):
        """T_m and E are states: they depend on no input without a step in between."""
        system = houses("a.T_m -> b.T_out", "b.T_m -> a.T_out", loops="refuse")
        assert [group.components for group in system.plan.groups] == [("a",), ("b",)]
        assert not any(group.loop for group in system.plan.groups)

    def test_a_component_steps_after_those_that_act_on_its_outputs(self):
        components = {"c": HOUSE, "b": HOUSE, "a": HOUSE}
        system = FMUSystem(components, ["a.Q_em -> b.Q_int", "b.Q_em -> c.Q_int"])
        assert [g.components for g in system.plan.groups] == [("a",), ("b",), ("c",)]
        order = [place for e in system.plan.initialization for place in e.links]
        assert order == [0, 1]

    def test_both_ways_without_a_loop_one_value_is_late(self):
        """a acts on b by P, b acts on a by T_air, but a's P does not depend on its T_out."""
        system = houses("a.P -> b.Q_int", "b.T_air -> a.T_out")
        assert [g.components for g in system.plan.groups] == [("a",), ("b",)]
        assert not system.order.loops
        assert [(k.source, k.target) for k in system.order.late] == [("b", "a")]

    def test_strong_components_against_scipy(self):
        import numpy as np
        from scipy.sparse import csr_matrix
        from scipy.sparse.csgraph import connected_components

        draw = np.random.default_rng(0)
        for _ in range(50):
            size = int(draw.integers(1, 30))
            edges = draw.random((size, size)) < 1.5 / size
            graph = {i: np.flatnonzero(edges[i]).tolist() for i in range(size)}
            found = strong_components(graph)
            _, labels = connected_components(csr_matrix(edges), connection="strong")
            expected = {frozenset(np.flatnonzero(labels == one).tolist()) for one in set(labels)}
            assert set(map(frozenset, found)) == expected
            seen = set()
            for component in found:  # each comes after all it depends on
                seen.update(component)
                assert all(after in seen for node in component for after in graph[node])

    def test_a_long_chain_needs_no_deep_recursion(self):
        names = [f"c{i}" for i in range(3000)]
        links = [Link(a, "y", b, "u") for a, b in pairwise(names)]
        through = {"y": frozenset({"u"})}
        told = dict.fromkeys(names, Feedthrough(through, through, known=True))
        order = order_of(names[::-1], links, told, Loop())
        assert [group.components[0] for group in order.groups] == names
        assert [one.links[0] for one in order.initialization] == list(range(len(links)))
