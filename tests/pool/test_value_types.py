"""Values of every type, in all pools: numbers, enumerations and Strings."""

import model_tools
import numpy as np
import pytest
import values_tools
from combinations import in_turn
from gymnasium import spaces
from values_tools import (
    POOLS,
    VERSIONS,
    Env,
    Writing,
    fixture_feedthrough,  # noqa: F401  # the fixture "feedthrough"
    versions,
)

from fmugym import ConfigError

LIMITS = {
    "Integer": (-(2**31), 2**31 - 1),
    "Boolean": (0, 1),
    "Float32": (-float(np.finfo(np.float32).max), float(np.finfo(np.float32).max)),
    **{f"Int{n}": (-(2 ** (n - 1)), 2 ** (n - 1) - 1) for n in (8, 16, 32)},
    **{f"UInt{n}": (0, 2**n - 1) for n in (8, 16, 32)},
    "Int64": (-(2**53), 2**53),
    "UInt64": (0, 2**53),
    "Real": (-1e30, 1e30),
    "Float64": (-1e30, 1e30),
}


@in_turn({"version": VERSIONS, "options": POOLS})
def test_numbers_of_every_type_come_out_as_they_went_in(feedthrough, version, options):
    types = values_tools.TYPES[version]
    names = {key: [f"{t}_{key}" for t in types] for key in ("in", "out", "parameter", "told")}
    for place in (0, 1):
        values = [LIMITS[type_][place] for type_ in types]
        env = Writing(
            feedthrough[version],
            given=values,
            model_input_names=names["in"],
            model_output_names=names["out"] + names["told"],
            model_parameters=dict(zip(names["parameter"], values, strict=True)),
            **options,
        )
        env.reset()
        env.step(0)
        assert env.state == tuple(map(float, values + values))
        env.close()


@versions
def test_values_outside_of_a_type(feedthrough, version):
    for type_ in values_tools.TYPES[version]:
        if type_ in {"Real", "Float64"}:
            continue
        low, high = LIMITS[type_]
        excess = 1e36 if type_ == "Float32" else 2 if "64" in type_ else 1
        for value in (low - excess, high + excess):
            with pytest.raises(ConfigError, match=f"{type_}_parameter"):
                Writing(
                    feedthrough[version],
                    given=[],
                    model_input_names=[],
                    model_output_names=[f"{type_}_out"],
                    model_parameters={f"{type_}_parameter": value},
                )
            env = Writing(
                feedthrough[version],
                given=[value],
                model_input_names=[f"{type_}_in"],
                model_output_names=[f"{type_}_out"],
            )
            env.reset()
            if type_ == "Boolean":
                env.step(0)
                assert env.state == (float(value >= 0.5),)
            else:
                with pytest.raises(ConfigError, match=f"{type_}_in"):
                    env.step(0)
            env.close()


@in_turn({"version": VERSIONS, "options": POOLS})
def test_enumerations_are_discrete(feedthrough, version, options):
    env = Env(
        feedthrough[version],
        model_input_names="Enumeration_in",
        model_output_names="Enumeration_out",
        **options,
    )
    assert env.action_space == env.observation_space == spaces.Discrete(2)
    env.reset()
    assert [env.step(action)[0] for action in (0, 1, 0)] == [0, 1, 0]
    env.close()


@in_turn({"version": VERSIONS, "options": POOLS})
def test_an_fmu_reads_a_file_of_its_resources(tmp_path, version, options, make_envs):
    path = model_tools.model_fmu(
        tmp_path / "Resource.fmu",
        "resource",
        version,
        "{resource}",
        [("y", "output", "")],
        add={"resources/y.txt": "42.5"},
    )

    def make():
        return Writing(path, [], model_input_names=[], model_output_names="y", **options)

    envs, env = make_envs(make, 2), make()
    assert env.reset()[0].tolist() == [42.5]
    assert envs.reset()[0].tolist() == [[42.5]] * 2
    env.close()


@pytest.mark.parametrize(
    ("changes", "facts"),
    [
        ({"model_input_names": "String_in"}, r"'String_in'.*input.*String.*model_parameters"),
        ({"model_output_names": "String_out"}, r"'String_out'.*output.*String.*number"),
        ({"model_parameters": {"String_parameter": 3}}, r"'String_parameter'.*String.*3"),
        ({"model_input_names": "Binary_in"}, r"'Binary_in'.*input.*Binary.*numbers"),
        ({"model_parameters": {"Binary_in": "00"}}, r"'Binary_in'"),
    ],
)
def test_refused_types(feedthrough, changes, facts):
    config = {"model_input_names": "v", "model_output_names": "w", "bounds": {"v": (0, 1)}}
    with pytest.raises(ConfigError, match=facts):
        Env(feedthrough[3], **(config | changes))
