"""What is gone or has moved warns, for one release, wherever a user may still give it."""

import re
from contextlib import contextmanager

import pytest

import fmugym
from fmugym.archive import ArchiveLimits
from fmugym.config import FOREIGN, EnvConfig
from fmugym.declared.task import Task
from fmugym.declared.task_fmu import fmu_of
from fmugym.retired import RETIRED

every_retired_key = pytest.mark.parametrize("key", RETIRED)
HOUSE = fmugym.bundled_fmu("House")


@contextmanager
def told(key):
    """There is a warning, and it shows the line of this file."""
    match = re.escape(f"{key!r} is gone") + ".*: " + RETIRED[key]
    with pytest.warns(FutureWarning, match=match) as told:
        yield
    assert {warning.filename for warning in told} == {__file__}


@every_retired_key
def test_in_a_config(key):
    names = {"model_input_names": "u", "model_output_names": "y"}
    with told(key):
        assert EnvConfig.from_dict(names | {key: 1}) == EnvConfig.from_dict(names)


@every_retired_key
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


@every_retired_key
def test_in_the_section_system(key):
    with told(key):
        task = Task.of({"system": {"components": {"a": {"bundled": "House"}}, key: 1}})
        system = fmu_of(task)
    assert not hasattr(system, key)


@every_retired_key
def test_in_an_argument_of_a_system(key):
    with told(key):
        fmugym.FMUSystem({"a": HOUSE}, **{key: 1})


MOVED = {
    "probe_timeout": None,
    "call_timeout": 3.0,
    "reset_method": "reset",
    "leak_limit": None,
    "max_instances": 2,
    "licence_wait": 1.5,
    "preload": ("libm.so.6",),
    "archive_limits": ArchiveLimits(max_ratio=3),
}


def test_keys_for_experts_may_stand_where_they_stood_in_a_config():
    assert list(MOVED) == list(FOREIGN.keys)
    names = {"model_input_names": "u", "model_output_names": "y"}
    for key, value in MOVED.items():
        with pytest.warns(FutureWarning, match=rf"'{key}' now stands in the table 'foreign'"):
            old = EnvConfig.from_dict(names | {key: value})
        assert old == EnvConfig.from_dict(names | {"foreign": {key: value}})
        assert getattr(old.foreign, key) == value


def test_keys_for_experts_may_stand_where_they_stood_in_a_task_file(tmp_path):
    old, new = tmp_path / "old.toml", tmp_path / "new.toml"
    new.write_text('[foreign]\nmax_instances = 2\npreload = ["lib/a.so"]\n')
    old.write_text('[config]\nmax_instances = 2\npreload = ["lib/a.so"]\non_fault = "raise"\n')
    with pytest.warns(FutureWarning, match=r"now stands in \[foreign\]") as warned:
        task = Task.read(old)
    assert len(warned) == 2
    assert task.document["foreign"] == Task.read(new).document["foreign"]
    assert task.document["config"] == {"on_fault": "raise"}
    task.write(tmp_path / "written.toml")
    assert Task.read(tmp_path / "written.toml") == task
