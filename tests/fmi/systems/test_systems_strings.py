"""Texts in systems: parameters of components, and of the system."""

import gymnasium
import pytest
import ssp_tools
import values_tools
from fmu_tools import PlainEnv
from system_tools import (
    closing_pools,  # noqa: F401  # the fixture "make"
    play,
)

from fmugym import Component, ConfigError, Connection, FMUSystem

VERSIONS = (1, 2, 3)


@pytest.fixture(scope="module", name="fmus")
def compiled(tmp_path_factory):
    folder = tmp_path_factory.mktemp("feedthrough")
    return {v: values_tools.feedthrough_fmu(folder / f"F{v}.fmu", v) for v in VERSIONS}


LENGTHS = ["a.length", "b.length", "c.length"]
"""The FMU tells the length of its String parameter."""


def three(fmus, connections=(), **starts):
    components = {
        name: Component(fmus[v], {"String_parameter": starts[name]} if name in starts else {})
        for name, v in zip("abc", VERSIONS, strict=True)
    }
    return FMUSystem(components, list(connections))


def labelled(fmus, **starts):
    return three(fmus, [f"label -> {name}.String_parameter" for name in "ac"], **starts)


class Env(PlainEnv):
    def __init__(self, fmu, **parameters):
        config = {
            "model_input_names": [],
            "model_output_names": LENGTHS,
            "model_parameters": parameters,
            "time_step": 0.1,
        }
        super().__init__(fmu, config)

    def _get_action_space(self):
        return gymnasium.spaces.Discrete(1)

    def _get_inputs(self):
        return []


def test_each_component_has_its_own(make, fmus):
    system = three(fmus, a="four", b="", c="gr\u00fc\u00df dich")
    assert play(make(system, (), LENGTHS), 1).tolist() == [[4, 0, 11]] * 2


def test_those_of_an_environment_win(fmus):
    parameters = {"a.String_parameter": "longer", "b.String_parameter": "b"}
    env = Env(three(fmus, a="four", c="c"), **parameters)
    for _ in range(2):
        env.reset()
        assert env.state == (6.0, 1.0, 1.0)
    env.close()


def test_one_parameter_of_the_system_is_that_of_several(fmus):
    env = Env(labelled(fmus, b="b", c="short"), label="the same")
    env.reset()
    assert env.state == (8.0, 1.0, 8.0)
    env.close()
    env = Env(labelled(fmus, b="b", c="short"))
    env.reset()
    assert env.state == (0.0, 1.0, 5.0), "without a text, each component starts as it would"
    env.close()


@pytest.mark.parametrize(
    ("connection", "facts"),
    [
        (
            "a.String_told -> b.String_in",
            ["a.String_told -> b.String_in", "String", "start_values"],
        ),
        ("a.String_told -> told", ["a.String_told", "String"]),
        ("a.Real_out -> b.String_in", ["b.String_in", "String"]),
        (Connection("x", "b.String_parameter", 2.0), ["gain", "b.String_parameter"]),
        ("a.Real_out -> b.String_parameter", ["b.String_parameter", "String"]),
    ],
)
def test_connections_carry_no_texts(fmus, connection, facts):
    with pytest.raises(ConfigError) as error:
        three(fmus, [connection])
    assert all(fact in str(error.value) for fact in facts), error.value


def test_a_text_and_a_number_have_no_common_source(fmus):
    with pytest.raises(ConfigError, match=r"b\.Real_parameter.*a\.String_parameter"):
        three(fmus, ["x -> a.String_parameter", "x -> b.Real_parameter"])


def test_archives_have_them(make, fmus, tmp_path, ran):
    """In parameter sets of components, and as a connector of the system."""
    system = labelled(fmus, a="four", b="b", c="<&>")
    file = ssp_tools.write(system, tmp_path / "s.ssp")
    again = FMUSystem.read(file)
    assert again.connectors == system.connectors
    assert play(make(again, (), LENGTHS), 0).tolist() == [[4, 1, 3]]
    ran("info", file)
