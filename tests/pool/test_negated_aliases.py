"""Negated aliases of FMI 1.0: the value behind the value reference, with the other sign."""

from contextlib import closing
from functools import partial

import numpy as np
import pytest
from exchange_tools import exchange_fmu
from fmu_tools import PlainEnv, edited_fmu, probe_config, probe_fmu
from pool_tools import open_pool, reset
from system_tools import system

import fmugym
from fmugym import FMU, bundled_fmu
from fmugym.control.linearization import linearize_along
from fmugym.fmi.systems.system import SystemFMU
from fmugym.fmi.systems.system_plan import ComponentPlan
from fmugym.pool.pool_form import form_of_listing

ALIASES = (
    ("minus_a", 0, "input", "continuous", '<Real start="0" min="-3" max="1"/>'),
    ("minus_sum", 11, "output", "continuous", '<Real min="-2" max="9"/>'),
    ("minus_gain", 20, "internal", "parameter", '<Real start="-2"/>'),
    ("minus_n", 100, "input", "discrete", '<Integer start="0" min="-5" max="4"/>'),
    ("minus_n_out", 110, "output", "discrete", "<Integer/>"),
    ("off", 200, "input", "discrete", '<Boolean start="true"/>'),
    ("off_out", 210, "output", "discrete", "<Boolean/>"),
    ("same_mode", 300, "input", "discrete", '<Enumeration declaredType="Mode" start="1"/>'),
)
INPUTS = ["minus_a", "minus_n", "off"]
OUTPUTS = ["sum", "minus_sum", "n_out", "minus_n_out", "on_out", "off_out"]
OPTIONS = {
    "native": {"backend": "native"},
    "process": {"isolation": "process", "workers": 2},
    "fmpy": {"backend": "fmpy"},
    "system": {"backend": "native"},
}


def aliased_fmu(folder):
    extra = "".join(
        f'<ScalarVariable name="{name}" valueReference="{reference}" causality="{causality}" '
        f'variability="{variability}" alias="negatedAlias">{inside}</ScalarVariable>'
        for name, reference, causality, variability, inside in ALIASES
    )
    return probe_fmu(folder, 1, {"</ModelVariables>": f"{extra}</ModelVariables>"})


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    return aliased_fmu(tmp_path_factory.mktemp("aliases"))


def system_of(path):
    parts = ComponentPlan("plant", path), ComponentPlan("other", bundled_fmu("Pendulum"))
    return SystemFMU(system(parts, ()))


@pytest.mark.parametrize("kind", OPTIONS)
def test_the_values_of_every_pool(path, opened, kind):
    is_system = kind == "system"
    fmu, prefix = (system_of(path), "plant.") if is_system else (FMU(path), "")
    names = [[f"{prefix}{name}" for name in some] for some in (INPUTS, OUTPUTS)]
    pool = opened(open_pool(fmu, *names, 0.1, 3, OPTIONS[kind]))
    outputs, statuses = reset(pool, {f"{prefix}minus_gain": -2.0})
    assert not np.any(statuses)
    for _ in range(10):
        outputs, statuses = pool.step(np.array([[-1.0, 0, 2], [3, 0, -2], [1, 0, 0]]))
        assert not np.any(statuses)
    expected = [[2, 0, -4], [-2, 0, 4], [-3, 0, 2], [3, 0, -2], [0, 1, 1], [1, 0, 0]]
    np.testing.assert_allclose(outputs, expected, atol=1e-9)
    assert not np.signbit(outputs[outputs == 0]).any()


def test_its_attributes_are_its_own(path):
    """The schema says that the value is negated; limits and start values are of the variable."""
    about = FMU(path).description
    variable = about.variable("minus_gain")
    assert variable.negated
    assert variable.start_number == -2
    assert about.variable("minus_a").range == (-3, 1)
    assert about.variable("minus_n").integer_limits == (-(2**31) + 1, 2**31)
    assert not about.variable("a").negated


def test_a_type_without_a_negation_is_told(path):
    fmu = FMU(path)
    assert not fmu.description.variable("same_mode").negated
    assert "'same_mode' is a negated alias of type Enumeration" in " ".join(fmu.findings)


def test_an_alias_of_the_same_sign_changes_nothing(tmp_path):
    path = probe_fmu(tmp_path, 1, {'name="sum" ': 'name="sum" alias="alias" '})
    assert not FMU(path).description.variable("sum").negated


def test_both_signs_are_different_variables_of_a_list(path):
    about = FMU(path).description
    both = [form_of_listing([about.variable(name)], 1) for name in ("sum", "minus_sum")]
    assert both[0] != both[1]


@pytest.mark.parametrize("isolation", ["none", "process"])
def test_of_an_environment(path, isolation):
    """Limits of the action, a mean over substeps, a snapshot and the parameters of an episode."""
    config = probe_config(
        model_input_names="minus_a",
        model_output_names=["sum", "minus_sum"],
        substeps=2,
        samplings={"minus_sum": "max"},
        model_parameters={"minus_gain": -1.0},
    )
    with PlainEnv(path, config, isolation=isolation) as env:
        assert env.action_space.low == -3
        assert env.action_space.high == 1
        env.reset(options={"model_parameters": {"minus_gain": -4.0}})
        first, *_ = env.step([-0.5])
        np.testing.assert_allclose(first, [0.2, -0.1], atol=1e-6)
        snapshot = env.save_state()
        second, *_ = env.step([-0.5])
        np.testing.assert_allclose(second, [0.4, -0.3], atol=1e-6)
        env.restore_state(snapshot)
        again, *_ = env.step([-0.5])
        np.testing.assert_array_equal(again, second)


@pytest.fixture(scope="module")
def solved(tmp_path_factory):
    """The FMU of dahlquist for model exchange, with the opposites of its input and its state."""
    folder = tmp_path_factory.mktemp("solved")
    source = exchange_fmu(folder / "Model.fmu", "dahlquist", 1)
    extra = "".join(
        f'<ScalarVariable name="{name}" valueReference="{reference}" causality="{causality}" '
        f'variability="continuous" alias="negatedAlias"><Real {start}/></ScalarVariable>'
        for name, reference, causality, start in (
            ("minus_u", 2, "input", 'start="0"'),
            ("minus_x", 0, "output", ""),
        )
    )
    ends = {"</ModelVariables>": f"{extra}</ModelVariables>"}
    return edited_fmu(source, folder / "edited", ends)


def solved_env(path, name):
    config = {"model_input_names": name, "model_output_names": ["x", "minus_x"]}
    return PlainEnv(path, config | {"time_step": 0.1, "bounds": {name: (-1, 1)}})


def test_of_model_exchange(solved):
    rows = []
    for name, value in (("u", 0.5), ("minus_u", -0.5)):
        with solved_env(solved, name) as env:
            env.reset()
            rows += [env.step([value])[0] for _ in range(5)][-1:]
    np.testing.assert_array_equal(rows[0], rows[1])
    np.testing.assert_array_equal(rows[0][0], -rows[0][1])
    assert rows[0][0] != 1


def test_of_linear_models(solved):
    found = []
    for name in ("u", "minus_u"):
        with closing(fmugym.FMUVectorEnv(partial(solved_env, solved, name), 2)) as envs:
            envs.reset(seed=0)
            actions, start = np.zeros((3, 1), np.float32), envs.save_state(0)
            found.append(linearize_along(envs, start, actions, states=["x"]))
    np.testing.assert_allclose(found[0].B, -found[1].B, rtol=1e-6)
    assert abs(found[0].B).min() > 0.05
