"""The config: what it takes, what it fills in, and the errors for what it refuses."""

import dataclasses
import math

import numpy as np
import pytest
from combinations import in_turn
from fmu_tools import MAJOR_VERSIONS, probe_config, probe_fmu

from fmugym import FMU, Choice, ConfigError, Uniform
from fmugym.environment.config import EnvConfig
from fmugym.environment.interface import resolve
from fmugym.fmi.variable import checked_value


def resolved(path, **changes):
    return resolve(EnvConfig.from_dict(probe_config(**changes)), FMU(path).description)


class TestTaken:
    def test_defaults(self):
        config = EnvConfig.from_dict({"model_input_names": [], "model_output_names": "y"})
        assert (config.positive_reward, config.negative_reward) == (1.0, -100.0)
        assert config.max_episode_steps is None
        assert (config.substeps, config.warm_up) == (1, 0.0)
        assert config.on_fault == "truncate"

    def test_a_bare_name_is_one_name(self):
        config = EnvConfig.from_dict(
            {"model_input_names": "force", "model_output_names": "x", "monitor_names": "energy"}
        )
        assert config.model_input_names == ("force",)
        assert config.model_output_names == ("x",)
        assert config.monitor_names == ("energy",)

    def test_a_checked_config_is_taken_as_it_is(self):
        config = EnvConfig.from_dict(probe_config())
        assert EnvConfig.from_dict(config) is config

    def test_it_is_frozen_and_does_not_change_with_the_dict(self):
        given = probe_config(model_parameters={"gain": 2.0})
        config = EnvConfig.from_dict(given)
        given["model_parameters"]["gain"] = 3.0
        assert config.model_parameters == {"gain": 2.0}
        with pytest.raises(dataclasses.FrozenInstanceError):
            config.time_step = 1.0

    def test_numpy_numbers(self):
        config = EnvConfig.from_dict(
            probe_config(time_step=np.float32(0.5), warm_up=np.array(1.0), start_time=np.int64(3))
        )
        assert float(config.time_step) == 0.5


class TestFilledInFromTheFMU:
    def test_time_step_and_start_time(self, tmp_path):
        experiment = '<DefaultExperiment startTime="2" stepSize="0.25"/><ModelVariables>'
        path = probe_fmu(tmp_path, 2, {"<ModelVariables>": experiment})
        spec = resolved(path, time_step=None).pool_spec()
        assert (spec.time_step, spec.start_time) == (0.25, 2.0)
        spec = resolved(path, time_step=0.5, start_time=0.0).pool_spec()
        assert (spec.time_step, spec.start_time) == (0.5, 0.0)

    def test_substeps_and_warm_up(self, probe):
        spec = resolved(probe(2), time_step=0.3, substeps=3, warm_up=0.9).pool_spec()
        assert spec.warm_up_steps == 3
        assert spec.communication_step_size == pytest.approx(0.1, abs=1e-16)
        assert spec.communication_point(9) == pytest.approx(0.9, abs=1e-15)

    def test_bounds_go_before_those_of_the_fmu(self, probe):
        interface = resolved(probe(2), bounds={"a": (-3, 4)})
        assert interface.inputs[0].range == (-3, 4)


class TestValuesForVariables:
    @pytest.fixture
    def variable(self, probe):
        return FMU(probe(3)).variable

    @pytest.mark.parametrize(
        ("name", "value", "expected"),
        [
            ("gain", 2, 2.0),
            ("gain", np.float32(0.5), 0.5),
            ("n", 3, 3.0),
            ("n", 3.0, 3.0),
            ("n", np.int8(-3), -3.0),
            ("n", 2**31 - 1, 2.0**31 - 1),
            ("n", -(2**31), -(2.0**31)),
            ("on", True, 1.0),
            ("on", np.False_, 0.0),
            ("on", 1, 1.0),
            ("mode", "turbo", 5.0),
            ("mode", 2, 2.0),
            ("Int8_in", -128, -128.0),
            ("UInt16_in", 65535, 65535.0),
            ("Int64_in", 2**53, 2.0**53),
            ("Float32_in", 3.4e38, 3.4e38),
        ],
    )
    def test_taken(self, variable, name, value, expected):
        result = checked_value(variable(name), value)
        assert result == expected
        assert float(result) == expected

    @pytest.mark.parametrize(
        ("name", "value", "match"),
        [
            ("gain", math.nan, "'gain' must be finite, got nan"),
            ("gain", math.inf, "'gain' must be finite"),
            ("gain", "1.0", "'gain' must be a number, got '1.0'"),
            ("gain", None, "'gain' must be a number, got None"),
            ("gain", True, "'gain' must be a number, got True"),
            ("gain", [1.0], "'gain' must be a number"),
            ("gain", np.ones(1), "'gain' must be a number"),
            ("gain", 1j, "'gain' must be a number"),
            ("gain", 10**400, "'gain' must be a number"),
            ("gain", Uniform, "'gain' must be a number"),
            ("n", 2.5, "'n' is of type Int32: expected an integer .*, got 2.5"),
            ("n", 2**31, "'n' is of type Int32: expected an integer from -2147483648 to 214748364"),
            ("n", -(2**31) - 1, "'n' is of type Int32"),
            ("on", 0.5, "'on' is a Boolean, got 0.5"),
            ("on", 2, "'on' is a Boolean, got 2"),
            ("on", "False", "'on' must be a number, got 'False'"),
            ("mode", 3, r"'mode': expected one of 1 \(slow\), 2 \(fast\), 5 \(turbo\), got 3"),
            ("mode", 1.5, "'mode' is of type Enumeration: expected an integer"),
            ("mode", "trubo", "unknown item of 'mode' 'trubo'; did you mean 'turbo'"),
            ("Int8_in", 128, "expected an integer from -128 to 127, got 128"),
            ("UInt16_in", -1, "expected an integer from 0 to 65535, got -1"),
            ("Int64_in", 2**63, "expected an integer from"),
            ("Int64_in", 2**60, r"integers beyond 2\*\*53 are not exact"),
            ("Float32_in", 1e39, "'Float32_in' is a Float32, too narrow for 1e.39"),
        ],
    )
    def test_refused(self, variable, name, value, match):
        with pytest.raises(ConfigError, match=match):
            checked_value(variable(name), value)


class TestRefused:
    @pytest.mark.parametrize(
        ("changes", "match"),
        [
            ({"model_input_names": 3}, "model_input_names must be a name or a list of names"),
            ({"model_input_names": ["a", "a"]}, "model_input_names: 'a' is named twice"),
            ({"model_output_names": []}, "'model_output_names' names no output"),
            ({"model_output_names": ["sum", "sum"]}, "'sum' is named twice"),
            ({"monitor_names": ["mix"]}, "'mix' is named twice"),
            ({"model_parameters": ["gain"]}, "model_parameters must be a table"),
            ({"model_parameters": {1: 2}}, "model_parameters must be a table with names as keys"),
            ({"episode_variables": None}, "episode_variables must be a table"),
            ({"episode_variables": {"target": "x"}}, "episode variable 'target' must be a number"),
            ({"episode_variables": {"target": math.nan}}, "'target' must be finite"),
            ({"episode_variables": {"past": [1.0, "x"]}}, "'past' must be an array of numbers"),
            ({"episode_variables": {"past": [[1.0], [1.0, 2.0]]}}, "'past' must be an array of"),
            ({"episode_variables": {"past": [math.inf]}}, "'past' must be an array of finite"),
            ({"episode_variables": {"past": []}}, "'past' must be an array of finite"),
            (
                {"episode_variables": {"past": [Uniform(0, 1), "x"]}},
                "element 1 of .*'past' must be",
            ),
            ({"episode_variables": {"past": [Uniform(0, 1), math.inf]}}, "'past' must be finite"),
            (
                {"episode_variables": {"past": [Choice(["a"])]}},
                "element 0 of .*'past' must be a num",
            ),
            ({"episode_variables": {"past": [[Uniform(0, 1)], [1, 2]]}}, "'past' must be an array"),
            ({"episode_variables": {"past": [{"low": 1}]}}, "'past' must be .*distribution"),
            ({"time_step": 0}, r"time_step must be .*positive.*, got 0"),
            ({"time_step": "0.1"}, "time_step must be a number, got '0.1'"),
            ({"start_time": math.inf}, "start_time must be finite"),
            ({"tolerance": 0.0}, r"tolerance must be .*positive"),
            ({"warm_up": -1.0}, "warm_up must be finite and not negative"),
            ({"negative_reward": math.inf}, "negative_reward must be finite"),
            ({"substeps": 0}, "substeps must be a positive integer, got 0"),
            ({"max_episode_steps": "100"}, "max_episode_steps must be a positive integer"),
            ({"on_fault": "ignore"}, "unknown on_fault 'ignore'; known are: 'truncate'"),
            ({"bounds": {"a": (1, -1)}}, r"bounds of 'a' must be \(low, high\) with low < high"),
            ({"bounds": {"a": ("x", 1)}}, "bounds of 'a'"),
            ({"bounds": {"a": (0, math.nan)}}, "bounds of 'a'"),
        ],
    )
    def test_wrong_types_and_ranges(self, changes, match):
        with pytest.raises(ConfigError, match=match):
            EnvConfig.from_dict(probe_config(**changes))

    @pytest.mark.parametrize("config", [None, [], "x", 3])
    def test_no_dict(self, config):
        with pytest.raises(ConfigError, match="config must be a dict"):
            EnvConfig.from_dict(config)

    @pytest.mark.parametrize("key", ["model_input_names", "model_output_names"])
    def test_missing_key(self, key):
        config = probe_config()
        del config[key]
        with pytest.raises(ConfigError, match=f"config key '{key}' is missing"):
            EnvConfig.from_dict(config)

    @in_turn(
        {
            "changes,match": [
                ({"model_input_names": "aa"}, "unknown variable of Probe 'aa'"),
                ({"model_output_names": "mixx"}, "'mixx'; did you mean 'mix'"),
                ({"monitor_names": "stepss"}, "did you mean 'steps'"),
                ({"model_parameters": {"gian": 1}}, "did you mean 'gain'"),
                ({"bounds": {"sun": (0, 1)}}, "'sun'; did you mean 'sum'"),
                (
                    {"bounds": {"seven": (0, 1)}},
                    "unknown input, output or parameter in 'bounds' 'seven'",
                ),
                (
                    {"model_input_names": "mix"},
                    "'mix' cannot be an input: it is a continuous output",
                ),
                (
                    {"model_input_names": "gain"},
                    "'gain' cannot be an input: it is a fixed parameter",
                ),
                ({"model_input_names": "seven"}, "'seven' cannot be an input: it is a constant"),
                ({"model_input_names": "double_gain"}, "cannot be an input: it is a fixed"),
                (
                    {"model_input_names": "label"},
                    "'label' cannot be an input: it is of type String",
                ),
                (
                    {"model_output_names": "label"},
                    "'label' cannot be an output: it is of type String",
                ),
                (
                    {"model_parameters": {"mix": 1}},
                    "'mix' cannot be set: it is a continuous output",
                ),
                ({"model_parameters": {"seven": 8}}, "'seven' cannot be set: it is a constant"),
                ({"model_parameters": {"double_gain": 8}}, "'double_gain' cannot be set"),
                ({"model_parameters": {"label": 8}}, "'label' is a String, got 8"),
                ({"model_parameters": {"leaky": 0.5}}, "'leaky' is a Boolean"),
                ({"model_parameters": {"fault": 1.5}}, "'fault' is of type Int"),
                (
                    {"time_step": None},
                    "config key 'time_step' is missing, and Probe has no default",
                ),
                (
                    {"warm_up": 0.15},
                    "warm_up must be a multiple of the time step of 0.1 s, got 0.15",
                ),
            ],
            "version": MAJOR_VERSIONS,
        }
    )
    def test_what_does_not_fit_the_fmu(self, probe, version, changes, match):
        with pytest.raises(ConfigError, match=match):
            resolved(probe(version), **changes).pool_spec()
