"""FMUs of FMI 1.0 that leave things out: accepted as FMPy accepts them, with the same values."""

import sys

import fmu_tools
import fresh
import pytest
import quirk_table

import fmugym

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="its library is made for Linux")

PARAMETER = 'causality="internal" variability="parameter"'
INPUT = '<Real start="0" min="-1" max="1"/>'
STATE = 'name="y" valueReference="1" causality="output"><Real'
EDITS = {
    "nothing left out": {},
    "no variability": {' variability="parameter"': ""},
    "no causality": {PARAMETER: 'variability="parameter"'},
    "neither": {PARAMETER: ""},
    "causality none": {PARAMETER: 'causality="none" variability="parameter"'},
    "another kind of co-simulation": {"CoSimulation_StandAlone": "CoSimulation_Tool"},
    "no capabilities": {"<Capabilities />": ""},
    "an empty implementation": {
        "<CoSimulation_StandAlone><Capabilities /></CoSimulation_StandAlone>": ""
    },
    "no number of event indicators": {' numberOfEventIndicators="0"': ""},
    "no model name": {' modelName="Zoo"': ""},
    "a start value of a state": {STATE: f'{STATE} start="0.5" fixed="true"'},
    "no start value of an input": {INPUT: '<Real min="-1" max="1"/>'},
    "two variables of one name": {'name="clock"': 'name="calls"'},
    "an alias": {'name="returns"': 'name="returns" alias="alias"'},
    "a direct dependency": {
        f"{STATE} />": f"{STATE} /><DirectDependency><Name>u</Name></DirectDependency>"
    },
}


class LenientEnv(fmugym.FMI1CSEnv):
    def __init__(self, path):
        config = {
            "model_input_names": "u",
            "model_output_names": "y",
            "model_parameters": {"gain": 2.0, "tau": 0.3},
            "time_step": 0.05,
            "bounds": {"u": (-1.0, 1.0)},
        }
        super().__init__(path, config)

    def _is_done(self):
        return False


@pytest.mark.parametrize("case", EDITS)
def test_values_are_those_of_fmpy(tmp_path, case):
    base = quirk_table.quirk_fmu(tmp_path / "base", 1, "well behaved")
    path = fmu_tools.edited_fmu(base, tmp_path / "edited", EDITS[case])
    expected = fresh.play(path, ["y"], [{"u": 0.5}] * 3, 0.05, {"gain": 2.0, "tau": 0.3})
    env = LenientEnv(path)
    env.reset()
    rows = [list(env.state)]
    for _ in range(3):
        env.step([0.5])
        rows.append(list(env.state))
    env.close()
    assert rows == expected


@pytest.mark.parametrize("start", ["true", "1"])
def test_types_need_no_declared_type(tmp_path, start):
    """An Enumeration without items, and a Boolean as number."""
    edits = {' declaredType="Mode"': "", 'start="false"': f'start="{start}"'}
    path = fmu_tools.probe_fmu(tmp_path, 1, edits)
    inputs, outputs = {"mode": 2, "on": 1, "n": 3}, ["mode_out", "on_out", "n_out"]
    expected = fresh.play(path, outputs, [inputs], 0.1)
    config = {"model_input_names": list(inputs), "model_output_names": outputs, "time_step": 0.1}
    env = fmu_tools.PlainEnv(path, config | {"bounds": {"mode": (1, 3)}})
    env.reset()
    assert list(env.state) == expected[0]
    env.step(list(inputs.values()))
    assert list(env.state) == expected[1]
    env.close()
