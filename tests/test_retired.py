"""What is gone does nothing but warn, for one release, wherever a user may still give it."""

import re
from contextlib import contextmanager

import pytest

import fmugym
from fmugym.declared.systems import system_of
from fmugym.declared.task import Task
from fmugym.retired import RETIRED

pytestmark = pytest.mark.parametrize("key", RETIRED)
HOUSE = fmugym.bundled_fmu("House")


@contextmanager
def told(key):
    """There is a warning, and it shows the line of this file."""
    match = re.escape(f"{key!r} is gone") + ".*: " + RETIRED[key]
    with pytest.warns(FutureWarning, match=match) as told:
        yield
    assert {warning.filename for warning in told} == {__file__}


def test_in_a_config(key):
    names = {"model_input_names": "u", "model_output_names": "y"}
    with told(key):
        assert fmugym.EnvConfig.from_dict(names | {key: 1}) == fmugym.EnvConfig.from_dict(names)


def test_in_a_task_file(key, tmp_path):
    file = tmp_path / "task.toml"
    file.write_text(
        f"""
        fmu = {{ bundled = "House" }}
        time_step = "1h"
        reward = "-T"

        [config]
        {key} = 1

        [variables]
        T = {{ name = "T_air" }}
        u = {{ name = "u" }}

        [agent]
        actions = ["u"]
        observations = ["T"]
        """
    )
    with told(key):
        env = fmugym.load(file)
    assert not hasattr(env.config, key)
    env.close()


def test_in_the_section_system(key):
    task = Task.of({"system": {"components": {"a": {"bundled": "House"}}, key: 1}})
    with told(key):
        system = system_of(task.root.child("system"))
    assert not hasattr(system, key)


def test_in_an_argument_of_a_system(key):
    with told(key):
        fmugym.FMUSystem({"a": HOUSE}, **{key: 1})
