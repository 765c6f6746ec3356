"""Mutated tasks: each is played, or refused with an error that says where the mistake is.

    python tests/tools/fuzz_tasks.py --count 4000 --seed 0

A case takes a task that has every feature, and changes some of its values, keys and expressions. It
is loaded from a dict or from a TOML file, written, read again, and played for some steps. An error
of loading must name a key of the task, and the file if there is one. See ``fuzz_driver.py``.
"""

import contextlib
import copy
import datetime
import math
import sys

import numpy as np
import tomlkit
from fuzz_driver import Case, CaseError, main, require

import fmugym
from fmugym.errors import FMUGymError, FMULoadError, TaskError
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

ODD = (
    *(
        None,
        True,
        False,
        0,
        -1,
        1,
        2.5,
        1e308,
        -1e308,
        math.nan,
        math.inf,
        10**400,
        10**5000,
        "",
        " ",
    ),
    *(
        "x",
        "nan",
        "1e999",
        "1/0",
        "q",
        "angle",
        "15min",
        "-3s",
        "01-15",
        "02-30",
        "0.1.2",
        "a" * 3000,
    ),
    *("(" * 60, "\x00", "\x1b[31m", "é", "lambda: 0", "__import__('os')", "q.__class__", "[1]"),
    *(
        [],
        {},
        [[]],
        [1, "a"],
        ["q", "q"],
        {"distribution": "uniform", "low": 1, "high": 0},
        {"": 1},
    ),
    *({"distribution": "uniform", "low": 0, "high": 1}, {"distribution": "choice", "values": []}),
    *(datetime.date(2024, 1, 15), datetime.time(6), np.float32(2), np.arange(3), np.zeros((2, 2))),
    *(object(), b"x", range(3), (1, 2), {1: 2}, float, 1j),
)
CHARACTERS = "abqTx_ .,+-*/%()<>=!&|^~[]{}'\"0123456789e\n\t#:;"


def paths_of(value, path=()):
    """The keys that lead to each value of a task."""
    items = value.items() if isinstance(value, dict) else ()
    if isinstance(value, list):
        items = enumerate(value)
    for key, item in items:
        yield (*path, key)
        yield from paths_of(item, (*path, key))


def at(task, path):
    for key in path:
        task = task[key]
    return task


def spoil_text(rng, text):
    """Insert, remove or replace a character."""
    place = rng.randrange(len(text) + 1)
    rest = text[place + rng.randrange(2) :]
    return text[:place] + rng.choice(["", rng.choice(CHARACTERS)]) + rest


def mutate(rng, task):
    """Change one thing in a task; returns what."""
    path = rng.choice(list(paths_of(task)))
    parent, key = at(task, path[:-1]), path[-1]
    value, others = parent[key], list(paths_of(task))
    kind = rng.choice(("odd", "odd", "text", "text", "remove", "rename", "copy", "move", "double"))
    if kind == "text" and isinstance(value, str):
        parent[key] = spoil_text(rng, value)
    elif kind == "remove":
        del parent[key]
    elif kind == "rename" and isinstance(parent, dict):
        parent[spoil_text(rng, str(key))] = parent.pop(key)
    elif kind == "copy":
        parent[key] = copy.deepcopy(at(task, rng.choice(others)))
    elif kind == "move" and isinstance(parent, dict):
        parent[str(rng.choice(others)[-1])] = copy.deepcopy(value)
    elif kind == "double" and isinstance(parent, list):
        parent.append(copy.deepcopy(value))
    else:
        parent[key] = copy.deepcopy(rng.choice(ODD))
    return f"{kind} {'.'.join(map(str, path))}"


def is_placed(error, file):
    """Whether an error says where the mistake is: in a file, and under which key."""
    text = str(error)
    if file is not None and not text.startswith((file.name, "the path")):
        return False
    return any(key in text for key in TASK.keys)


def load(task, file):
    try:
        return fmugym.load(task if file is None else file)
    except (TaskError, FMULoadError) as error:
        require(is_placed(error, file), f"the error does not say where: {error}")
        raise
    except FMUGymError as error:
        raise CaseError(f"{type(error).__name__} instead of a TaskError: {error}") from None


def play(task, file):
    """Load a task, write it, and play it."""
    env = load(task, file)
    try:
        written = file.with_name("written.toml") if file is not None else None
        if written is not None:
            env.task.write(written)
            require(fmugym.Task.read(written) == env.task, "another task is read than was written")
        env.action_space.seed(0)
        env.reset(seed=0)
        for _ in range(3):
            observation, reward, *ends, _ = env.step(env.action_space.sample())
            require(np.isfinite(reward), f"a reward of {reward}")
            require(np.isfinite(observation).all(), f"an observation of {observation}")
            if any(ends):
                break
    finally:
        env.close()


def as_file(task, folder):
    """The task as a TOML file; None if no TOML file can hold it."""
    try:
        text = tomlkit.dumps(task)
    except Exception:
        return None
    file = folder / "task.toml"
    file.write_text(text, encoding="utf-8", errors="replace")
    return file


@contextlib.contextmanager
def program():
    """See ``fuzz_driver.run``."""

    def make(rng, folder):
        task = copy.deepcopy(rng.choice((PENDULUM, SWITCHED)))
        changes = [mutate(rng, task) for _ in range(rng.choice((1, 1, 1, 2, 3)))]
        file = as_file(task, folder) if rng.random() < 0.5 else None
        kind = ("pendulum" if "kpis" in task else "house") + (" as a dict" if file is None else "")
        return Case(lambda: play(task, file), kind, changes)

    yield make


if __name__ == "__main__":
    sys.exit(main(program, __doc__))
