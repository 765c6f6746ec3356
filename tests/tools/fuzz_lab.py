"""Odd calls of the simulated lab by the thousand: each must end well or in an error of the lab.

    python tests/tools/fuzz_lab.py --count 4000 --seed 0

A case calls one method of `Client` or `Lab`, or one constructor, and replaces one or two of its
arguments by values of a wrong type, range or shape. A constructor may raise `ConfigError`; a call
may raise `LabError` only. A case also fails if a refused call costs the user something, or if a
cell stays in use. See ``fuzz_driver.py``.
"""

import contextlib
import itertools
import sys
from pathlib import Path

import numpy as np
import odd_values
from fuzz_driver import CaseError, main, of_kinds, require
from odd_values import NUMBERS, Unspeakable

from fmugym import ConfigError
from fmugym.lab import (
    CellType,
    Client,
    Lab,
    LabError,
    ManualClock,
    Options,
    RealClock,
    User,
)
from fmugym.lab.disturbance import (
    StateDependentPositionDisturbance,
    StateDependentTorqueDisturbance,
    TimedPositionDisturbance,
    TimedTorqueDisturbance,
)

USER = "a user's token"


# Odd values


class Unready:
    """A disturbance that fails when it is asked."""

    duration, torque, position = 1.0, (0.01,), None

    def is_due(self, time, position):
        raise ZeroDivisionError("this disturbance is not ready")


class OddClock:
    """A clock that gives an odd time, or fails, from its second answer on."""

    def __init__(self, answer, first=0.0):
        self._answers = itertools.chain([first], itertools.repeat(answer))

    def time(self):
        answer = next(self._answers)
        if isinstance(answer, Exception):
            raise answer
        return answer

    def sleep(self, seconds):
        if seconds < 0:
            raise ZeroDivisionError("this clock cannot go back")


OTHERS = (
    *(
        CellType,
        CellType.SINGLE,
        CellType.DOUBLE,
        Unready(),
        User(),
        Options(),
        {CellType.SINGLE: 1},
    ),
    *([CellType.SINGLE], [CellType.DOUBLE] * 3, (CellType.SINGLE, "single"), [None]),
    *(TimedTorqueDisturbance(0.0, 0.1, (0.01,)), lambda: itertools.repeat(CellType.SINGLE)),
    *(lambda: [Unready()], lambda: itertools.repeat(Unready()), lambda: {USER: Unspeakable()}),
    *(lambda: ManualClock(), lambda: Client),
)


def odd(rng):
    """Draw an odd value, one of the lab's own now and then."""
    return odd_values.odd(rng, OTHERS)


def odd_clock(rng, folder):
    answer = rng.choice((*NUMBERS, "noon", [], Unspeakable(), OSError("no time"), -1.0, 1e300))
    return OddClock(answer, rng.choice((0.0, answer)))


def odd_folder(rng, folder):
    """Draw a folder that cannot be used."""
    blocked = folder / "a file"
    blocked.touch()
    names = (blocked, blocked / "under a file", "\0", "x" * 300, b"bytes", 5, "", folder / "\ud800")
    return rng.choice((*names, str(blocked), Path("/proc/nothing"), "/dev/null/x"))


# Calls of a lab that is at work


class Scene:
    """A lab with a lease, an episode and an experiment, both of them recorded now and then.

    Args:
        rng: What is drawn.
        video_folder: Where videos go.
    """

    def __init__(self, rng, video_folder=None):
        self.lab = Lab(
            "ideal", drive_step=2e-3, clock=ManualClock(), seed=0, video_folder=video_folder
        )
        self.client, self.rng = Client(self.lab), rng
        self.gym = self.client.start_gym(USER, 100, [CellType.SINGLE] * 2)
        kind = rng.choice(("SimplePendulum", "SimplePendulum", "Acrobot"))
        self.joints = 2 if kind == "Acrobot" else 1
        self.experiment, _ = self.client.start_experiment(USER, kind, 20)

    def rights(self):
        """Return what the user has left."""
        info = self.client.get_user_info(USER)
        return info.number_of_attempts, info.bucket_size, info.gym_bucket_size


def start_arguments(scene, owner):
    rng = scene.rng
    options = {
        "preparation_time": 0.1,
        "record": False,
        "initial_state": [0.1],
        "initial_position": [0.1],
        "cell_id": None,
        "disturbances": "default_simple_pendulum",
    }
    chosen = {name: value for name, value in options.items() if rng.random() < 0.5}
    return [owner, "SimplePendulum", 5.0], chosen


def one_token(kind):
    return lambda scene: ([getattr(scene, kind)], {})


def setter(scene):
    return [[0.01] * scene.joints, scene.experiment], {}


CALLS = {
    "get_user_info": lambda scene: ([USER], {}),
    "get_cells": lambda scene: ([USER], {}),
    "start_gym": lambda scene: ([USER, 5.0, [CellType.SINGLE]], {}),
    "stop_gym": one_token("gym"),
    "start_experiment": lambda scene: start_arguments(scene, USER),
    "start_episode": lambda scene: start_arguments(scene, scene.gym),
    "stop_experiment": one_token("experiment"),
    "stop_episode": one_token("experiment"),
    "get_position": one_token("experiment"),
    "get_velocity": one_token("experiment"),
    "get_torque": one_token("experiment"),
    "set_position": setter,
    "set_velocity": setter,
    "set_torque": setter,
    "set_impedance_controller_params": lambda scene: (
        [[0.1] * scene.joints, [0.01] * scene.joints, scene.experiment],
        {},
    ),
    "get_actuator_info": one_token("experiment"),
    "get_logs": one_token("experiment"),
    "view": one_token("gym"),
    "livestream_url": one_token("gym"),
}
FREQUENT = ("start_gym", "start_experiment", "start_episode", "set_torque", "view") * 2


def call(rng, folder):
    """Make one odd call of a client, or of the lab where the client has no such method."""
    scene = Scene(rng)
    name = rng.choice((*CALLS, *FREQUENT))
    arguments, options = CALLS[name](scene)
    if name == "view" and rng.random() < 0.5:
        options["render_mode"] = "rgb_array"
    spoil(rng, arguments, options)
    owner = scene.client if hasattr(scene.client, name) else scene.lab
    return scene, lambda: getattr(owner, name)(*arguments, **options)


def spoil(rng, arguments, options):
    """Replace one or two arguments by odd values."""
    places = [*range(len(arguments)), *options]
    for place in rng.sample(places, min(len(places), rng.choice((1, 1, 1, 2)))):
        (options if isinstance(place, str) else arguments)[place] = odd(rng)


def record(rng, folder):
    """Record a session into a folder that cannot be used."""
    try:
        scene = Scene(rng, odd_folder(rng, folder))
    except ConfigError:
        return Scene(rng), lambda: None

    def use():
        token, _ = scene.client.start_experiment(USER, "SimplePendulum", 1, record=True)
        scene.client.stop_experiment(token)

    return scene, use


def odd_call(rng, folder):
    scene, use = rng.choice((call, call, call, call, call, call, call, record))(rng, folder)

    def play():
        before = scene.rights()
        try:
            use()
            scene.client.get_cells(USER)
        except LabError:
            after = scene.rights()
            require(after == before, f"a refused call cost {before} -> {after}")
            raise
        except ConfigError as error:  # only the mode of a view is no request to the lab
            require("render mode" in str(error), f"ConfigError: {error}")
            raise
        finally:
            check_rest(scene)

    return play


def check_rest(scene):
    """Go on with the lab: all cells must come free, and be of use."""
    scene.lab.clock.advance(100.0)
    gym = scene.client.start_gym(USER, 100, [CellType.SINGLE] * 4 + [CellType.DOUBLE] * 2)
    busy = scene.lab.clock.time() > 3800
    token, _ = scene.client.start_episode(gym, "SimplePendulum", 1)
    works = np.isfinite(scene.client.get_position(token))
    scene.lab.close()
    require(not busy, "a cell stayed in use")
    require(works, "a cell is broken")


# Constructors

LAB = {
    "preset": "ideal",
    "speed": 2.0,
    "users": {USER: User()},
    "cells": {CellType.SINGLE: 1},
    "seed": 3,
    "parameters": {CellType.SINGLE: {"l": 0.12}},
}
USERS = {
    "name": "Ada",
    "gym": True,
    "number_of_attempts": 3,
    "max_experiment_length": 5.0,
    "max_bucket_size": 3,
    "refil_interval": 1.0,
    "max_gym_length": 5.0,
    "gym_max_bucket_size": 3,
    "experiment_types": ("SimplePendulum",),
    "valid_for": 100.0,
}
DISTURBANCES = {
    TimedTorqueDisturbance: {"start_time": 0.0, "duration": 0.1, "torque": [0.01]},
    TimedPositionDisturbance: {
        "trigger_time": 0.0,
        "disturbance_position": [0.1],
        "duration": 0.1,
    },
    StateDependentTorqueDisturbance: {
        "trigger_position": [0.0],
        "duration": 0.1,
        "torque": [0.01],
        "tolerance": 0.1,
        "earliest": 0.0,
    },
    StateDependentPositionDisturbance: {
        "trigger_position": [0.0],
        "disturbance_position": None,
        "duration": 0.1,
        "tolerance": 0.1,
        "earliest": 0.0,
    },
}


def construct(rng, folder):
    """Make something of odd arguments; returns keyword arguments for a lab and a session."""
    kind = rng.choice(("lab", "lab", "option", "option", "user", "disturbance", "clock", "folder"))
    if kind == "lab":
        options = {name: LAB[name] for name in LAB if rng.random() < 0.3}
        options[rng.choice(tuple(LAB))] = odd(rng)
        return options, {}
    if kind == "option":
        names = [*Options.__dataclass_fields__, "heart_beat"]
        return {rng.choice(names): rng.choice((odd, odd_pair))(rng)}, {}
    if kind == "user":
        return {"users": {USER: User(**USERS | {rng.choice(tuple(USERS)): odd(rng)})}}, {}
    if kind == "disturbance":
        cls = rng.choice(tuple(DISTURBANCES))
        arguments = DISTURBANCES[cls]
        spoiled = arguments | {rng.choice(tuple(arguments)): odd(rng)}
        return {}, {"disturbances": rng.choice((cls(**spoiled), [cls(**spoiled)]))}
    if kind == "clock":
        return {
            "clock": rng.choice((odd_clock, real_clock, manual_clock, any_clock))(rng, folder)
        }, {}
    return {"video_folder": rng.choice((odd_folder(rng, folder), odd(rng)))}, {"record": True}


def odd_pair(rng):
    return rng.choice((odd(rng), 0.1)), rng.choice((odd(rng), 0.1))


def real_clock(rng, folder):
    return RealClock(odd(rng))


def manual_clock(rng, folder):
    return ManualClock(odd(rng))


def any_clock(rng, folder):
    return odd(rng)


def odd_lab(rng, folder):
    """Make a lab of odd arguments, and use it."""

    def play():
        try:
            options, session = construct(rng, folder)
            lab = Lab(**{"preset": "ideal", "clock": ManualClock(), **options})
        except LabError as error:
            raise CaseError(f"LabError of a constructor: {error}") from error
        with contextlib.closing(lab):
            live(lab, session)

    return play


def live(lab, session):
    """Use a lab that was made of odd arguments."""
    client = Client(lab)
    client.get_user_info(USER)
    token, _ = client.start_experiment(USER, "SimplePendulum", 0.5, **session)
    for _ in range(3):
        if isinstance(lab.clock, ManualClock):  # a real one may be slow beyond all measure
            lab.clock.sleep(0.01)
        client.set_torque(0.01, token)
        client.get_position(token)
    client.get_logs(token)
    client.stop_experiment(token)
    lab.view(client.start_gym(USER, 0.5, [CellType.SINGLE]))


def odd_client(rng, folder):
    return lambda: Client(odd(rng))


program = of_kinds((odd_lab, odd_client, *(odd_call,) * 6))


if __name__ == "__main__":
    sys.exit(main(program, __doc__))
