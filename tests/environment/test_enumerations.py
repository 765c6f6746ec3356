"""Enumerations: what a task, a class or an option writes is one of the items."""

import re

import fmu_tools
import numpy as np
import pytest
from fmu_tools import PlainEnv
from gymnasium.spaces import Discrete, MultiDiscrete

import fmugym
from fmugym.errors import ConfigError, TaskError

ITEMS = "1 (slow), 2 (fast), 5 (turbo)"

MODE = {"actions": "mode", "observations": "mode_out"}
OTHER = {"actions": "a", "observations": "mode_out"}


@pytest.fixture
def task(tmp_path):
    fmu = fmu_tools.probe_fmu(tmp_path, 2)
    return {"fmu": str(fmu), "time_step": 0.1, "reward": "-sum", "agent": OTHER}


def schedule(**values):
    return {"schedule": dict(zip(("06:00", "08:00"), values.values(), strict=True))}


WRONG = {
    "levels": ("variables.mode.levels", 3, {"variables": {"mode": {"levels": [1, 3]}}}),
    "an expression": ("inputs.mode", 3, {"inputs": {"mode": "1 + 2"}}),
    "a branch": ("inputs.mode", 4, {"inputs": {"mode": "2 if sum > 1 else 4 if sum > 0 else 5"}}),
    "an expression of names": (
        "inputs.mode",
        3,
        {"expressions": {"m": "a if a > 2 else 3"}, "inputs": {"mode": "m"}},
    ),
    "data": (
        "data.m.input",
        3,
        {"data": {"m": {"values": [1, 2, 3], "step": "1h", "input": "mode"}}},
    ),
    "a schedule": (
        "inputs.mode",
        4,
        {"setpoints": {"m": schedule(a=1, b=4)}, "inputs": {"mode": "m"}},
    ),
    "a set point": ("inputs.mode", 3, {"setpoints": {"m": 3}, "inputs": {"mode": "m"}}),
    "a drawn set point": (
        "inputs.mode",
        3,
        {
            "setpoints": {"m": {"distribution": "choice", "values": [1, 3]}},
            "inputs": {"mode": "m"},
        },
    ),
    "memory": ("inputs.mode", 3, {"memory": {"m": 3}, "inputs": {"mode": "m"}}),
    "levels of another action": (
        "inputs.mode",
        4,
        {
            "variables": {"go": {"levels": [1, 4]}},
            "agent": {**OTHER, "actions": "go"},
            "inputs": {"mode": "go"},
        },
    ),
    "a parameter": ("parameters.mode", 3, {"parameters": {"mode": 3}}),
    "a drawn parameter": (
        "parameters.mode",
        3,
        {"parameters": {"mode": {"distribution": "choice", "values": [1, 3]}}},
    ),
    "a warm-up": (
        "warm_up.controller",
        3,
        {"agent": MODE, "warm_up": {"period": 1, "controller": 3}},
    ),
    "a hysteresis": (
        "warm_up.controller",
        3,
        {
            "agent": MODE,
            "warm_up": {
                "period": 1,
                "controller": "hysteresis of=sum setpoint=1 band=1 below=3 above=1",
            },
        },
    ),
    "a schedule of a warm-up": (
        "warm_up.controller",
        4,
        {"agent": MODE, "warm_up": {"period": 1, "controller": "schedule 00:00=1 08:00=4"}},
    ),
}


@pytest.mark.parametrize(("key", "number", "changes"), WRONG.values(), ids=WRONG)
def test_a_task_that_writes_another_number_is_refused(task, key, number, changes):
    changes = {"agent": MODE, **changes} if key == "variables.mode.levels" else changes
    with pytest.raises(TaskError) as caught:
        fmugym.load({**task, **changes})
    for fact in (f"{key}:", f"expected one of {ITEMS}", f"got {number}"):
        assert fact in str(caught.value)


@pytest.mark.parametrize("levels", [[5, 1], [1, 2, 5]])
def test_levels_are_items(task, levels):
    with_levels = {"variables": {"mode": {"levels": levels}}, "agent": MODE}
    env = fmugym.load({**task, **with_levels})
    env.reset(seed=0)
    for place, level in enumerate(levels):
        env.step(place)
        assert env.read_variables("mode") == {"mode": level}
    env.close()


@pytest.mark.parametrize(
    ("name", "levels", "fact"),
    [("n", [1, 2.5], "got 2.5"), ("on", [0.2, 1], "'on' is a Boolean, got 0.2")],
)
def test_levels_of_integers_and_booleans_are_such(task, name, levels, fact):
    agent = {"actions": name, "observations": "sum"}
    with pytest.raises(TaskError, match=f"variables.{name}.levels.*{fact}"):
        fmugym.load({**task, "variables": {name: {"levels": levels}}, "agent": agent})


def test_expressions_of_items_are_taken(task):
    env = fmugym.load({**task, "inputs": {"mode": "2 if a > 0 else 5"}})
    env.reset(seed=0)
    for action, item in ((0.5, 2), (-0.5, 5)):
        env.step(np.float32([action]))
        assert env.read_variables("mode") == {"mode": item}
    env.close()


class Chooser(PlainEnv):
    """An environment whose action is what is written."""

    space = Discrete(3, start=1)

    def _get_action_space(self):
        return self.space


class Two(Chooser):
    space = MultiDiscrete([6, 2])


@pytest.mark.parametrize(("cls", "number"), [(Chooser, 3), (Two, 0)])
def test_a_class_whose_choices_are_others_is_refused(make_env, cls, number):
    with pytest.raises(ConfigError, match=f"expected one of 1 .slow.*got {number}"):
        make_env(cls=cls, model_input_names=["mode", "n"][: len(cls.space.shape) + 1])


def test_a_class_whose_choices_are_items_is_taken(make_env):
    class Slow(Chooser):
        space = Discrete(2, start=1)

    env = make_env(cls=Slow, model_input_names="mode", model_output_names="mode_out")
    env.reset(seed=0)
    env.step(2)
    assert env.read_variables("mode") == {"mode": 2.0}


def test_options_are_checked(make_env):
    env = make_env(model_output_names="mode_out")
    with pytest.raises(ConfigError, match=f"{re.escape(ITEMS)}, got 3"):
        env.reset(options={"model_parameters": {"mode": 3}})
