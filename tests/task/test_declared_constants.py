"""Expressions of constants in the places of numbers, as the docs promise."""

import json

import pytest

import fmugym
from fmugym import TaskError
from fmugym.keys import Either, Entries, Kind, Listed, Table
from fmugym.task.task_keys import SCHEMA, TASK

NUMERIC = {"number", "integer"}


def kinds_in(kind, path=()):
    """Each kind of a value, with the keys that lead to it."""
    match kind:
        case Kind():
            yield ".".join(path), kind
        case Listed() | Entries():
            yield from kinds_in(kind.kind, (*path, "*"))
        case Either():
            yield from kinds_in(kind.table, path)
            yield from kinds_in(kind.other, path)
        case Table():
            for name, key in kind.keys.items():
                yield from kinds_in(key.kind, (*path, name))


def is_numeric(kind):
    types, title = kind.schema.get("type", ""), kind.schema.get("title", "")
    types = {types} if isinstance(types, str) else {*types}
    parts = title.replace(",", " ").split()
    is_other = title in ("text, number", "expression") or "text" in parts or "list" in parts
    return bool(types & NUMERIC or {"number", "time"} & set(parts)) and not is_other


NUMBERS = {name: kind for name, kind in kinds_in(TASK) if is_numeric(kind)}


def test_each_key_of_a_number_takes_one():
    for name, kind in NUMBERS.items():
        text, number = ("1/4", 0.25) if "probability" in name else ("6/2 - 1", 2)
        assert kind.check("it", text) == number, name
        with pytest.raises(fmugym.ConfigError):
            kind.check("it", "1/0")


def test_all_sections_have_such_keys():
    sections = {name.partition(".")[0] for name in NUMBERS}
    expected = "system time_step substeps episode_length variables setpoints memory plant config"
    assert {*expected.split(), "foreign", "clock", "agent", "data", "costs"} <= sections


@pytest.mark.parametrize("name", ["levels", "saturation", "values", "times"])
def test_lists_of_numbers_take_some(name):
    kinds = [kind for path, kind in kinds_in(TASK) if path.endswith(f".{name}")]
    assert kinds
    for kind in kinds:
        assert [*kind.check(name, ["1/4", "3 - 1"])] == [0.25, 2]


def task(**changes):
    return {
        "fmu": {"bundled": "Pendulum"},
        "time_step": "1/60",
        "reward": "-abs(q)",
        "variables": {"tau": {"min": "-1/10", "max": "1/10"}},
        "agent": {"actions": "tau", "observations": "q"},
        **changes,
    }


def test_a_step_of_a_sixtieth():
    env = fmugym.load(
        task(
            substeps="6/3",
            episode_length="2 - 1",
            config={"stop_time": "2 * 60", "fault_reward": "-1/4", "fault_retries": "1 + 1"},
            foreign={"max_instances": "2 + 1", "licence_wait": "1/2"},
            parameters={"m": {"distribution": "choice", "values": ["1/20", 0.1]}},
        )
    )
    config = env.config
    assert config.time_step == 1 / 60
    assert (config.substeps, config.max_episode_steps, config.fault_retries) == (2, 60, 2)
    assert (config.stop_time, config.fault_reward) == (120.0, -0.25)
    assert (config.foreign.max_instances, config.foreign.licence_wait) == (3, 0.5)
    assert config.model_parameters["m"].values == (0.05, 0.1)
    env.close()


def test_times_of_a_clock():
    env = fmugym.load(task(clock="60 * 60 - 1", episode_length="1s"))
    assert env.config.episode_variables["clock"] == 3599
    env.close()


@pytest.mark.parametrize(
    ("key", "value", "fact"),
    [
        ("time_step", "1/0", "'1/0' is no finite number"),
        ("time_step", "1 - 2", "not negative"),
        ("time_step", "1 parsec", "15min"),
        ("time_step", "q", "15min"),
        ("substeps", "5/2", "positive integer, got 2.5"),
        ("clock", "15-04", "01-15"),
    ],
)
def test_others_are_refused(key, value, fact):
    with pytest.raises(TaskError, match=f"{key}.*{fact}"):
        fmugym.load(task(**{key: value}))


def test_editors_know_it():
    schema = json.loads(SCHEMA.read_text())["properties"]
    assert {"string", "integer"} <= set(schema["substeps"]["type"])
