"""FMUs that give no units, wrong ones, or differences: one unit of a variable, wherever it is used.

The reference is the house whose model description has all units.
"""

import json
import logging
import math
import re
import tomllib
from dataclasses import replace

import numpy as np
import pytest
import values_tools
from fmu_tools import edited_fmu, read_fmu, write_fmu

import fmugym
from fmugym.cli.task_proposal import Proposal
from fmugym.cli.validation import validate
from fmugym.deployment.plant.tags import read_plant
from fmugym.envs.house import HOUSE_TASK
from fmugym.records.log_fit import fit_logs
from fmugym.records.plant_log import PlantLog
from fmugym.task.likely_units import likely_unit, require_units, unit_within
from fmugym.training.sb3_training import TrainingSettings, train
from fmugym.training.search.probe import Probe

UNITS = {
    "T": {"fmu_unit": "K"},
    "T_floor": {"fmu_unit": "K"},
    "T_start": {"fmu_unit": "K"},
    "power": {"fmu_unit": "W"},
    "outside": {"name": "T_out", "fmu_unit": "K"},
    "u": {"min": 0, "max": 1},
}


def without_units(folder, version="2.0"):
    """The bundled house as exporters write it that know neither units nor limits."""
    files = read_fmu(fmugym.bundled_fmu("House", version))
    xml = files["modelDescription.xml"].decode()
    head, rest = xml.split("<ModelVariables>")
    head = re.sub(r"<UnitDefinitions>.*</UnitDefinitions>", "", head, flags=re.DOTALL)
    rest = re.sub(r'\s(unit|displayUnit|nominal|min|max)="[^"]*"', "", rest)
    assert 'unit="' not in rest
    files["modelDescription.xml"] = f"{head}<ModelVariables>{rest}".encode()
    return write_fmu(folder / "House.fmu", files)


class Endless(fmugym.FMI2CSEnv):
    def _is_done(self):
        return False


def house(fmu=None, **changes):
    own = {} if fmu is None else {"fmu": str(fmu)}
    return fmugym.load({"extends": str(HOUSE_TASK), **own, **changes})


def played(env, steps=30):
    env.action_space.seed(0)
    rows = [env.reset(seed=3)[0]]
    rewards = []
    for _ in range(steps):
        observation, reward, *_ = env.step(env.action_space.sample())
        rows.append(observation)
        rewards.append(reward)
    env.close()
    return np.array(rows), np.array(rewards)


class TestConversion:
    @pytest.mark.parametrize("version", ["2.0", "3.0"])
    def test_is_that_of_an_fmu_with_units(self, tmp_path, version):
        """Outputs, means, forecasts, parameters, data that inputs get, rewards."""
        one = played(house(without_units(tmp_path, version), variables=UNITS))
        other = played(house())
        np.testing.assert_allclose(one[0], other[0], rtol=1e-6)
        np.testing.assert_allclose(one[1], other[1], rtol=1e-9)

    def test_of_a_vector_environment(self, tmp_path):
        path = without_units(tmp_path)
        one = fmugym.FMUVectorEnv(lambda: house(path, variables=UNITS), 3)
        other = fmugym.FMUVectorEnv(house, 3)
        for first, second in zip(one.reset(seed=2)[0], other.reset(seed=2)[0], strict=True):
            np.testing.assert_allclose(first, second, rtol=1e-6)
        one.close()
        other.close()

    def test_of_monitors_actions_and_set_points(self, tmp_path):
        def environment(fmu, **more):
            task = {
                "fmu": fmu,
                "time_step": "15min",
                "variables": {
                    "T_a": {"name": "T_air", "unit": "degC", **more},
                    "T_o": {"name": "T_out", "unit": "degC", "min": -10, "max": 30, **more},
                    "T": {"name": "T_op", "unit": "degC", **more},
                },
                "setpoints": {"T_set": {"value": 21, "of": "T"}},
                "agent": {"actions": ["T_o"], "observations": ["T", "T_set_error"]},
                "reward": "-abs(T_set - T_a)",
            }
            return fmugym.load(task)

        one = environment(str(without_units(tmp_path)), fmu_unit="K")
        other = environment({"bundled": "House"})
        assert one.action_space == other.action_space
        for first, second in zip(played(one), played(other), strict=True):
            np.testing.assert_allclose(first, second, rtol=1e-6, atol=1e-5)

    def test_of_sensors(self, tmp_path):
        sensors = {"T": {"bias": 1.0, "quantum": 0.5, "saturation": [15, 25]}}
        variables = {name: one | sensors.get(name, {}) for name, one in UNITS.items()}
        one = played(house(without_units(tmp_path), variables=variables))
        other = played(house(variables=sensors))
        np.testing.assert_allclose(one[0], other[0], rtol=1e-6)

    def test_holds_for_all_names_of_a_variable(self, tmp_path):
        names = UNITS | {"T_again": {"name": "T_op", "unit": "degC"}}
        env = house(
            without_units(tmp_path), variables=names, reward="abs(T_again - T) + T_op - T - 273.15"
        )
        _, rewards = played(env)
        np.testing.assert_allclose(rewards, 0.0, atol=1e-9)

    def test_of_ranges_of_a_fit_and_of_columns_of_a_log(self, tmp_path):
        path, times = without_units(tmp_path), 900.0 * np.arange(8)
        log = PlantLog(
            times,
            {
                "T": 20.0 + times / 9000.0,
                "u": times % 1800.0 / 900.0,
                **{name: np.full(8, value) for name, value in (("T_out", 5), ("I_sol", 0))},
                "Q_int": np.full(8, 300.0),
            },
            {"T": "degC", "T_out": "degC"},
            np.zeros(8),
        )
        values = [
            fit_logs(make, [log], {"T_start": (18, 24)}, candidates=2).values
            for make in (lambda: house(path, variables=UNITS), house)
        ]
        assert 291 <= values[0]["T_m_0"] <= 298
        assert values[0] == pytest.approx(values[1])

    def test_of_tags_of_a_plant(self, tmp_path):
        plant = {
            "address": "127.0.0.1:502",
            "protocol": "modbus",
            "tags": {
                "T": {"register": 0, "type": "float64", "unit": "K"},
                "power": {"register": 4, "type": "float64", "unit": "W"},
            },
        }
        with house(without_units(tmp_path), variables=UNITS, plant=plant) as env:
            own = read_plant(env).tags
        with house(plant=plant) as env:
            other = read_plant(env).tags
        assert own.keys() == {"T", "power"}
        for name, tag in own.items():
            assert tag.conversion(300.0) == pytest.approx(other[name].conversion(300.0))
            assert tag.to_task(300.0) == pytest.approx(other[name].to_task(300.0))

    @pytest.mark.parametrize("given", [500.0, [500.0, 250.0]])
    def test_of_an_array_at_the_start(self, tmp_path, given):
        path = values_tools.state_space_fmu(tmp_path / "S.fmu")
        variables = {"u": {"min": -1, "max": 1}, "start": {"name": "x_0"}}
        task = {
            "fmu": str(path),
            "time_step": 1.0,
            "variables": variables | {"start": {"name": "x_0", "unit": "mm", "fmu_unit": "m"}},
            "parameters": {"start": given},
            "agent": {"actions": ["u[1]"], "observations": ["y[1]"]},
            "reward": "1",
        }
        env = fmugym.load(task)
        env.reset(seed=0)
        assert env.parameters["x_0"].tolist() == (np.array(given) / 1000 * np.ones(2)).tolist()
        env.close()

    @pytest.mark.parametrize(("version", "tag"), [("2.0", "Real"), ("3.0", "Float64")])
    @pytest.mark.parametrize("place", ["variable", "type"])
    def test_of_differences_has_no_offset(self, tmp_path, version, tag, place):
        """As of a band of 2 K, which is a band of 2 degC."""
        old = 'description="Start value of T_m"'
        files = read_fmu(without_units(tmp_path, version))
        xml = files["modelDescription.xml"].decode()
        start = xml.index('name="T_m_0"')
        flag = 'relativeQuantity="true"' if place == "variable" else 'declaredType="Band"'
        own = xml[start : xml.index("/>", start)]
        where = 'start="293.15"'
        assert old in own
        xml = xml.replace(own, own.replace(where, f"{flag} {where}"))
        band = '<SimpleType name="Band"><Real relativeQuantity="true"/></SimpleType>'
        if version == "3.0":
            band = '<Float64Type name="Band" relativeQuantity="true"/>'
        xml = xml.replace("<TypeDefinitions>", f"<TypeDefinitions>{band}")
        files["modelDescription.xml"] = xml.encode()
        path = write_fmu(tmp_path / "Relative.fmu", files)
        env = house(path, variables=UNITS, parameters={"T_start": 290.0})
        env.reset(seed=0)
        assert env.parameters["T_m_0"] == 290.0
        env.close()

    def test_wins_over_a_unit_of_the_fmu_with_one_line(self, tmp_path, caplog):
        edits = {'<Real unit="K" displayUnit="degC" nominal="300"/>': '<Real unit="degC"/>'}
        path = edited_fmu("House", tmp_path, edits)
        variables = {name: UNITS[name] for name in ("T", "T_floor")}
        with caplog.at_level(logging.WARNING):
            one = played(house(path, variables=variables))
        other = played(house())
        np.testing.assert_allclose(one[0], other[0], rtol=1e-6)
        lines = [record.message for record in caplog.records if "T_op" in record.message]
        assert len(lines) == 1
        assert "K" in lines[0]
        assert "degC" in lines[0]

    def test_of_a_class(self, tmp_path):
        config = {
            "model_input_names": ["u"],
            "model_output_names": ["T_op"],
            "bounds": {"u": (0, 1)},
            "time_step": 900.0,
            "units": {"T_op": "K"},
        }
        env = Endless(without_units(tmp_path), config)
        assert env.fmu.variable("T_op").unit == "K"
        env.close()
        with pytest.raises(fmugym.ConfigError, match="T_op"):
            Endless(without_units(tmp_path), config | {"units": {"T_oq": "K"}})

    @pytest.mark.parametrize(
        "drawn",
        [
            {"distribution": "uniform", "low": 0.05, "high": 0.2},
            {"distribution": "normal", "mean": 0.1, "std": 0.02},
            {"distribution": "log_uniform", "low": 0.05, "high": 0.2},
            {"distribution": "choice", "values": [0.05, 0.1, 0.2]},
        ],
        ids=lambda drawn: drawn["distribution"],
    )
    def test_of_what_is_drawn(self, drawn):
        """In kW/K here; the house has W/K."""
        numbers = {
            name: 1e3 * np.array(value) if name != "distribution" else value
            for name, value in drawn.items()
        }
        unit = {"u": {"min": 0, "max": 1}, "H_ve": {"unit": "kW/K"}}
        found = []
        for variables, given in ((unit, drawn), ({"u": unit["u"]}, numbers)):
            plain = {key: np.asarray(value).tolist() for key, value in given.items()}
            with house(variables=variables, parameters={"H_ve": plain}) as env:
                found.append([env.reset(seed=seed)[1]["drawn"]["H_ve"] for seed in range(5)])
        assert found[0] == pytest.approx(found[1], rel=1e-12)
        assert 40 < min(found[0]) < max(found[0]) < 250


class TestRefusals:
    @pytest.mark.parametrize(
        ("changes", "words"),
        [
            ({"other": {"name": "T_op", "fmu_unit": "degC"}}, ["T_op", "K", "degC"]),
            ({"gain": {"min": 0, "max": 1, "fmu_unit": "K"}}, ["gain", "no variable"]),
            ({"T": {"fmu_unit": "W"}}, ["degC", "W"]),
            ({"T": {"fmu_unit": "Kelwin"}}, ["Kelwin"]),
            ({"T": {"fmu_unit": 7}}, ["fmu_unit"]),
        ],
    )
    def test_name_the_key(self, tmp_path, changes, words):
        with pytest.raises(fmugym.ConfigError) as error:
            house(without_units(tmp_path), variables=UNITS | changes)
        assert all(word in str(error.value) for word in words)

    def test_config_of_a_task_has_no_such_key(self, tmp_path):
        with pytest.raises(fmugym.ConfigError, match="fmu_unit"):
            house(without_units(tmp_path), config={"units": {"T_op": "K"}})


def env_value(task):
    with fmugym.load(task) as env:
        return env.reset(seed=0)[0][0]


class TestSystems:
    def test_variables_of_components_have_units(self, tmp_path):
        components = {"a": str(without_units(tmp_path))}
        temperature = {"name": "a.T_op", "unit": "degC", "min": 10, "max": 40}
        task = {
            "system": {"components": components},
            "time_step": "15min",
            "variables": {"u": {"name": "a.u", "min": 0, "max": 1}, "T": temperature},
            "agent": {"actions": ["u"], "observations": ["T"]},
            "reward": "1",
        }
        with fmugym.load(task) as env, pytest.raises(fmugym.ConfigError, match='fmu_unit = "K"'):
            require_units(env)
        kelvin = env_value(task)
        task["variables"]["T"] = {**temperature, "fmu_unit": "K"}
        assert env_value(task) == pytest.approx(kelvin - 273.15, abs=1e-3)
        with fmugym.load(task) as env:
            require_units(env)

    def test_differences_are_linked_without_an_offset(self, tmp_path):
        """A difference in K drives one in degC."""
        paths = []
        for name, unit in (("A", "K"), ("B", "degC")):
            edits = {
                '<Real unit="K" displayUnit="degC" min="200" max="350" nominal="300" '
                'start="278.15"/>': f'<Real unit="{unit}" relativeQuantity="true" start="3"/>',
            }
            (tmp_path / name).mkdir()
            paths.append(edited_fmu("House", tmp_path / name, edits))
        system = fmugym.FMUSystem(
            components={"a": paths[0], "b": paths[1]},
            connections=[("d", "a.T_out"), ("d", "b.T_out")],
        )
        description = system.as_fmu().description
        ends = description.ends[description.variable("d").value_reference]
        assert [(end.gain, end.offset) for end in ends] == [(1.0, 0.0)] * 2


class TestLikelyUnits:
    @pytest.mark.parametrize(
        ("name", "start", "description", "unit"),
        [
            ("T", "293.15", "", "K"),
            ("TRooMea", "294", "", "K"),
            ("zone.T_air", "280.4", "", "K"),
            ("temperature_out", "300", "", "K"),
            ("x", "298.15", "", "K"),
            ("x", None, "Supply temperature in K", "K"),
            ("x", None, "Supply temperature [degC]", "degC"),
            ("p_in", "101325", "", "Pa"),
            ("pressure", "200000", "", "Pa"),
            ("valve", "45", "", "%"),
            ("RH", "60", "", "%"),
            ("T", "20", "", None),
            ("T", None, "", None),
            ("Torque", "300", "", None),
            ("p", "0.5", "", None),
            ("valve", "0.45", "", None),
            ("n", "300", "", None),
        ],
    )
    def test_by_name_start_and_description(self, name, start, description, unit):
        variable = variable_of(name, start, description)
        assert likely_unit(variable) == unit

    def test_of_a_variable_with_a_unit_there_is_none(self):
        assert likely_unit(replace(variable_of("T", "293.15"), unit="degC")) is None

    @pytest.mark.parametrize(
        ("wanted", "limits", "seen", "unit"),
        [
            ("degC", (10, 30), (292.8, 293.9), "K"),
            ("degC", (10, 30), (288.0, 301.0), "K"),
            ("degC", (-math.inf, 30), (292.8, 293.9), "K"),
            ("K", (283, 303), (18.0, 22.0), "degC"),
            ("bar", (0, 4), (1e5, 2.5e5), "Pa"),
            ("kPa", (80, 120), (101325.0, 101325.0), "Pa"),
            ("1", (0, 1), (0.0, 85.0), "%"),
            ("kW", (0, 5), (0.0, 3500.0), "W"),
            ("degC", (10, 30), (19.0, 31.0), None),
            ("degC", (10, 30), (35.0, 80.0), None),
            ("kW", (0, 5), (0.0, 40.0), None),
            ("EUR", (0, 5), (0.0, 4000.0), None),
        ],
    )
    def test_that_brings_values_within_limits(self, wanted, limits, seen, unit):
        assert unit_within(variable_of("y", None), wanted, limits, seen, {}) == unit


def variable_of(name, start, description=""):
    base = fmugym.FMU(fmugym.bundled_fmu("House")).variable("T_air")
    return replace(base, name=name, start=start, description=description, unit=None)


class TestValidate:
    def report(self, path, **variables):
        task = {
            "fmu": str(path),
            "time_step": "15min",
            "episode_length": "1d",
            "variables": {"u": {"min": 0, "max": 1}, **variables},
            "agent": {"actions": ["u"], "observations": [*variables]},
            "reward": "1",
        }
        return validate(lambda: fmugym.load(task))

    def test_refuses_limits_that_outputs_contradict(self, tmp_path):
        path = without_units(tmp_path)
        declared = {"name": "T_op", "unit": "degC", "min": 10, "max": 40}
        report = self.report(path, T=declared)
        assert report.verdict == "error"
        (error,) = [one for one in report.findings if one.verdict == "error"]
        assert error.check == "units"
        assert "T " in error.text
        assert 'fmu_unit = "K"' in error.cure
        assert not any("widen" in one.cure for one in report.findings)
        report = self.report(path, T=declared | {"fmu_unit": "K"})
        assert not [one for one in report.findings if one.check == "units"]

    @pytest.mark.parametrize(
        ("name", "declared", "unit"),
        [
            ("T_op", {"unit": "degC", "min": 10}, None),
            ("T_op", {"unit": "degC", "max": 60}, "K"),
            ("T_op", {"unit": "degF", "min": 40, "max": 110}, "K"),
            ("T_out", {"unit": "1", "min": 0, "max": 10}, "%"),
            ("P", {"unit": "kW", "min": 0, "max": 10}, "W"),
            ("E", {"unit": "kWh", "min": 0, "max": 200}, "J"),
        ],
    )
    def test_of_other_quantities(self, tmp_path, name, declared, unit):
        """A start temperature of 278 stands for a number of per cent here."""
        report = self.report(without_units(tmp_path), seen=declared | {"name": name})
        errors = [one for one in report.findings if one.verdict == "error"]
        assert [f'fmu_unit = "{unit}"' in one.cure for one in errors] == [True] * bool(unit)

    def test_proposes_a_unit_of_what_looks_like_kelvin(self, tmp_path):
        report = self.report(without_units(tmp_path), T={"name": "T_op", "unit": "degC"})
        (found,) = [one for one in report.findings if one.check == "units"]
        assert (found.verdict, 'fmu_unit = "K"' in found.cure) == ("warning", True)

    def test_proposes_a_unit_where_the_task_has_none(self, tmp_path):
        report = self.report(without_units(tmp_path), T={"name": "T_op"})
        (found,) = [one for one in report.findings if one.check == "units"]
        assert (found.verdict, 'fmu_unit = "K"' in found.cure) == ("ok", True)

    def test_says_nothing_of_limits_that_fit(self, tmp_path):
        declared = {"name": "T_op", "min": 280, "max": 320, "unit": "K"}
        report = self.report(without_units(tmp_path), T=declared)
        assert not [one for one in report.findings if one.check == "units"]

    def test_never_refuses_for_a_start_value(self, tmp_path):
        """A declared start value is often only a default."""
        declared = {"T": {"name": "T_op"}, "T_o": {"name": "T_out", "unit": "degC", "max": 40}}
        path = without_units(tmp_path)
        task = {
            "fmu": str(path),
            "time_step": "15min",
            "episode_length": "1d",
            "variables": {"u": {"min": 0, "max": 1}, **declared},
            "data": {"weather": {"values": [5.0], "step": "1d", "unit": "degC", "input": "T_o"}},
            "agent": {"actions": ["u"], "observations": ["T"]},
            "reward": "1",
        }
        findings = validate(lambda: fmugym.load(task)).findings
        assert {one.verdict for one in findings if one.check == "units"} == {"warning"}

    def test_refuses_trainings_too(self, tmp_path):
        declared = {"name": "T_op", "unit": "degC", "min": 10, "max": 40}
        task = {
            "fmu": str(without_units(tmp_path)),
            "time_step": "15min",
            "episode_length": "1d",
            "variables": {"u": {"min": 0, "max": 1}, "T": declared},
            "agent": {"actions": ["u"], "observations": ["T"]},
            "reward": "-abs(T - 21)",
        }
        with pytest.raises(fmugym.ConfigError, match='fmu_unit = "K"'):
            Probe.of(lambda: fmugym.load(task), 2, print)
        pytest.importorskip("stable_baselines3", reason="needs the extra test-sb3")
        settings = TrainingSettings(lambda: fmugym.load(task), {}, tmp_path / "agent", steps=5000)
        with pytest.raises(fmugym.ConfigError, match='fmu_unit = "K"'):
            train(settings)
        assert not (tmp_path / "agent").exists()


class TestNew:
    def test_proposes_units_by_names_and_starts(self, tmp_path):
        files = read_fmu(without_units(tmp_path))
        xml = files["modelDescription.xml"].decode()
        assert 'description="Temperature of the outside air"' in xml
        xml = xml.replace('description="Temperature of the outside air"', "")
        xml = xml.replace('name="T_out"', 'name="T_supply"')
        files["modelDescription.xml"] = xml.encode()
        fmu = fmugym.FMU(write_fmu(tmp_path / "Supply.fmu", files))
        proposal = Proposal(fmu, tmp_path)
        text = proposal.text()
        task = tomllib.loads(text)
        assert task["variables"]["T_supply"]["fmu_unit"] == "K"
        assert any("T_supply" in note and "K" in note for note in proposal.notes())
        env = fmugym.load(task | {"fmu": str(fmu.path)})
        assert env.fmu.variable("T_supply").unit == "K"
        env.close()

    def test_proposes_units_by_descriptions(self, tmp_path):
        edits = {
            '<Real unit="K" displayUnit="degC" nominal="300"/>': "<Real/>",
            "Operative temperature inside": "Operative temperature in K",
        }
        text = Proposal(fmugym.FMU(edited_fmu("House", tmp_path, edits))).text()
        assert tomllib.loads(text)["variables"]["T_op"] == {"fmu_unit": "K"}

    def test_a_temperature_without_a_start_is_like_others(self, tmp_path):
        """As exporters write outputs: they are calculated."""
        fmu = fmugym.FMU(without_units(tmp_path))
        variables = tomllib.loads(Proposal(fmu).text())["variables"]
        assert {name for name, one in variables.items() if one.get("fmu_unit") == "K"} == {
            *("T_air", "T_op", "T_m", "T_w")
        }
        edits = {'start="293.15"': 'start="20"'}
        (tmp_path / "degC").mkdir()
        other = fmugym.FMU(edited_fmu(fmu.path, tmp_path / "degC", edits))
        variables = tomllib.loads(Proposal(other).text())["variables"]
        assert not any("fmu_unit" in variables.get(name, {}) for name in ("T_air", "T_op"))

    def test_proposes_none_where_the_fmu_has_units(self):
        assert "fmu_unit" not in Proposal(fmugym.FMU(fmugym.bundled_fmu("House"))).text()


@pytest.mark.parametrize(
    "command",
    [
        ("validate",),
        ("simulate", "--steps", "3", "--action", "0.5"),
        ("evaluate", "--episodes", "1", "--steps", "3", "--action", "0.5"),
        ("tune", "pid of=T setpoint=21 kp=0.01..1", "--rounds", "1", "--steps", "3"),
    ],
    ids=lambda command: command[0],
)
def test_the_command_line_refuses(tmp_path, cli, command):
    path = without_units(tmp_path)
    (tmp_path / "task.toml").write_text(
        f"""fmu = {json.dumps(str(path))}
time_step = "15min"
episode_length = "1d"
reward = "-abs(T - 21)"
variables.T = {{ name = "T_op", unit = "degC", min = 10, max = 40 }}
variables.u = {{ min = 0, max = 1 }}
agent = {{ actions = ["u"], observations = ["T"] }}
"""
    )
    name, *options = command
    code, out, err = cli(name, tmp_path / "task.toml", *options)
    assert code == 1
    assert 'fmu_unit = "K"' in out + err
