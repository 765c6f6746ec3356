"""Mutated tasks: each is played, or refused with an error that names the key and the file."""

import contextlib
import copy
import datetime
import re
from pathlib import Path

import numpy as np
import pytest
import tomlkit
from hypothesis import given
from hypothesis import strategies as st
from odd_values import (
    GROUPS,
    NUMBERS,
    OBJECTS,
    TEXTS,
    Slippery,
    Unspeakable,
    working_or_refused,
)

import fmugym
from fmugym.errors import FMULoadError, TaskError
from fmugym.expressions.language import Expression
from fmugym.task.task_entries import Entry
from fmugym.task.task_keys import TASK

PENDULUM = {
    "version": 1,
    "description": "a pendulum",
    "fmu": {"bundled": "Pendulum", "fmi_version": "2.0"},
    "time_step": "50ms",
    "substeps": 2,
    "episode_length": "1s",
    "warm_up": {"period": "0.2s", "controller": "swing", "cache": False},
    "controllers": {"swing": "hysteresis of=angle setpoint=goal band=5 below=0.01 above=-0.01"},
    "clock": {"from": "12-20", "to": "01-10", "step": "1d", "exclude": "scenarios"},
    "scenarios": {"peak": {"start": "01-05", "length": "2s"}},
    "variables": {
        "angle": {
            "name": "q",
            "unit": "deg",
            "min": -180,
            "max": 180,
            "nominal": 90,
            "noise": 0.1,
            "delay": "0.1s",
            "drop_out": {"probability": 0.1, "value": 0},
            "bias": {"distribution": "normal", "mean": 0, "std": 1},
            "quantum": 0.1,
        },
        "torque": {
            "name": "tau",
            "unit": "N.m",
            "min": -0.01,
            "max": 0.01,
            "rate": 1,
            "saturation": [-0.01, 0.01],
            "description": "of the motor",
        },
        "turning": {"name": "q_dot", "unit": "deg/s", "sample": "mean", "min": -999, "max": 999},
    },
    "parameters": {"q_0": {"distribution": "uniform", "low": -1, "high": 1}, "m": 0.05},
    "data": {
        "price": {"values": [0.2, 0.5], "step": "1h", "interpolation": "previous", "min": 0},
        "load": {"values": [1.0, 2.0, 4.0], "times": [0, 1, 7], "unit": "deg", "period": "10s"},
    },
    "setpoints": {
        "goal": {"schedule": {"06:00": 10, "22:00": 0}, "of": "angle"},
        "wave": {"sine": {"amplitude": 3, "period": "2s"}, "min": -3, "max": 3},
        "steps": {"steps": {"low": 0, "high": 1, "every": "0.2s"}},
        "rise": {"ramp": {"from": 0, "to": 1, "duration": "1s"}, "min": 0, "max": 1},
        "fixed": 3,
    },
    "memory": {"total": {"start": 0, "update": "total + dt * angle", "min": -999, "max": 999}},
    "expressions": {"far": {"expr": "abs(goal_error) / 180", "min": 0, "max": 9}, "v": "turning"},
    "agent": {
        "actions": ["torque"],
        "observations": ["angle", "goal", "goal_error", "wave", "steps", "total", "far"],
        "forecast": {
            "of": ["price", "load"],
            "horizon": "0.4s",
            "step": "0.2s",
            "error": {"std": 0.1},
        },
        "history": {"of": ["angle", "torque"], "length": "0.1s"},
        "rescale": True,
        "normalize": "nominal",
    },
    "reward": {"near": {"expr": "-far", "weight": 2}, "calm": "-abs(previous(angle) - angle)"},
    "costs": {"cost": {"expr": "price * abs(v)", "limit": 10}},
    "kpis": {"worst": {"min": "near"}, "sum": {"sum": "cost * dt_h"}, "both": "worst + sum"},
    "terminated": "abs(angle) > 170",
    "truncated": "elapsed > 5 and not done",
    "config": {"on_fault": "truncate"},
    "foreign": {"max_instances": 3},
}

SWITCHED = {
    "fmu": {"bundled": "House"},
    "time_step": "15min",
    "episode_length": "6h",
    "warm_up": "1h",
    "start_time": "0s",
    "variables": {
        "u": {"levels": [0, 0.5, 1], "min_on": "30min", "min_off": "30min"},
        "T": {"name": "T_op", "unit": "degC", "min": 10, "max": 30},
        "power": {"name": "P", "unit": "kWh", "sample": "integral", "min": 0, "max": 9},
        "gain": {"levels": [0, 1]},
    },
    "inputs": {"T_out": "273.15 + 5 * sin(2 * pi * clock / 86400)"},
    "data": {"sun": {"values": [0, 300], "step": "12h", "unit": "W/m2", "input": "I_sol"}},
    "agent": {"actions": ["u", "gain"], "observations": ["T", "sun"]},
    "reward": "-power if T > 20 else -1 - gain",
}

WORDS = st.sampled_from(
    (
        *("x", "1e999", "1/0", "angle", "15min", "-3s", "01-15", "02-30", "0.1.2", "a" * 3000),
        *("(" * 60, "\x1b[31m", "lambda: 0", "__import__('os')", "q.__class__", "[1]"),
        *({"distribution": "uniform", "low": 1, "high": 0}, {"": 1}, ["q", "q"], [1, "a"], float),
        *({"distribution": "uniform", "low": 0, "high": 1}, {"distribution": "choice"}),
        *(datetime.date(2024, 1, 15), datetime.time(6), np.arange(3)),
    )
)
"""Values that tasks have elsewhere, or nearly have."""

VALUES = WORDS | NUMBERS | TEXTS | GROUPS | OBJECTS
CHARACTERS = "abqTx_ .,+-*/%()<>=!&|^~[]{}'\"0123456789e\n\t#:;"


def paths_of(value, path=()):
    """The keys that lead to each value of a task."""
    items = {dict: lambda: value.items(), list: lambda: enumerate(value)}.get(type(value), tuple)
    for key, item in items():
        yield (*path, key)
        yield from paths_of(item, (*path, key))


def at(task, path):
    for key in path:
        task = task[key]
    return task


def misspelled(draw, text):
    """Insert, remove or replace a character."""
    place = draw(st.integers(0, len(text)))
    end = place + draw(st.integers(0, 1))
    return text[:place] + draw(st.text(CHARACTERS, max_size=1)) + text[end:]


def mutate(draw, task):
    """Change one value or key of a task."""
    paths = list(paths_of(task))
    *path, key = draw(st.sampled_from(paths))
    parent = at(task, path)
    value, other = parent[key], draw(st.sampled_from(paths))
    kinds = ["odd", "odd", "remove", "copy"]
    kinds += ["rename", "move"] if type(parent) is dict else ["double"]
    kinds += ["misspell", "misspell"] if type(value) is str else []
    match draw(st.sampled_from(kinds)):
        case "odd":
            parent[key] = copied(draw(VALUES))
        case "remove":
            del parent[key]
        case "copy":
            parent[key] = copied(at(task, other))
        case "rename":
            parent[misspelled(draw, str(key))] = parent.pop(key)
        case "move":
            parent[str(other[-1])] = copied(value)
        case "double":
            parent.append(copied(value))
        case "misspell":
            parent[key] = misspelled(draw, value)


def copied(value):
    return copy.deepcopy(value) if type(value) in (dict, list) else value


@st.composite
def mutated_tasks(draw):
    """A strategy of tasks with one to three changes."""
    task = copy.deepcopy(draw(st.sampled_from((PENDULUM, SWITCHED))))
    for _ in range(draw(st.sampled_from((1, 1, 1, 2, 3)))):
        mutate(draw, task)
    return task


def load(source):
    """Load a task from a dict or a file; an error must tell where the mistake is."""
    try:
        return fmugym.load(source)
    except (TaskError, FMULoadError) as error:
        text = str(error)
        assert any(key in text for key in TASK.keys), f"no key: {text}"
        if isinstance(source, Path):
            assert text.startswith((source.name, "the path")), f"no file: {text}"
        raise
    except fmugym.FMUGymError as error:
        raise AssertionError(f"{type(error).__name__} instead of a TaskError") from error


def as_file(task):
    """The task as a file, or as it is if no TOML file can hold it."""
    file = Path.cwd() / "task.toml"
    try:
        text = tomlkit.dumps(task)
    except Exception:  # of any kind
        return task
    if re.search(r"\d{1000}", text):
        return task
    file.write_text(text, encoding="utf-8", errors="replace")
    return file


def play(source):
    """Play a task; that of a file is also written, and read again."""
    with contextlib.closing(load(source)) as env:
        if isinstance(source, Path):
            env.task.write("written.toml")
            assert fmugym.Task.read("written.toml") == env.task
        env.action_space.seed(0)
        env.reset(seed=0)
        for _ in range(3):
            observation, reward, *ends, _ = env.step(env.action_space.sample())
            assert np.isfinite(reward)
            assert np.isfinite(observation).all()
            if any(ends):
                break


@pytest.fixture(name="task", params=[PENDULUM, SWITCHED], ids=["pendulum", "house"])
def fixture_task(request):
    return copy.deepcopy(request.param)


def test_a_sound_task_is_played(task, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    play(task)
    file = as_file(task)
    assert file.exists()
    play(file)


@pytest.mark.parametrize("key", ["fmu", "time_step", "variables", "agent", "reward", "zzz"])
@pytest.mark.parametrize("odd", [10**5000, "\x1b[31m", [[]], object(), Unspeakable()], ids=type)
def test_an_odd_value_is_refused_by_its_key(task, key, odd):
    with pytest.raises(TaskError, match=key):
        load(task | {key: odd})


def test_a_number_without_a_text_is_an_expression():
    assert Expression.parse(Slippery(1.5)).text == "1.5"


def test_an_error_without_a_place_is_found(task, monkeypatch):
    monkeypatch.setattr(Entry, "error", lambda self, text: TaskError("something is wrong"))
    with pytest.raises(AssertionError, match="no key"):
        load(task | {"time_step": "soon"})


@given(mutated_tasks(), st.booleans())
def test_a_mutated_task_is_played_or_refused(task, in_file):
    with working_or_refused():
        play(as_file(task) if in_file else task)
