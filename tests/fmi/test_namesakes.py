"""Names that several variables of one FMU have: who uses one is told, others notice nothing."""

import numpy as np
import pytest
from exchange_tools import exchange_fmu
from fmu_tools import PlainEnv, edited_fmu, probe_config, probe_fmu
from pool_tools import open_pool, start, step
from system_tools import system

import fmugym
from fmugym import FMU, ConfigError, bundled_fmu
from fmugym.fmi.systems.system import SystemFMU
from fmugym.fmi.systems.system_plan import ComponentPlan

TWICE = {"sum": 14, "mix": 13, "a": 3, "gain": 23, "trim": 12, "x[2]": 11}
"""Names, and other value references behind them."""

REFUSED = "is the name of 2 variables of Probe"


def twin_fmu(folder, version, names=tuple(TWICE)):
    """The probe with more variables whose names are taken; ``x`` is an array by its names."""
    if version == 3:
        made = '<Float64 name="{}" valueReference="{}" causality="local"/>'
    else:
        causality = "internal" if version == 1 else "local"
        made = f'<ScalarVariable name="{{}}" valueReference="{{}}" causality="{causality}"><Real/>'
        made += "</ScalarVariable>"
    rows = [(name, TWICE[name]) for name in names]
    rows += [("x[1]", 10), ("x[2]", 13)] if "x[2]" in names else []
    extra = "".join(made.format(*row) for row in rows)
    return probe_fmu(folder, version, {"</ModelVariables>": f"{extra}</ModelVariables>"})


@pytest.mark.parametrize("version", [1, 2, 3])
def test_a_name_that_a_config_uses(tmp_path, version):
    path = twin_fmu(tmp_path, version)
    for changes in (
        {"model_input_names": "a"},
        {"model_output_names": "sum"},
        {"model_output_names": "x"},
        {"model_output_names": "x[2]"},
        {"monitor_names": "mix"},
        {"model_parameters": {"gain": 2.0}},
    ):
        sound = {"model_input_names": "b", "model_output_names": "free_out"}
        with pytest.raises(ConfigError, match=REFUSED):
            PlainEnv(path, probe_config(**sound | changes))


@pytest.mark.parametrize("version", [1, 2, 3])
def test_a_name_that_nobody_uses(tmp_path, version):
    path = twin_fmu(tmp_path, version, ("mix",))
    with PlainEnv(path, probe_config(model_output_names=["sum", "free_out"])) as env:
        env.reset(seed=0)
        observation, *_ = env.step([1.0])
        assert observation[0] == pytest.approx(0.1)
        for call in (
            lambda: env.reset(options={"model_parameters": {"mix": 1.0}}),
            lambda: env.fmu.variable("mix"),
            lambda: env.fmu.description.find("mix"),
        ):
            with pytest.raises(ConfigError, match=REFUSED):
                call()
    assert "mix" not in FMU(path).description.variables
    assert any("mix" in finding for finding in FMU(path).findings)


def test_the_states_of_a_model(tmp_path, opened):
    """Equations, whose states have no names of their own, are integrated all the same."""
    source = exchange_fmu(tmp_path / "Model.fmu", "van_der_pol", 2)
    path = edited_fmu(source, tmp_path / "edited", {'name="x2"': 'name="mu"'})
    rows = []
    for one in (source, path):
        pool = start(opened(open_pool(FMU(one), (), ["x1"])))
        rows += [[step(pool) for _ in range(5)]]
    np.testing.assert_array_equal(*rows)
    assert FMU(path).description.derivatives == {"x1": "der(x1)"}


TASK = """
fmu = {{ path = {path!r} }}
time_step = 0.1
parameters = {{ {parameters} }}
reward = "{reward}"

[variables]
load = {{ name = "{name}", min = -1, max = 1 }}

[agent]
actions = ["load"]
observations = ["{observations}"]
"""
SOUND = {"parameters": "", "reward": "-b", "name": "c", "observations": "free_out"}


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("parameters", "gain = 1.0"),
        ("reward", "-mix"),
        ("reward", "-sum"),
        ("name", "a"),
        ("observations", "sum"),
    ],
)
def test_a_name_that_a_task_uses(tmp_path, key, value):
    path = twin_fmu(tmp_path, 2)
    file = tmp_path / "task.toml"
    text = TASK.replace("{{ path = {path!r} }}", "{path!r}")
    file.write_text(text.format(path=str(path), **SOUND))
    fmugym.load(file).close()
    file.write_text(text.format(path=str(path), **SOUND | {key: value}))
    with pytest.raises(ConfigError, match=REFUSED) as caught:
        fmugym.load(file)
    lines = enumerate(file.read_text().splitlines(), 1)
    number = next(i for i, one in lines if f"{key} =" in one)
    assert str(caught.value).startswith(f"task.toml, line {number}, ")


def test_of_a_component(tmp_path):
    parts = (
        ComponentPlan("plant", twin_fmu(tmp_path, 2)),
        ComponentPlan("other", bundled_fmu("Pendulum")),
    )
    about = SystemFMU(system(parts, ())).description
    assert about.variable("plant.b").causality == "input"
    with pytest.raises(ConfigError, match=r"'plant\.sum' is the name of 2 variables"):
        about.variable("plant.sum")
